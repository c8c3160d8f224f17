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

from taisoft.backend.arrays import Count, FieldArena, upload
from taisoft.backend.runtime import kernel
from taisoft.contact.prox import dvec, prox, scaled

NODES = 6  # maximum nodes of a contact, three on each side
CHANGED, SIZE, RESIDUAL, BEST, STEP, SWEEPS, CHECKS, AGE, MOMENTUM, VERDICT = range(10)  # in `state`; AGE: sweeps since `best`
HISTORY = 1024  # residuals kept per launch
CHUNKS = 256  # partial sums over the contacts, so that a sum does not depend on threads


@dataclass(frozen=True, eq=False)
class ContactProblem:
    """Fields of up to `capacity` contacts; the first count[0] are in use. Fields of the other form of W are None."""

    capacity: Count
    serial: bool  # whether loops run on one thread
    matrix: bool  # whether W is given as a matrix
    n_nodes: Count
    count: Any  # (2) i32: contacts, colours
    friction: Any  # f64
    b: Any  # 3-vectors [m/s]: u without impulses; (normal, t1, t2)
    factor: Any  # 2-vectors: r-factors of normal and tangents [kg]; 0 if nothing can move
    r: Any  # 3-vectors: impulses [N s]
    relaxation: Any  # f64: largest fraction of the r-factors that a sweep uses; set by its solver
    best: Any  # 3-vectors: the best impulses so far
    sweep_start: Any  # 3-vectors: impulses at the start of the sweep
    previous: Any  # 3-vectors: impulses after the previous sweep, before extrapolation
    term: Any  # 2-vectors: contributions of each contact to two sums
    partial: Any  # (CHUNKS) 2-vectors: sums over chunks of the contacts
    order: Any  # i32: contacts in sweep order
    colour: Any  # i32: of each contact, see `graph`
    colour_start: Any  # (capacity + 1) i32: start of each colour in `order`
    state: Any  # (10) f64: two sums, residual, that of `best`, fraction of the r-factors, counts; see `r_factor`, `momentum`
    history: Any  # (HISTORY) f64: residuals at the checks of a launch
    # W over nodes
    node: Any  # (capacity, NODES) i32, the first arity[c] are in use
    arity: Any  # i32
    weight: Any  # (capacity, NODES) f64: positive on side a, negative on side b
    normal: Any  # 3-vectors: from b to a
    tangent: Any  # 3-vectors: t1; t2 = normal x t1
    inverse_mass: Any  # (n_nodes) 3-vectors [1/kg], 0 on constrained axes
    w: Any  # (n_nodes) 3-vectors [m/s]: M^-1 J^T r
    entry_start: Any  # (n_nodes + 1) i32: contacts of each node
    entry: Any  # i32: NODES * contact + index of the node in it
    # W as a matrix
    row_start: Any  # (capacity + 1) i32
    column: Any  # i32
    block: Any  # (blocks, 9) f64


def build_node_problem(arena: FieldArena, capacity: int, n_nodes: int, serial: bool) -> ContactProblem:
    """Allocate a problem for contacts between the nodes of a model."""

    def vectors(name: str, count: int = capacity):
        return arena.vectors(f"problem_{name}", ti.f64, count)

    def ints(name: str, shape):
        return arena.field(f"problem_{name}", ti.i32, shape)

    return ContactProblem(
        **_common(arena, capacity, serial),
        matrix=False,
        n_nodes=n_nodes,
        node=ints("node", (capacity, NODES)),
        arity=ints("arity", capacity),
        weight=arena.field("problem_weight", ti.f64, (capacity, NODES)),
        normal=vectors("normal"),
        tangent=vectors("tangent"),
        inverse_mass=vectors("inverse_mass", n_nodes),
        w=vectors("w", n_nodes),
        entry_start=ints("entry_start", n_nodes + 1),
        entry=ints("entry", NODES * capacity),
        row_start=None,
        column=None,
        block=None,
    )


