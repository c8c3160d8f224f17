"""Order in which symmetric Gauss-Seidel passes the nodes of a divided system: the even chunks, the odd ones, then the last nodes.

Several threads share the chunks of one parity, so these may not depend on each other. Where a coupling term has nodes in several
chunks of one parity, those outside the first of these chunks are therefore last: one thread passes them in ascending order after
all chunks, and first in a backward sweep. All terms then belong to L, as do all blocks of the matrix at last nodes. Blocks
between other nodes in different chunks of one parity are in E, see `pcg_gauss_seidel`.
Blocks at last nodes are not where the half-rows of the matrix have them (`NodeGraph`). In a forward sweep the vector is 0 at last
nodes until their turn, which leaves these blocks out. In a backward sweep neighbours of last nodes look for them in both halves.
"""

import taichi as ti

from taisoft.backend.runtime import kernel
from taisoft.fem.node_graph import n_nodes_of, node_of
from taisoft.linear.block_csr import (
    keep_padding_lane,
    off_diagonal_times,
    padded_times,
    partial_row_times,
    partial_row_times_backward,
)

EVEN, ODD = range(2)  # parities of chunks
PLAIN, BESIDE, IS_LAST = range(3)  # values of Coupling.place: no last node at hand, neighbour of one, a last node
NO_CHUNK = 1 << 30


@ti.func
def chunk_range(m: ti.template(), k: ti.template(), w: ti.template(), c, last: ti.template()):
    """Return the first place of chunk c, or of the last nodes, in their list, and one past its end."""
    first, end = 0, n_nodes_of(m, w.subset)
    if ti.static(last):
        end = k.n_last[0]
    elif ti.static(w.in_chunks):
        first, end = c << w.chunk_shift, ti.min(end, (c + 1) << w.chunk_shift)
    return first, end


@ti.func
def node_at(k: ti.template(), w: ti.template(), at, last: ti.template()):
    """Return the node at a place of a chunk, or of the last nodes."""
    i = node_of(w.subset, at)
    if ti.static(last):
        i = k.last[at]
    return i


@ti.func
def is_later(k: ti.template(), w: ti.template(), i, last: ti.template()):
    """Whether node i is a last node, not passed with its chunk."""
    later = False
    if ti.static(w.has_last(k) and not last):
        later = k.place[i] == IS_LAST
    return later


@ti.func
def _times_last(m: ti.template(), A: ti.template(), k: ti.template(), first, end, above, x: ti.template()):
    """Sum of the blocks first <= at < end at last nodes with a number larger than `above` times x there."""
    y = ti.Vector([0.0, 0.0, 0.0, 0.0], m.real)
    for at in range(first, end):
        j = A.column[at]
        if k.place[j] == IS_LAST and j > above:
            y += padded_times(A.value[at], x[j])
    return ti.Vector([y[0], y[1], y[2]])


@ti.func
def _times_others(m: ti.template(), A: ti.template(), k: ti.template(), c, first, end, x: ti.template()):
    """Sum of the blocks first <= at < end at other nodes times x there."""
    y = ti.Vector([0.0, 0.0, 0.0, 0.0], m.real)
    for at in range(first, end):
        j = A.column[at]
        if k.place[j] != IS_LAST:
            y += padded_times(A.value[at], x[j])
    keep_padding_lane(m, A, c, y)
    return ti.Vector([y[0], y[1], y[2]])


@ti.func
def _end(A: ti.template(), k: ti.template(), w: ti.template(), row):
    """One past the last entry of a half-row in L or L^T."""
    end = A.row_start[row + 1]
    if ti.static(A.crossed and w.is_shared(k)):
        end = A.apart_start[row]
    return end


