"""Motions commanded from a loop: `set_pose`, `set_velocity` and `set_displacement`.

* they move obstacles, rigid bodies and held nodes as paths do, bit by bit, with the same contact forces;
* they turn at a constant rate, last as long as asked, and then hold, or go on;
* checkpoints and `rebuild` keep them, `reset` forgets them, a search made before does not outlast them;
* what cannot follow them, or cannot be foreseen, is refused in a sentence; a path that follows commands is referred to them.
"""

import numpy as np
import pytest

import taisoft as ts
from tests.dynamics.contact_scenes import SIDE, cube

DT = 1 / 512  # so that times, and products with SPEED, are exact
SPEED = 2.0**-4  # [m/s]
KINDS = {"bdf2": {"dt": DT}, "symplectic_euler": {"dt": DT / 8}}


def sideways(t: float) -> np.ndarray:
    return np.array([-SPEED * t, 0.0, 0.0])


def scene(path=None) -> ts.Scene:
    """A cube on the ground, with its top held, beside a wall and a rigid tool; path: of all three."""
    made, soft = ts.Scene(), ts.Material(young=5e4, poisson=0.3, density=1000.0, friction=0.4)
    at = path and (lambda t: (path(t), np.eye(3)))
    body = made.add_body(cube(2), soft, name="cube", position=(0, 1e-4, 0))
    body.move(lambda X: X[:, 1] > 0.99 * SIDE, path)
    beside = body.rest_positions.max(axis=0)[0] + 1e-4 + 0.2 * SIDE
    made.add_obstacle(ts.HalfSpace((0, 0, 0), (0, 1, 0)), name="ground")
    made.add_obstacle(ts.Box((beside, 0.3 * SIDE, -0.22 * SIDE), np.full(3, 0.2 * SIDE)), name="wall", path=at)
    place = (beside, 0.3 * SIDE, 0.22 * SIDE)
    made.add_rigid_body(ts.box_mesh((1, 1, 1), np.full(3, 0.4 * SIDE)), name="tool", position=place).move(at)
    return made


def command(sim: ts.Simulator, x: np.ndarray, **seconds) -> None:
    sim.set_displacement("cube", 0, x, **seconds)
    sim.set_pose("tool", x, **seconds)
    sim.set_pose("wall", x, **seconds)


def follow(sim: ts.Simulator, steps: int, each=lambda: None) -> list[np.ndarray]:
    """Positions, contact forces on the wall and reactions after each of some steps."""
    found = []
    for _ in range(steps):
        each()
        sim.advance(round(DT / sim.dt))
        found += [sim.positions(), sim.contact_force("wall"), sim.contact_force("tool", "cube"), sim.reactions("cube")]
    assert np.abs(found[-2]).max() > 0.0 and np.abs(found[-3]).max() > 0.0
    return found


@pytest.fixture(scope="module", params=KINDS)
def kind(request):
    """A simulator without paths, and what one with paths gives."""
    settings = {"integrator": request.param, "precision": "f64"} | KINDS[request.param]
    with ts.Simulator(scene(sideways), **settings) as sim:
        expected = follow(sim, 10)
    with ts.Simulator(scene(), **settings) as sim:
        yield sim, expected, [sim.step().elastic for _ in range(3)]


def same(found: list, expected: list) -> bool:
    return all(np.array_equal(a, b) for a, b in zip(found, expected, strict=True))


def test_commands_move_things_as_paths_do(kind):
    sim, expected, _ = kind
    sim.reset()
    assert same(follow(sim, 10, lambda: command(sim, sideways(sim.time + DT))), expected)
    sim.reset()
    command(sim, sideways(10 * DT), seconds=10 * DT)
    sim.detect_contacts()  # a search without motion
    assert same(follow(sim, 10), expected)
    sim.reset()
    for name in ("wall", "tool"):
        sim.set_velocity(name, (-SPEED, 0, 0))
    sim.set_displacement("cube", 0, sideways(10 * DT), seconds=10 * DT)
    assert same(follow(sim, 10), expected)


