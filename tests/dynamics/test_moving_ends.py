"""Connections with ends on obstacles that move:

* a mass on springs follows the closed form of a driven oscillator, with damping relative to the obstacle;
* statics at a time, tendons over a pulley that moves, checkpoints, batches;
* exact attachments to obstacles are fixed or moved nodes, do not touch their obstacle, and have its reaction.
"""

import numpy as np
import pytest

import taisoft as ts
from taisoft.dynamics.schemes import EXPLICIT, IMPLICIT
from taisoft.errors import SceneError, SimulationError
from taisoft.fem.reference import lumped_masses
from tests.collision.rotations import rotation
from tests.dynamics.scenes import cube, rubber
from tests.fem.oracle_springs import shape_row

OMEGA, SPEED, RATE = 20.0, 0.4, 3.0


def simulator(scene: ts.Scene, integrator: str, dt: float, **settings) -> ts.Simulator:
    tight = {} if integrator in EXPLICIT else {"newton_tolerance": 1e-12, "linear_tolerance": 1e-12}
    return ts.Simulator(scene, dt=dt, integrator=integrator, precision="f64", **tight, **settings)


def driven(path, rate: float = 0.0, kind: str = "spring", order: int = 1) -> ts.Scene:
    """A cube each of whose nodes is pulled to a place on an obstacle in proportion to its mass: it moves as a point mass."""
    scene = ts.Scene(gravity=(0, 0, 0))
    scene.contact_forces = False
    body = scene.add_body(cube(), rubber(young=1e6), name="mass", order=order)
    scene.add_obstacle(ts.Sphere((0, 9, 0), 1.0), name="lift", path=path)
    for i, (x, m) in enumerate(zip(body.rest_positions, lumped_masses(scene))):
        if kind == "spring":
            scene.add_spring(("mass", i), ("lift", x), m * OMEGA**2, rest_length=0.0, damping=2 * rate * m)
        else:
            scene.attach("mass", [i], "lift", m * OMEGA**2, 2 * rate * m)
    return scene


@pytest.mark.parametrize("kind", ["spring", "attachment"])
@pytest.mark.parametrize("rate", [0.0, RATE])
@pytest.mark.parametrize("integrator", [*EXPLICIT, *IMPLICIT])
def test_a_driven_oscillator(integrator, rate, kind):
    """x'' = -w^2 (x - V t) - 2 d (x' - V) from rest: x = V t - V exp(-d t) sin(w_d t) / w_d."""
    dt = 2.5e-4
    w_d = np.sqrt(OMEGA**2 - rate**2)
    first_order = integrator in ("symplectic_euler", "implicit_euler", "linearly_implicit_euler")
    with simulator(driven(lambda t: ((SPEED * t, 0, 0), np.eye(3)), rate, kind), integrator, dt) as sim:
        rest = sim.positions()
        for _ in range(5):
            for _ in range(200):
                sim.step()
            moved, t = sim.positions() - rest, sim.time
            exact = SPEED * (t - np.exp(-rate * t) * np.sin(w_d * t) / w_d)
            assert np.abs(moved - moved[0]).max() < 1e-7
            assert moved[0, 0] == pytest.approx(exact, abs=(0.03 if first_order else 1e-3) * SPEED / OMEGA)
        assert not sim.energies().loads and moved[0, 0] > 0.05


def test_batches_follow_the_same_path():
    path, ends = lambda t: ((0.2 * np.sin(9 * t), 0, 0), rotation((0, 0, 1), 3 * t)), []
    for batched in (True, False):
        with simulator(driven(path, RATE), "symplectic_euler", 1e-4) as sim:
            if batched:
                sim.run(seconds=0.02, fps=100)
            else:
                for _ in range(200):
                    sim.step()
            ends.append(sim.positions())
    assert np.abs(ends[0] - ends[1]).max() < 1e-12 and np.abs(ends[0] - cube().vertices).max() > 0.01


