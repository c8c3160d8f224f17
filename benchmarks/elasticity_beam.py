"""The falling beam of exact_path.py in taisoft: its scene, its steps, its tip's path, its memory.

Below model.PARALLEL_FROM tets or PARALLEL_THREADS threads taisoft steps on one thread of the CPU, and so does MuJoCo.
"""

import math

import numpy as np

import taisoft as ts
from taisoft.output.report import peak_memory
from taisoft.scene.scene import Scene
from taisoft.stability import stable_dt
from taisoft.study.measure import TimedRun, advance, warm_up

from .exact_path import DENSITY, GRAVITY, POISSON, SAMPLE, SIZE, YOUNG

LAWS = {"SNH": "stable_neo_hookean", "SVK": "st_venant_kirchhoff", "COR": "corotational"}
MARGIN = 0.9  # of the largest stable step about the rest shape


def n_tets(cells) -> int:
    """Number of tets, five a cell."""
    return 5 * math.prod(cells)


def beam_scene(cells, law: str = "SVK") -> Scene:
    """The beam, clamped at its left end face, straight and at rest. law: one of LAWS."""
    scene = ts.Scene(gravity=(0.0, -GRAVITY, 0.0))
    rubber = ts.Material(law=LAWS[law], young=YOUNG, poisson=POISSON, density=DENSITY)
    beam = scene.add_body(ts.box_mesh(cells, SIZE), rubber, name="beam")
    beam.fix(lambda X: X[:, 0] < -SIZE[0] / 2 + 1e-9)
    return scene


def explicit_steps(scene: Scene) -> int:
    """Smallest number of explicit steps in 10 ms whose dt is at most MARGIN of the limit."""
    return math.ceil(SAMPLE / (MARGIN * stable_dt(scene, verlet=True)))


def steps_within_limit(cells) -> int:
    """Those of the beam; one limit for all laws."""
    return explicit_steps(beam_scene(cells))


def follow_tip(sim: ts.Simulator, steps: int, samples: int) -> tuple[np.ndarray, TimedRun]:
    """Path (samples + 1, 3) [m] of the mean of the end face's nodes, every `steps` steps from the start, and the stretch."""
    sim.reset()
    tip = np.flatnonzero(sim.scene.body("beam").rest_positions[:, 0] > SIZE[0] / 2 - 1e-9)
    path, whole = [sim.positions("beam")[tip].mean(axis=0)], TimedRun()
    for _ in range(samples):
        whole += advance(sim, steps)
        path.append(sim.positions("beam")[tip].mean(axis=0))
    return np.array(path), whole


def measure_memory(meshes, arch: str, integrators=("velocity_verlet", "bdf2")) -> list[dict]:
    """Bytes of the fields per tet in f32, by default of an explicit and an implicit simulator, and the peak of the process."""
    rows = [{"tets": 0, "integrator": "before", "field_bytes": 0, "bytes_per_tet": None, "peak_bytes": peak_memory()}]
    for cells in meshes:
        for integrator in integrators:
            dt = SAMPLE / steps_within_limit(cells)
            with ts.Simulator(beam_scene(cells), dt=dt, integrator=integrator, precision="f32", arch=arch) as sim:
                warm_up(sim)
                total = sum(sim.field_bytes.values())
            rows.append(
                {
                    "tets": n_tets(cells),
                    "integrator": integrator,
                    "field_bytes": total,
                    "bytes_per_tet": total / n_tets(cells),
                    "peak_bytes": peak_memory(),
                }
            )
    return rows
