"""Forces and tractions that follow paths in time:

* the momentum of a free body is the integrator's own quadrature of the load, and the oracle's deformation that of each step;
* a constant path gives the bits of a constant load; a batch of explicit sub-steps gives what single steps give;
* statics take the loads of their time; energies are those of the present time, and the check of energy knows of the work;
* `set_force` and `set_traction` replace a path by a value; checkpoints resume bitwise before and after that;
* scene files hold key frames; refined scenes keep paths; the plan and the digests tell loads apart;
* paths that fail or give other shapes are refused in one sentence.
"""

import numpy as np
import pytest

import taisoft as ts
from taisoft.dynamics.schemes import EXPLICIT, IMPLICIT
from taisoft.errors import SceneError
from taisoft.scene.fingerprint import scene_digest
from taisoft.scene.refine import refined, with_order
from tests.dynamics.scenes import SNH, cube, dynamics, rubber
from tests.scene.toml_scenes import there_and_back

DT, STEPS = 1e-3, 12
RAMP = ts.KeyFrames((0.0, 0.004, 0.02), [(0, 0, 0), (60, -20, 10), (10, 40, -30)], smooth=True)
INTEGRATORS = [*EXPLICIT, *IMPLICIT]


def push(t: float) -> np.ndarray:
    return np.array([80 * np.sin(300 * t), 20 - 3e3 * t, 5.0])


def free_body(force, order: int = 1, ground: bool = False, held: bool = False) -> ts.Scene:
    scene = ts.Scene(gravity=(0, 0, 0))
    body = scene.add_body(cube(cells=(2, 1, 1)), rubber(), name="body", order=order)
    body.add_force(lambda X: X[:, 0] > 0.49, force)
    if held:
        body.fix(lambda X: X[:, 0] < -0.49)
    if ground:
        scene.add_obstacle(ts.HalfSpace((0, -9, 0), (0, 1, 0)))
    return scene


def simulator(scene: ts.Scene, integrator: str, **settings) -> ts.Simulator:
    tight = {} if integrator in EXPLICIT else {"newton_tolerance": 1e-12, "linear_tolerance": 1e-12}
    return ts.Simulator(scene, dt=DT, integrator=integrator, precision="f64", **tight, **settings)


def momenta(integrator: str) -> np.ndarray:
    """Momentum (STEPS + 1, 3) [N s] of a free body from rest, by the integrator's formula for M v' = F(t)."""
    F, p = [push(k * DT / 2) for k in range(2 * STEPS + 1)], [np.zeros(3)]  # of half steps
    for n in range(STEPS):
        start, middle, end = F[2 * n : 2 * n + 3]
        if integrator == "bdf2" and n:
            p.append((4 * p[n] - p[n - 1] + 2 * DT * end) / 3)
            continue
        mean = {"symplectic_euler": start, "velocity_verlet": (start + end) / 2, "implicit_midpoint": middle}.get(integrator, end)
        p.append(p[n] + DT * mean)
    return np.array(p)


@pytest.mark.parametrize("ground", [False, True])
@pytest.mark.parametrize("integrator", INTEGRATORS)
def test_momentum_is_the_quadrature_of_the_load(integrator, ground):
    if ground and integrator == "implicit_midpoint":
        pytest.skip("takes no contacts")
    wanted = momenta(integrator)
    with simulator(free_body(push, ground=ground), integrator) as sim:
        mass = sim.scene.bodies[0].mass
        for n in range(STEPS):
            sim.step()
            # the lumped mass is uniform enough only in the mean: weigh by it
            v, weights = sim.velocities(), lumped(sim)
            assert weights @ v == pytest.approx(wanted[n + 1], rel=1e-9, abs=1e-12 * mass)
        if integrator in EXPLICIT:
            sim.reset()
            sim.advance(5)
            sim.advance(STEPS - 5)
            assert lumped(sim) @ sim.velocities() == pytest.approx(wanted[-1], rel=1e-9)


def lumped(sim: ts.Simulator) -> np.ndarray:
    from taisoft.fem.reference import lumped_masses

    return lumped_masses(sim.scene)


