"""The frictional contact problem: impulses r with u = W r + b, Signorini's and Coulomb's laws between r and u.

W, the Delassus operator, has one of two forms. Over nodes: W = J M^-1 J^T, where J^T r distributes the impulses to the nodes of
each contact by their weights; `w` = M^-1 J^T r is kept up to date and nothing is assembled. As a matrix: 3x3 blocks in CSR.
Solvers use only `velocity` and `add_impulse`, so each is written once.
The r-factors f are 1 / W_nn and 1 / max(W_t1t1, W_t2t2), the same for every solver, since the residual
    |r - prox(r - f u)| / |r|
depends on them. (The change of r between two sweeps is no measure: it shrinks with a solver's step.) Each solver uses its own
fraction of them, `relaxation`.
All values are f64: impulses are small differences of large ones.
"""

from dataclasses import dataclass
from typing import Any

import numpy as np
import scipy.sparse as sp
import taichi as ti

from taisoft.backend.arrays import Count, FieldArena, download, upload
from taisoft.backend.lists import Lists, add_up_counts, clear_counts, count_entry, keys_if, make_lists, place_of_entry, sort_lists
from taisoft.backend.paths import on_gpu_path
from taisoft.backend.runtime import kernel
from taisoft.backend.team import Team, make_team
from taisoft.contact.prox import dvec, prox, scaled
from taisoft.ranges import expand, owners

NODES = 6  # maximum nodes of a contact, three on each side
RESIDUAL, BEST, STEP, SWEEPS, CHECKS, AGE, MOMENTUM, WEIGHT, VERDICT = range(9)  # in `state`, see `solve`
HISTORY = 1024  # residuals kept per launch
CHUNKS = 256  # partial sums over the contacts, so that a sum does not depend on threads


@dataclass(frozen=True, eq=False)
class SweepWork:
    """What solvers by sweeps keep of each contact."""

    relaxation: Any  # f64: largest fraction of the r-factors that a sweep uses
    best: Any  # 3-vectors: the best impulses so far
    sweep_start: Any  # 3-vectors: impulses at the start of the sweep
    previous: Any  # 3-vectors: impulses after the previous sweep, before extrapolation
    idle: Any  # i32: 1 for contacts that were open without an impulse at the last check: Gauss-Seidel skips them until the next
    term: Any  # 2-vectors: contributions of each contact to two sums
    partial: Any  # (CHUNKS) 2-vectors: sums over chunks of the contacts
    order: Any  # i32: contacts in sweep order
    colour: Any  # i32: of each contact, see `colouring`
    by_colour: Lists  # of each colour's contacts, in `order`
    state: Any  # (9) f64: residual, that of `best`, fraction of the r-factors; see `solve`
    history: Any  # (HISTORY) f64: residuals at the checks of a launch


@dataclass(frozen=True, eq=False)
class PastContacts:
    """Contacts of the previous step, which the next one starts from, see `build`."""

    feature: Any  # 3-vectors i32
    point: Any  # 3-vectors [m]
    impulse: Any  # 3-vectors, world frame [N s]
    collider: Any  # 2-vectors i32
    mask: Any  # (1) i32: number of buckets and of slots in use, a power of two, minus one
    by_feature: Lists  # of the contacts in each bucket, in `member`
    member: Any  # i32
    bucket: Any  # i32: of each contact; then the slot of its pair
    pair: Any  # i32: first contact of each one's pair of colliders
    pair_slot: Any  # i32: hash table of the pairs, by their first contacts, -1 if free
    claim: Any  # i32: lowest of the contacts that have come to a free slot
    pair_sum: Any  # 2-vectors: sums of normal impulses [N s] and of r-factors [kg] over a pair's contacts, at the first


@dataclass(frozen=True, eq=False)
class RenewalWork:
    """What a renewal of the geometry decides about contacts, see `dynamics.contact_geometry`."""

    fate: Any  # i32: what becomes of each present contact
    match: Any  # i32: of each new contact, the present one that it replaces, or how it was judged
    inherited: Any  # 3-vectors, world frame: impulses that a new contact gets from others [N s]
    target: Any  # f64: target of each new contact [m]
    height: Any  # f64: of each new contact, its gap minus what it has opened since the step's start [m]
    is_kept: Any  # i32: 1 at the first contact of a pair of colliders whose contacts stay as they are
    heir: Any  # i32: of each present contact, the new one that gets its impulse, -1 if none does
    giver: Any  # i32: of each new contact, the first present one whose heir it is, or the number of these
    source: Any  # i32: of each contact of the next geometry, the present or new one that it comes from


