"""What the contacts of a step have done: sums of impulses by collider, pair, moment and node, and their record by names.

Colliders are indices, and impulses in world axes. Impulses act on a body at its nodes, and on an obstacle at the point.
"""

from dataclasses import dataclass

import numpy as np

from taisoft.backend.arrays import download
from taisoft.collision.contacts import Contacts, in_columns, named_contacts
from taisoft.contact.problem import ContactProblem, fill_rows, read_entries
from taisoft.contact.targets import GUARD, SELF_CONTACT
from taisoft.scene.scene import Scene

Pairs = tuple[np.ndarray, np.ndarray]  # colliders (k,2), the lower index first, and their sums (k,13), see `sum_pairs`
IMPULSE, MOMENTS, SLIP, NORMAL = slice(0, 3), (slice(3, 6), slice(6, 9)), slice(9, 12), slice(12, 13)  # columns
# what a later step needs
ROWS = "normal tangent r impact_impulse arity arity_a point gap area guard status slip body feature factor".split()
MORE_ROWS = [*ROWS, *"friction restitution obstacle_displacement approach load target min_opening".split()]


@dataclass(frozen=True)
class ContactRows:
    """Contacts of a problem on the host, each array (k, ...)."""

    collider: np.ndarray  # (k,2) indices
    feature: np.ndarray  # (k,3)
    point: np.ndarray  # (k,3) [m]
    normal: np.ndarray  # (k,3) from b to a
    gap: np.ndarray  # (k,) [m]
    impulse: np.ndarray  # (k,3) on a [N s]
    nodes: np.ndarray  # (k, 2 w), w of each side, -1 where there is none
    weights: np.ndarray  # (k, 2 w)
    guard: np.ndarray  # (k,) as of `Contacts`
    area: np.ndarray  # (k,) of mortar contacts, else 0 [m^2]
    state: np.ndarray  # (k,) of `prox`
    slip: np.ndarray  # (k,3) of side a over side b [m]

    def named(self, scene: Scene, **further) -> Contacts:
        """Return the record by names. further: what `named_contacts` takes besides."""
        return named_contacts(scene, **vars(self), **further)


def offsets_of(common: float, within: np.ndarray, guard: np.ndarray) -> np.ndarray:
    """Return the offsets (k,) [m] of contacts. common: between different bodies; within: (k,) bool: parts of one touch."""
    return common * np.where(within, SELF_CONTACT, 1.0) * np.where(guard, GUARD, 1.0)


