"""The frictional contact problem: impulses r with u = W r + b, Signorini's and Coulomb's laws between r and u.

W, the Delassus operator, is given in one of two forms. Over nodes: W = J M^-1 J^T, where J r pushes the nodes of each contact by
their weights, and `w` = M^-1 J^T r is kept up to date; nothing is assembled. As a matrix: 3x3 blocks in CSR. Solvers see
only `velocity` and `push`, so each is written once.
The r-factors are 1 / W_nn and 1 / max(W_t1t1, W_t2t2), the same for every solver, since the residual
    |r - prox(r - f u)| / |r|
rests on them: a change of r between two sweeps shrinks with the step that a solver dares, and tells nothing.
All is f64: impulses are small differences of large ones.
"""

from dataclasses import dataclass
from typing import Any

import taichi as ti

from taisoft.collision.surface import dvec
from taisoft.contact.prox import prox, scaled
from taisoft.runtime import FieldArena, kernel

NODES = 6  # of a contact at most, three on each side
CHANGED, SIZE, RESIDUAL, GOOD, STEP, SWEEPS, LOOKS = range(7)  # places in `state`
HISTORY = 1024  # residuals kept


@dataclass(frozen=True, eq=False)
class ContactProblem:
    """Fields of up to `capacity` contacts; the first count[0] hold. What a form does not need is None."""

    capacity: int
    serial: bool  # loops run on one thread
    matrix: bool  # the form of W
    n_nodes: int
    count: Any  # (1) i32
    friction: Any  # f64
    b: Any  # 3-vectors [m/s]: u without impulses; (normal, t1, t2)
    factor: Any  # 2-vectors: r-factors of normal and tangents [kg]; 0 where nothing can move
    r: Any  # 3-vectors: impulses [N s]
    good: Any  # 3-vectors: impulses of the last good iterate
    trial: Any  # 3-vectors: impulses of a sweep that uses those of the last one only
    order: Any  # i32: contacts in the order of a sweep
    state: Any  # (7) f64: sums and value of the residual, that of the last good iterate, share of the r-factors, counts
    history: Any  # (HISTORY) f64: residuals of the first looks
    # over nodes
    node: Any  # (capacity, NODES) i32, the first arity[c] hold
    arity: Any  # i32
    weight: Any  # (capacity, NODES) f64: positive on side a, negative on side b
    normal: Any  # 3-vectors: from b to a
    tangent: Any  # 3-vectors: t1; t2 = normal x t1
    inverse_mass: Any  # (n_nodes) 3-vectors [1/kg], 0 on constrained axes
    w: Any  # (n_nodes) 3-vectors [m/s]: M^-1 J^T r
    entry_start: Any  # (n_nodes + 1) i32: contacts of each node
    entry: Any  # i32: NODES * contact + place
    # as a matrix
    row_start: Any  # (capacity + 1) i32
    column: Any  # i32
    block: Any  # (blocks, 9) f64


def build_node_problem(arena: FieldArena, capacity: int, n_nodes: int, serial: bool) -> ContactProblem:
    """Room for contacts between the nodes of a model."""
    def vectors(name: str, count: int = capacity):
        return arena.vectors(f"problem_{name}", ti.f64, count)

    def ints(name: str, shape):
        return arena.field(f"problem_{name}", ti.i32, shape)

    return ContactProblem(
        **_common(arena, capacity, serial), matrix=False, n_nodes=n_nodes, node=ints("node", (capacity, NODES)),
        arity=ints("arity", capacity), weight=arena.field("problem_weight", ti.f64, (capacity, NODES)),
        normal=vectors("normal"), tangent=vectors("tangent"), inverse_mass=vectors("inverse_mass", n_nodes),
        w=vectors("w", n_nodes), entry_start=ints("entry_start", n_nodes + 1), entry=ints("entry", NODES * capacity),
        row_start=None, column=None, block=None,
    )  # fmt: skip


