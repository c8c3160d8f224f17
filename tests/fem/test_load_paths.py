"""Loads that follow paths in time, and springs on a support that moves: free bodies, and a mass on damped springs, step as each
integrator's formula says; statics and energies are of their time; a given value replaces a path; bad loads and paths are refused,
at once or at the step that needs them; refined scenes and files keep them.
"""

import numpy as np
import pytest

import taisoft as ts
from taisoft.dynamics.schemes import EXPLICIT, IMPLICIT
from taisoft.errors import SceneError
from taisoft.fem.reference import lumped_mass, lumped_masses, triangle_areas
from taisoft.scene.refine import refined, with_order
from tests.dynamics.companion import add_companion, simulator
from tests.dynamics.scenes import cube, rows_of, rubber
from tests.scene.toml_scenes import there_and_back

DT, STEPS = 1e-3, 12
RAMP = ts.KeyFrames((0.0, 0.004, 0.02), [(0, 0, 0), (60, -20, 10), (10, 40, -30)], smooth=True)
PULL = ts.KeyFrames((0.0, 0.004), values=(10.0, 90.0))
ROWS = np.random.default_rng(0).standard_normal((3, 3))
INTEGRATORS = [*EXPLICIT, *IMPLICIT]
OMEGA, RATE, SPEED = 20.0, 4.0, 4.0  # [1/s, 1/s, m/s] of the springs and their support


def push(t: float) -> np.ndarray:
    return np.array([80 * np.sin(300 * t), 20 - 3e3 * t, 5.0])


def free_body(force, held: bool = False) -> ts.Scene:
    scene = ts.Scene(gravity=(0, 0, 0))
    scene.contact_forces = False
    body = scene.add_body(cube(cells=(2, 1, 1)), rubber(), name="body")
    body.add_force(lambda X: X[:, 0] > 0.49, force)
    if held:
        body.fix(lambda X: X[:, 0] < -0.49)
    return scene


def momentum(sim: ts.Simulator, name: str = "body") -> np.ndarray:
    """By lumped masses, also of bodies whose momentum the springs of others change."""
    return lumped_masses(sim.scene)[rows_of(sim, name)] @ sim.velocities(name)


def loaded() -> ts.Scene:
    """Free bodies, each with a load of its own kind along a path, the pulled ones by a tendon along x; a mass on springs."""
    scene = free_body(push)
    for k, name in enumerate(("stretched", "by node", "pulled", "puller"), 1):
        scene.add_body(cube((4 * k, 0, 0)), rubber(), name=name)
    scene.body("stretched").add_traction(lambda c: c[:, 0] > 4.49, lambda t: (0, 1e5 * t, 30.0))
    scene.body("by node").add_force([5, 2, 7], lambda t: (1 + 1e3 * t) * ROWS)
    scene.body("by node").add_force([5], (0, 0, 0.25))
    scene.add_tendon([("pulled", (12, 0, 0)), ("puller", (16, 0, 0))], PULL, name="line")
    body = scene.add_body(cube(), rubber(), name="mass", position=(0, -5, 0))
    scene.add_obstacle(ts.Sphere((0, 9, 0), 1.0), name="lift", path=lambda t: ((0, SPEED * t, 0), np.eye(3)))
    for i, (x, m) in enumerate(zip(body.rest_positions, lumped_mass(body))):  # in proportion to the nodes' masses
        scene.add_spring(("mass", i), ("lift", x + (0, -3, 0)), m * OMEGA**2, damping=2 * RATE * m)
    return add_companion(scene)


LOADS = {
    "body": push,
    "stretched": lambda t: np.array([0, 1e5 * t, 30.0]) * 0.9 * 1.1,
    "by node": lambda t: (1 + 1e3 * t) * ROWS.sum(axis=0) + (0, 0, 0.25),
    "pulled": lambda t: np.array([PULL.value_at(t), 0, 0]),
    "puller": lambda t: np.array([-PULL.value_at(t), 0, 0]),
}