def rows_of(rows: dict[str, np.ndarray], impulse_fraction: float, sides: tuple | None = None) -> ContactRows:
    """Return the contacts that `read_rows` has read. impulse_fraction: of a step, in which their impulses act; sides: nodes and
    weights (k, 2 w) to be returned instead of those of the rows."""
    normal, tangent, r = rows["normal"], rows["tangent"], rows["r"] / impulse_fraction + rows["impact_impulse"]
    impulse = r[:, :1] * normal + r[:, 1:2] * tangent + r[:, 2:] * np.cross(normal, tangent)
    if sides is None:
        nodes, weights = in_columns(*(rows[name] for name in ("arity", "arity_a", "node", "weight")))
        on_b = slice(weights.shape[1] // 2, None)
        weights[:, on_b] = 0.0 - weights[:, on_b]
        sides = nodes, weights
    return ContactRows(
        *(rows["body"], rows["feature"], rows["point"], normal, rows["gap"], impulse, *sides),
        *(rows["guard"], rows["area"], rows["status"], rows["slip"]),
    )


def join_sides(*found: tuple[np.ndarray, np.ndarray]) -> tuple[np.ndarray, np.ndarray]:
    """Return nodes and weights (k, 2 w) of all contacts, from those of several lists whose w may differ."""
    widths = {nodes.shape[1] for nodes, _ in found}
    if len(widths) == 1:
        return tuple(np.concatenate(parts) for parts in zip(*found))
    joined, width = [], max(widths) // 2
    for parts, none in zip(zip(*found), (-1, 0)):
        parts = [part.reshape(len(part), 2, part.shape[1] // 2) for part in parts]
        parts = [np.pad(part, ((0, 0), (0, 0), (0, width - part.shape[2])), constant_values=none) for part in parts]
        joined.append(np.concatenate(parts).reshape(-1, 2 * width))
    return tuple(joined)


def join_contacts(first: ContactRows, second: ContactRows) -> ContactRows:
    """Return the contacts of both."""
    nodes, weights = join_sides((first.nodes, first.weights), (second.nodes, second.weights))
    others = vars(first).keys() - {"nodes", "weights"}
    return ContactRows(
        nodes=nodes, weights=weights, **{name: np.concatenate([getattr(one, name) for one in (first, second)]) for name in others}
    )


def slip_velocities(problem: ContactProblem, v: np.ndarray, duration: float) -> np.ndarray:
    """Return the velocities (k,3) of sides a relative to sides b [m/s]. v: (n_nodes, 3) [m/s]; duration [s]: of the step."""
    (contact, node, weight), u = read_entries(problem), np.zeros((problem.count[0], 3))
    np.add.at(u, contact, weight[:, None] * v[node])
    return u - problem.obstacle_displacement.to_numpy(len(u)) / duration


def sum_pairs(rows: ContactRows, u: np.ndarray, x: np.ndarray, before: Pairs | None) -> Pairs:
    """Return each pair of different colliders that may touch, and sums over their contacts.

    IMPULSE: on the first one [N s]; MOMENTS: of what the first and what the second one gets, about the origin [N m s]; SLIP: the
    normal impulse times the tangential velocity of the first relative to the second [N m]; NORMAL: the normal impulse [N s].

    rows: with the nodes before dependent ones were replaced; u: (k,3) of `slip_velocities`; x: (n_nodes, 3) [m]. before: pairs
    and sums to be added.
    """
    normal = (rows.impulse * rows.normal).sum(axis=1, keepdims=True)
    slip = normal * (u - (u * rows.normal).sum(axis=1, keepdims=True) * rows.normal)
    nodes, weights, half = rows.nodes, rows.weights, rows.nodes.shape[1] // 2
    arms = [np.einsum("cj,cji->ci", weights[:, own], x[nodes[:, own]]) for own in (slice(0, half), slice(half, None))]
    arms[1] = np.where(nodes[:, half:].max(axis=1, keepdims=True) < 0, rows.point, arms[1])
    sums = np.hstack([rows.impulse, np.cross(arms[0], rows.impulse), np.cross(rows.impulse, arms[1]), slip, normal])
    different = rows.collider[:, 0] != rows.collider[:, 1]
    pairs, sums = rows.collider[different].astype(np.int64), sums[different]
    if before is not None:
        pairs, sums = np.concatenate([before[0], pairs]), np.concatenate([before[1], sums])
    unique, pair = np.unique(pairs, axis=0, return_inverse=True)
    total = np.zeros((len(unique), sums.shape[1]))
    np.add.at(total, pair.reshape(-1), sums)
    return unique, total


def sum_on(found: Pairs, collider: int, other: int | None) -> np.ndarray:
    """Return what a collider gets from another one, or from all others, (10,): impulse [N s], moment about the origin [N m s],
    slip velocity times normal impulse [N m], and normal impulse [N s]."""
    (pairs, sums), total = found, np.zeros(10)
    for own in (0, 1):
        chosen = (pairs[:, own] == collider) & ((pairs[:, 1 - own] == other) | (other is None))
        part, sign = sums[chosen].sum(axis=0), 1.0 - 2.0 * own
        total += np.concatenate([sign * part[IMPULSE], part[MOMENTS[own]], sign * part[SLIP], part[NORMAL]])
    return total


def nodal_impulses(contacts: Contacts | ContactRows, n_nodes: int) -> np.ndarray:
    """Return the contact impulses (n_nodes, 3) [N s] on the nodes of all bodies, in the order added.

    contacts: a record from `Simulator.contacts`. Each impulse is distributed to the nodes that it acted on in the solver, by
    their weights, with its sign on side a and the opposite on side b, so that sums over a body are those of its contacts.
    """
    nodes, weights = contacts.nodes, contacts.weights
    signs, used, total = np.repeat([1.0, -1.0], weights.shape[1] // 2), nodes >= 0, np.zeros((n_nodes, 3))
    parts = (signs * weights)[:, :, None] * contacts.impulse[:, None]
    for axis in range(3):
        total[:, axis] = np.bincount(nodes[used], parts[used][:, axis], n_nodes)
    return total


def read_rows(problem: ContactProblem, names: list[str] = ROWS) -> dict[str, np.ndarray]:
    """Return what a later step, or `rows_of`, needs of a problem's contacts: fields by name, node and weight row by row.

    names: MORE_ROWS for what this step needs.
    """
    rows = dict(zip(names, download([getattr(problem, name) for name in names], problem.count[0])))
    return rows | dict(zip(("node", "weight"), read_entries(problem)[1:]))


def write_rows(problem: ContactProblem, rows: dict[str, np.ndarray]) -> None:
    """Restore the result of `read_rows`, for which there must be room."""
    rows = dict(rows)
    fill_rows(problem, *(rows.pop(name) for name in ("arity", "node", "weight")))
    for name, values in rows.items():
        getattr(problem, name).from_numpy(values, 0)