def build_matrix_problem(arena: FieldArena, n: int, n_blocks: int, serial: bool) -> ContactProblem:
    """Allocate a problem for n contacts and a W of n_blocks 3x3 blocks."""

    def ints(name: str, count: int):
        return arena.field(f"problem_{name}", ti.i32, count)

    return ContactProblem(
        **_common(arena, n, serial),
        matrix=True,
        n_nodes=0,
        node=None,
        arity=None,
        weight=None,
        normal=None,
        tangent=None,
        inverse_mass=None,
        w=None,
        entry_start=None,
        entry=None,
        row_start=ints("row_start", n + 1),
        column=ints("column", n_blocks),
        block=arena.field("problem_block", ti.f64, (n_blocks, 9)),
    )


def _common(arena: FieldArena, capacity: int, serial: bool) -> dict[str, Any]:
    def vectors(name: str, n: int = 3):
        return arena.vectors(f"problem_{name}", ti.f64, capacity, n=n)

    return {
        "capacity": capacity,
        "serial": serial,
        "count": arena.field("problem_count", ti.i32, 2),
        "friction": arena.field("problem_friction", ti.f64, capacity),
        "b": vectors("b"),
        "factor": vectors("factor", 2),
        "r": vectors("r"),
        "relaxation": arena.field("problem_relaxation", ti.f64, capacity),
        "best": vectors("best"),
        "sweep_start": vectors("sweep_start"),
        "previous": vectors("previous"),
        "term": vectors("term", 2),
        "partial": arena.vectors("problem_partial", ti.f64, CHUNKS, n=2),
        "order": arena.field("problem_order", ti.i32, capacity),
        "colour": arena.field("problem_colour", ti.i32, capacity),
        "colour_start": arena.field("problem_colour_start", ti.i32, capacity + 1),
        "state": arena.field("problem_state", ti.f64, 10),
        "history": arena.field("problem_history", ti.f64, HISTORY),
    }


def fill_field(field, values: np.ndarray) -> None:
    """Fill the first rows of a field with values (k, ...) and the others with 0."""
    whole = np.zeros((field.shape[0], *values.shape[1:]))
    whole[: len(values)] = values
    upload([(field, whole)])


def fill_matrix_problem(p: ContactProblem, W: sp.spmatrix, b: np.ndarray, friction: np.ndarray) -> None:
    """Upload W (3k,3k), b (3k,) and coefficients of friction (k,) to a problem large enough; keep its impulses."""
    blocks, k = sp.bsr_matrix(W, blocksize=(3, 3)), len(friction)
    blocks.sort_indices()
    p.count[0] = k
    for field, values in (
        (p.row_start, blocks.indptr),
        (p.column, blocks.indices),
        (p.block, blocks.data.reshape(-1, 9)),
        (p.b, b.reshape(k, 3)),
        (p.friction, friction),
        (p.order, np.arange(k)),
    ):
        fill_field(field, values)
    find_factors(p)


# --- solver interface -------------------------------------------------------------------------------------------------


@ti.func
def to_frame(p: ti.template(), c, v):
    """Transform a world vector to the frame of contact c."""
    n, t = p.normal[c], p.tangent[c]
    return dvec(n.dot(v), t.dot(v), n.cross(t).dot(v))


@ti.func
def to_world(p: ti.template(), c, r):
    """Transform a vector from the frame of contact c to the world."""
    n, t = p.normal[c], p.tangent[c]
    return r[0] * n + r[1] * t + r[2] * n.cross(t)


@ti.func
def velocity(p: ti.template(), c):
    """u of contact c at the present impulses [m/s]."""
    u = p.b[c]
    if ti.static(p.matrix):
        for k in range(p.row_start[c], p.row_start[c + 1]):
            r = p.r[p.column[k]]
            for i in ti.static(range(3)):
                u[i] += p.block[k, 3 * i] * r[0] + p.block[k, 3 * i + 1] * r[1] + p.block[k, 3 * i + 2] * r[2]
    else:
        v = dvec(0.0)
        for k in range(p.arity[c]):
            v += p.weight[c, k] * p.w[p.node[c, k]]
        u += to_frame(p, c, v)
    return u


@ti.func
def add_impulse(p: ti.template(), c, change):
    """Add a change of contact c's impulse to w at its nodes. Contacts updated in parallel must share no movable node."""
    if ti.static(not p.matrix):
        d = to_world(p, c, change)
        for k in range(p.arity[c]):
            i = p.node[c, k]
            p.w[i] = p.w[i] + p.weight[c, k] * (p.inverse_mass[i] * d)


