"""How well friction holds and what it dissipates, from the contacts of each step.

A contact has a normal n, an impulse p on its side a [N s], and a relative velocity u [m/s] of its two points. Steps of implicit
Euler displace nodes by dt times their velocity at the end, so that u is the mean over the step. The obstacle's part of u is the
mean of its path. t marks the parts across n. Of a step that was cut into substeps only the last one's contacts are known.

Creep: the mean of |u_t| over the contacts that must stick, |p_t| < STICKING mu p_n, weighted with p_n, over all steps, in mean
surface edges per second; 0 if Coulomb's law holds exactly.
Work of friction: the sum of p_t . u_t over contacts and steps [J]; negative where friction dissipates. In a cut step, the last
substep's work counts as often as there are substeps: an estimate.
"""

import numpy as np

from taisoft import Simulator
from taisoft.collision.contacts import Contacts
from taisoft.mesh.quality import mean_surface_edge

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
        self._sim = sim
        self._edge = mean_surface_edge([(b.rest_positions, b.nodes.surface) for b in sim.scene.bodies])
        self._moving = [one for one in sim.scene.obstacles if one.path is not None]
        self._slip = self._load = 0.0  # sums of p_n |u_t| and of p_n over what must stick
        self.work = 0.0  #: of friction so far [J]
        self.cut = 0  #: steps that were cut into substeps

    @property
    def creep(self) -> float | None:
        """Mean creep so far [1/s], None if nothing had to stick."""
        return self._slip / self._load / self._edge if self._load > 0.0 else None

    def add(self, substeps: int) -> None:
        """Add the last step. substeps: how many it had."""
        self.cut += substeps > 1
        c = self._sim.contacts()
        if not len(c):
            return
        u = relative_velocities(c, self._sim.velocities()) - self._obstacle_velocities(c, self._sim.dt / substeps)
        across, pressing, tangential = parts(c, u)
        self.work += float((tangential * across).sum()) * substeps
        sticks = np.linalg.norm(tangential, axis=1) < STICKING * c.friction * pressing
        self._load += float(pressing[sticks].sum())
        self._slip += float((pressing * np.linalg.norm(across, axis=1))[sticks].sum())

    def _obstacle_velocities(self, c: Contacts, dt: float) -> np.ndarray:
        """(k,3) [m/s] mean velocity over the last dt [s] of the obstacle at each contact; 0 for bodies."""
        found, end = np.zeros((len(c), 3)), self._sim.time
        for obstacle in self._moving:
            here = c.body_b == obstacle.name
            (shift, turn), pivot = obstacle.pose(end - dt), obstacle.shape.pivot
            at_rest = (c.point[here] - pivot - shift) @ turn + pivot
            found[here] = (obstacle.points_at(end, at_rest) - c.point[here]) / dt
        return found


def relative_velocities(c: Contacts, v: np.ndarray) -> np.ndarray:
    """(k,3) [m/s] velocity of side a minus that of side b, for nodes of velocities v (n,3) [m/s]; obstacles at rest."""
    signs = np.repeat([1.0, -1.0], c.nodes.shape[1] // 2)
    return np.einsum("kq,kqi->ki", np.where(c.nodes >= 0, c.weights, 0.0) * signs, v[c.nodes])


def parts(c: Contacts, u: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """The tangential part of velocities u (k,3), and normal (k,) and tangential impulses (k,3) [N s]."""
    pressing = (c.impulse * c.normal).sum(axis=1)
    across = u - (u * c.normal).sum(axis=1)[:, None] * c.normal
    return across, pressing, c.impulse - pressing[:, None] * c.normal