@dataclass(frozen=True, eq=False)
class ContactProblem:
    """Fields of up to `capacity` contacts; the first count[0] are in use. Fields of the other form of W are None."""

    capacity: Count
    serial: bool  # whether loops run on one thread
    on_cpu: bool
    matrix: bool  # whether W is given as a matrix
    count: Any  # (3) i32: contacts, colours, entries up to the end of the last row
    friction: Any  # f64
    b: Any  # 3-vectors [m/s]: u without impulses; (normal, t1, t2)
    factor: Any  # 2-vectors: r-factors of normal and tangents [kg]; 0 if nothing can move
    r: Any  # 3-vectors: impulses [N s]
    sweep: SweepWork
    team: Team  # of loops over the contacts
    # W as a matrix
    row_start: Any = None  # (capacity + 1) i32
    column: Any = None  # i32
    block: Any = None  # (blocks, 9) f64
    # W over nodes
    n_nodes: Count = 0
    first: Any = None  # i32: first entry of each contact's row; rows ascend, and there may be gaps between them
    arity: Any = None  # i32: number of its entries
    arity_a: Any = None  # i32: of these, the first ones, which belong to side a
    node: Any = None  # (n_entries) i32
    weight: Any = None  # (n_entries) f64: of side a those of its point, of side b minus those
    contact: Any = None  # (n_entries) i32
    room: Lists | None = None  # of rows, see `build.fill`
    normal: Any = None  # 3-vectors: from b to a
    tangent: Any = None  # 3-vectors: t1; t2 = normal x t1
    inverse_mass: Any = None  # (n_nodes) 3-vectors [1/kg], 0 on constrained axes
    w: Any = None  # (n_nodes) 3-vectors [m/s]: M^-1 J^T r at the nodes of contacts
    by_node: Lists | None = None  # of the entries of each node, in `entry`
    entry: Any = None  # (n_entries) i32
    # of detected contacts, see `build`
    body: Any = None  # 2-vectors i32: colliders
    feature: Any = None  # 3-vectors i32
    point: Any = None  # 3-vectors [m]
    gap: Any = None  # f64 [m]
    area: Any = None  # f64: of mortar contacts, else 0 [m^2]
    guard: Any = None  # i32: 1 where a mortar contact carries the load
    status: Any = None  # i32: OPEN, STICK or SLIP, by the last projection of the impulse (`prox`)
    slip: Any = None  # 3-vectors: tangential displacement of side a relative to side b in the last step or substep [m]
    target: Any = None  # f64: smallest gap at the end of an implicit step [m], see `build`
    obstacle_displacement: Any = None  # 3-vectors: obstacle's displacement at the contact in the step [m]
    approach: Any = None  # f64: normal velocity at the start of the step, negative if surfaces approach [m/s]
    load: Any = None  # f64: velocity that the pair's impulses of the previous step gave its contacts [m/s]
    restitution: Any = None  # f64
    min_velocity: Any = None  # f64: least normal velocity after the impact, set only in steps with one [m/s]
    min_opening: Any = None  # f64: least opening of the gap in the step, 0 without restitution [m]
    impact_impulse: Any = None  # 3-vectors: impulse of the impact before the step [N s]
    past: PastContacts | None = None
    renewal: RenewalWork | None = None


