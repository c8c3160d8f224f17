"""Fields at the nodes for viewers, made on the host from what a simulator tells about tets and contacts: stress and impulses.

The stress at node i is the mean over its tets e, weighted by their rest volumes V_e,
    sigma_i = sum_e V_e sigma_e / sum_e V_e,
and what is shown of it is von Mises' equivalent,
    q = sqrt(3/2 s : s),  s = sigma - tr(sigma)/3 I.
Tensors are averaged, not their q, so that opposite shears of neighbours cancel. The mean smooths: peaks at edges and corners come
out lower than in the tets, and stresses of linear tets that lock show less of their chequer. At surface nodes it is first order.
"""

import numpy as np
import scipy.sparse as sp


class NodalMean:
    """Means over the tets at each node, of either order, weighted by rest volumes. bodies: in the order added."""

    def __init__(self, bodies):
        rows, columns, n, m = [], [], 0, 0
        for body in bodies:
            elements = body.nodes.elements
            rows.append(n + elements.ravel())
            columns.append(m + np.repeat(np.arange(len(elements)), elements.shape[1]))
            n, m = n + body.n_nodes, m + len(elements)
        volumes = np.concatenate([body.mesh.volumes for body in bodies])
        rows, columns = np.concatenate(rows), np.concatenate(columns)
        share = volumes[columns] / np.bincount(rows, volumes[columns], n)[rows]
        self._mean = sp.csr_matrix((share, (rows, columns)), shape=(n, m))

    def __call__(self, values: np.ndarray) -> np.ndarray:
        """Of values (m, ...) of all tets of all bodies: (n, ...) at the nodes.

        A tet where a value is not finite, as a stress in a flat one, does not count; 0 where no tet of a node does.
        """
        flat = np.asarray(values, dtype=np.float64).reshape(self._mean.shape[1], -1)
        known = np.isfinite(flat).all(axis=1)
        if known.all():
            mean = self._mean @ flat
        else:
            counted = self._mean @ known.astype(np.float64)
            mean = (self._mean @ np.where(known[:, None], flat, 0.0)) / np.where(counted > 0.0, counted, 1.0)[:, None]
        return mean.reshape(-1, *np.shape(values)[1:])


def von_mises(sigma: np.ndarray) -> np.ndarray:
    """Equivalent stress (...,) [Pa] of stresses (..., 3, 3) [Pa]: 0 under pressure alone, |s| under uniaxial tension s."""
    deviator = sigma - np.trace(sigma, axis1=-2, axis2=-1)[..., None, None] / 3.0 * np.eye(3)
    return np.sqrt(1.5 * np.einsum("...ij,...ij->...", deviator, deviator))


def contact_impulses(contacts, n_nodes: int) -> np.ndarray:
    """Impulses (n_nodes, 3) [N s] that contacts gave to the nodes of all bodies, in the order added.

    contacts: a record as `Simulator.contacts` gives it. Each impulse goes to the nodes that it acted on in the solver, by their
    weights, with its sign on side a and the opposite on side b, so that sums over a body are those of its contacts.
    """
    sides = np.repeat([1.0, -1.0], 3)
    parts = (sides * contacts.weights)[:, :, None] * contacts.impulse[:, None]  # (k,6,3)
    used = contacts.nodes >= 0
    total = np.zeros((n_nodes, 3))
    for axis in range(3):
        total[:, axis] = np.bincount(contacts.nodes[used], parts[used][:, axis], n_nodes)
    return total
