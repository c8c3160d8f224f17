"""W = J A^-1 J^T of contacts with the factor A = L L^T of a stage's matrix: W = Y^T Y with Y = L^-1 J^T.

A couples no nodes of different parts, bodies in general, so that Y and W are found part by part.
Weakness: Y and W are dense within each part.
"""

from dataclasses import dataclass
from typing import Any, NamedTuple

import numpy as np
import scipy.linalg as sl
import scipy.sparse as sp
import taichi as ti

from taisoft.backend.arrays import Count, FieldArena
from taisoft.backend.runtime import kernel
from taisoft.contact.problem import ContactProblem, frame_of, residual_of, to_frame
from taisoft.contact.prox import dvec, prox, scaled
from taisoft.dynamics.contact_terms import stage_velocity_of
from taisoft.fem.model import Model
from taisoft.fem.state import LAW
from taisoft.linear.factor import Factor, substitute_backward, substitute_forward

NONE = -1


@dataclass(frozen=True, eq=False)
class Unknowns:
    """Where the nodes of a model are in a factor, and where their contacts are in Y."""

    factor: Factor
    n_own: Count
    n_parts: Count
    node: Any  # (n_own) i32: those with unknowns
    at: Any  # (n_nodes) i32: first unknown of each node, in the order of elimination, or NONE
    part: Any  # (n_nodes) i32, of nodes with unknowns
    first: Any  # (n_parts + 1) i32: first unknown of each part
    number: Any  # (most contacts) i32: of each contact among those of W, or NONE
    slot: Any  # (n_parts * most contacts) i32: of each contact among those of a part, or NONE
    count: Any  # (n_parts) i32: contacts of each part
    begin: Any  # (n_parts) i32: where its Y begins


class Part(NamedTuple):
    """Y of a part."""

    rows: np.ndarray  # of W
    unknowns: slice
    Y: np.ndarray  # (unknowns, rows)


@ti.func
def _moves(m: ti.template(), w: ti.template(), i):
    """Whether node i has an unknown on a free axis."""
    return w.at[i] != NONE and (m.free[i] != 0.0).any()


@kernel
def _list_contacts(m: ti.template(), p: ti.template(), w: ti.template()):
    """List the contacts of each part."""
    ti.loop_config(serialize=True)
    for k in range(w.n_parts * p.count[0]):
        w.slot[k] = NONE
    ti.loop_config(serialize=True)
    for part in range(w.n_parts):
        w.count[part] = 0
    ti.loop_config(serialize=True)
    for c in range(p.count[0]):
        if w.number[c] != NONE:
            for e in range(p.first[c], p.first[c] + p.arity[c]):
                if _moves(m, w, p.node[e]):
                    part = w.part[p.node[e]]
                    k = part * p.count[0] + c
                    if w.slot[k] == NONE:
                        w.slot[k] = w.count[part]
                        w.count[part] += 1


@kernel
def _fill_rows(m: ti.template(), p: ti.template(), w: ti.template(), Y: ti.template()):
    """Add J^T to Y, 0 on constrained axes and for tangents without friction."""
    ti.loop_config(serialize=True)
    for c in range(p.count[0]):
        if w.number[c] != NONE:
            frame = frame_of(p, c)
            n_rows = 3 if p.friction[c] != 0.0 else 1
            for e in range(p.first[c], p.first[c] + p.arity[c]):
                i = p.node[e]
                if _moves(m, w, i):
                    part = w.part[i]
                    columns = 3 * w.count[part]
                    at = w.begin[part] + (w.at[i] - w.first[part]) * columns + 3 * w.slot[part * p.count[0] + c]
                    for axis in ti.static(range(3)):
                        weight = p.weight[e] * ti.cast(m.free[i][axis], ti.f64)
                        for row in range(n_rows):
                            Y[at + axis * columns + row] += weight * frame[row, axis]


@kernel
def begin_direct(m: ti.template(), k: ti.template(), w: ti.template(), beta: ti.f64):
    """Set work.velocity to u at the present x, and the factor's right-hand side to -L^-1 r_0."""
    ti.loop_config(serialize=True)
    for c in range(k.problem.count[0]):
        k.work.velocity[c] = stage_velocity_of(k, c, beta)
    ti.loop_config(serialize=True)
    for _ in range(1):
        for j in range(w.n_own):
            i = w.node[j]
            for axis in ti.static(range(3)):
                w.factor.rhs[w.at[i] + axis] = -ti.cast(m.free[i][axis] * k.residual_linear[i][axis], ti.f64)
        substitute_forward(w.factor)


@kernel
def end_direct(m: ti.template(), k: ti.template(), w: ti.template()):
    """Replace the factor's right-hand side by the change s of v, and set work.rate to u then. scalars: LAW, by the impulses."""
    rows, work = ti.static((k.problem, k.work))
    ti.loop_config(serialize=True)
    for _ in range(1):
        substitute_backward(w.factor)
        sums = ti.Vector([0.0, 0.0], ti.f64)
        for c in range(rows.count[0]):
            d = dvec(0.0)
            for e in range(rows.first[c], rows.first[c] + rows.arity[c]):
                i = rows.node[e]
                if w.at[i] != NONE:
                    for axis in ti.static(range(3)):
                        d[axis] += rows.weight[e] * ti.cast(m.free[i][axis], ti.f64) * w.factor.rhs[w.at[i] + axis]
            u, r = work.velocity[c] + to_frame(rows, c, d), rows.r[c]
            work.rate[c] = u
            change = r - prox(r - scaled(rows.factor[c], u), rows.friction[c])
            sums += ti.Vector([change.dot(change), r.dot(r)], ti.f64)
        m.state.scalars[LAW] = residual_of(sums)