def build_node_problem(arena: FieldArena, capacity: int, n_nodes: int, serial: bool, entries: int) -> ContactProblem:
    """Allocate a problem for contacts between the nodes of a model, whose rows have up to `entries` entries in all."""
    n, n_slots = capacity, max(64, 1 << (2 * capacity - 1).bit_length())
    past = PastContacts(
        **_fields(arena, "feature", ti.i32, n, 3, "past_contact"),
        **_fields(arena, "collider", ti.i32, n, 2, "past_contact"),
        **_fields(arena, "point impulse", ti.f64, n, 3, "past_contact"),
        **_fields(arena, "pair_sum", ti.f64, n, 2, "past_contact"),
        **_fields(arena, "member bucket pair", ti.i32, n, 0, "past_contact"),
        **_fields(arena, "pair_slot claim", ti.i32, n_slots, 0, "past_contact"),
        **_fields(arena, "mask", ti.i32, 1, 0, "past_contact"),
        by_feature=make_lists(arena, "past_contact", n_slots, serial),
    )
    renewal = RenewalWork(
        **_fields(arena, "fate match is_kept heir giver source", ti.i32, n, 0, "renewal"),
        **_fields(arena, "target height", ti.f64, n, 0, "renewal"),
        **_fields(arena, "inherited", ti.f64, n, 3, "renewal"),
    )
    return ContactProblem(
        n,
        serial,
        not on_gpu_path(),
        False,
        n_nodes=n_nodes,
        past=past,
        renewal=renewal,
        **_solver_fields(arena, n, serial),
        **_fields(arena, "first arity arity_a guard status", ti.i32, n),
        **_fields(arena, "node contact entry", ti.i32, entries),
        **_fields(arena, "weight", ti.f64, entries),
        **_fields(arena, "normal tangent point slip obstacle_displacement impact_impulse", ti.f64, n, 3),
        **_fields(arena, "gap area target approach load restitution min_velocity min_opening", ti.f64, n),
        **_fields(arena, "body", ti.i32, n, 2),
        **_fields(arena, "feature", ti.i32, n, 3),
        **_fields(arena, "inverse_mass w", ti.f64, n_nodes, 3),
        room=make_lists(arena, "problem_room", n, serial),
        by_node=make_lists(arena, "problem_node", n_nodes, serial),
    )


def build_matrix_problem(arena: FieldArena, n: int, n_blocks: int, serial: bool) -> ContactProblem:
    """Allocate a problem for n contacts and a W of n_blocks 3x3 blocks."""
    return ContactProblem(
        n,
        serial,
        not on_gpu_path(),
        True,
        **_solver_fields(arena, n, serial),
        **_fields(arena, "row_start", ti.i32, n + 1),
        **_fields(arena, "column", ti.i32, n_blocks),
        **_fields(arena, "block", ti.f64, (n_blocks, 9)),
    )


def _solver_fields(arena: FieldArena, n: int, serial: bool) -> dict[str, Any]:
    """Fields that both forms of W need."""
    sweep = SweepWork(
        by_colour=make_lists(arena, "problem_colour", n, serial),
        **_fields(arena, "relaxation", ti.f64, n),
        **_fields(arena, "best sweep_start previous", ti.f64, n, 3),
        **_fields(arena, "term", ti.f64, n, 2),
        **_fields(arena, "partial", ti.f64, CHUNKS, 2),
        **_fields(arena, "order colour idle", ti.i32, n),
        **_fields(arena, "state", ti.f64, VERDICT + 1),
        **_fields(arena, "history", ti.f64, HISTORY),
    )
    return {
        "sweep": sweep,
        "team": make_team(arena, "problem"),
        **_fields(arena, "count", ti.i32, 3),
        **_fields(arena, "friction", ti.f64, n),
        **_fields(arena, "b r", ti.f64, n, 3),
        **_fields(arena, "factor", ti.f64, n, 2),
    }


def _fields(arena: FieldArena, names: str, dtype, shape, components: int = 0, of: str = "problem") -> dict[str, Any]:
    """Allocate scalars, or vectors of so many components, by name."""

    def allocate(name: str):
        return arena.vectors(name, dtype, shape, n=components) if components else arena.field(name, dtype, shape)

    return {name: allocate(f"{of}_{name}") for name in names.split()}


def fill_field(field, values: np.ndarray) -> None:
    """Fill the first rows of a field with values (k, ...) and the others with 0."""
    whole = np.zeros((field.shape[0], *values.shape[1:]))
    whole[: len(values)] = values
    upload([(field, whole)])


def fill_rows(problem: ContactProblem, arity: np.ndarray, node: np.ndarray, weight: np.ndarray) -> None:
    """Set the number of contacts and their rows: arity (k,), and node and weight of all entries, row by row."""
    contact, first = owners(arity), np.cumsum(arity) - arity
    problem.count[0], problem.count[2] = len(arity), len(contact)
    rows = {"first": first, "arity": arity, "contact": contact, "node": node, "weight": weight}
    for name, values in rows.items():
        getattr(problem, name).from_numpy(values, 0)


