"""Loads that follow paths in time: forces, tractions, pressures and tensions:

* the momentum of a free body is the integrator's own quadrature of its load, in batches as in single steps;
* statics take the loads of their time; energies are those of the present time;
* a value given while it runs replaces a path;
* paths that fail, give other shapes or values that are not allowed are refused, at once or at the step that needs them;
* refined scenes keep paths; files hold key frames.
"""

import numpy as np
import pytest

import taisoft as ts
from taisoft.dynamics.schemes import EXPLICIT, IMPLICIT
from taisoft.errors import SceneError
from taisoft.fem.reference import lumped_masses
from taisoft.scene.refine import refined, with_order
from tests.dynamics.companion import add_companion, simulator
from tests.dynamics.scenes import cube, rows_of, rubber
from tests.scene.toml_scenes import there_and_back

DT, STEPS = 1e-3, 12
RAMP = ts.KeyFrames((0.0, 0.004, 0.02), [(0, 0, 0), (60, -20, 10), (10, 40, -30)], smooth=True)
PULL = ts.KeyFrames((0.0, 0.004), values=(10.0, 90.0))
ROWS = np.random.default_rng(0).standard_normal((3, 3))
INTEGRATORS = [*EXPLICIT, *IMPLICIT]


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


# --- integrators --------------------------------------------------------------------------------------------------------


def loaded() -> ts.Scene:
    """Free bodies, each with a load of its own kind along a path; the pulled ones by a tendon along x."""
    scene = free_body(push)
    for k, name in enumerate(("stretched", "by node", "pulled", "puller"), 1):
        scene.add_body(cube((4 * k, 0, 0)), rubber(), name=name)
    scene.body("stretched").add_traction(lambda c: c[:, 0] > 4.49, lambda t: (0, 1e5 * t, 30.0))
    scene.body("by node").add_force([5, 2, 7], lambda t: (1 + 1e3 * t) * ROWS)
    scene.body("by node").add_force([5], (0, 0, 0.25))
    scene.add_tendon([("pulled", (12, 0, 0)), ("puller", (16, 0, 0))], PULL, name="line")
    return add_companion(scene)


LOADS = {
    "body": push,
    "stretched": lambda t: np.array([0, 1e5 * t, 30.0]) * 0.9 * 1.1,
    "by node": lambda t: (1 + 1e3 * t) * ROWS.sum(axis=0) + (0, 0, 0.25),
    "pulled": lambda t: np.array([PULL.value_at(t), 0, 0]),
    "puller": lambda t: np.array([-PULL.value_at(t), 0, 0]),
}


def quadrature(integrator: str, load) -> np.ndarray:
    """Momentum (STEPS + 1, 3) [N s] of a free body from rest, by the integrator's formula for M v' = F(t)."""
    F, p = [load(k * DT / 2) for k in range(2 * STEPS + 1)], [np.zeros(3)]  # of half steps
    for n in range(STEPS):
        start, middle, end = F[2 * n : 2 * n + 3]
        if integrator == "bdf2" and n:
            p.append((4 * p[n] - p[n - 1] + 2 * DT * end) / 3)
            continue
        mean = {"symplectic_euler": start, "velocity_verlet": (start + end) / 2, "implicit_midpoint": middle}.get(integrator, end)
        p.append(p[n] + DT * mean)
    return np.array(p)


@pytest.mark.parametrize("integrator", INTEGRATORS)
def test_momentum_is_the_quadrature_of_the_load(integrator):
    wanted = {name: quadrature(integrator, load) for name, load in LOADS.items()}
    with simulator(loaded(), integrator, DT) as sim:
        for n in range(STEPS):
            sim.step()
            for name, p in wanted.items():
                assert momentum(sim, name) == pytest.approx(p[n + 1], rel=1e-7, abs=1e-8), (name, n)
        assert sim.joint_force("line") == 90.0
        x = sim.positions()
        if integrator in EXPLICIT:
            sim.reset()
            sim.advance(5)
            sim.advance(STEPS - 5)
            assert np.abs(sim.positions() - x).max() < 1e-14
        before = {name: momentum(sim, name) for name in ("body", "pulled")}
        sim.set_tension("line", 3.0)
        sim.set_force("body", 0, (3.0, -4.0, 5.0))
        assert sim.joint_force("line") == 3.0
        sim.step()
        if integrator != "bdf2":  # whose steps depend on earlier ones, too
            for name, force in (("body", (3.0, -4.0, 5.0)), ("pulled", (3.0, 0, 0))):
                assert momentum(sim, name) - before[name] == pytest.approx(DT * np.array(force), rel=1e-4, abs=1e-8)


@pytest.mark.parametrize("integrator", ["symplectic_euler", "implicit_midpoint"])
def test_energies_are_of_the_present_time(integrator):
    with simulator(add_companion(free_body(push, held=True)), integrator, DT) as sim:
        report = sim.advance(1)
        nodes, weights = sim.scene.body("body").forces[0].nodes, lumped_masses(sim.scene)
        mean = weights[nodes] @ sim.positions()[nodes] / weights[nodes].sum()
        assert report.loads == pytest.approx(-push(DT) @ mean, rel=1e-12) and sim.energies().loads == report.loads
        sim.reset()
        mean = weights[nodes] @ sim.positions()[nodes] / weights[nodes].sum()
        assert sim.energies().loads == pytest.approx(-push(0.0) @ mean, rel=1e-12)


