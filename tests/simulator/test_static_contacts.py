"""Statics with contacts: load steps agree with slow steps in time, contacts alone hold bodies up to what friction bears, loads
grow along their paths, and what nothing holds is refused by name.
"""

import numpy as np
import pytest

import taisoft as ts
from taisoft.backend import runtime
from taisoft.static import StaticResult

UPRIGHT = np.eye(3)
OFFSET = 1e-3  # of the ball's radius [m], more than contacts keep
SIDE, WEIGHT = 0.1, 9.81  # of a block of 1000 kg/m^3 [m], [N]


def block_on_ground(gap: float = 0.0, cells: int = 2, friction: float = 0.5, **forces) -> ts.Scene:
    scene = ts.Scene()
    block = scene.add_body(
        ts.box_mesh((cells,) * 3, (SIDE,) * 3), ts.Material(young=1e5), name="block", position=(0, 0.5 * SIDE + gap, 0)
    )
    scene.add_ground(friction=0.5)
    scene.set_contact("block", "ground", friction=friction)
    if forces:
        block.add_force(lambda X: X[:, 0] > 0.49 * SIDE, **forces)
    return scene


def pressed_ball(density: float = 1000.0, friction: float = 0.5, turned: np.ndarray = UPRIGHT) -> ts.Scene:
    """Half a ball above a plane by the contact offset, whose equator comes down by 8 % of the radius until t = 1 s."""
    whole = ts.ball_mesh(1.0, 10)
    below = whole.vertices[whole.tets].mean(axis=1)[:, 1] < 0.0
    nodes, tets = np.unique(whole.tets[below], return_inverse=True)
    mesh = ts.TetMesh(whole.vertices[nodes] @ turned.T, tets.reshape(-1, 4))
    scene, up = ts.Scene(gravity=(0, 0, 0)), turned @ (0.0, 1.0, 0.0)
    ball = scene.add_body(mesh, ts.Material(young=1e6, density=density), name="ball")
    equator = np.flatnonzero(np.abs(mesh.vertices @ up) < 1e-9)
    ball.move(equator, lambda t: -0.08 * t * up)
    scene.add_obstacle(ts.HalfSpace(-(1.0 + OFFSET) * up, up), name="plane")
    scene.set_contact("ball", "plane", friction=friction)
    scene.collision = ts.CollisionSettings(offset=2e-5)  # the default of statics
    return scene


@pytest.fixture(scope="module")
def pressed() -> StaticResult:
    return ts.solve_static(pressed_ball(), steps=2, error=True, tolerance=1e-9)


def test_load_steps_are_slow_steps_in_time(pressed):
    """A ball so light that inertia is 1e-9 of the forces; the contact law is the same."""
    with ts.Simulator(pressed_ball(density=1e-3), dt=0.5, precision="f64") as sim:
        for step in range(2):
            sim.step()
            force = sim.contact_force("ball", "plane")
            assert pressed.contact_force("ball", "plane", step=step) == pytest.approx(force, abs=1e-5 * force[1])
            size = np.abs(sim.positions() - pressed.positions(step=step)).max()
            assert size < 1e-6 * 0.08, "positions differ"


def test_contacts_hold_what_a_hinge_leaves():
    """A bar turns about its lower left edge until a ball carries its other end."""
    scene = ts.Scene()
    bar = scene.add_body(ts.box_mesh((8, 2, 2), (0.4, 0.1, 0.1)), ts.Material(young=1e5), name="bar", position=(0, 0.1, 0))
    bar.fix(lambda X: (X[:, 0] < -0.199) & (X[:, 1] < -0.049))
    scene.add_obstacle(ts.Sphere((0.18, -0.051, 0), 0.1), name="ball", friction=0.3)
    found = ts.solve_static(scene)
    force = found.contact_force("bar", "ball")[1]
    assert found.converged and force > 10.0
    assert force + found.reactions("bar")[:, 1].sum() == pytest.approx(4.0 * 9.81, rel=1e-4)