def read_entries(problem: ContactProblem) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Return the contact, node and weight of all entries, row by row."""
    contact, at = expand(*download([problem.first, problem.arity], problem.count[0]))
    node, weight = download([problem.node, problem.weight], problem.count[2])
    return contact, node[at], weight[at]


def fill_matrix_problem(problem: ContactProblem, W: sp.spmatrix, b: np.ndarray, friction: np.ndarray) -> None:
    """Upload W (3k,3k), b (3k,) and coefficients of friction (k,) to a problem large enough; keep its impulses."""
    W, k = sp.bsr_matrix(W, blocksize=(3, 3)), len(friction)
    W.sort_indices()
    problem.count[0] = k
    problem.row_start.from_numpy(W.indptr, 0)
    problem.column.from_numpy(W.indices, 0)
    problem.block.from_numpy(W.data.reshape(-1, 9), 0)
    problem.b.from_numpy(b.reshape(k, 3), 0)
    problem.friction.from_numpy(friction, 0)
    problem.sweep.order.from_numpy(np.arange(k), 0)
    find_factors(problem)


# --- solver interface -------------------------------------------------------------------------------------------------


@ti.func
def to_frame(problem: ti.template(), c, v):
    """Transform a world vector to the frame of contact c."""
    n, t = problem.normal[c], problem.tangent[c]
    return dvec(n.dot(v), t.dot(v), n.cross(t).dot(v))


@ti.func
def frame_of(problem: ti.template(), c):
    """Rows normal, t1, t2 of contact c (3,3)."""
    n, t = problem.normal[c], problem.tangent[c]
    return ti.Matrix.rows([n, t, n.cross(t)])


@ti.func
def to_world(problem: ti.template(), c, r):
    """Transform a vector from the frame of contact c to the world."""
    n, t = problem.normal[c], problem.tangent[c]
    return r[0] * n + r[1] * t + r[2] * n.cross(t)


@ti.func
def velocity(problem: ti.template(), c):
    """u of contact c at the present impulses [m/s]."""
    u = problem.b[c]
    if ti.static(problem.matrix):
        for k in range(problem.row_start[c], problem.row_start[c + 1]):
            r = problem.r[problem.column[k]]
            for i in ti.static(range(3)):
                u[i] += problem.block[k, 3 * i] * r[0] + problem.block[k, 3 * i + 1] * r[1] + problem.block[k, 3 * i + 2] * r[2]
    else:
        v = dvec(0.0)
        for e in range(problem.first[c], problem.first[c] + problem.arity[c]):
            v += problem.weight[e] * problem.w[problem.node[e]]
        u += to_frame(problem, c, v)
    return u


@ti.func
def add_impulse(problem: ti.template(), c, change):
    """Add a change of contact c's impulse to w at its nodes. Contacts updated in parallel must share no movable node."""
    if ti.static(not problem.matrix):
        d = to_world(problem, c, change)
        for e in range(problem.first[c], problem.first[c] + problem.arity[c]):
            i = problem.node[e]
            problem.w[i] = problem.w[i] + problem.weight[e] * (problem.inverse_mass[i] * d)


@ti.func
def impulse_on(problem: ti.template(), i):
    """(J^T r) of node i [N s], summed over its contacts in a fixed order."""
    d = dvec(0.0)
    for at in range(problem.by_node.start[i], problem.by_node.start[i + 1]):
        c = problem.contact[problem.entry[at]]
        d += problem.weight[problem.entry[at]] * to_world(problem, c, problem.r[c])
    return d


@ti.func
def natural_map(problem: ti.template(), c):
    """(|r - prox(r - f u)|^2, |r|^2) of contact c."""
    r = problem.r[c]
    d = r - prox(r - scaled(problem.factor[c], velocity(problem, c)), problem.friction[c])
    return ti.Vector([d.dot(d), r.dot(r)], ti.f64)


@ti.func
def residual_of(sums):
    """Relative residual from the sums of `natural_map`; 1 if r is 0 but not a solution, or not a number."""
    result = ti.cast(0.0, ti.f64)
    if sums[1] > 0.0:
        result = ti.sqrt(sums[0] / sums[1])
    elif not sums[0] == 0.0:
        result = 1.0
    return result