@pytest.mark.parametrize("integrator", ["symplectic_euler", "velocity_verlet", "implicit_euler"])
@pytest.mark.parametrize("ground", [False, True])
def test_a_constant_path_gives_the_same_bits(integrator, ground):
    results = []
    for force in ((30.0, -10.0, 5.0), lambda t: (30.0, -10.0, 5.0), ts.KeyFrames((0.0,), [(30.0, -10.0, 5.0)])):
        with simulator(free_body(force, ground=ground, held=True), integrator) as sim:
            sim.advance(7)
            sim.advance(6)
            results.append((sim.positions(), sim.velocities(), sim.reactions(), sim.energies().loads))
    for other in results[1:]:
        assert all(np.array_equal(a, b) for a, b in zip(results[0], other))


@pytest.mark.parametrize("integrator", EXPLICIT)
def test_batches_equal_single_steps(integrator):
    results = []
    for batches in ([1] * STEPS, [5, STEPS - 5]):
        with simulator(free_body(RAMP, held=True), integrator) as sim:
            for n in batches:
                sim.advance(n)
            results.append((sim.positions(), sim.velocities(), sim.reactions()))
    assert np.abs(results[0][0] - results[1][0]).max() < 1e-14 and np.abs(results[0][1] - results[1][1]).max() < 1e-12
    assert results[0][2] == pytest.approx(results[1][2], rel=1e-9, abs=1e-9) and np.abs(results[0][1]).max() > 1e-4


@pytest.mark.parametrize("integrator", EXPLICIT)
def test_parallel_kernels_give_the_same(integrator):
    results = []
    for serial in (True, False):
        with dynamics(free_body(RAMP, held=True), dt=DT, integrator=integrator, precision="f64") as made:
            made.stepper.simulation.model = _with_serial(made.state.model, serial)
            made.advance(STEPS)
            results.append(made.state.state())
    assert all(np.abs(a - b).max() < 1e-12 for a, b in zip(*results))


def _with_serial(model, serial: bool):
    from dataclasses import replace

    return replace(model, serial=serial)


def test_a_tractions_path_is_a_force_of_the_area():
    results = []
    for name, value in (("add_traction", lambda t: (0, 1e4 * t, 0)), ("add_force", lambda t: (0, 1e4 * t * 0.99, 0))):
        scene = ts.Scene(gravity=(0, 0, 0))
        body = scene.add_body(cube(), rubber(), name="body")
        where = (lambda X: X[:, 0] > 0.49) if name == "add_traction" else (lambda X: np.ones(len(X), dtype=bool))
        getattr(body, name)(where, value)
        with simulator(scene, "implicit_euler") as sim:
            sim.step()
            results.append(lumped(sim) @ sim.velocities())
    assert results[0] == pytest.approx(results[1], rel=1e-6, abs=1e-9) and results[0][1] > 0


def test_forces_per_node_may_follow_paths():
    scene = ts.Scene(gravity=(0, 0, 0))
    body = scene.add_body(cube(), rubber(), name="body")
    rows = np.random.default_rng(0).standard_normal((3, 3))
    body.add_force([5, 2, 7], lambda t: (1 + 1e3 * t) * rows)
    body.add_force([5], (0, 0, 0.25))
    with simulator(scene, "implicit_euler") as sim:
        sim.step()
        assert lumped(sim) @ sim.velocities() == pytest.approx(DT * (2 * rows.sum(axis=0) + (0, 0, 0.25)), rel=1e-6)


def test_statics_take_the_loads_of_their_time():
    scene, same = free_body(RAMP, held=True, order=2), free_body(RAMP(0.003)[0], held=True, order=2)
    assert np.array_equal(ts.solve_static(scene, time=0.003).positions(), ts.solve_static(same).positions())
    assert np.abs(ts.solve_static(scene).positions() - scene.bodies[0].rest_positions).max() < 1e-12
    for time, message in ((np.nan, "time must be finite, not nan"), (None, "time must be a number, not None")):
        with pytest.raises(SceneError, match=f"^{message}$"):
            ts.solve_static(scene, time=time)


