"""Parts of `cuda_check.py`; each runs in its own process and prints results as they come."""

from collections.abc import Callable, Iterator
from contextlib import closing
from itertools import product
from time import perf_counter
from types import SimpleNamespace

import numpy as np

import taisoft as ts
from taisoft import changes
from taisoft.backend.runtime import open_runtime
from taisoft.dynamics.schemes import EXPLICIT
from taisoft.errors import TaisoftError
from taisoft.scene.scene import Scene

from .beam import MARGIN, beam_scene
from .contact_colouring import measure_crossover
from .programs import own
from .programs.session import Setting
from .runner import patched, print_result, warm_up
from .scaling_runs import cubes_on_ground
from .timed_run import advance
from .works.references import MUJOCO, TAISOFT
from .works.runs import Row, measure
from .works.scenes import WORKS

EXPLICIT_STEPS = {"W1 12x3x3": 3, "W1 24x6x6": 5, "W1 48x12x12": 11, "W2": 3, "W3": 2, "W4": 19}  # stable steps in 10 ms
TIMED_STEPS, IMPLICIT_STEPS = 200, 3
SMALL = 4  # cells across the small beam; its stable step is scaled to larger ones
PLATES, QUICK_PLATES = (8, 32, 64, 128), (4,)
SIZES, QUICK_SIZES = (37, 58), (6,)  # cells across a beam of 20 n^3 tets: 1.0 and 3.9 million
CUBES, QUICK_CUBES = 100_000, 640  # tets, about
RERUNS = 3


def run_job(name: str, arch: str, quick: bool) -> None:
    """Print the results of a part."""
    for found in JOBS[name][2](arch, quick):
        print_result(found)


def works(arch: str, quick: bool) -> Iterator[dict]:
    """Time and error of the works, explicit and implicit, on `arch` and on the CPU of the same machine."""
    for work in WORKS:
        if work.key in (("W1 12x3x3",) if quick else EXPLICIT_STEPS):
            model = MUJOCO if work.cells is not None else TAISOFT
            methods = (("velocity_verlet", EXPLICIT_STEPS[work.key]), ("implicit_euler", 1))
            kinds = product(methods, dict.fromkeys((arch, "cpu")))
            settings = [Setting(own.NAME, model, *method, {"precision": "f32", "arch": where}) for method, where in kinds]
            program = SimpleNamespace(NAME=own.NAME, Run=own.Run, settings=lambda _work, _arch, settings=settings: settings)
            yield from map(_work_numbers, measure(work, [program], 1))


def _work_numbers(row: Row) -> dict:
    """Time, error and verdict of one setting, or its failure."""
    setting = row.setting
    named = {"work": row.work.key, "tets": row.work.tets, "setting": f"{setting.method}, {1e3 * setting.dt:.3g} ms"}
    named |= {"arch": setting.options["arch"]}
    if row.failure:
        return named | {"failure": row.failure}
    found = {name: getattr(row.verdict, name) for name in ("error", "stands", "inverted")}
    return named | found | {"seconds": row.timing.median, "build_seconds": row.build_seconds[0], "unconverged": row.unconverged}


def sweeps(arch: str, quick: bool) -> Iterator[dict]:
    """Coloured against serial Gauss-Seidel on two plates with increasing numbers of contacts."""
    for n in QUICK_PLATES if quick else PLATES:
        with closing(open_runtime(arch, "f32", "the check of solvers")) as runtime:
            (point,) = measure_crossover((n,), runtime)
        yield {"contacts": point.contacts, "colours": point.colours} | {
            f"{name}_{what}": value
            for name, one in (("serial", point.serial), ("coloured", point.coloured))
            for what, value in (("ms", 1e3 * one.median), ("sweeps", one.sweeps), ("residual", one.residual))
        }


