"""Error estimates by companions, mostly of stand-ins whose errors are known: in time, of the solvers and of the mesh, by body, at
nodes and so far; what leaves an error unknown is noted; a run of a real simulator goes on as without companions.
"""

import numpy as np
import pytest

import taisoft as ts
from taisoft.errors import SimulationError
from taisoft.estimation.companions import on_mesh, other_mesh, other_steps, tighter
from taisoft.estimation.comparison import Differences
from taisoft.running import run
from taisoft.stability import stable_dt
from tests.dynamics.scenes import cube, rubber
from tests.estimation.stand_in import BDF2, VERLET, StandIn, block, motion

FALLING = motion(frequency=0.0)


def two_blocks(cells=(1, 1, 1), order=1) -> ts.Scene:
    """A block of five tets, and one of 40."""
    scene = block(cells=cells)
    scene.add_body(cube(cells=(2, 2, 2)), rubber(), name="fine", position=(5, 0, 0), order=order)
    return scene


def estimate(sim: StandIn, seconds: float = 1.0, fps: float = 16, **arguments):
    return run(sim, seconds, fps=fps, error=True, **arguments).error_estimate


def test_free_fall_in_steps_of_implicit_euler():
    """x_n = -g dt^2 n (n + 1) / 2: the error at time t is g t dt / 2. Positions err by half of Newton's tolerance, too."""
    kind = motion(frequency=0.0, offset=lambda sim: (0.5 * sim.settings.newton_tolerance * sim.time, 0.0, 0.0))
    sim = kind(two_blocks(), newton_tolerance=1e-3)
    e = estimate(sim)
    assert e.excursion == pytest.approx(5.0 * (1.0 + 1 / 64), rel=1e-6) and e.order == pytest.approx(1.0)
    assert e.time * e.excursion == pytest.approx(5.0 / 64) and e.solver * e.excursion == pytest.approx(0.5e-3)
    assert e.space is None and e.total == pytest.approx(e.time + e.solver) and not e.notes
    assert e.companions == ["dt = 0.03125 s", "dt = 0.0625 s", "tolerances x 0.1"] and set(e.bodies) == {"block", "fine"}
    assert e.bodies["fine"].time == e.time and e.bodies["block"].solver == e.solver
    assert e.energies.gravity == pytest.approx(-10.0 * len(sim.rest) * 5.0 / 64) and e.energies.kinetic == 0.0
    assert len(kind.made) == 4 and all(companion.closed for companion in kind.made[1:]) and not sim.closed


def test_the_largest_difference_of_each_body_up_to_a_time():
    differences, x = Differences(np.array([0, 0, 1])), np.zeros((3, 3))
    for apart in ([1.0, 3.0, 2.0], [2.0, 1.0, 5.0], [0.0, 4.0, 1.0]):
        differences.add(x, x + np.outer(apart, (0.6, 0.0, 0.8)))
    assert differences.largest() == pytest.approx([4.0, 5.0]) and differences.largest(2) == pytest.approx([3.0, 5.0])
    assert differences.squares == pytest.approx([14 / 3, 10.0, 17 / 3]) and differences.map == pytest.approx([0.0, 4.0, 1.0])


def test_few_or_unstable_steps_are_compared_with_half_the_step():
    e = estimate(FALLING(block(), dt=1 / 16), 0.5)
    assert e.companions[0] == "dt = 0.03125 s" and len(e.companions) == 2 and e.order == 1.0
    assert e.time * e.excursion == pytest.approx(5.0 * 0.5 / 16)
    kind = motion(stable_dt=3.9 / 60, offset=lambda sim: (0.0, 9.0 * sim.dt**2 * sim.time, 0.0))  # 4 dt would be unstable
    sim = kind(block(), 1 / 60, VERLET)
    assert [[companion.ratio for companion in other_steps(FALLING(block(), 1 / 60), n)] for n in (31, 32)] == [[0.5], [2, 4]]
    (half,) = other_steps(sim, 32)
    half.follow(3)
    assert (half.ratio, half.sim.step_count, half.sim.time) == (0.5, 6, pytest.approx(0.05))
    assert estimate(sim).order == 2.0


def test_tolerances_of_all_that_is_solved_are_tightened():
    touching, free = block(touching=True), block()
    given = {"newton_tolerance": 1e-3, "linear_tolerance": 1e-2, "contact_tolerance": 1e-4}
    found = tighter(StandIn(touching, **given)).sim.settings
    assert [getattr(found, name) for name in given] == pytest.approx([1e-4, 1e-3, 1e-5])
    default = tighter(StandIn(free)).sim.settings
    assert default.newton_tolerance > 0.0 and default.linear_tolerance is default.contact_tolerance is None
    explicit = tighter(StandIn(touching, integrator=VERLET)).sim.settings
    assert explicit.newton_tolerance is None and explicit.contact_tolerance > 0.0
    assert tighter(StandIn(free, integrator=VERLET)) is None


