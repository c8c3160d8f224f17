"""Evaluation of recorded runs, the same for every program: error if an exact path is known, else whether it stands."""

from dataclasses import dataclass

import numpy as np

import taisoft as ts
from taisoft.mesh.quality import mean_surface_edge

from ..exact_path import SAMPLE
from ..programs.own import make_scene
from ..runner import without_warnings
from . import references
from .scenes import Work
from .semi_discrete import inverted

SHALLOW = 0.01  # maximum penetration over an edge
LEAN = 0.1  # maximum distance of a centre from the axis over the width
FREE = 0.2  # maximum relative error of a free fall; implicit Euler with 10 ms has 7 %
LEAST = 0.2  # minimum height of a centre above its support over the height at rest


@dataclass
class Verdict:
    """error: None without an exact path; good_to: uncertainty of the reference. inverted: maximum over the samples.

    penetration: maximum over the samples [m], None without contacts; edge: smallest of the bodies' mean surface edges [m]. fell:
    time at which it no longer stood [s], or None. free_fall: distance that the last body fell before anything reached it, over
    that of a free fall, or None.
    """

    inverted: int
    error: float | None = None
    good_to: float | None = None
    penetration: float | None = None
    edge: float | None = None
    fell: float | None = None
    free_fall: float | None = None

    @property
    def stands(self) -> bool:
        """Whether nothing fell, hung in the air, inverted a tet or penetrated by more than 1 % of an edge."""
        shallow = self.penetration is None or self.penetration <= SHALLOW * self.edge
        free = self.free_fall is None or abs(self.free_fall - 1.0) <= FREE
        return self.fell is None and self.inverted == 0 and shallow and free


def evaluate(work: Work, model: references.Model, positions: np.ndarray) -> Verdict:
    """Evaluate the positions (k,n,3) [m] of a program with this model."""
    parts = list(zip(work.bodies, work.slices().values()))
    verdict = Verdict(max(sum(inverted(body.mesh, x[nodes]) for body, nodes in parts) for x in positions))
    if work.kind == "path":
        reference = references.load(work, model)
        path = references.observed(work, positions, references.masses(work, model))
        verdict.error, verdict.good_to = reference.error(path), reference.good_to
    if work.touches:
        verdict.edge = min(mean_surface_edge([(body.mesh.vertices, body.mesh.surface)]) for body in work.bodies)
        verdict.penetration = deepest(work, positions)
    if work.kind == "stand":
        fallen = [k for k, x in enumerate(positions) if not _stands(work, x)]
        verdict.fell = fallen[0] * SAMPLE if fallen else None
    verdict.free_fall = free_fall(work, positions)
    return verdict


def free_fall(work: Work, positions: np.ndarray) -> float | None:
    """Distance that the last body has fallen by `free_until` over g t^2 / 2; None if undefined or not recorded so long."""
    if work.free_until is None or round(work.free_until / SAMPLE) >= len(positions):
        return None
    height = positions[:, list(work.slices().values())[-1], 1].mean(axis=1)
    return float((height[0] - height[round(work.free_until / SAMPLE)]) / (0.5 * work.gravity * work.free_until**2))


def deepest(work: Work, positions: np.ndarray) -> float:
    """Deepest overlap of two bodies, or of one and the ground, in any sample [m], by taisoft in f64.

    No simulator of another precision may be open.
    """
    with without_warnings():
        sim = ts.Simulator(make_scene(work), dt=1e-6, integrator="velocity_verlet", precision="f64")
    depth = 0.0
    with sim:
        for x in positions:
            sim.set_state(x, np.zeros_like(x))
            depth = max([depth, *(one.depth for one in sim.overlaps())])  # of finite positions always finite
    return depth


def _stands(work: Work, x: np.ndarray) -> bool:
    """Whether every free body lies on the previous one or the ground, near the axis."""
    floor = 0.0
    for body, nodes in zip(work.bodies, work.slices().values()):
        size = np.ptp(body.mesh.vertices, axis=0)
        centre = x[nodes].mean(axis=0)
        if not body.fixed.any():
            if np.abs(centre[[0, 2]]).max() > LEAN * size[0] or centre[1] - floor < LEAST * size[1]:
                return False
            floor = centre[1] + LEAST * size[1]
        else:
            loose = next(other.mesh.vertices for other in work.bodies if not other.fixed.any())
            below = np.abs(body.mesh.vertices[:, [0, 2]]).max(axis=1) <= 0.5 * np.ptp(loose[:, 0]) + 1e-9
            floor = x[nodes][below, 1].mean()
    return True