def test_statics_at_a_time():
    """The springs pull the body to where the obstacle is then, turned with it and without stress."""
    turn, shift = rotation((1.0, 2.0, -0.5), 1.1), np.array([0.3, -0.2, 0.4])
    centre = np.array([0.0, 9.0, 0.0])
    scene = driven(lambda t: (t * shift, np.eye(3) if t < 1 else turn))
    result = ts.solve_static(scene, time=1.0, tolerance=1e-9)
    expected = (cube().vertices - centre) @ turn.T + centre + shift
    assert result.converged and np.abs(result.positions() - expected).max() < 1e-6


def test_a_displaced_start_counts():
    """Points of an obstacle are given where they are at the start, whatever its path says there."""
    turn = rotation((0.0, 0.0, 1.0), 0.5)
    scene = driven(lambda t: ((3.0 + t, 0, 0), turn))
    with simulator(scene, "implicit_euler", 1e-3) as sim:
        sim.step()
        assert np.abs(sim.positions() - cube().vertices).max() < 1e-3
    spring = scene.springs[0]
    assert spring.points[1].position == pytest.approx(cube().vertices[0])


@pytest.mark.parametrize("stiffness", [None, 1e6])
def test_a_pulley_lifts_a_load(stiffness):
    lift = ts.KeyFrames((0.0, 0.4), translations=[(0, 0, 0), (0, 0.3, 0)], smooth=True)
    scene = ts.Scene()
    scene.contact_forces = False
    body = scene.add_body(cube(), rubber(young=1e6, mass_damping=20.0), name="load")
    scene.add_obstacle(ts.Sphere((0, 5, 0), 1.0), name="pulley", path=lift)
    scene.add_obstacle(ts.HalfSpace((0, 99, 0), (0, -1, 0)), name="wall")
    line = [("load", (0, 0.45, 0)), ("pulley", (0.0, 4.0, 0.0)), ("pulley", (1.0, 4.0, 0.0)), ("wall", (1.0, 1.0, 0.0))]
    scene.add_tendon(line, length=3.55 + 1.0 + 3.0, stiffness=stiffness, name="line")
    weight = body.mass * 9.81
    with simulator(scene, "implicit_euler", 1 / 120) as sim:
        for _ in range(150):
            report = sim.step()
            assert report.converged, report.problems
        extension = 0.0 if stiffness is None else weight / stiffness
        top = shape_row(body, np.array([0.0, 0.45, 0.0])) @ sim.positions()
        assert top[1] == pytest.approx(0.45 + 2 * 0.3 - extension, abs=1e-4)  # its other side has the same length more
        assert sim.joint_force("line") == pytest.approx(weight, rel=2e-3)


def test_a_path_that_fails_stops_the_run():
    scene = driven(lambda t: ((0, 0, 0), np.eye(3)) if t < 2.5e-3 else 1 / 0)
    for integrator in ("symplectic_euler", "implicit_euler"):
        with (
            simulator(scene, integrator, 1e-3) as sim,
            pytest.raises(SimulationError, match="obstacle 'lift': the path must give"),
        ):
            for _ in range(5):
                sim.step()


@pytest.mark.parametrize("integrator", ["velocity_verlet", "implicit_euler", "bdf2"])
def test_checkpoints_resume_bitwise(tmp_path, integrator):
    path = ts.KeyFrames((0.0, 0.02), translations=[(0, 0, 0), (0.1, 0, 0)])
    with simulator(driven(path, RATE), integrator, 1e-3) as sim:
        for k in range(8):
            if k == 4:
                sim.save_checkpoint(tmp_path / "c.npz")
            sim.step()
        wanted = sim.positions(), sim.joint_force("spring0")
    with ts.Simulator.load_checkpoint(tmp_path / "c.npz", driven(path, RATE)) as sim:
        for _ in range(4):
            sim.step()
        assert np.array_equal(sim.positions(), wanted[0]) and sim.joint_force("spring0") == wanted[1] != 0.0


# --- exact attachments to obstacles ---------------------------------------------------------------------------------------