def test_checkpoints_and_rebuild_continue_commands_and_reset_forgets_them(kind, tmp_path):
    sim, expected, at_rest = kind
    sim.reset()
    command(sim, sideways(10 * DT), seconds=10 * DT)
    follow(sim, 4)
    command(sim, sideways(5 * DT))  # not begun yet
    sim.save_checkpoint(tmp_path / "kept.npz")
    rest = follow(sim, 1)
    sim.rebuild()  # without the integrator's history
    command(sim, sideways(7 * DT), seconds=2 * DT)  # still moves at the end, and so presses
    followed = follow(sim, 2)
    assert np.allclose(sim.pose("wall").translation, sideways(7 * DT), rtol=0, atol=1e-15), "a pose holds"
    assert np.allclose(sim.pose("tool").translation, sideways(7 * DT), rtol=0, atol=1e-12)
    with ts.Simulator.load_checkpoint(tmp_path / "kept.npz", scene()) as loaded:
        assert same(follow(loaded, 1), rest)
        loaded.rebuild()
        command(loaded, sideways(7 * DT), seconds=2 * DT)
        assert same(follow(loaded, 2), followed)
        loaded.reset()
        assert all(np.abs(loaded.pose(name).translation).max() < 1e-15 for name in ("wall", "tool"))
        command(loaded, sideways(10 * DT), seconds=10 * DT)
        assert same(follow(loaded, 10), expected)
        loaded.reset()
        assert [loaded.step().elastic for _ in range(3)] == at_rest, "nothing is left where it was commanded"


def test_commands_turn_things_at_a_constant_rate():
    """Also a rigid body, about its centre; a second command starts where the first one is."""
    made = scene()
    made.contact_forces = False
    slider = made.add_rigid_body(ts.box_mesh((1, 1, 1), (1, 1, 1)), name="slider")
    slider.move(ts.KeyFrames((0.0,), translations=[(0.2, 0, 0)]), axes="x")
    slider.move(axes="yz")
    with ts.Simulator(made, DT, precision="f64") as sim:
        sim.set_velocity("slider", (0, 0, 0))
        for name in ("wall", "tool"):
            sim.set_velocity(name, (0, 0, 1.0), (0, 0.5, 0))
        sim.step()
        quarter = np.array([[0.0, 0, 1], [0, 1, 0], [-1, 0, 0]])
        for name in ("wall", "tool"):
            sim.set_pose(name, (1.0, 0, 0), quarter, seconds=3 * DT)
        sim.step()
        for name in ("wall", "tool"):
            first, angle = np.array([0, 0, DT]), 0.5 * DT + (np.pi / 2 - 0.5 * DT) / 3
            place, turn = sim.pose(name)
            assert np.allclose(place, first + (np.array([1.0, 0, 0]) - first) / 3, rtol=0, atol=1e-12)
            assert np.allclose(turn[0], [np.cos(angle), 0, np.sin(angle)], rtol=0, atol=1e-9)
        for _ in range(3):
            sim.step()
        assert np.allclose(sim.pose("slider").translation, (0.2, 0, 0), rtol=0, atol=1e-12), "each axis stays where it was"
        assert np.array_equal(sim.pose("wall").rotation, quarter)
        assert np.allclose(sim.pose("tool").rotation, quarter, rtol=0, atol=1e-9)


@pytest.mark.parametrize("integrator", KINDS)
def test_dampers_on_commanded_obstacles_know_their_velocity(integrator):
    found = []
    for path in (lambda t: (np.array([0, 16 * t * t, 0]), np.eye(3)), ts.KeyFrames((0,), translations=[(0, 0, 0)])):
        made = ts.Scene()
        made.contact_forces = False
        made.add_body(cube(1), ts.Material(young=5e4), name="cube")
        made.add_obstacle(ts.Sphere((0, 1, 0), 0.1), name="hook", path=path)
        made.add_spring(("cube", (0, SIDE, 0)), ("hook", (0, 1, 0)), 10.0, damping=50.0)
        with ts.Simulator(made, DT / 8, integrator=integrator, precision="f64") as sim:
            for _ in range(20):
                if len(found) == 1:
                    sim.set_pose("hook", (0, 16 * (sim.time + sim.dt) ** 2, 0))
                sim.step()
            found.append(sim.velocities("cube").mean(axis=0)[1])
    assert found[1] == pytest.approx(found[0], rel=0.02)


@pytest.fixture(scope="module")
def refusing():
    made = scene()
    made.add_rigid_body(ts.box_mesh((1, 1, 1), (1, 1, 1)), name="free", position=(50, 1, 0))
    made.add_obstacle(ts.Sphere((70, 0, 0), 0.1), name="hook")
    made.add_spring(("free", (0, 0, 0)), ("hook", (70, 0, 0)), 1.0, name="rope")
    with ts.Simulator(made, DT, precision="f64") as sim:
        yield sim