def test_results_by_load_step(pressed):
    assert pressed.converged and pressed.times == pytest.approx([0.5, 1.0]) and len(pressed.step_reports) == 2
    assert not any(report.kinetic for report in pressed.step_reports)
    half, full = (pressed.contact_force("ball", step=step)[1] for step in (0, 1))
    assert 0.0 < 2.0 * half < full and full == pressed.contact_force("ball")[1] == -pressed.contact_force("plane")[1]
    for step in (0, 1):
        total = pressed.contact_force("ball", step=step) + pressed.reactions("ball", step=step).sum(axis=0)
        assert np.abs(total).max() < 1e-5 * full
    contacts = pressed.contacts()
    assert (contacts.impulse / contacts.duration).sum(axis=0) == pytest.approx(pressed.contact_force("ball"), abs=1e-9 * full)
    turning = pressed.contact_torque("plane", "ball")
    assert np.abs(turning).max() < 1e-3 * full
    for call in (lambda: pressed.positions(step=2), lambda: pressed.contact_force("bal"), lambda: pressed.contacts(step=-3)):
        with pytest.raises(ts.SceneError):
            call()


def test_friction_depends_on_the_load_steps_and_says_so(pressed):
    """Without friction the path does not matter."""
    assert pressed.error_estimate.time > 1e-4
    smooth = ts.solve_static(pressed_ball(friction=0.0), steps=2, error=True, tolerance=1e-9)
    assert smooth.error_estimate.time < 1e-6


def test_turned_scene_has_turned_results():
    axis = np.array([[0.36, 0.48, -0.8], [-0.8, 0.6, 0.0], [0.48, 0.64, 0.6]])
    upright, turned = (ts.solve_static(pressed_ball(turned=R), tolerance=1e-9) for R in (UPRIGHT, axis))
    assert turned.positions() == pytest.approx(upright.positions() @ axis.T, abs=1e-6 * 0.08)


@pytest.mark.parametrize(("gap", "precision"), [(0.0, "f64"), (1e-3, "f32"), (0.6 * SIDE, "f64")])
def test_ground_alone_holds_a_block(gap, precision):
    """Wherever above it the block begins."""
    result = ts.solve_static(block_on_ground(gap), precision=precision)
    assert result.converged and result.contact_force("block", "ground")[1] == pytest.approx(WEIGHT, rel=1e-3)
    assert np.abs(result.positions("block")[:, [0, 2]].mean(axis=0)).max() < 1e-4 * SIDE


def test_stack_carries_its_weight():
    scene = block_on_ground()
    for k in (1, 2):
        mesh = ts.box_mesh((2 + k % 2,) * 3, (SIDE,) * 3)
        scene.add_body(mesh, ts.Material(young=1e5), name=f"block {k}", position=(0, (k + 0.5) * SIDE, 0))
    result = ts.solve_static(scene, tolerance=1e-7)
    for below, above, n in (("ground", "block", 3), ("block", "block 1", 2), ("block 1", "block 2", 1)):
        assert result.contact_force(above, below)[1] == pytest.approx(n * WEIGHT, rel=1e-5)


@pytest.mark.gpu_path
def test_friction_holds_up_to_its_limit():
    held = ts.solve_static(block_on_ground(force=(0.9 * 0.5 * WEIGHT, 0.0, 0.0)), tolerance=1e-7)
    assert held.converged and held.contact_force("block")[0] == pytest.approx(-0.45 * WEIGHT, rel=1e-5)
    with pytest.raises(ts.SimulationError, match="nothing holds body 'block'"):
        ts.solve_static(block_on_ground(force=(1.2 * 0.5 * WEIGHT, 0.0, 0.0)))
    assert runtime.open_kind() is None


def test_constant_loads_grow_and_paths_are_followed():
    """A constant pull grows with the weight; one along a path has its value at the end of each step."""
    for force, expected in (((1.0, 0.0, 0.0), (0.5, 1.0)), (lambda t: (1.0 if t < 0.6 else 0.3, 0.0, 0.0), (1.0, 0.3))):
        result = ts.solve_static(block_on_ground(force=force), steps=2, tolerance=1e-7)
        for step, pull in enumerate(expected):
            on_block = result.contact_force("block", step=step)
            assert on_block[:2] == pytest.approx([-pull, 0.5 * (step + 1) * WEIGHT], rel=1e-5)