@ti.func
def update_velocities(problem: ti.template()):
    """Set w = M^-1 J^T r at the nodes of contacts; does nothing if W is a matrix. On one thread each contact adds its impulse."""
    if ti.static(not problem.matrix and problem.serial):
        ti.loop_config(serialize=True)
        for c in range(problem.count[0]):
            for e in range(problem.first[c], problem.first[c] + problem.arity[c]):
                problem.w[problem.node[e]] = dvec(0.0)
        ti.loop_config(serialize=True)
        for c in range(problem.count[0]):
            if (problem.r[c] != 0.0).any():
                add_impulse(problem, c, problem.r[c])
    elif ti.static(not problem.matrix):
        for i in range(problem.n_nodes):
            problem.w[i] = problem.inverse_mass[i] * impulse_on(problem, i)


@kernel
def find_velocities(problem: ti.template()):
    """See `update_velocities`."""
    update_velocities(problem)


@ti.func
def set_velocities(problem: ti.template(), team: ti.template(), t):
    """`update_velocities` by all threads t of a team."""
    if ti.static(not problem.matrix and problem.serial):
        update_velocities(problem)
    elif ti.static(not problem.matrix):
        n = problem.count[0]
        for j in range(team.share(t, n)):
            c = team.entry(t, j, n)
            for e in range(problem.first[c], problem.first[c] + problem.arity[c]):
                i = problem.node[e]
                if problem.entry[problem.by_node.start[i]] == e:  # so that one contact sets it
                    problem.w[i] = problem.inverse_mass[i] * impulse_on(problem, i)
        team.sync()


@ti.func
def own_block(problem: ti.template(), c):
    """The 3x3 block of W between contact c and itself."""
    B = ti.Matrix.zero(ti.f64, 3, 3)
    if ti.static(problem.matrix):
        for k in range(problem.row_start[c], problem.row_start[c + 1]):
            if problem.column[k] == c:
                for i, j in ti.static(ti.ndrange(3, 3)):
                    B[i, j] += problem.block[k, 3 * i + j]
    else:
        E = frame_of(problem, c)
        h = dvec(0.0)
        for e in range(problem.first[c], problem.first[c] + problem.arity[c]):
            h += problem.weight[e] * problem.weight[e] * problem.inverse_mass[problem.node[e]]
        for i, j in ti.static(ti.ndrange(3, 3)):
            for q in ti.static(range(3)):
                B[i, j] += E[i, q] * h[q] * E[j, q]
    return B


@kernel
def find_factors(problem: ti.template()):
    """Set the r-factors from the diagonal of W."""
    ti.loop_config(serialize=problem.serial)
    for c in range(problem.count[0]):
        set_factors(problem, c)


@ti.func
def set_factors(problem: ti.template(), c):
    """Set the r-factors of contact c."""
    B = own_block(problem, c)
    across = ti.max(B[1, 1], B[2, 2])
    problem.factor[c][0] = ti.select(B[0, 0] > 0.0, 1.0 / B[0, 0], 0.0)
    problem.factor[c][1] = ti.select(across > 0.0, 1.0 / across, 0.0)
    if B[0, 0] <= 0.0:  # immovable
        problem.r[c] = dvec(0.0)


@ti.func
def list_entries(problem: ti.template(), go):
    """List the entries of each node, in ascending order, if go is 1; if it is 0, do nothing. Top-level loops of a kernel."""
    clear_counts(problem.by_node, keys_if(go, problem.n_nodes))
    ti.loop_config(serialize=problem.by_node.serial)
    for c in range(go * problem.count[0]):
        for e in range(problem.first[c], problem.first[c] + problem.arity[c]):
            count_entry(problem.by_node, problem.node[e])
    add_up_counts(problem.by_node, keys_if(go, problem.n_nodes))
    ti.loop_config(serialize=problem.by_node.serial)
    for c in range(go * problem.count[0]):
        for e in range(problem.first[c], problem.first[c] + problem.arity[c]):
            problem.entry[place_of_entry(problem.by_node, problem.node[e])] = e
    sort_lists(problem.by_node, keys_if(go, problem.n_nodes), problem.entry)


@kernel
def index_nodes(problem: ti.template()):
    """See `list_entries`."""
    list_entries(problem, 1)