@ti.func
def times_below(
    m: ti.template(), A: ti.template(), k: ti.template(), w: ti.template(), c, i, x: ti.template(), last: ti.template()
):
    """(L x)_i, for x that is 0 at last nodes not passed so far."""
    y = ti.Vector([0.0, 0.0, 0.0], m.real)
    if ti.static(last):
        y = off_diagonal_times(m, A, c, i, x)
    else:
        y = partial_row_times(m, A, c, A.row_start[i], _end(A, k, w, i), x)
    return y


@ti.func
def times_above(
    m: ti.template(), A: ti.template(), k: ti.template(), w: ti.template(), c, i, x: ti.template(), last: ti.template()
):
    """(L^T x)_i, of neighbours of last nodes without what `times_last_above` adds."""
    y, row = ti.Vector([0.0, 0.0, 0.0], m.real), i + m.n_nodes
    if ti.static(last):
        for half in range(2):
            y += _times_last(m, A, k, A.row_start[i + half * m.n_nodes], A.row_start[i + half * m.n_nodes + 1], i, x)
    else:
        y = partial_row_times_backward(m, A, c, A.row_start[row], _end(A, k, w, row), x)
    return y


@ti.func
def times_last_above(m: ti.template(), A: ti.template(), k: ti.template(), w: ti.template(), i, x: ti.template()):
    """Part of (L^T x)_i that `times_above` leaves out: at last nodes before the diagonal, or apart."""
    row, beside = i + m.n_nodes, k.place[i] == BESIDE
    first = A.row_start[i]
    y = _times_last(m, A, k, first, ti.select(beside, A.row_start[i + 1], first), -1, x)  # an empty loop costs less than a branch
    if ti.static(A.crossed):
        first = A.apart_start[row]
        y += _times_last(m, A, k, first, ti.select(beside, A.row_start[row + 1], first), -1, x)
    return y


@ti.func
def times_apart(m: ti.template(), A: ti.template(), k: ti.template(), w: ti.template(), c, i, x: ti.template()):
    """(E x)_i of a node that is not last."""
    y = ti.Vector([0.0, 0.0, 0.0], m.real)
    for half in range(2):
        row = i + half * m.n_nodes
        if ti.static(w.has_last(k)):
            y += _times_others(m, A, k, c, A.apart_start[row], A.row_start[row + 1], x)
        else:
            y += partial_row_times(m, A, c, A.apart_start[row], A.row_start[row + 1], x)
    return y


@ti.func
def clear_last(m: ti.template(), k: ti.template(), w: ti.template(), x: ti.template()):
    """Set x at the last nodes to 0, so that products before their turn leave them out."""
    if ti.static(w.has_last(k)):
        for at in range(k.n_last[0]):
            x[k.last[at]] = ti.Vector.zero(m.real, 3)


@kernel
def find_last(m: ti.template(), A: ti.template(), k: ti.template(), w: ti.template()):
    """Find the last nodes of new terms, and their neighbours."""
    ti.loop_config(serialize=m.serial)
    for i in range(m.n_nodes):
        k.place[i] = PLAIN
    ti.loop_config(serialize=True)
    for _ in range(1):
        for c in range(k.count[0]):
            home = ti.Vector([NO_CHUNK, NO_CHUNK])  # first chunk of each parity
            for j in range(k.arity[c]):
                chunk = k.node[c, j] >> w.chunk_shift
                for parity in ti.static((EVEN, ODD)):
                    if chunk % 2 == parity:
                        home[parity] = ti.min(home[parity], chunk)
            for j in range(k.arity[c]):
                i = k.node[c, j]
                if i >> w.chunk_shift != home[EVEN] and i >> w.chunk_shift != home[ODD]:
                    k.place[i] = IS_LAST
        n = 0
        for i in range(m.n_nodes):
            if k.place[i] == IS_LAST:
                k.last[n] = i
                n += 1
        k.n_last[0] = n
        for at in range(n):
            for half in range(2):
                row = k.last[at] + half * m.n_nodes
                for entry in range(A.row_start[row], A.row_start[row + 1]):
                    j = A.column[entry]
                    k.place[j] = ti.max(k.place[j], BESIDE)
