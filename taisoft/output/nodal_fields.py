"""Nodal fields for viewers, computed on the host from a simulator: stress, stretch, speed and contact loads.

The stress at node i is the mean over its tets e, weighted by their rest volumes V_e,
    sigma_i = sum_e V_e sigma_e / sum_e V_e,
and viewers show its von Mises equivalent,
    q = sqrt(3/2 s : s),  s = sigma - tr(sigma)/3 I.
Tensors are averaged rather than their q, so that opposite shears of neighbours cancel. Averaging smooths: peaks at edges and
corners come out lower than in the tets, and the chequerboard stresses of locking linear tets are damped. At surface nodes the
mean is first-order accurate.
"""

from functools import cached_property

import numpy as np
import scipy.sparse as sp

from taisoft.fem.reference import inverse_rest_edges
from taisoft.scene.rigid import RigidBody
from taisoft.view.choices import COLOURS

VECTORS = ("traction", "slip")  # of `ContactPressure`
UNKNOWN_ERROR = -1.0  # in files, of nodes whose error is unknown


class NodalMean:
    """Mean over the tets at each node, weighted by rest volumes, for bodies of either order. bodies: in the order added."""

    def __init__(self, bodies):
        rows, columns, n, m = [], [], 0, 0
        for body in bodies:
            elements = body.nodes.elements
            rows.append(n + elements.ravel())
            columns.append(m + np.repeat(np.arange(len(elements)), elements.shape[1]))
            n, m = n + body.n_nodes, m + len(elements)
        volumes = np.concatenate([body.volumes for body in bodies])
        rows, columns = np.concatenate(rows), np.concatenate(columns)
        weights = volumes[columns] / np.bincount(rows, volumes[columns], n)[rows]
        self._mean = sp.csr_matrix((weights, (rows, columns)), shape=(n, m))
        if any(body.nodes.embedded is not None for body in bodies):
            self._mean = sp.block_diag([_spread(body) for body in bodies], format="csr") @ self._mean

    def __call__(self, values: np.ndarray) -> np.ndarray:
        """Average values (m, ...) of all tets of all bodies to the nodes (n, ...).

        Tets with a value that is not finite, such as the stress in a flat tet, are left out; a node without any other gets 0.
        """
        flat = np.asarray(values, dtype=np.float64).reshape(self._mean.shape[1], -1)
        finite = np.isfinite(flat).all(axis=1)
        if finite.all():
            mean = self._mean @ flat
        else:
            total = self._mean @ finite.astype(np.float64)
            mean = (self._mean @ np.where(finite[:, None], flat, 0.0)) / np.where(total > 0.0, total, 1.0)[:, None]
        return mean.reshape(-1, *np.shape(values)[1:])


def _spread(body) -> sp.csr_matrix:
    """Matrix (n, n) that keeps values of the nodes of tets, and gives embedded vertices what these have around them."""
    embedded, own = body.nodes.embedded, sp.identity(body.nodes.n_elastic, format="csr")
    if embedded is None:
        return own
    return sp.hstack([sp.vstack([own, embedded]), sp.csr_matrix((body.n_nodes, embedded.shape[0]))], format="csr")


def surface_values(sim, *names: str) -> list[np.ndarray]:
    """Return fields of `sim.contact_pressure` at the nodes of all bodies (n, ...): 0 inside, and where nothing can touch.

    States are their numbers.
    """
    from taisoft.collision.contacts import STATES  # loads Taichi, which windows do without

    starts = np.cumsum([0, *(body.n_nodes for body in sim.scene.bodies)])
    found = [np.zeros((starts[-1], 3) if name in VECTORS else starts[-1]) for name in names]
    for body, first in zip(sim.scene.bodies if sim.touches else (), starts):
        record = sim.contact_pressure(body.name)
        for one, name in zip(found, names):
            values = getattr(record, name)
            one[first + record.index] = values if name != "state" else np.array([STATES.index(state) for state in values])
    return found


def von_mises(sigma: np.ndarray) -> np.ndarray:
    """Return the von Mises stress (...,) [Pa] of stresses (..., 3, 3) [Pa]: 0 for pure pressure, |s| for uniaxial tension s."""
    deviator = sigma - np.trace(sigma, axis1=-2, axis2=-1)[..., None, None] / 3.0 * np.eye(3)
    return np.sqrt(1.5 * np.einsum("...ij,...ij->...", deviator, deviator))


class NodalValues:
    """Quantities at the nodes of all bodies (n_nodes,) in a simulator's present state. bodies: of the scene, in the order added.

    by_step: stress is computed once a step, for several writers of one run.
    """

    def __init__(self, bodies, by_step: bool = False):
        self._bodies, self._by_step, self._stress = bodies, by_step, (None, np.empty(0))  # with the number of its step
        self._rigid = np.concatenate([np.full(body.n_nodes, isinstance(body, RigidBody)) for body in bodies])

    def __call__(self, kind: str, sim) -> np.ndarray:
        """Return one of `taisoft.view.choices.COLOURS` that has values."""
        return COLOURS[kind].value(self, sim)

    def stress(self, sim) -> np.ndarray:
        """Return the von Mises stress [Pa] of the mean stress, NaN in rigid bodies, whose tet is not their material."""
        if not self._by_step or self._stress[0] != sim.step_count:
            found = von_mises(self._mean(sim.stress()))
            self._stress = sim.step_count, np.where(self._rigid, np.nan, found)
        return self._stress[1]

    def stretch(self, sim) -> np.ndarray:
        """Return the mean of the largest principal stretch; for quadratic tets that of the linear tet of the corners."""
        parts = []
        for body, Dm_inv in zip(self._bodies, self._Dm_inv):
            corner = sim.positions(body.name)[body.mesh.tets]
            F = (corner[:, 1:] - corner[:, :1]).transpose(0, 2, 1) @ Dm_inv
            parts.append(np.sqrt(np.linalg.eigvalsh(F.transpose(0, 2, 1) @ F)[:, 2]))
        return self._mean(np.concatenate(parts))

    @staticmethod
    def speed(sim) -> np.ndarray:
        """Return the speed [m/s]."""
        return np.linalg.norm(sim.velocities(), axis=1)

    @staticmethod
    def touching(sim, field: str) -> np.ndarray:
        """Return a field of `ContactPressure`."""
        return surface_values(sim, field)[0]

    @cached_property
    def _mean(self) -> NodalMean:
        return NodalMean(self._bodies)

    @cached_property
    def _Dm_inv(self) -> list[np.ndarray]:
        return [inverse_rest_edges(b.mesh.vertices, b.mesh.tets)[0] for b in self._bodies]