def sizes(arch: str, quick: bool) -> Iterator[dict]:
    """Explicit and implicit steps of large beams, and steps with contacts on `arch` and on the CPU of the same machine."""
    with ts.Simulator(beam_scene((4 * SMALL, SMALL, SMALL), "SNH"), dt=1e-6, integrator="velocity_verlet", arch=arch) as sim:
        limit = sim.stable_dt
    scenes = {n: beam_scene((4 * n, n, n), "SNH") for n in (QUICK_SIZES if quick else SIZES)}
    for integrator in ("velocity_verlet", "bdf2"):
        for n, scene in scenes.items():
            dt = 0.01 if integrator == "bdf2" else 0.8 * MARGIN * limit * SMALL / n
            yield {"tets": 20 * n**3, "integrator": integrator, "arch": arch} | _timed_size(scene, integrator, dt, arch)
    for integrator, dt in (("implicit_euler", 0.005), ("symplectic_euler", 1e-4)):
        for where in dict.fromkeys((arch, "cpu")):
            scene = cubes_on_ground(QUICK_CUBES if quick else CUBES)
            tets = sum(body.mesh.n_tets for body in scene.bodies)
            named = {"tets": tets, "integrator": f"{integrator}, contacts", "arch": where}
            yield named | _timed_size(scene, integrator, dt, where)


def _timed_size(scene: Scene, integrator: str, dt: float, arch: str) -> dict:
    start = perf_counter()
    try:
        # the highest frequency of millions of tets takes minutes on the host: the step is scaled from the small beam's
        with patched(changes, "check_stability", lambda *_, **__: None):
            sim = ts.Simulator(scene, dt=dt, integrator=integrator, arch=arch)
        with sim:
            build = perf_counter() - start - sim.compile_seconds
            warm_up(sim)
            timed_run = advance(sim, TIMED_STEPS if integrator in EXPLICIT else IMPLICIT_STEPS)
            return {
                "step_ms": 1e3 * timed_run.seconds / timed_run.steps,
                "steps": timed_run.steps,
                "linear": timed_run.linear_iterations,
                "newton": timed_run.newton_iterations,
                "unconverged": timed_run.unconverged,
                "inverted": timed_run.inverted,
                "build_seconds": build,
                "compile_seconds": sim.compile_seconds,
                "field_bytes": sum(sim.field_bytes.values()),
            }
    except TaisoftError as error:
        return {"failure": str(error)}


def reruns(arch: str, quick: bool) -> Iterator[dict]:
    """Distance of the final states of reruns to the first run, relative to its excursion."""
    for name, build, integrator, dt, seconds in (
        ("hanging beam", lambda: beam_scene((12, 3, 3), "SNH"), "velocity_verlet", 0.002, 1.0),
        ("hanging beam", lambda: beam_scene((12, 3, 3), "SNH"), "bdf2", 0.01, 0.5),
        ("two cubes on the ground", lambda: cubes_on_ground(640), "symplectic_euler", 5e-4, 0.2),
        ("two cubes on the ground", lambda: cubes_on_ground(640), "implicit_euler", 0.005, 0.2),
    )[: 1 if quick else None]:
        ends, start = [], None
        with ts.Simulator(build(), dt=dt, integrator=integrator, arch=arch, allow_unstable=True) as sim:
            for _ in range(RERUNS):
                sim.reset()
                start = sim.positions()
                advance(sim, round(seconds / dt))
                ends.append(sim.positions())
        excursion = float(np.abs(ends[0] - start).max())
        spread = max(float(np.abs(end - ends[0]).max()) for end in ends[1:])
        yield {"scene": name, "integrator": integrator, "reruns": RERUNS, "spread": spread / excursion}


JOBS: dict[str, tuple[str, float, Callable[[str, bool], Iterator[dict]]]] = {  # title, time limit [s], what is measured
    "sizes": ("One and four million tets, and contacts", 110.0, sizes),
    "reruns": ("Repeatability", 50.0, reruns),
    "works": ("Works W1 to W4", 120.0, works),
    "sweeps": ("Coloured against serial Gauss-Seidel", 40.0, sweeps),
}