def test_statics_take_the_loads_of_their_time():
    scene, same = (add_companion(free_body(force, held=True)) for force in (RAMP, RAMP(0.003)[0]))
    assert np.array_equal(ts.solve_static(scene, time=0.003).positions(), ts.solve_static(same).positions())
    assert np.abs(ts.solve_static(scene).positions("body") - scene.body("body").rest_positions).max() < 1e-12
    for time, message in ((np.nan, "time must be finite, not nan"), (None, "time must be a number, not None")):
        with pytest.raises(SceneError, match=f"^{message}$"):
            ts.solve_static(scene, time=time)


# --- scenes and files ---------------------------------------------------------------------------------------------------


def test_scene_files_hold_key_frames(tmp_path):
    scene, path = free_body(RAMP), tmp_path / "a.toml"
    scene.bodies[0].add_traction([0, 3], ts.KeyFrames((0, 1 / 3), [(0, 0, 0), (1 / 7, 0, 0)]))
    there_and_back(path, scene, {"dt": 0.01})
    assert ts.read_scene(path)[0].bodies[0].forces[0].path(0.003).tolist() == RAMP(0.003)[0].tolist()
    with pytest.raises(SceneError, match="body 'body': has a load along a function, which a file cannot store: use ts.KeyFrames"):
        ts.write_scene(tmp_path / "b.toml", free_body(push))
    text = path.read_text()
    for old, new, message in (
        ("release = false", "release = true", "key frames: a load has translations only"),
        ("smooth = true", "smoth = true", r"bodies.body.force\[0\].force.smoth is not known .did you mean smooth"),
        ("times = [0.0, 0.004, 0.02]", "times = [0.0, 0.02, 0.004]", r"bodies.body.force\[0\].force.times must ascend"),
    ):
        assert old in text
        path.write_text(text.replace(old, new))
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


# --- bad input ----------------------------------------------------------------------------------------------------------


def shouts(t: float):
    raise RuntimeError("first\nsecond" + 999 * " third")


BAD = [  # what a force or its path is, and the message; the force may be (3,) or (3, 3)
    (lambda t: 1 / 0, "the path failed at t = 0: ZeroDivisionError: division by zero$"),
    (shouts, r"the path failed at t = 0: RuntimeError: first second third .{1,100}\.\.\.$"),
    (lambda t: (1.0, 2.0), r"the path's force at t = 0 must have shape \(3,\).*, not \(2,\)$"),
    (lambda t: (1.0, 2.0, np.nan), r"the path's force at t = 0: entry \[2\] is nan, not finite$"),
    (lambda t: (1.0, -1e39, 0.0), r"the path's force at t = 0: entry \[1\] is -1e\+39, too large for a 32-bit float$"),
    (lambda t: ("1", "2", "3"), r"the path's force at t = 0 must be numbers of shape \(3,\).*, not \('1', '2', '3'\)$"),
    (lambda t: None, "the path must give a force at t = 0, not None$"),
    (ts.KeyFrames((0,), [(0, 0, 0)], release=True), "force: key frames: a load has translations only"),
    (ts.KeyFrames((0,), values=(0,)), "force: key frames need translations here"),
    ("north", r"force must be numbers of shape \(3,\) or \(3, 3\), not 'north'$"),
]


@pytest.mark.parametrize("path, message", BAD)
def test_bad_loads_are_refused(path, message):
    body = ts.Scene().add_body(cube(), rubber(), name="body")
    with pytest.raises(SceneError, match=f"^body 'body': add_force: {message}"):
        body.add_force([1, 2, 3], path)
    assert body.forces == []
    with pytest.raises(SceneError, match="loads cannot be set: call body.add_force, body.add_traction or body.add_p"):
        body.loads = []


def lift(failing) -> ts.Scene:
    scene = free_body((0, 0, 0))
    scene.add_obstacle(ts.Sphere((0, 9, 0), 1.0), name="lift", path=lambda t: ((0, 0, 0), np.eye(3)) if t < 0.0035 else failing)
    scene.add_spring(("body", 0), ("lift", (0, 8, 0)), 1.0)
    return scene


def tendon(failing: float, **given) -> ts.Scene:
    scene = free_body((0, 0, 0))
    key = "length" if given else "force"
    scene.add_tendon([("body", 0), ("body", 4)], **{key: lambda t: 1.0 if t < 0.0035 else failing}, name="line", **given)
    return scene


def pressed(failing: float) -> ts.Scene:
    scene = free_body((0, 0, 0))
    scene.body("body").add_pressure([0], lambda t: 1.0 if t < 0.0035 else failing)
    return scene


LATE = {  # a path that fails from 3.5 ms on
    "force": (lambda: free_body(lambda t: (1, 0, 0) if t < 0.0035 else None), "body 'body': force 0: the path must give a force"),
    "pressure": (lambda: pressed(np.inf), "body 'body': pressure 0: the path's pressure at t = 0.00[345] is inf, not finite"),
    "tension": (lambda: tendon(-2.0), "tendon 'line': its path gave -2 N at t = 0.00[345] s: a tendon cannot push"),
    "length": (lambda: tendon(-2.0, stiffness=1.0), "tendon 'line': its path gave -2 m at t = 0.00[345] s: a length must be"),
    "obstacle": (lambda: lift(0.0), "obstacle 'lift': the path must give"),
}


@pytest.mark.parametrize("kind", LATE)
@pytest.mark.parametrize("integrator", ["velocity_verlet", "implicit_euler"])
def test_a_path_that_fails_later_stops_the_run(integrator, kind):
    make, message = LATE[kind]
    with simulator(add_companion(make()), integrator, DT) as sim:
        with pytest.raises(ts.SimulationError, match=message):
            for _ in range(9):
                sim.step()
        assert 0.002 < sim.time < 0.0045 and np.isfinite(sim.positions()).all()