@pytest.mark.parametrize(
    "call, words",
    [
        (lambda sim: sim.set_pose("jaw", (0, 0, 0)), "no body or obstacle is called 'jaw'"),
        (lambda sim: sim.set_pose("cube", (0, 0, 0)), "set_pose: body 'cube' is elastic: sim.set_displacement"),
        (lambda sim: sim.set_velocity("free", (0, 0, 0)), "set_velocity: rigid body 'free' is not held: call its move()"),
        (lambda sim: sim.set_pose("hook", (0, 0, 0)), "obstacle 'hook': spring 'rope' holds on to it"),
        (lambda sim: sim.set_pose("wall", (0, np.nan, 0)), "set_pose of wall.s translation"),
        (lambda sim: sim.set_pose("wall", (0, 0, 0), 2 * np.eye(3)), "set_pose of wall.s rotation .* must be orthonormal"),
        (lambda sim: sim.set_pose("wall", (0, 0, 0), seconds=0), "set_pose: seconds must be greater than 0 s"),
        (lambda sim: sim.set_velocity("wall", (0, 0)), "set_velocity: 'wall': velocity"),
        (lambda sim: sim.set_displacement("tool", 0, (0, 0, 0)), "body 'tool': set_displacement: it is rigid"),
        (lambda sim: sim.set_displacement("wall", 0, (0, 0, 0)), "body 'wall': set_displacement: it is an obstacle"),
        (lambda sim: sim.set_displacement("cube", 1, (0, 0, 0)), "body 'cube': set_displacement: index"),
        (lambda sim: sim.set_displacement("cube", 0, np.zeros((2, 3))), "body 'cube': set_displacement: value"),
    ],
)
def test_what_cannot_follow_a_command_is_refused(refusing, call, words):
    with pytest.raises(ts.SceneError, match=words):
        call(refusing)
    assert not refusing.pose("wall").translation.any()


def test_runs_that_have_to_foresee_motion_refuse_commands(refusing):
    def command_within(sim, index, report):
        sim.set_pose("wall", (0, 0, 0))

    report = refusing.run(2 * DT, fps=None, error=True, on_frame=command_within)
    assert report.status == "failed" and "set_pose: the companions of a run with error=True do not follow" in report.problems[0]
    refusing.set_pose("wall", (0, 0, 0))
    with pytest.raises(ts.SimulationError, match="^error=True: 'wall' follows a command"):
        refusing.run(DT, error=True)
    refusing.reset()
    with (
        ts.Simulator(scene(), DT, precision="f64", tolerance=0.01) as sim,
        pytest.raises(ts.SimulationError, match="set_pose: with a tolerance, steps are chosen ahead"),
    ):
        sim.set_pose("wall", (0, 0, 0))


def test_a_path_that_follows_commands_is_referred_to_set_pose_and_one_that_jumps_warns():
    made, now = scene(), [0.0]
    made.remove(made.obstacles[-1])
    made.add_obstacle(ts.Sphere((1, 1, 1), 0.1), name="jaw", path=lambda t: ((now[0], 0, 0), np.eye(3)))
    made.add_obstacle(ts.Sphere((3, 1, 1), 0.1), name="jumper", path=lambda t: ((t > 1.3 * DT, 0, 0), np.eye(3)))
    loose = made.add_rigid_body(ts.box_mesh((1, 1, 1), (1, 1, 1)), name="loose", position=(9, 9, 9))
    loose.move(lambda t: None if t >= 2 * DT else ((0, 0, 0), np.eye(3)))
    with ts.Simulator(made, DT, precision="f64") as sim:
        sim.step()
        with pytest.warns(UserWarning, match=r"obstacle 'jumper': the path jumps by 1 at t = 0.00253"):
            sim.step()
        with pytest.raises(ts.SceneError, match="set_pose: rigid body 'loose': its path has released it"):
            sim.set_pose("loose", (0, 0, 0))
        now[0] = 0.1
        with pytest.raises(ts.SimulationError, match="obstacle 'jaw': the path gives another value .* sim.set_pose commands"):
            sim.step()
        sim.set_pose("jaw", (0.1, 0, 0))  # instead of its path
        sim.step()
