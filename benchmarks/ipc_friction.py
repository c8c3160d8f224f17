"""How well friction holds and what it dissipates, from the contacts of each step.

A contact has a normal n, an impulse p on its side a [N s], and a relative displacement d [m] of its two points over the step,
from the nodes' displacements and the obstacle's path; t marks the parts across n. Only whole steps count: of a step that was cut
into substeps only the last one's contacts are known.

Creep: the mean of |d_t| / dt over the contacts that must stick, |p_t| < STICKING mu p_n, weighted with p_n, over all steps, in
mean surface edges per second; 0 if Coulomb's law holds exactly.
Work of friction: the sum of p_t . d_t / dt over contacts and steps [J], of the mean relative velocity; negative where friction
dissipates.
"""

import numpy as np

from taisoft import Simulator
from taisoft.collision.contacts import Contacts
from taisoft.mesh.tet_mesh import mean_surface_edge

STICKING = 0.9  # of the cone: impulses inside it must stick
TOLERANCES = (1e-2, 1e-4, 1e-6)
STEPS = {  # per case of the table: all tolerances take the same number
    "house_of_cards": 26,  # until just before the first cube hits
    "masonry_arch": 200,
    "roller_and_ball": 100,
    "rough_funnel": 75,
}


class FrictionMeter:
    """Sums over the steps of a simulator: call `add` after each step."""

    def __init__(self, sim: Simulator):
        self._sim, self._x, self._time = sim, sim.positions(), sim.time
        self._edge = mean_surface_edge([(b.rest_positions, b.nodes.surface) for b in sim.scene.bodies])
        self._obstacles = {one.name: one for one in sim.scene.obstacles}
        self._slip = self._load = 0.0  # sums of p_n |d_t| / dt and of p_n over what must stick
        self.work = 0.0  #: of friction so far [J]
        self.cut = 0  #: steps that were cut into substeps, and do not count

    @property
    def creep(self) -> float | None:
        """Mean creep so far [1/s], None if nothing had to stick."""
        return self._slip / self._load / self._edge if self._load > 0.0 else None

    def add(self, substeps: int) -> None:
        """Add the last step. substeps: how many it had."""
        x, time, c = self._sim.positions(), self._sim.time, self._sim.contacts()
        moved, begin, dt = x - self._x, self._time, time - self._time
        self._x, self._time = x, time
        if substeps > 1:
            self.cut += 1
            return
        if not len(c):
            return
        d = relative_displacements(c, moved) - self._obstacle_displacements(c, begin, time)
        across, pressing, tangential = parts(c, d)
        self.work += float((tangential * across).sum() / dt)
        sticks = np.linalg.norm(tangential, axis=1) < STICKING * c.friction * pressing
        self._load += float(pressing[sticks].sum())
        self._slip += float((pressing * np.linalg.norm(across, axis=1))[sticks].sum() / dt)

    def _obstacle_displacements(self, c: Contacts, begin: float, end: float) -> np.ndarray:
        """(k,3) [m] how far the obstacle at each contact moves its point; 0 for bodies."""
        moved = np.zeros((len(c), 3))
        for name, obstacle in self._obstacles.items():
            here = c.body_b == name
            if obstacle.path is not None and here.any():
                (shift, turn), pivot = obstacle.pose(begin), obstacle.shape.pivot
                at_rest = (c.point[here] - pivot - shift) @ turn + pivot
                moved[here] = obstacle.points_at(end, at_rest) - c.point[here]
        return moved


def relative_displacements(c: Contacts, moved: np.ndarray) -> np.ndarray:
    """(k,3) [m] displacement of side a minus that of side b, for nodes that moved by (n,3) [m]; obstacles at rest."""
    signs = np.array([1.0, 1.0, 1.0, -1.0, -1.0, -1.0])
    return np.einsum("kq,kqi->ki", np.where(c.nodes >= 0, c.weights, 0.0) * signs, moved[c.nodes])


def parts(c: Contacts, d: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """The tangential part of displacements d (k,3), and normal (k,) and tangential impulses (k,3) [N s]."""
    pressing = (c.impulse * c.normal).sum(axis=1)
    across = d - (d * c.normal).sum(axis=1)[:, None] * c.normal
    return across, pressing, c.impulse - pressing[:, None] * c.normal