def test_errors_of_the_mesh():
    """Falls are wrong by h^2. A mesh of h/2 shows that; the other order of elements is taken to have no error."""
    kind = motion(frequency=0.0, width_error=1.0)
    for mesh, errors in (("refined", (1.0, 0.25)), ("order", (0.75, 0.75 * 0.25))):
        e = estimate(kind(two_blocks(), dt=1 / 64), error_mesh=mesh)
        errors = 5.0 * (1.0 + 1 / 64) * 5.0 ** (-2.0 / 3.0) * np.array(errors)
        found = [body.space * e.excursion for body in e.bodies.values()]
        assert found == pytest.approx(errors, rel=1e-6) and e.space == max(body.space for body in e.bodies.values())
        assert e.companions[0] == f"mesh: {mesh}" and e.total == pytest.approx(e.time + e.space + e.solver)
    sim = kind(two_blocks(), 0.8 * stable_dt(two_blocks(), verlet=True), VERLET)
    companion = on_mesh(sim, "refined")[0]  # its steps are stable on its mesh
    assert companion.steps > 1 and companion.steps * companion.sim.dt == pytest.approx(sim.dt)
    assert companion.sim.dt < stable_dt(companion.sim.scene, verlet=True)


def test_errors_at_the_nodes_and_so_far():
    """All kinds are added; in space they are known at the nodes that both meshes share."""
    seen = []

    def look(sim, k, _report):
        seen.append((sim.nodal_errors(), sim.error_so_far))
        if k == 12:
            sim.changes += 1

    kind = motion(width_error=0.1, offset=lambda sim: (0.5 * (sim.settings.newton_tolerance or 0.0) * sim.time, 0.0, 0.0))
    run(kind(two_blocks((2, 2, 2)), newton_tolerance=1e-3), 1.0, look, 16, error=True, error_mesh="refined")
    assert np.isnan(seen[0][0]).all() and seen[0][1].time is None  # before the first comparison
    for errors, e in seen[2:12]:
        sums = [body.time + body.space + body.solver for body in e.bodies.values()]
        assert 0.0 < errors.min() and 0.3 * sums[0] < errors.max() / e.excursion <= 1.001 * max(sums)
    assert np.isnan(seen[13][0]).all()  # after a change


def test_frames_need_not_lie_at_common_steps():
    """Five steps a frame, comparisons at multiples of four: those of the last common step of every frame."""
    frames, sim = [], FALLING(block(), dt=1 / 60)
    e = estimate(sim, 55 / 60, 12, on_frame=lambda sim, *_: frames.append(sim.step_count))
    assert frames == list(range(0, 56, 5)) and e.order == pytest.approx(1.0) and not e.notes
    assert e.time * e.excursion == pytest.approx(5.0 / 60 * 52 / 60)
    assert estimate(sim, 3 / 60, 20).time is not None


def parting(sim) -> np.ndarray:
    """An offset that falls with the step, but after half a second has another sign for twice the step."""
    return np.array([sim.dt**2 if sim.time <= 0.5 else np.cos(np.pi * np.log2(64 * sim.dt)), 0.0, 0.0])


def test_paths_that_part_are_noticed():
    e = estimate(motion(offset=parting)(two_blocks(), 1 / 64, BDF2), 2.0)
    assert e.time is None and 0.4 < e.agree_until < 0.7 and 0.0 < e.time_until_then < 0.1
    assert set(e.spread_after) == {"block", "fine"} and all(spread > 0.1 for spread in e.spread_after.values())
    assert e.solver is None and "part after t = " in e.notes[0] and "solver is unknown, since the paths part" in e.notes[1]
    few = estimate(motion(offset=parting)(block(), 1 / 16, BDF2), 1.0)  # one companion
    assert few.time is None and "with half the step some node is over 10%" in few.notes[0] and few.agree_until <= 0.5


def test_failed_and_unconverged_companions():
    def fails_with(test) -> type[StandIn]:
        def before_step(sim):
            if test(sim) and sim.time > 0.5:
                raise SimulationError("made to fail")

        return motion(before_step=before_step)

    e = estimate(fails_with(lambda sim: sim.dt > 1 / 50)(block()))
    assert e.time is None and e.solver is not None and "dt = 0.03125 s failed: made to fail" in e.notes[0]
    e = estimate(fails_with(lambda sim: sim.settings.newton_tolerance)(block()))
    assert e.notes == ["the error of solver is unknown: its companion (tolerances x 0.1) failed: made to fail"]
    assert e.time > 0.0 and e.solver is None
    e = estimate(motion(unconverged=lambda sim: bool(sim.settings.newton_tolerance))(block()))
    assert e.notes == ["of the companion with tolerances x 0.1, 64 of 64 steps did not converge"] and e.solver is not None