@pytest.mark.parametrize("integrator", ["symplectic_euler", "implicit_midpoint"])
def test_energies_are_of_the_present_time(integrator):
    with simulator(free_body(push, held=True), integrator) as sim:
        report = sim.advance(1)
        body, weights = sim.scene.bodies[0], lumped(sim)
        nodes = body.forces[0].nodes
        mean = weights[nodes] @ sim.positions()[nodes] / weights[nodes].sum()
        assert report.loads == pytest.approx(-push(DT) @ mean, rel=1e-12) and sim.energies().loads == report.loads
        sim.reset()
        mean = weights[nodes] @ body.rest_positions[nodes] / weights[nodes].sum()
        assert sim.energies().loads == pytest.approx(-push(0.0) @ mean, rel=1e-12)


def test_the_work_of_a_path_is_no_created_energy():
    """A force that pushes a free body to and fro adds energy without bound."""
    scene = free_body(lambda t: (3e3 * np.sign(np.sin(40 * t)), 0, 0))
    with ts.Simulator(scene, dt=1e-3, integrator="symplectic_euler") as sim:
        assert sim.run(seconds=0.3).status == "ok"


def test_a_drag_acts_beside_paths():
    scene = free_body(lambda t: (0, 30.0, 0))
    for integrator in ("symplectic_euler", "implicit_euler"):
        with simulator(scene.snapshot(), integrator, draggable=True) as sim:
            nodes = sim.scene.bodies[0].forces[0].nodes
            sim.drag("body", nodes, np.ones(len(nodes)), (50.0, 0, 0), 1.0)
            sim.advance(1)
            drag = sim.dragged.force
            assert (
                lumped(sim) @ sim.velocities() == pytest.approx(DT * (drag + (0, 30.0, 0)), rel=1e-6, abs=1e-9) and drag[0] > 1.0
            )
            sim.release()
            before = lumped(sim) @ sim.velocities()
            sim.advance(1)
            assert lumped(sim) @ sim.velocities() - before == pytest.approx([0, 30.0 * DT, 0], rel=1e-6, abs=1e-9)


# --- changes and checkpoints ------------------------------------------------------------------------------------------


@pytest.mark.parametrize("integrator", ["velocity_verlet", "bdf2"])
@pytest.mark.parametrize("replaced", [False, True])
def test_checkpoints_resume_bitwise(tmp_path, integrator, replaced):
    def scene():
        made = free_body(RAMP, held=True)
        made.bodies[0].add_traction([0, 1], ts.KeyFrames((0, 1), [(0, 0, 0), (0, 1e5, 0)]))
        return made

    with simulator(scene(), integrator) as sim:
        sim.advance(4)
        sim.advance(1)
        if replaced:
            sim.set_force("body", 0, (5.0, 6.0, 7.0))
        sim.step()
        sim.save_checkpoint(tmp_path / "c.npz")
        for _ in range(4):
            sim.step()
        wanted = sim.positions(), sim.velocities(), sim.energies().loads
    with ts.Simulator.load_checkpoint(tmp_path / "c.npz", scene()) as sim:
        assert (sim.scene.bodies[0].forces[0].path is None) == replaced
        for _ in range(4):
            sim.step()
        found = sim.positions(), sim.velocities(), sim.energies().loads
    assert all(np.array_equal(a, b) for a, b in zip(wanted, found))
    for force in (ts.KeyFrames((0, 1), [(0, 0, 0), (1, 0, 0)]), (0, 0, 0)):
        other = free_body(force, held=True)
        other.bodies[0].add_traction([0, 1], ts.KeyFrames((0, 1), [(0, 0, 0), (0, 1e5, 0)]))
        with pytest.raises(SceneError, match="differs in body 'body': loads"):
            ts.Simulator.load_checkpoint(tmp_path / "c.npz", other)


@pytest.mark.parametrize("integrator", ["symplectic_euler", "implicit_euler"])
def test_a_value_replaces_a_path(integrator):
    value = (3.0, -4.0, 5.0)
    with simulator(free_body(push), integrator) as sim:
        sim.set_force("body", 0, value)
        sim.advance(1)
        sim.advance(1)
        assert lumped(sim) @ sim.velocities() == pytest.approx(2 * DT * np.array(value), rel=1e-6)
        sim.reset()
        sim.step()
        assert lumped(sim) @ sim.velocities() == pytest.approx(DT * np.array(value), rel=1e-6)
        with pytest.raises(SceneError, match=r"^body 'body': set_force: force 0 must have shape \(3,\) or \(4, 3\), not \(2,\)$"):
            sim.set_force("body", 0, (1.0, 2.0))


