"""Captured steps with contacts: a process of `taisoft bench contact --capture` and `--replay`.

python contact_states.py capture SCENE FILE [quick] runs a scene of SCENES and saves the states before every fifth step and before
the ten steps with the most Newton iterations: positions, velocities, multistep history, contacts and impulses.
python contact_states.py replay FILE PRECISION TOLERANCE [REFERENCE] solves the stage of each state without substeps, divided into
halves if it does not converge. REFERENCE: file of positions to compare with; it is written if it does not exist.
Both print lines of JSON. They use nothing newer than version 0.1, so that both versions can be measured on the same states.
"""

import json
import pickle
import runpy
import sys
import time
import warnings
from collections.abc import Callable
from contextlib import contextmanager
from pathlib import Path
from types import SimpleNamespace

import numpy as np

import taisoft as ts

try:
    from taisoft.backend import runtime
except ImportError:  # version 0.1
    from taisoft import runtime
try:
    from taisoft.backend.counters import counting
except ImportError:  # an older version, which counts launches at all times

    @contextmanager
    def counting():
        """The same context; its record is complete at the end."""
        counts, before = SimpleNamespace(), runtime.launches.copy()
        yield counts
        counts.launches = runtime.launches - before


ROOT = Path(ts.__file__).resolve().parents[1]
MESHES = Path(__file__).resolve().parents[2] / "shared" / "meshes"
EVERY, SLOWEST, QUICK_STEPS = 5, 10, 3
MAX_HALVES = 16
DOWN, GROUND = (0.0, -9.81, 0.0), ts.HalfSpace((0, 0, 0), (0, 1, 0))
IMPLICIT = {"integrator": "implicit_euler"}


def figure(name: str, height: float) -> ts.TetMesh:
    """A mesh of shared/meshes, scaled to 1 m, above y = height."""
    mesh = ts.read_mesh(MESHES / name)
    x = mesh.vertices - mesh.vertices.mean(axis=0)
    x = x / np.ptp(x, axis=0).max()
    return ts.TetMesh(x + [0.0, height - x[:, 1].min(), 0.0], mesh.tets)


def rubber(**changes) -> ts.Material:
    """The material of the real meshes."""
    return ts.Material(**({"young": 2e5, "poisson": 0.4, "density": 1000.0, "friction": 0.5} | changes))


def landing(name: str, obstacle=GROUND) -> ts.Scene:
    """A mesh just before it lands at 1 m/s."""
    scene = ts.Scene(gravity=DOWN)
    scene.add_body(figure(name, 0.01), rubber(), name="figure", velocity=(0, -1, 0))
    scene.add_obstacle(obstacle, name="obstacle", friction=0.5)
    return scene


def on_another(name: str) -> ts.Scene:
    """A mesh falls on another on the ground, slightly off centre."""
    scene = ts.Scene(gravity=DOWN)
    below = figure(name, 0.001)
    scene.add_body(below, rubber(), name="below")
    above = figure(name, below.vertices[:, 1].max() + 0.01)
    scene.add_body(above, rubber(), name="above", position=(0.05, 0.0, 0.03), velocity=(0, -1, 0))
    scene.add_obstacle(GROUND, name="ground", friction=0.5)
    return scene


def cloth(height: float = 0.102, friction: float = 0.3) -> ts.Scene:
    """A cloth, 2 mm thick, falls on a sphere."""
    scene = ts.Scene(gravity=DOWN)
    material = ts.Material(young=1e5, poisson=0.3, density=500.0, friction=friction)
    scene.add_body(ts.sheet_mesh((20, 20), (0.5, 0.002, 0.5)), material, name="cloth", position=(0, height, 0))
    scene.add_obstacle(ts.Sphere((0, 0, 0), 0.1), name="sphere", friction=friction)
    return scene


def mat() -> ts.Scene:
    """A mat that is twisted from rest."""
    scene = ts.Scene(gravity=(0, 0, 0))
    mesh = ts.box_mesh((20, 20, 1), (1.0, 1.0, 0.02))
    x = mesh.vertices + np.random.default_rng(0).uniform(-1e-4, 1e-4, mesh.n_verts)[:, None] * [0.0, 0.0, 1.0]
    body = scene.add_body(ts.TetMesh(x, mesh.tets), ts.Material(young=2e4, poisson=0.4, density=1000.0, friction=0.3), name="mat")
    turn = np.array([np.radians(90.0) * 8.0, 0.0, 0.0])
    for side in (-1.0, 1.0):
        body.move(lambda X, side=side: side * X[:, 0] > 0.499, ts.KeyFrames([0.0, 8.0], rotations=[np.zeros(3), side * turn]))
    return scene


