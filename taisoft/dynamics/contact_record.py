"""Contacts of a problem on the host: their record, sums over the contacts of pairs, and their rows for a checkpoint."""

import numpy as np

from taisoft.backend.arrays import download, upload
from taisoft.collision.contacts import Contacts
from taisoft.collision.detector import Detection
from taisoft.contact.problem import NODES, ContactProblem


def record_contacts(detection: Detection, p: ContactProblem, impulse_fraction: float) -> Contacts:
    """Return the record of a problem's contacts with their impulses. impulse_fraction: of a step, in which they act."""
    normal, tangent, r, struck, point, gap, body, feature, node, weight, arity = download(
        [p.normal, p.tangent, p.r, p.impact_impulse, p.point, p.gap, p.body, p.feature, p.node, p.weight, p.arity], p.count[0]
    )
    r = r / impulse_fraction + struck
    impulse = r[:, :1] * normal + r[:, 1:2] * tangent + r[:, 2:] * np.cross(normal, tangent)
    return detection.record(point, normal, gap, impulse, body, feature, *_sides(node, weight, arity))


Pairs = tuple[np.ndarray, np.ndarray]  # colliders (k,2), the lower index first, and their sums (k,13), see `sum_pairs`
IMPULSE, MOMENTS, SLIP, NORMAL = slice(0, 3), (slice(3, 6), slice(6, 9)), slice(9, 12), slice(12, 13)  # columns


def sum_pairs(p: ContactProblem, found: Contacts, sides: tuple, x: np.ndarray, v: np.ndarray, before: Pairs | None) -> Pairs:
    """Return each pair of different colliders that may touch, and sums over their contacts.

    IMPULSE: on the first one [N s]; MOMENTS: of what the first and what the second one gets, about the origin [N m s]; SLIP: the
    normal impulse times the tangential velocity of the first relative to the second [N m]; NORMAL: the normal impulse [N s].
    Impulses act on a body at its nodes, and on an obstacle at the contact points.

    found: the record of the problem's contacts; sides: their nodes and weights (k, 2 w), before dependent nodes are replaced;
    x [m], v [m/s]: (n_nodes, 3). before: pairs and sums to be added.
    """
    body, node, weight, arity, moved = download([p.body, p.node, p.weight, p.arity, p.obstacle_displacement], p.count[0])
    weight = np.where(np.arange(node.shape[1]) < arity[:, None], weight, 0.0)
    u = np.einsum("cj,cji->ci", weight, v[np.where(weight != 0.0, node, 0)]) - moved / found.duration
    normal = (found.impulse * found.normal).sum(axis=1, keepdims=True)
    slip = normal * (u - (u * found.normal).sum(axis=1, keepdims=True) * found.normal)
    (nodes, weights), half = sides, sides[0].shape[1] // 2
    arms = [np.einsum("cj,cji->ci", weights[:, own], x[nodes[:, own]]) for own in (slice(0, half), slice(half, None))]
    arms[1] = np.where(nodes[:, half:].max(axis=1, keepdims=True) < 0, found.point, arms[1])
    sums = np.hstack([found.impulse, np.cross(arms[0], found.impulse), np.cross(found.impulse, arms[1]), slip, normal])
    different = body[:, 0] != body[:, 1]
    pairs, sums = body[different].astype(np.int64), sums[different]
    if before is not None:
        pairs, sums = np.concatenate([before[0], pairs]), np.concatenate([before[1], sums])
    unique, pair = np.unique(pairs, axis=0, return_inverse=True)
    total = np.zeros((len(unique), sums.shape[1]))
    np.add.at(total, pair.reshape(-1), sums)
    return unique, total


def nodal_impulses(contacts: Contacts, n_nodes: int) -> np.ndarray:
    """Return the contact impulses (n_nodes, 3) [N s] on the nodes of all bodies, in the order added.

    contacts: a record from `Simulator.contacts`. Each impulse is distributed to the nodes that it acted on in the solver, by
    their weights, with its sign on side a and the opposite on side b, so that sums over a body are those of its contacts.
    """
    return distribute(contacts.impulse, contacts.nodes, contacts.weights, n_nodes)


def distribute(impulse: np.ndarray, nodes: np.ndarray, weights: np.ndarray, n_nodes: int) -> np.ndarray:
    """Distribute impulses (k,3) [N s] to the nodes of both sides (k, 2 w) by their weights, with opposite signs: (n_nodes,3)."""
    signs = np.repeat([1.0, -1.0], weights.shape[1] // 2)
    parts, used, total = (signs * weights)[:, :, None] * impulse[:, None], nodes >= 0, np.zeros((n_nodes, 3))
    for axis in range(3):
        total[:, axis] = np.bincount(nodes[used], parts[used][:, axis], n_nodes)
    return total


def _sides(node: np.ndarray, weight: np.ndarray, arity: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return nodes and weights (n, 2 k) of a problem's contacts, k of each side, as the record stores them.

    A node is on side a if its weight is positive. If nodes depend on others, those of one side may have weights of both signs.
    """
    n, width = node.shape
    used, half = np.arange(width) < arity[:, None], NODES // 2 if width == NODES else width
    side_b = used & (weight < 0.0)
    nodes, weights = np.full((n, 2 * half), -1), np.zeros((n, 2 * half))
    for side, first in ((used & ~side_b, 0), (side_b, half)):
        row, column = np.nonzero(side)
        place = first + np.cumsum(side, axis=1)[row, column] - 1
        nodes[row, place], weights[row, place] = node[row, column], np.abs(weight[row, column])
    return nodes, weights


def read_rows(p: ContactProblem) -> dict[str, np.ndarray]:
    """Return everything that a later step, or `record_contacts`, needs of a problem's contacts."""
    fields = _fields(p)
    return dict(zip(fields, download(list(fields.values()), p.count[0])))


def write_rows(p: ContactProblem, rows: dict[str, np.ndarray]) -> None:
    """Restore the result of `read_rows`, of at most `capacity` contacts."""
    n, whole = len(rows["gap"]), []
    for name, field in _fields(p).items():
        data = np.zeros((p.capacity, *rows[name].shape[1:]), dtype=rows[name].dtype)
        data[:n] = rows[name]
        whole.append((field, data))
    upload(whole)
    p.count[0] = n


def _fields(p: ContactProblem) -> dict:
    parts = {"normal": p.normal, "tangent": p.tangent, "r": p.r, "node": p.node, "weight": p.weight, "arity": p.arity}
    return parts | {
        "point": p.point,
        "gap": p.gap,
        "body": p.body,
        "feature": p.feature,
        "struck": p.impact_impulse,
        "factor": p.factor,
    }