@kernel
def move_directly(m: ti.template(), w: ti.template(), x_hat: ti.template(), beta: ti.f64):
    """Move the nodes by the change of v."""
    ti.loop_config(serialize=True)
    for j in range(w.n_own):
        i = w.node[j]
        s = dvec(w.factor.rhs[w.at[i]], w.factor.rhs[w.at[i] + 1], w.factor.rhs[w.at[i] + 2])
        m.state.x[i] += beta * s
        m.state.v[i] = (m.state.x[i] - x_hat[i]) / beta


class Delassus:
    """W of some contacts of a stage. contacts: (k), in the order of its rows; parts: of Y, one or more for each part of A."""

    def __init__(self, model: Model, factor: Factor, nodes: np.ndarray, most: int):
        """nodes (n): those with unknowns, in the order of the factor's blocks; most: maximum number of contacts."""
        fronts, arena, n = factor.fronts, FieldArena(), model.n_nodes
        at, part, parts = np.full(n, NONE), np.zeros(n), len(fronts.parts)
        at[nodes] = fronts.place[::3]
        first = fronts.first[[*(start for start, _ in fronts.parts), fronts.parts[-1][1]]]
        part[nodes] = np.searchsorted(first, at[nodes], "right") - 1
        indices = {"node": nodes, "at": at, "part": part, "first": first}
        sizes = {"number": most, "slot": parts * most, "count": parts, "begin": parts}
        self._model, self._arena, self._n_bytes = model, arena, 0
        self.unknowns = Unknowns(
            factor,
            len(nodes),
            parts,
            **{name: arena.filled(name, ti.i32, data.astype(np.int32)) for name, data in indices.items()},
            **{name: arena.field(name, ti.i32, size) for name, size in sizes.items()},
        )
        self._Y = arena.field("Y", ti.f64, 0)
        self.clear()

    def clear(self) -> None:
        """Forget the contacts, whose rows or matrix have changed."""
        none = np.zeros(0, dtype=np.int64)
        self.contacts, self.parts, self._used = none, [], 0
        self._blocks = [(none, none, np.zeros((0, 0)))]  # rows and columns of W, and what is added to it there

    def add(self, p: ContactProblem, contacts: np.ndarray) -> None:
        """Add contacts (k) to those of W."""
        before, known = len(self.contacts), self.parts
        self.contacts = np.concatenate([self.contacts, contacts])
        self.parts = known + (added := self._form(p, contacts, before))
        for part in added:
            for other in (one for one in known if one.unknowns == part.unknowns):
                block = other.Y.T @ part.Y
                self._blocks += [(other.rows, part.rows, block), (part.rows, other.rows, block.T)]
            lower = sl.blas.dsyrk(1.0, part.Y.T, lower=1)
            self._blocks.append((part.rows, part.rows, lower + np.tril(lower, -1).T))

    def _form(self, p: ContactProblem, contacts: np.ndarray, first: int) -> list[Part]:
        """Return the parts of Y for contacts (k), which are those from `first` on of W."""
        w, n = self.unknowns, int(p.count[0])
        w.number.host[:n] = NONE
        w.number.host[contacts] = np.arange(len(contacts))
        _list_contacts(self._model, p, w)
        width = np.diff(w.first.host)
        ends = self._used + np.cumsum(3 * width * w.count.host)
        w.begin.host[:] = ends - 3 * width * w.count.host
        if (total := int(ends[-1])) > self._Y.shape[0]:  # the parts keep the memory of the old one
            self._Y.release()
            self._arena.bytes.pop("Y")
            self._Y = self._arena.field("Y", ti.f64, 2 * total)
        self._Y.host[self._used : total] = 0.0
        _fill_rows(self._model, p, w, self._Y)
        found, self._used = [], total
        for k in np.flatnonzero(w.count.host).tolist():
            Y = self._Y.host[w.begin[k] : ends[k]].reshape(width[k], -1)
            w.factor.fronts.forward(w.factor.fronts.parts[k], Y)
            number = first + w.number.host[np.flatnonzero(w.slot.host[k * n : (k + 1) * n] != NONE)]
            found.append(Part((3 * number[:, None] + np.arange(3)).reshape(-1), slice(w.first[k], w.first[k + 1]), Y))
        return found

    def matrix(self, most: int) -> np.ndarray | sp.bsr_matrix:
        """Return W (3k,3k) of the k contacts, dense if there are at most so many rows."""
        n = 3 * len(self.contacts)
        if n <= most:
            W = np.zeros((n, n))
            for rows, columns, block in self._blocks:
                W[rows[:, None], columns] += block
            return W
        entries = [(np.repeat(i, len(j)), np.tile(j, len(i)), block.reshape(-1)) for i, j, block in self._blocks]
        rows, columns, values = (np.concatenate(one) for one in zip(*entries))
        return sp.coo_matrix((values, (rows, columns)), shape=(n, n)).tobsr((3, 3))

    @property
    def field_bytes(self) -> dict[str, int]:
        """Bytes by name."""
        return self._arena.bytes

    def release(self) -> None:
        """Free the fields."""
        self._arena.release()
