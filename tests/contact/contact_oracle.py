"""Frictional contact problems in NumPy: the laws, the residual, plain Gauss-Seidel, random problems over nodes."""

import json
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import scipy.sparse as sp

NODES = 6


def factors(W: np.ndarray) -> np.ndarray:
    """1 / W_nn and 1 / max(W_t1t1, W_t2t2) for both tangents, (k,3)."""
    d = np.diag(W).reshape(-1, 3)
    across = np.maximum(d[:, 1], d[:, 2])
    return np.column_stack([1 / d[:, 0], 1 / across, 1 / across])


def project(z, mu: float) -> np.ndarray:
    """The prox of one contact."""
    normal = max(z[0], 0.0)
    size = float(np.hypot(z[1], z[2]))
    share = 1.0 if size <= mu * normal else mu * normal / size
    return np.array([normal, share * z[1], share * z[2]])


def residual(W, b, mu, r) -> float:
    """|r - prox(r - f u)| / |r|."""
    W, r = sp.csr_matrix(W).toarray(), np.asarray(r).reshape(-1, 3)
    u = (W @ r.ravel() + b).reshape(-1, 3)
    p = np.array([project(row, m) for row, m in zip(r - factors(W) * u, mu)])
    changed, size = np.linalg.norm(r - p), np.linalg.norm(r)
    return changed / size if size else float(changed > 0)


def gauss_seidel(W, b, mu, sweeps: int, order=None) -> np.ndarray:
    """Impulses (k,3) after plain sweeps from 0."""
    W, f = sp.csr_matrix(W).toarray(), factors(sp.csr_matrix(W).toarray())
    r = np.zeros((len(mu), 3))
    for _ in range(sweeps):
        for c in range(len(mu)) if order is None else order:
            u = W[3 * c : 3 * c + 3] @ r.ravel() + b[3 * c : 3 * c + 3]
            r[c] = project(r[c] - f[c] * u, mu[c])
    return r


def breaks(W, b, mu, r) -> dict[str, float]:
    """By how much impulses break the laws: each a share of the largest impulse, velocity or their product."""
    r = np.asarray(r).reshape(-1, 3)
    u = (W @ r.ravel() + b).reshape(-1, 3)
    force, speed = np.abs(r).max(initial=1e-300), max(np.abs(u).max(initial=0), np.abs(b).max(initial=1e-300))
    slip, hold = np.linalg.norm(u[:, 1:], axis=1), np.linalg.norm(r[:, 1:], axis=1)
    return {
        "pulls": max(0.0, -r[:, 0].min()) / force,
        "outside its cone": max(0.0, (hold - mu * r[:, 0]).max()) / force,
        "goes deeper": max(0.0, -u[:, 0].min()) / speed,
        "pushes what parts": np.abs(r[:, 0] * u[:, 0]).max() / (force * speed),
        "slips though held": ((mu * r[:, 0] - hold) * slip).max() / (force * speed),
        "not against the slip": np.abs(hold * slip + (r[:, 1:] * u[:, 1:]).sum(axis=1)).max() / (force * speed),
    }


@dataclass(frozen=True)
class NodeContacts:
    """Contacts over nodes; rows and units as the fields of ContactProblem."""

    node: np.ndarray
    arity: np.ndarray
    weight: np.ndarray
    normal: np.ndarray
    tangent: np.ndarray
    inverse_mass: np.ndarray
    b: np.ndarray
    friction: np.ndarray

    @property
    def entries(self) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """Contact, node and weight of those in use, row by row."""
        used = np.arange(NODES) < self.arity[:, None]
        return np.nonzero(used)[0], self.node[used], self.weight[used]

    @property
    def jacobian(self) -> np.ndarray:
        """J (3k, 3n)."""
        J = np.zeros((len(self.arity), 3, len(self.inverse_mass), 3))
        frame = np.stack([self.normal, self.tangent, np.cross(self.normal, self.tangent)], axis=1)
        for c, i, w in zip(*self.entries):
            J[c, :, i] += w * frame[c]
        return J.reshape(3 * len(self.arity), -1)

    @property
    def W(self) -> np.ndarray:
        """J M^-1 J^T (3k,3k)."""
        J = self.jacobian
        return J @ (self.inverse_mass.reshape(-1, 1) * J.T)


def random_contacts(
    seed: int, k: int, n_nodes: int, friction: float = 0.5, prescribed: bool = False, spread: float = 0.2
) -> NodeContacts:
    """k contacts between nodes of the lower and the upper half, up to three on either side.

    prescribed: whether some nodes are prescribed along all axes, some along one. spread: of the normals about z.
    """
    rng = np.random.default_rng(seed)
    node, weight = np.zeros((k, NODES), dtype=np.int32), np.zeros((k, NODES))
    arity = np.zeros(k, dtype=np.int32)
    half = n_nodes // 2
    for c in range(k):
        up, down = rng.integers(1, 4, 2)
        nodes = np.concatenate([half + rng.permutation(n_nodes - half)[:up], rng.permutation(half)[:down]])
        arity[c] = len(nodes)
        node[c, : arity[c]] = nodes
        weight[c, : arity[c]] = np.concatenate([rng.dirichlet(np.ones(up)), -rng.dirichlet(np.ones(down))])
    normal = np.array([0.0, 0.0, 1.0]) + spread * rng.normal(size=(k, 3))
    normal /= np.linalg.norm(normal, axis=1, keepdims=True)
    tangent = np.cross(normal, rng.normal(size=(k, 3)))
    tangent /= np.linalg.norm(tangent, axis=1, keepdims=True)
    inverse_mass = np.repeat(np.exp(rng.uniform(-1, 1, (n_nodes, 1))), 3, axis=1)
    if prescribed:
        inverse_mass[: half // 2] = 0.0
        inverse_mass[half : half + half // 3, 0] = 0.0
    v = rng.normal(size=(n_nodes, 3))
    v[half:, 2] -= 1.0
    found = NodeContacts(node, arity, weight, normal, tangent, inverse_mass, np.zeros(3 * k), np.full(k, friction))
    return NodeContacts(**{**found.__dict__, "b": found.jacobian @ v.ravel()})


def load(path: Path) -> tuple[sp.csr_matrix, np.ndarray, np.ndarray]:
    """W, b, mu of one of the shared problems: .npz of `contact_problems` or fcp_*.json of `references`."""
    if path.suffix == ".npz":
        data = np.load(path)
        n = 3 * int(data["n_contacts"])
        return sp.csr_matrix((data["val"], (data["row"], data["col"])), shape=(n, n)), data["b"], data["mu"]
    loads = json.loads(path.read_text(encoding="utf-8"))["loads"]
    return sp.csr_matrix(np.array(loads["W"])), np.array(loads["q"]), np.array(loads["mu"])