# --- copies -----------------------------------------------------------------------------------------------------------


def test_scene_files_hold_key_frames(tmp_path):
    scene = free_body(RAMP)
    scene.bodies[0].add_traction([0, 3], ts.KeyFrames((0, 1 / 3), [(0, 0, 0), (1 / 7, 0, 0)]))
    there_and_back(tmp_path / "a.toml", scene, {"dt": 0.01})
    again = ts.read_scene(tmp_path / "a.toml")[0]
    assert again.bodies[0].forces[0].path(0.003).tolist() == RAMP(0.003)[0].tolist()
    with pytest.raises(SceneError, match="body 'body': has a load along a function, which a file cannot store: use ts.KeyFrames"):
        ts.write_scene(tmp_path / "b.toml", free_body(push))


@pytest.mark.parametrize(
    "old, new, message",
    [
        ("smooth = true", "rotations = [[0, 0, 0], [0, 0, 1], [0, 0, 2]]", "force.*a load has translations only"),
        ("release = false", "release = true", "force.*a load has translations only"),
        ("smooth = true", "smoth = true", r"bodies.body.force\[0\].force.smoth is not known .did you mean smooth"),
        ("times = [0.0, 0.004, 0.02]", "times = [0.0, 0.02, 0.004]", r"bodies.body.force\[0\].force.times must ascend"),
    ],
)
def test_bad_key_frames_of_loads_are_refused(tmp_path, old, new, message):
    path = tmp_path / "a.toml"
    ts.write_scene(path, free_body(RAMP))
    assert old in path.read_text()
    path.write_text(path.read_text().replace(old, new))
    with pytest.raises(SceneError, match=message):
        ts.read_scene(path)


@pytest.mark.parametrize("change", [refined, lambda scene: with_order(scene, 2)], ids=["refined", "order"])
def test_refined_scenes_keep_paths(change):
    scene = free_body(RAMP)
    body = scene.bodies[0]
    body.add_traction(lambda c: c[:, 1] > 0.44, push)
    body.add_force([0, 3], lambda t: t * np.array([(1, 0, 0), (0, 1, 0)]))
    new = change(scene).bodies[0]
    assert [load.path is None for load in new.loads] == [False] * 3 and new.tractions[0].path is push
    assert new.forces[0].path.frames is RAMP and new.forces[1].nodes.tolist() == [0, 3]


def test_the_plan_and_the_digest_tell_paths_apart():
    scenes = [free_body(force) for force in ((0, 0, 0), lambda t: (0, 0, 0), RAMP, ts.KeyFrames((0,), [(0, 0, 0)]))]
    assert len({scene_digest(scene) for scene in scenes}) == 4
    for scene in scenes[:2]:
        with ts.Simulator(scene, dt=DT) as sim:
            assert sim.plan.on["load_paths"] == (scene is not scenes[0])


# --- bad input --------------------------------------------------------------------------------------------------------


def shouts(t: float):
    raise RuntimeError("first\nsecond" + 999 * " third")


BAD = [  # what a path gives, and the message; the force may be (3,) or (3, 3)
    (lambda t: 1 / 0, "the path failed at t = {t}: ZeroDivisionError: division by zero$"),
    (shouts, r"the path failed at t = {t}: RuntimeError: first second third .{{1,100}}\.\.\.$"),
    (lambda t: (1.0, 2.0), r"the path's force at t = {t} must have shape \(3,\).*, not \(2,\)$"),
    (lambda t: (1.0, 2.0, np.nan), r"the path's force at t = {t}: entry \[2\] is nan, not finite$"),
    (lambda t: (1.0, -1e39, 0.0), r"the path's force at t = {t}: entry \[1\] is -1e\+39, too large for a 32-bit float$"),
    (lambda t: ("1", "2", "3"), r"the path's force at t = {t} must be numbers of shape \(3,\).*, not \('1', '2', '3'\)$"),
    (lambda t: (True, False, True), r"the path's force at t = {t} must be numbers"),
    (lambda t: (None, 0.0, 0.0), r"the path's force at t = {t} must be numbers"),
    (lambda t: None, "the path must give a force at t = {t}, not None$"),
]