def test_offset_is_small_on_planes_alone():
    """Where it adds to a given displacement; curves and meshes keep the room that they have in time."""
    scene = block_on_ground()
    edge, offsets = 0.05 * (2 + 2**0.5) / 3, []
    for shape in (ts.HalfSpace((0, 1, 0), (0, -1, 0)), ts.Sphere((0, 1, 0), 0.1)):
        scene.add_obstacle(shape)
        with ts.Simulator(scene.snapshot(), integrator="static") as sim:
            offsets.append(sim.contact_offset / edge)
    assert offsets == pytest.approx([2e-5, 2e-3], rel=0.05)


def test_reversed_push_leaves_friction():
    """An obstacle that presses and withdraws: the block stays where friction holds it, strained."""
    scene = block_on_ground()
    path = ts.KeyFrames([0.0, 1.0, 2.0], [[0, 0, 0], [-2e-3, 0, 0], [0, 0, 0]])
    scene.add_obstacle(ts.HalfSpace((0.5 * SIDE, 0, 0), (-1, 0, 0)), name="wall", friction=0.0, path=path)
    result = ts.solve_static(scene, time=2.0, steps=4)
    pushed, left = (result.contact_force("wall", step=step)[0] for step in (1, 3))
    assert pushed == pytest.approx(0.25 * WEIGHT, rel=1e-3), "half of the weight acts by then"
    assert left < 1e-3 * pushed and result.positions("block")[:, 0].mean() < -1e-3


def test_what_nothing_can_hold_is_refused():
    loose = ts.Scene()
    loose.add_body(ts.box_mesh((1, 1, 1), (1, 1, 1)), ts.Material(), name="loose")
    away = block_on_ground()
    away.gravity = (0.0, 9.81, 0.0)
    for scene, settings, error, message in (
        (loose, {"steps": 2}, ts.SceneError, "body 'loose': nothing holds it along xyz"),
        (away, {}, ts.SimulationError, "nothing holds body 'block'"),
        (block_on_ground(), {"time": 0.0}, ts.SceneError, "time must be greater than 0 s"),
        (block_on_ground(), {"steps": 0}, ts.SceneError, "steps must be a whole number of at least 1"),
        (block_on_ground(), {"contact_tolerance": 2.0}, ts.SimulationError, "contact_tolerance"),
        (loose, {"error": True}, ts.SceneError, "error and quantities need steps, or a scene"),
    ):
        with pytest.raises(error, match=message):
            ts.solve_static(scene, **settings)
    for settings, message in (
        ({"ramp": 1.0}, "ramp needs integrator 'static'"),
        ({"integrator": "static", "tolerance": 1e-2}, "takes load steps: use error=True"),
    ):
        with pytest.raises(ts.SimulationError, match=message):
            ts.Simulator(block_on_ground(), **settings)


def test_simulator_takes_load_steps(tmp_path):
    """Frames are load steps, and a checkpoint continues them: with the same bits."""
    frames = []
    with ts.Simulator(block_on_ground(force=(1.0, 0.0, 0.0)), dt=0.25, integrator="static", precision="f64", ramp=1.0) as sim:
        result = sim.run(0.5, on_frame=lambda sim, index, report: frames.append(sim.contact_force("block")[1]))
        assert result.status == "ok" and frames == pytest.approx([0.0, 0.25 * WEIGHT, 0.5 * WEIGHT], rel=1e-5)
        sim.save_checkpoint(tmp_path / "half.npz")
        sim.run(0.5)
        end = sim.positions()
    with ts.Simulator.load_checkpoint(tmp_path / "half.npz", block_on_ground(force=(1.0, 0.0, 0.0))) as sim:
        sim.run(0.5)
        assert np.array_equal(sim.positions(), end) and sim.contact_force("block")[1] == pytest.approx(WEIGHT, rel=1e-5)