def motion(integrator: str, load, w: float = 0.0, d: float = 0.0) -> list[tuple[np.ndarray, np.ndarray]]:
    """x and v (3,) from rest, at the start and after each step, by the integrator's formula for x'' = load(t) - w x - d x'."""
    x, v, a = np.zeros(3), np.zeros(3), load(0.0)
    found = [(x, v)]
    for n in range(STEPS):
        start, middle, end = (load((n + share) * DT) for share in (0.0, 0.5, 1.0))
        if integrator == "symplectic_euler":
            v = v + DT * (start - w * x - d * v)
            x = x + DT * v
        elif integrator == "velocity_verlet":
            half = v + DT / 2 * a
            x = x + DT * half
            a = end - w * x - d * (half + DT / 2 * a)
            v = half + DT / 2 * a
        else:
            old, x_hat, v_hat, beta, force = (x, v), x, v, DT, end
            if integrator == "implicit_midpoint":
                beta, force = DT / 2, middle
            elif integrator == "bdf2" and n:
                x_hat, v_hat, beta = *((4 * now - before) / 3 for now, before in zip(old, found[-2])), 2 * DT / 3
            v = (v_hat + beta * (force - w * x_hat)) / (1 + beta * d + beta**2 * w)
            x = x_hat + beta * v
            if integrator == "implicit_midpoint":
                x, v = 2 * x - old[0], 2 * v - old[1]
        found.append((x, v))
    return found


@pytest.mark.parametrize("integrator", INTEGRATORS)
def test_steps_are_those_of_the_integrators_formula(integrator):
    momenta = {name: motion(integrator, load) for name, load in LOADS.items()}
    pull = np.array([0.0, SPEED, 0.0])
    swing = motion(integrator, lambda t: (OMEGA**2 * t + 2 * RATE) * pull, OMEGA**2, 2 * RATE)
    with simulator(loaded(), integrator, DT) as sim:
        rest = sim.positions("mass")
        for n in range(1, STEPS + 1):
            sim.step()
            for name, found in momenta.items():
                assert momentum(sim, name) == pytest.approx(found[n][1], rel=1e-7, abs=1e-8), (name, n)
            assert np.abs(sim.positions("mass") - rest - swing[n][0]).max() < 1e-9
        assert sim.joint_force("line") == 90.0
        x = sim.positions()
        if integrator in EXPLICIT:
            sim.reset()
            sim.advance(5)
            sim.advance(STEPS - 5)
            assert np.abs(sim.positions() - x).max() < 1e-14
        if integrator != "bdf2":  # whose steps depend on earlier ones, too
            before = {name: momentum(sim, name) for name in ("body", "pulled")}
            sim.set_tension("line", 3.0)
            sim.set_force("body", 0, (3.0, -4.0, 5.0))
            sim.step()
            for name, force in (("body", (3.0, -4.0, 5.0)), ("pulled", (3.0, 0, 0))):
                assert momentum(sim, name) - before[name] == pytest.approx(DT * np.array(force), rel=1e-4, abs=1e-8)


def test_energies_are_of_the_present_time():
    with simulator(add_companion(free_body(push, held=True)), "implicit_midpoint", DT) as sim:
        nodes, weights = sim.scene.body("body").forces[0].nodes, lumped_masses(sim.scene)
        for _ in range(2):
            mean = weights[nodes] @ sim.positions()[nodes] / weights[nodes].sum()
            assert sim.energies().loads == pytest.approx(-push(sim.time) @ mean, rel=1e-12)
            sim.step()


def test_statics_take_the_loads_of_their_time():
    scene, same = (add_companion(free_body(force, held=True)) for force in (RAMP, RAMP(0.003)[0]))
    assert np.array_equal(ts.solve_static(scene, time=0.003).positions(), ts.solve_static(same).positions())
    with pytest.raises(SceneError, match="^time must be finite, not nan$"):
        ts.solve_static(scene, time=np.nan)


def test_scene_files_hold_pressures_and_key_frames_but_no_functions(tmp_path):
    scene = free_body(RAMP)
    body = scene.bodies[0]
    body.add_traction([0, 3], ts.KeyFrames((0, 1 / 3), [(0, 0, 0), (1 / 7, 0, 0)]))
    body.add_pressure(np.arange(len(body.mesh.surface)), 7e3)
    body.add_pressure([3, 1], PULL)
    there_and_back(tmp_path / "a.toml", scene, {"dt": 0.01})
    with pytest.raises(SceneError, match="body 'body': has a force along a function, which a file cannot store: use ts"):
        ts.write_scene(tmp_path / "b.toml", free_body(push))