def gripper() -> ts.Scene:
    """Two plates close on a ball and lift it."""
    scene = ts.Scene(gravity=DOWN)
    soft = ts.Material(young=1e5, poisson=0.4, density=1000.0, friction=0.8)
    scene.add_body(ts.ball_mesh(0.1, 8), soft, name="ball", position=(0, 0.101, 0))
    scene.add_obstacle(GROUND, name="ground", friction=0.5)
    for name, side in (("left", -1.0), ("right", 1.0)):
        displacements = [(0, 0, 0), (-side * 0.03, 0, 0), (-side * 0.03, 0.1, 0)]
        path = ts.KeyFrames([0.0, 0.4, 1.0], displacements, smooth=True)
        scene.add_obstacle(ts.Box((side * 0.115, 0.12, 0), (0.01, 0.06, 0.06)), name=name, friction=0.8, path=path)
    return scene


def slabs() -> ts.Scene:
    """A soft slab on one ten thousand times as stiff."""
    scene, mesh = ts.Scene(gravity=DOWN), ts.box_mesh((12, 1, 12), (1.0, 0.05, 1.0))
    c = np.sqrt(0.5)
    turned = ts.TetMesh(mesh.vertices @ np.array([[c, 0, c], [0, 1, 0], [-c, 0, c]]).T, mesh.tets)
    for name, one, young, height in (("lower", mesh, 1e8, 0.025), ("upper", turned, 1e4, 0.085)):
        scene.add_body(one, rubber(young=young, density=1500.0, friction=0.1), name=name, position=(0, height, 0))
    scene.add_obstacle(GROUND, name="plane", friction=0.1)
    return scene


def demo(name: str) -> ts.Scene:
    """The scene of a demo."""
    return runpy.run_path(str(ROOT / "demos" / f"{name}.py"))["build"]()


BUNNY, ARMADILLO = "bunny.msh", "Armadillo13K.msh"
SMALL_BOX = ts.Box((0, -0.2, 0), (0.25, 0.2, 0.25))  # smaller than the mesh that lands on it
EULER = IMPLICIT | {"dt": 0.01}
# name: (scene, settings, steps that count, steps before them)
SCENES: dict[str, tuple[Callable[[], ts.Scene], dict, int, int]] = {
    "bunny on ground": (lambda: landing(BUNNY), EULER, 40, 0),
    "bunny on box": (lambda: landing(BUNNY, SMALL_BOX), EULER, 40, 0),
    "bunny on bunny": (lambda: on_another(BUNNY), EULER, 40, 0),
    "Armadillo on ground": (lambda: landing(ARMADILLO), EULER, 40, 0),
    "Armadillo on box": (lambda: landing(ARMADILLO, SMALL_BOX), EULER, 40, 0),
    "Armadillo on Armadillo": (lambda: on_another(ARMADILLO), EULER, 20, 0),
    "cloth on sphere": (cloth, {"integrator": "bdf2", "dt": 1 / 120}, 60, 0),
    "cube pile": (lambda: demo("cube_pile"), EULER, 60, 15),
    "twisted mat": (mat, IMPLICIT | {"dt": 0.02, "self_collision": True}, 60, 200),
    "squeeze": (lambda: demo("squeeze"), EULER, 60, 40),
    "gripper": (gripper, {"integrator": "bdf2", "dt": 0.01}, 60, 20),
    "soft on stiff": (slabs, IMPLICIT | {"dt": 1 / 120}, 60, 0),
}


def can_build(name: str) -> bool:
    """Whether the scene's mesh is available."""
    mesh = {"bunny": BUNNY, "Armadillo": ARMADILLO}.get(name.split()[0])
    return mesh is None or (MESHES / mesh).is_file()


def timed(call: Callable) -> tuple:
    """The result of a call, and its seconds without compilation."""
    begin, compiled = time.perf_counter(), runtime.compile_clock()
    result = call()
    return result, time.perf_counter() - begin - (runtime.compile_clock() - compiled)


def take_steps(sim: ts.Simulator, steps: int) -> tuple[list[float], list]:
    """Seconds without compilation, and reports, of single steps."""
    taken = [timed(lambda: sim.advance(1)) for _ in range(steps)]
    return [seconds for _, seconds in taken], [report for report, _ in taken]


def open_silently(scene: ts.Scene, **settings) -> ts.Simulator:
    """A simulator, without warnings."""
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        return ts.Simulator(scene, **settings)


def parts_of(sim: ts.Simulator) -> tuple:
    """The stepper and the state, whose names depend on the version."""
    if hasattr(sim, "_dynamics"):
        return sim._dynamics.stepper, sim._dynamics.state
    return sim._stepper, sim._simulation if hasattr(sim, "_simulation") else sim._world


