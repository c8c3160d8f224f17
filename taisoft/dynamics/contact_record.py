"""Contacts of a problem on the host: their record, the sum of their impulses, and their rows for a checkpoint."""

import numpy as np

from taisoft.backend.arrays import download, upload
from taisoft.collision.contacts import Contacts
from taisoft.collision.detector import Detection
from taisoft.contact.problem import NODES, ContactProblem
from taisoft.scene.scene import Scene


def record_contacts(detection: Detection, p: ContactProblem, impulse_fraction: float) -> Contacts:
    """Return the record of a problem's contacts with their impulses. impulse_fraction: of a step, in which they act."""
    normal, tangent, r, struck, point, gap, body, feature, node, weight, arity = download(
        [p.normal, p.tangent, p.r, p.impact_impulse, p.point, p.gap, p.body, p.feature, p.node, p.weight, p.arity], p.count[0]
    )
    r = r / impulse_fraction + struck
    impulse = r[:, :1] * normal + r[:, 1:2] * tangent + r[:, 2:] * np.cross(normal, tangent)
    return detection.record(point, normal, gap, impulse, body, feature, *_sides(node, weight, arity))


def sum_impulses(contacts: Contacts, scene: Scene) -> np.ndarray:
    """Return the impulse on each collider from the given contacts, (n_colliders, 3) [N s]."""
    place = {one.name: k for k, one in enumerate(scene.colliders)}
    total = np.zeros((len(place), 3))
    for names, sign in ((contacts.body_a, 1.0), (contacts.body_b, -1.0)):
        np.add.at(total, [place[name] for name in names], sign * contacts.impulse)
    return total


Pairs = tuple[np.ndarray, np.ndarray]  # colliders (k,2), the lower index first, and impulses (k,3) on the first [N s]


def sum_pairs(contacts: Contacts, scene: Scene, before: Pairs | None = None) -> Pairs:
    """Return each pair of colliders that touch, and the impulse that the first gets from the second.

    before: pairs and impulses to be added.
    """
    place = {one.name: k for k, one in enumerate(scene.colliders)}
    names = zip(contacts.body_a, contacts.body_b)
    pairs = np.array([(place[a], place[b]) for a, b in names], dtype=np.int64).reshape(-1, 2)
    impulses = contacts.impulse
    if before is not None:
        pairs, impulses = np.concatenate([before[0], pairs]), np.concatenate([before[1], impulses])
    unique, pair = np.unique(pairs, axis=0, return_inverse=True)
    total = np.zeros((len(unique), 3))
    np.add.at(total, pair.reshape(-1), impulses)
    return unique, total


def sum_moments(contacts: Contacts, scene: Scene, x: np.ndarray) -> np.ndarray:
    """Return the moment of the given contacts' impulses on each collider about the origin, (n_colliders, 3) [N m s].

    x: (n_nodes, 3) [m]; impulses act on a body at its nodes, and on an obstacle at the contact points.
    """
    starts = np.cumsum([0, *(body.n_nodes for body in scene.bodies)])
    moments = np.concatenate([np.zeros((1, 3)), np.cross(x, nodal_impulses(contacts, len(x))).cumsum(axis=0)])
    total = np.zeros((len(scene.colliders), 3))
    total[: len(scene.bodies)] = np.diff(moments[starts], axis=0)
    for k, obstacle in enumerate(scene.obstacles, len(scene.bodies)):
        own = contacts.body_b == obstacle.name
        total[k] = -np.cross(contacts.point[own], contacts.impulse[own]).sum(axis=0)
    return total


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