@pytest.mark.parametrize(
    "name, value, note", [("changes", 1, "changed"), ("dt", 1 / 128, "changed"), ("dragged", True, "dragged")]
)
@pytest.mark.parametrize("looks", [False, True])
@pytest.mark.parametrize("when", [5, 16])
def test_changes_leave_the_error_unknown(name, value, note, when, looks):
    """Also after the last comparison, and after a look at the error."""

    def change(sim, k, _report):
        assert not looks or sim.error_so_far is not None
        if k == when:
            setattr(sim, name, value)

    e = estimate(StandIn(block()), on_frame=change)
    assert e.time is e.total is None and note in e.notes[0]


def test_bodies_at_rest_and_short_runs_have_no_relative_error():
    scene = block()
    scene.gravity = (0.0, 0.0, 0.0)
    assert estimate(StandIn(scene)).notes == ["the errors are unknown: nothing moves"]
    stopped = run(StandIn(block()), 1.0, fps=1, error=True, stop=lambda: True).error_estimate
    assert stopped.notes == ["the errors are unknown: the run has fewer than 4 steps"]


def test_meshes_that_cannot_be_compared_are_refused():
    sim, both, faster = StandIn(two_blocks()), StandIn(two_blocks(order=2)), StandIn(two_blocks())
    faster.v = faster.v + (0.0, 0.1, 0.0)  # not as in its scene
    held = two_blocks()
    held.body("block").fix(lambda X: X[:, 0] < 9.0)
    for bad, mesh, message in (
        (sim, "fine", "error_mesh 'fine' is unknown: it must be 'refined' or 'order', or a scene"),
        (both, "order", "the bodies have both orders"),
        (sim, two_blocks(), "body 'block' has 5 tets there and 5 in the run: the mesh widths must differ"),
        (sim, block(), "its bodies are block, and those of the run block, fine"),
        (StandIn(held), "refined", "body 'block': all nodes of both meshes that coincide are constrained"),
        (faster, "refined", "the run must start there"),
    ):
        with pytest.raises(SimulationError, match=message):
            on_mesh(bad, mesh)
    assert {body.order for body in other_mesh(sim, "order").bodies} == {2}
    sim.advance(1)
    with pytest.raises(SimulationError, match=r"the run must start there too: reset\(\)"):
        on_mesh(sim, "refined")
    assert sim.made[-1].closed
    with pytest.raises(SimulationError, match="error_mesh needs error=True"):
        run(sim, 1.0, error_mesh="refined")


def test_a_body_on_another_mesh_may_be_placed_a_little_differently():
    """The error is that of the motion: the same wherever it starts. Farther away it is not the run's."""
    kind, found = motion(frequency=0.0, width_error=1.0), []
    for height in (0.0, 0.005, 0.5):
        moved = block(cells=(2, 2, 2))
        moved.body("block").position = moved.body("block").position + (0.0, height, 0.0)
        if height == 0.5:
            with pytest.raises(SimulationError, match="the scene's bodies are 0.5 m from their places in the run"):
                on_mesh(kind(block()), moved)
        else:
            found.append(estimate(kind(block()), error_mesh=moved).space)
    assert found[0] == pytest.approx(found[1]) and found[0] > 0.0


def test_a_broken_run_releases_its_companions():
    kind = motion()
    with pytest.raises(ZeroDivisionError):
        run(kind(block()), 1.0, lambda *_: 1 / 0, 16, error=True)
    assert [one.closed for one in kind.made] == [False, True, True, True]


def test_a_real_run_goes_on_as_without_companions():
    """From a state in motion. Its error is of the right size, is known at the nodes during the run, and excludes another run."""
    ends, seen = [], []

    def look(sim, k, _report):
        seen.append((sim.nodal_errors("beam"), sim.error_so_far))
        if k == 2:
            with pytest.raises(SimulationError, match="during another one"):
                sim.run(0.1, error=True)

    scene = ts.Scene(gravity=(0.0, -9.8, 0.0))
    body = scene.add_body(ts.box_mesh((2, 1, 1), (2.0, 1.0, 1.0)), rubber(), name="beam")
    fixed = body.rest_positions[:, 0] < -0.99
    body.fix(fixed)
    with ts.Simulator(scene, dt=1 / 120, precision="f64") as sim:
        for error in (False, True):
            sim.reset()
            sim.run(0.2)
            e = sim.run(0.6, fps=30, error=error, on_frame=look if error else None).error_estimate
            ends.append(sim.positions())
        assert sim.error_so_far is None and len(seen) > 2
        with pytest.raises(SimulationError, match="only during"):
            sim.nodal_errors()
        sim.reset()
        space = sim.run(0.2, error=True, error_mesh="refined").error_estimate.space
    assert np.array_equal(*ends) and 0.03 < space < 0.6
    errors, last = seen[-1]
    assert last.time == e.time and (errors[fixed] == 0.0).all() and 0.0 < errors[~fixed].min()
    assert errors.max() <= 1.01 * e.excursion * e.total and 0.005 < e.time < 0.5 and e.solver < 0.01