def capture(name: str, file: Path, quick: bool) -> None:
    """Run a scene and save its states. quick: of the first steps only."""
    build, settings, steps, before = SCENES[name]
    steps, found = QUICK_STEPS if quick else steps, []
    with open_silently(build(), **settings, precision="f32") as sim:
        while sim.step_count < before:
            sim.advance(before - sim.step_count)
        for k in range(steps):
            stepper, state = parts_of(sim)
            kept = {"world": state.snapshot(), "stepper": stepper.snapshot()}
            report = sim.advance(1)
            found.append((report.newton_iterations, k, kept))
    slow = {k for _, k, _ in sorted(found, key=lambda one: -one[0])[:SLOWEST]}
    states = [{"step": before + k, "kept": kept, "captured": n} for n, k, kept in found if k % EVERY == 0 or k in slow]
    file.write_bytes(pickle.dumps({"scene": name, "states": states}))
    print(json.dumps({"scene": name, "states": len(states), "newton": sum(n for n, _, _ in found)}))


def replay(file: Path, precision: str, tolerance: float, reference: Path | None) -> None:
    """Solve the stage of each state."""
    data = pickle.loads(file.read_bytes())
    build, settings, _, _ = SCENES[data["scene"]]
    known = pickle.loads(reference.read_bytes()) if reference and reference.exists() else None
    ends = []
    with open_silently(build(), **settings, precision=precision) as sim:
        scale = float(np.mean([edge(body.mesh) for body in sim.scene.bodies]))
        stepper = parts_of(sim)[0]
        stepper.tolerance = stepper.contact_tolerance = tolerance
        for k, state in enumerate(data["states"]):
            row, x = solve(sim, state["kept"], sim.dt, 1 if reference and known is None else MAX_HALVES)
            row |= {"scene": data["scene"], "step": state["step"], "captured": state["captured"]}
            if known is not None and known[k] is not None and row["halves"] == 1:  # a step in halves is another one
                row["error"] = float(np.abs(x - known[k]).max() / scale)
            ends.append(x if row["converged"] else None)
            print(json.dumps(row), flush=True)
    if reference and known is None:
        reference.write_bytes(pickle.dumps(ends))


def edge(mesh: ts.TetMesh) -> float:
    """Mean edge of the mesh's surface [m]."""
    p = mesh.vertices[mesh.surface]
    return float(np.linalg.norm(p - np.roll(p, 1, axis=1), axis=2).mean())


def solve(sim: ts.Simulator, kept: dict, dt: float, max_halves: int) -> tuple[dict, np.ndarray]:
    """Solve a stage of dt from a state, divided into halves until it converges. Returns a row and the final positions."""
    stepper, world = parts_of(sim)
    halves, newton, linear, first, seconds, launched = 1, 0, 0, None, 0.0, 0
    while True:
        world.restore(kept["world"])
        stepper.restore(fitting(kept["stepper"], stepper.snapshot()))
        done, begin, compiled = [], time.perf_counter(), runtime.compile_clock()
        with counting() as counts:
            for part in range(halves):
                done.append(stepper.solve_stage(world.time + part * dt / halves, dt / halves, None))
                if not done[-1].converged:
                    break
        seconds += time.perf_counter() - begin - (runtime.compile_clock() - compiled)
        launched += counts.launches.total()
        newton += sum(r.newton_iterations for r in done)
        linear += sum(r.linear_iterations for r in done)
        first = first or done[0]
        good = done[-1].converged
        if good or halves >= max_halves:
            break
        halves *= 2
    row = {
        "newton": first.newton_iterations,
        "linear": first.linear_iterations,
        "all newton": newton,
        "all linear": linear,
        "halves": halves,
        "converged": good,
        "seconds": seconds,
        "launches": launched,
        "residual": done[-1].residual,
        "contact residual": done[-1].contact_residual,
        "contacts": int(stepper.contact.n_contacts),
    }
    return row, sim.positions()


def fitting(kept: dict, own: dict) -> dict:
    """A saved snapshot in the layout of this version; entries that it lacks keep this version's values."""
    found = {}
    for name, value in own.items():
        if name == "rows":  # contacts; a missing column is zero, as without impact
            rows = kept[name]
            found[name] = {key: rows.get(key, np.zeros_like(rows["r"])) for key in value}
        else:
            found[name] = fitting(kept[name], value) if isinstance(value, dict) and name in kept else kept.get(name, value)
    return found


if __name__ == "__main__":
    task, first, second, *rest = sys.argv[1:]
    if task == "capture":
        capture(first, Path(second), rest == ["quick"])
    else:
        replay(Path(first), second, float(rest[0]), Path(rest[1]) if rest[1:] else None)
