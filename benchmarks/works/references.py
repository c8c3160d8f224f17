"""Exact paths of W1 and W2 for each program's law and masses, stored in data/works.npz with their uncertainty.

W1: the mean of the beam's end face, by Runge-Kutta of order 8 (exact_path.py). W2: the mass centre's height, by velocity Verlet
with contact at the nodes: those that would end a step below the ground stop on it, with Coulomb friction. This is of first
order in dt; the path is that of DT / 2, its uncertainty the distance to that of DT.

`python -m benchmarks.works.references` computes the file (about 20 minutes).
"""

import argparse
from dataclasses import dataclass
from itertools import product
from pathlib import Path
from time import perf_counter

import numpy as np

from taisoft.errors import SimulationError

from ..exact_path import DENSITY, POISSON, SAMPLE, integrate
from .scenes import WORKS, Work
from .semi_discrete import SemiDiscrete

DATA = Path(__file__).parent.parent / "data" / "works.npz"
DT = 1e-4  # s
TOLERANCES = (1e-7, 1e-9)  # of W1


@dataclass(frozen=True)
class Model:
    """Model of a program: its law (see semi_discrete.LAWS), and whether all nodes have equal masses."""

    law: str
    equal_masses: bool = False

    def __str__(self) -> str:
        return self.law + (", equal masses" if self.equal_masses else "")


TAISOFT, MUJOCO, PYBULLET, NEWTON = Model("SNH"), Model("SVK"), Model("SNH", equal_masses=True), Model("SNH13")
MODELS = (TAISOFT, MUJOCO, PYBULLET, NEWTON)


@dataclass(frozen=True)
class Reference:
    """path (k,d) [m], a point every SAMPLE from 0 on; good_to: its uncertainty, as an `error`."""

    work: Work
    path: np.ndarray
    good_to: float

    def error(self, path: np.ndarray) -> float:
        """Error of a path (k,d) [m]: W1: largest distance over the excursion; W2: root mean square over the drop of 0.5 m."""
        away = np.linalg.norm(path - self.path, axis=1)
        if self.work.cells is None:
            return float(np.sqrt(np.mean(away**2)) / 0.5)
        return float(away.max() / np.linalg.norm(self.path - self.path[0], axis=1).max())


def observed(work: Work, positions: np.ndarray, mass: np.ndarray) -> np.ndarray:
    """The compared quantity from positions (k,n,3) [m]: W1's tip (k,3), W2's height of the mass centre (k,1)."""
    if work.cells is None:
        return (positions[:, :, 1] @ mass / mass.sum())[:, None]
    return positions[:, tip(work)].mean(axis=1)


def tip(work: Work) -> np.ndarray:
    """Indices of the nodes of W1's end face."""
    x = work.start[:, 0]
    return np.flatnonzero(x > x.max() - 1e-9)


def masses(work: Work, model: Model) -> np.ndarray:
    """Masses of all nodes (n,) [kg], body after body."""
    return np.concatenate([semi_discrete(work, k, model).mass for k in range(len(work.bodies))])


def semi_discrete(work: Work, k: int, model: Model) -> SemiDiscrete:
    """Body k of a work with a program's law and masses."""
    body = work.bodies[k]
    numbers = (model.law, body.young, POISSON, DENSITY, work.gravity)
    return SemiDiscrete(body.mesh, *numbers, ~body.fixed, equal_masses=model.equal_masses)


def fall_on_ground(body: SemiDiscrete, friction: float, dt: float, seconds: float) -> np.ndarray:
    """Height of the mass centre (k,1) [m] every SAMPLE. Raises SimulationError if it diverges."""
    steps = round(SAMPLE / dt)
    u, v = np.zeros((2, 3, len(body.mass)))
    height, heights = body.vertices[:, 1], []
    v += 0.5 * dt * body.acceleration(u)
    for k in range(round(seconds / SAMPLE) * steps + 1):
        if k % steps == 0:
            heights.append(body.mass @ (height + u[1]) / body.mass.sum())
        down = -(height + u[1]) / dt  # lower velocities end below the ground
        hit = v[1] < down
        pushed = (down - v[1])[hit]
        v[1, hit] = down[hit]
        speed = np.hypot(v[0, hit], v[2, hit])
        v[::2, hit] *= np.maximum(1 - friction * pushed / np.maximum(speed, 1e-300), 0)
        u += dt * v
        v += dt * body.acceleration(u)
    if not np.isfinite(heights).all():
        raise SimulationError(f"dt = {dt} s diverges")
    return np.array(heights)[:, None]


def make(work: Work, model: Model) -> tuple[np.ndarray, float]:
    """Compute a path and its uncertainty."""
    body = semi_discrete(work, 0, model)
    if work.cells is None:
        loose, path = (fall_on_ground(body, work.friction, dt, work.seconds) for dt in (DT, DT / 2))
    else:
        loose, path = (integrate(body, tolerance, tip(work))[1] for tolerance in TOLERANCES)
    return path, Reference(work, path, 0.0).error(loose)


def load(work: Work, model: Model) -> Reference:
    """The stored reference. Raises SimulationError without one."""
    with np.load(DATA) as data:
        if f"{work.key}: {model}" not in data:
            raise SimulationError(f"no reference is stored for {work.key} with {model}")
        return Reference(work, data[f"{work.key}: {model}"], float(data[f"{work.key}: {model}: good to"]))


def main(arguments=None) -> None:
    """Compute the file; existing paths are kept without --anew."""
    parser = argparse.ArgumentParser(description=__doc__.partition("\n")[0])
    parser.add_argument("--anew", action="store_true", help="recompute all")
    options = parser.parse_args(arguments)
    kept = dict(np.load(DATA)) if DATA.exists() and not options.anew else {}
    for work, model in product((work for work in WORKS if work.kind == "path"), MODELS):
        name, start = f"{work.key}: {model}", perf_counter()
        if name in kept:
            continue
        try:
            kept[name], kept[f"{name}: good to"] = make(work, model)
        except SimulationError as error:
            print(f"{name}: {error}", flush=True)
            continue
        print(f"{name}: good to {kept[f'{name}: good to']:.1e}, {perf_counter() - start:.0f} s", flush=True)
        np.savez_compressed(DATA, **kept)


if __name__ == "__main__":
    main()