@pytest.mark.parametrize("path, message", BAD)
def test_bad_values_are_refused_at_any_time_by_the_same_sentence(path, message):
    body = ts.Scene().add_body(cube(), rubber(SNH), name="body")
    with pytest.raises(SceneError, match=f"^body 'body': add_force: {message.format(t=0)}"):
        body.add_force([1, 2, 3], path)
    assert body.forces == []
    for integrator in ("velocity_verlet", "implicit_euler"):
        scene = free_body(lambda t, path=path: (1, 0, 0) if t < 0.0035 else path(t))
        with simulator(scene, integrator) as sim:
            sim.step()
            with pytest.raises(ts.SimulationError, match=f"body 'body': force 0: {message.format(t='0.00[345]')}"):
                for _ in range(9):
                    sim.step()
            assert 0.002 < sim.time < 0.0045 and np.isfinite(sim.positions()).all()


def test_the_shape_of_a_paths_values_cannot_change():
    """A total force cannot become a force for each node."""
    scene = ts.Scene()
    body = scene.add_body(cube(), rubber(SNH), name="body")
    body.fix(lambda X: X[:, 0] < 0)
    body.add_force([1, 2, 3], lambda t: np.ones((3, 3)) if t > 0 else np.ones(3))
    with pytest.raises(
        ts.SimulationError, match=r"body 'body': force 0: the path's force at .* must have shape \(3,\), not \(3, 3\)$"
    ):
        ts.solve_static(scene, time=1.0)


@pytest.mark.parametrize(
    "path, message",
    [
        (ts.KeyFrames((0,), [(0, 0, 0)], release=True), "add_force: force: key frames: a load has translations only"),
        ("north", r"add_force: force must be numbers of shape \(3,\) or \(3, 3\), not 'north'$"),
    ],
)
def test_bad_paths_are_refused(path, message):
    body = ts.Scene().add_body(cube(), rubber(SNH), name="body")
    with pytest.raises(SceneError, match=f"^body 'body': {message}"):
        body.add_force([1, 2, 3], path)
    assert body.forces == []
    with pytest.raises(SceneError, match="loads cannot be set: call body.add_force, body.add_traction or body.add_p"):
        body.loads = []


@pytest.mark.parametrize("integrator", ["symplectic_euler", "velocity_verlet"])
def test_a_path_may_reuse_its_array(integrator):
    """A batch of explicit steps takes each step's own value."""
    reused, ends = np.zeros(3), []

    def reusing(t: float) -> np.ndarray:
        reused[0] = 1e3 * t
        return reused

    for path in (reusing, lambda t: np.array([1e3 * t, 0.0, 0.0])):
        scene = ts.Scene(gravity=(0.0, 0.0, 0.0))
        scene.add_body(ts.box_mesh((1, 1, 1), (1.0, 1.0, 1.0)), ts.Material(young=1e5), name="b").add_force(
            lambda X: X[:, 0] > 0.0, path
        )
        with ts.Simulator(scene, dt=1e-4, integrator=integrator) as sim:
            sim.advance(50)
            ends.append(sim.positions())
    assert np.array_equal(*ends)


# --- failures ---------------------------------------------------------------------------------------------------------


def kick(t: float) -> tuple:
    """A force that no velocity of a light body survives."""
    return (3e38 if t > 5.5 * DT else 0.0, 0.0, 0.0)


def pull_apart(t: float) -> tuple:
    """A displacement too large for a velocity."""
    return (3e37 if t > 5.5 * DT else 0.0, 0.0, 0.0)


@pytest.mark.parametrize("integrator", EXPLICIT)
@pytest.mark.parametrize(
    "drive", [lambda body: body.add_force([0, 3], kick), lambda body: body.move([0, 3], pull_apart)], ids=["load", "target"]
)
def test_the_reason_of_a_failure_is_found_at_the_step_that_failed(integrator, drive):
    message = r"step [67]: body 'body', node [03]: position, velocity or force is no longer finite"
    for n in (1, 10):
        scene = ts.Scene(gravity=(0, 0, 0))
        drive(scene.add_body(cube(), rubber(young=1e-3, density=1e-3), name="body"))
        with simulator(scene, integrator) as sim, pytest.raises(ts.SimulationError, match=message):
            for _ in range(10):
                sim.advance(n)