def test_refined_scenes_keep_paths_and_pressures():
    scene = free_body(RAMP)
    body = scene.bodies[0]
    body.add_traction(lambda c: c[:, 1] > 0.44, push)
    body.add_force([0, 3], lambda t: t * np.array([(1, 0, 0), (0, 1, 0)]))
    body.add_pressure(lambda c: c[:, 1] < 9.0, PULL)
    body.add_pressure(np.flatnonzero(body.mesh.vertices[body.mesh.surface].mean(axis=1)[:, 1] > 0.44), PULL)
    for new in (refined(scene).bodies[0], with_order(scene, 2).bodies[0]):
        assert [load.path is None for load in new.loads] == [False] * 5 and new.tractions[0].path is push
        assert new.forces[0].path.frames is RAMP and new.forces[1].nodes.tolist() == [0, 3]
        assert [p.closed for p in new.pressures] == [True, False]
        assert triangle_areas(new, new.pressures[1].triangles).sum() == pytest.approx(1.1)


BAD = [  # kind of load, where, its value or path, message; forces may be (3,) or (3, 3)
    ("force", [1, 2, 3], lambda t: 1 / 0, "the path failed at t = 0: ZeroDivisionError: division by zero$"),
    ("force", [1, 2, 3], lambda t: (1.0, 2.0), r"the path's force at t = 0 must have shape \(3,\).*, not \(2,\)$"),
    ("force", [1, 2, 3], lambda t: (1.0, 2.0, np.nan), r"the path's force at t = 0: entry \[2\] is nan, not finite$"),
    ("force", [1, 2, 3], lambda t: None, "the path must give a force at t = 0, not None$"),
    ("force", [1, 2, 3], ts.KeyFrames((0,), [(0, 0, 0)], release=True), "force: key frames: a load has translations only"),
    ("force", [1, 2, 3], ts.KeyFrames((0,), values=(0,)), "force: key frames need translations here"),
    ("force", [1, 2, 3], "north", r"force must be numbers of shape \(3,\) or \(3, 3\), not 'north'$"),
    ("pressure", [0], "high", "pressure must be a number, not 'high'"),
    ("pressure", [0], lambda t: (1, 2), "the path's pressure at t = 0 must be a number"),
    ("pressure", [0], ts.KeyFrames((0,), [(0, 0, 0)]), "pressure: key frames need values here"),
    ("pressure", [99], 1.0, "surface triangle 99 does not exist"),
    ("pressure", [], 1.0, "no surface triangle is chosen"),
]


@pytest.mark.parametrize("kind, where, value, message", BAD)
def test_bad_loads_are_refused(kind, where, value, message):
    body = ts.Scene().add_body(cube(), rubber(), name="body")
    with pytest.raises(SceneError, match=f"^body 'body': add_{kind}: {message}"):
        getattr(body, f"add_{kind}")(where, value)
    assert body.loads == ()


def failing(at_first, later):
    """A path that fails from 3.5 ms on."""
    return lambda t: at_first if t < 0.0035 else later


def lift(scene: ts.Scene) -> None:
    scene.add_obstacle(ts.Sphere((0, 9, 0), 1.0), name="lift", path=failing(((0, 0, 0), np.eye(3)), 0.0))
    scene.add_spring(("body", 0), ("lift", (0, 8, 0)), 1.0)


ENDS = [("body", 0), ("body", 4)]
LATE = [  # what a scene gets, and the message
    (lambda s: s.bodies[0].add_force([0], failing((1, 0, 0), None)), "body 'body': force 1: the path must give a force"),
    (lambda s: s.bodies[0].add_pressure([0], failing(1, np.inf)), "body 'body': pressure 0: .* at t = 0.00[345] is inf"),
    (lambda s: s.add_tendon(ENDS, failing(1, -2), name="t"), "'t': its path gave -2 N at t = 0.00[345] s: a tendon cannot push"),
    (lambda s: s.add_tendon(ENDS, length=failing(1, -2), stiffness=1), "its path gave -2 m at t = 0.00[345] s: a length must be"),
    (lift, "obstacle 'lift': the path must give"),
]


@pytest.mark.parametrize("add, message", LATE)
def test_a_path_that_fails_later_stops_the_run(add, message):
    scene, integrator = free_body((0, 0, 0)), "implicit_euler" if add is LATE[1][0] else "velocity_verlet"
    add(scene)
    with simulator(add_companion(scene), integrator, DT) as sim:
        with pytest.raises(ts.SimulationError, match=message):
            for _ in range(9):
                sim.step()
        assert 0.002 < sim.time < 0.0045 and np.isfinite(sim.positions()).all()
