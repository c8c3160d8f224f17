"""The falling beam of exact_path.py in taisoft, and how many explicit steps a scene needs."""

import math

import taisoft as ts
from taisoft.errors import SimulationError
from taisoft.scene.scene import Scene
from taisoft.stability import stable_dt

from .exact_path import DENSITY, GRAVITY, POISSON, SAMPLE, SIZE, YOUNG
from .reference_cases.record import LAWS
from .timed_run import advance

MARGIN = 0.9  # step over the largest stable step about the rest shape


def n_tets(cells) -> int:
    """Number of tets, five per cell."""
    return 5 * math.prod(cells)


def beam_scene(cells, law: str = "SVK") -> Scene:
    """The beam at rest, clamped at its left end. law: one of LAWS."""
    scene = ts.Scene(gravity=(0.0, -GRAVITY, 0.0))
    rubber = ts.Material(law=LAWS[law], young=YOUNG, poisson=POISSON, density=DENSITY)
    beam = scene.add_body(ts.box_mesh(cells, SIZE), rubber, name="beam")
    beam.fix(lambda X: X[:, 0] < -SIZE[0] / 2 + 1e-9)
    return scene


def explicit_steps(scene: Scene) -> int:
    """Smallest number of explicit steps in 10 ms with dt at most MARGIN times the stability limit."""
    return math.ceil(SAMPLE / (MARGIN * stable_dt(scene, verlet=True)))


def lasting_steps(scene: Scene, integrator: str, arch: str, seconds: float) -> int:
    """Smallest number of explicit steps in 10 ms that is stable for `seconds`.

    The stability limit is that of small vibrations about the rest shape; laws stiffen under compression.
    """
    least = explicit_steps(scene)
    samples = round(seconds / SAMPLE)
    with ts.Simulator(scene, dt=SAMPLE / least, integrator=integrator, precision="f32", arch=arch) as sim:
        for steps in range(least, 4 * least):
            sim.dt = SAMPLE / steps
            sim.reset()
            try:
                advance(sim, steps * samples)
            except SimulationError:
                continue
            return steps
    raise SimulationError(f"{integrator}: even dt = {1e3 * sim.dt:.3f} ms does not last {seconds} s")