@ti.func
def impulse_on(p: ti.template(), i):
    """(J^T r) of node i [N s], summed over its contacts in a fixed order."""
    d = dvec(0.0)
    for e in range(p.entry_start[i], p.entry_start[i + 1]):
        c, k = p.entry[e] // NODES, p.entry[e] % NODES
        d += p.weight[c, k] * to_world(p, c, p.r[c])
    return d


@ti.func
def gather_velocity(p: ti.template(), i):
    """M^-1 J^T r at node i."""
    return p.inverse_mass[i] * impulse_on(p, i)


@ti.func
def natural_map(p: ti.template(), c):
    """(|r - prox(r - f u)|^2, |r|^2) of contact c."""
    r = p.r[c]
    d = r - prox(r - scaled(p.factor[c], velocity(p, c)), p.friction[c])
    return d.dot(d), r.dot(r)


@ti.func
def residual_of(changed, size):
    """Relative residual from the two sums; 1 if r is 0 but not a solution, or not a number."""
    result = ti.cast(0.0, ti.f64)
    if size > 0.0:
        result = ti.sqrt(changed / size)
    elif not changed == 0.0:
        result = 1.0
    return result


@kernel
def find_velocities(p: ti.template()):
    """Set w = M^-1 J^T r over nodes; does nothing if W is a matrix."""
    if ti.static(not p.matrix):
        ti.loop_config(serialize=p.serial)
        for i in range(p.n_nodes):
            p.w[i] = gather_velocity(p, i)


@ti.func
def residual(p: ti.template()):
    """The residual of the present impulses, summed in order; w is up to date."""
    changed, size = ti.cast(0.0, ti.f64), ti.cast(0.0, ti.f64)
    for c in range(p.count[0]):
        d, s = natural_map(p, c)
        changed += d
        size += s
    return residual_of(changed, size)


@ti.func
def own_block(p: ti.template(), c):
    """The 3x3 block of W between contact c and itself."""
    B = ti.Matrix.zero(ti.f64, 3, 3)
    if ti.static(p.matrix):
        for k in range(p.row_start[c], p.row_start[c + 1]):
            if p.column[k] == c:
                for i, j in ti.static(ti.ndrange(3, 3)):
                    B[i, j] += p.block[k, 3 * i + j]
    else:
        n, t = p.normal[c], p.tangent[c]
        E = ti.Matrix.rows([n, t, n.cross(t)])
        h = dvec(0.0)
        for k in range(p.arity[c]):
            h += p.weight[c, k] * p.weight[c, k] * p.inverse_mass[p.node[c, k]]
        for i, j in ti.static(ti.ndrange(3, 3)):
            for q in ti.static(range(3)):
                B[i, j] += E[i, q] * h[q] * E[j, q]
    return B


@kernel
def find_factors(p: ti.template()):
    """Set the r-factors from the diagonal of W."""
    ti.loop_config(serialize=p.serial)
    for c in range(p.count[0]):
        B = own_block(p, c)
        across = ti.max(B[1, 1], B[2, 2])
        p.factor[c][0] = ti.select(B[0, 0] > 0.0, 1.0 / B[0, 0], 0.0)
        p.factor[c][1] = ti.select(across > 0.0, 1.0 / across, 0.0)
        if B[0, 0] <= 0.0:  # immovable
            p.r[c] = dvec(0.0)


@kernel
def index_nodes(p: ti.template()):
    """List the contacts of each node, in ascending order."""
    ti.loop_config(serialize=True)
    for _ in range(1):
        for i in range(p.n_nodes + 1):
            p.entry_start[i] = 0
        for c in range(p.count[0]):
            for k in range(p.arity[c]):
                p.entry_start[p.node[c, k]] += 1
        total = 0
        for i in range(p.n_nodes + 1):
            total += p.entry_start[i]
            p.entry_start[i] = total
        for back in range(p.count[0]):
            c = p.count[0] - 1 - back
            for k in range(p.arity[c]):
                i = p.node[c, k]
                p.entry_start[i] -= 1
                p.entry[p.entry_start[i]] = NODES * c + k