def carried(exact: bool, path=None, contact: bool = False) -> ts.Scene:
    """A bar whose end is attached to a box that moves, or moved along the same path."""
    scene = ts.Scene()
    scene.contact_forces = contact
    bar = scene.add_body(ts.box_mesh((4, 1, 1), (1.0, 0.2, 0.2)), rubber(young=3e5), name="bar", position=(0.5, 0, 0))
    scene.add_obstacle(ts.Box((-0.1, 0, 0), (0.15, 0.2, 0.2)), name="hand", path=path)  # the bar's end is inside

    def end(X):
        return X[:, 0] < -0.49

    if exact:
        scene.attach("bar", end, "hand", name="grip")
    elif path is None:
        bar.fix(end)
    else:
        X = bar.rest_positions[end(bar.rest_positions)] + bar.position
        hand = scene.obstacle("hand")
        bar.move(end, lambda t: hand.points_at(t, hand.undisplaced(0.0, X)) - X)
    return scene


TURN = ts.KeyFrames((0.0, 0.2), translations=[(0, 0, 0), (0.1, 0.2, 0)], rotations=[(0, 0, 0), (0.3, 0.0, 0.5)], smooth=True)


@pytest.mark.parametrize("path", [None, TURN], ids=["at rest", "moving"])
@pytest.mark.parametrize("integrator", ["velocity_verlet", "implicit_euler"])
def test_an_exact_attachment_is_a_constraint(integrator, path):
    found = []
    for exact in (True, False):
        with simulator(carried(exact, path), integrator, 2e-4 if integrator in EXPLICIT else 5e-3) as sim:
            for _ in range(40):
                sim.step()
            found.append((sim.positions(), sim.velocities(), sim.reactions()))
            nodes = np.flatnonzero(sim.scene.bodies[0].rest_positions[:, 0] < -0.49)
            if exact:
                assert (
                    np.array_equal(sim.joint_force("grip"), sim.reactions()[nodes]) and np.abs(sim.joint_force("grip")).max() > 1
                )
    assert all(np.array_equal(a, b) for a, b in zip(*found))


def test_statics_modes_and_stable_dt_know_exact_attachments():
    pair = carried(True), carried(False)
    x = [ts.solve_static(scene).positions() for scene in pair]
    assert np.abs(x[0] - x[1]).max() < 1e-12 and np.abs(x[0] - pair[0].bodies[0].rest_positions).max() > 1e-3
    assert ts.modes(pair[0], 3).frequencies == pytest.approx(ts.modes(pair[1], 3).frequencies, rel=1e-9)
    sim = [simulator(scene, "symplectic_euler", 1e-5) for scene in pair]
    assert sim[0].stable_dt <= sim[1].stable_dt
    for one in sim:
        one.close()


@pytest.mark.parametrize("shape", ["box", "sphere", "mesh"])
def test_attached_bodies_do_not_touch_their_obstacle(shape):
    scene = carried(True, TURN, contact=True)
    if shape != "box":
        hand, block = ts.Sphere((-0.1, 0, 0), 0.25), ts.box_mesh((1, 1, 1), (0.3, 0.4, 0.4), (-0.1, 0, 0))
        scene.obstacles.clear()
        scene.add_obstacle(hand if shape == "sphere" else ts.MeshObstacle(block.vertices, block.surface), name="hand", path=TURN)
    scene.add_obstacle(ts.HalfSpace((0, -0.25, 0), (0, 1, 0)), name="ground")
    free = carried(True, TURN)
    with simulator(scene, "implicit_euler", 5e-3) as sim, simulator(free, "implicit_euler", 5e-3) as alone:
        for _ in range(6):
            assert sim.step().n_contacts == 0
            alone.step()
        assert sim.positions() == pytest.approx(alone.positions(), abs=1e-9)
        for _ in range(40):
            report = sim.step()
        assert report.converged


def test_files_and_refusals(tmp_path):
    scene = carried(True, TURN)
    ts.write_scene(tmp_path / "a.toml", scene)
    again = ts.read_scene(tmp_path / "a.toml")[0]
    assert [one.name for one in again.exact_attachments] == ["grip"] and not again.dependent_attachments
    scene.bodies[0].fix([0])
    with pytest.raises(
        SceneError, match="^attachment 'grip': node 0 of body 'bar' is fixed or moved, too: leave it out there or here"
    ):
        scene.check()