def build_matrix_problem(arena: FieldArena, n: int, n_blocks: int, serial: bool) -> ContactProblem:
    """Room for n contacts and a W of n_blocks 3x3 blocks."""
    def ints(name: str, count: int):
        return arena.field(f"problem_{name}", ti.i32, count)

    return ContactProblem(
        **_common(arena, n, serial), matrix=True, n_nodes=0, node=None, arity=None, weight=None, normal=None, tangent=None,
        inverse_mass=None, w=None, entry_start=None, entry=None, row_start=ints("row_start", n + 1),
        column=ints("column", n_blocks), block=arena.field("problem_block", ti.f64, (n_blocks, 9)),
    )  # fmt: skip


def _common(arena: FieldArena, capacity: int, serial: bool) -> dict[str, Any]:
    def vectors(name: str, n: int = 3):
        return arena.vectors(f"problem_{name}", ti.f64, capacity, n=n)

    return {
        "capacity": capacity, "serial": serial, "count": arena.field("problem_count", ti.i32, 1),
        "friction": arena.field("problem_friction", ti.f64, capacity), "b": vectors("b"), "factor": vectors("factor", 2),
        "r": vectors("r"), "good": vectors("good"), "trial": vectors("trial"),
        "order": arena.field("problem_order", ti.i32, capacity), "state": arena.field("problem_state", ti.f64, 7),
        "history": arena.field("problem_history", ti.f64, HISTORY),
    }  # fmt: skip


# --- what solvers see -------------------------------------------------------------------------------------------------


@ti.func
def to_frame(p: ti.template(), c, v):
    """A vector of the world in the frame of contact c."""
    n, t = p.normal[c], p.tangent[c]
    return dvec(n.dot(v), t.dot(v), n.cross(t).dot(v))


@ti.func
def to_world(p: ti.template(), c, r):
    """A vector of contact c's frame in the world."""
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
def push(p: ti.template(), c, change):
    """Tell the nodes of contact c that its impulse changed. Contacts that are pushed at once must share no movable node."""
    if ti.static(not p.matrix):
        d = to_world(p, c, change)
        for k in range(p.arity[c]):
            i = p.node[c, k]
            p.w[i] = p.w[i] + p.weight[c, k] * (p.inverse_mass[i] * d)


@ti.func
def gather_velocity(p: ti.template(), i):
    """M^-1 J^T r at node i, its contacts in a fixed order."""
    d = dvec(0.0)
    for e in range(p.entry_start[i], p.entry_start[i + 1]):
        c, k = p.entry[e] // NODES, p.entry[e] % NODES
        d += p.weight[c, k] * to_world(p, c, p.r[c])
    return p.inverse_mass[i] * d


@ti.func
def natural_map(p: ti.template(), c):
    """(|r - prox(r - f u)|^2, |r|^2) of contact c."""
    r = p.r[c]
    d = r - prox(r - scaled(p.factor[c], velocity(p, c)), p.friction[c])
    return d.dot(d), r.dot(r)


@ti.func
def residual_of(changed, size):
    """The relative residual from the two sums; 1 where impulses are wanted and there are none."""
    result = ti.cast(0.0, ti.f64)
    if size > 0.0:
        result = ti.sqrt(changed / size)
    elif changed > 0.0:
        result = 1.0
    return result


@kernel
def find_velocities(p: ti.template()):
    """w = M^-1 J^T r over nodes; nothing to do for a matrix."""
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


@kernel
def find_factors(p: ti.template()):
    """r-factors from the diagonal of W."""
    ti.loop_config(serialize=p.serial)
    for c in range(p.count[0]):
        d = dvec(0.0)
        if ti.static(p.matrix):
            for k in range(p.row_start[c], p.row_start[c + 1]):
                if p.column[k] == c:
                    d = dvec(p.block[k, 0], p.block[k, 4], p.block[k, 8])
        else:
            n, t = p.normal[c], p.tangent[c]
            s = n.cross(t)
            for k in range(p.arity[c]):
                h = p.weight[c, k] * p.weight[c, k] * p.inverse_mass[p.node[c, k]]
                d += dvec((h * n).dot(n), (h * t).dot(t), (h * s).dot(s))
        across = ti.max(d[1], d[2])
        p.factor[c][0] = ti.select(d[0] > 0.0, 1.0 / d[0], 0.0)
        p.factor[c][1] = ti.select(across > 0.0, 1.0 / across, 0.0)
        if d[0] <= 0.0:  # nothing can move it
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
