"""Order in which symmetric Gauss-Seidel passes the nodes of a divided system: the even chunks, the odd ones, then the last nodes.

Several threads share the chunks of one parity, so these may not depend on each other. Where a coupling term has nodes in several
chunks of one parity, those outside the first of these chunks are therefore last: one thread passes them in ascending order after
all chunks, and first in a backward sweep. All terms then belong to L, as do all blocks of the matrix at last nodes. Blocks
between other nodes in different chunks of one parity are in E, see `gauss_seidel`.
Blocks at last nodes are not where the half-rows of the matrix have them (`NodeGraph`). In a forward sweep the vector is 0 at last
nodes until their turn, which leaves these blocks out. In a backward sweep neighbours of last nodes look for them in both halves.
"""

import taichi as ti

from taisoft.backend.runtime import kernel
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
def chunk_range(model: ti.template(), terms: ti.template(), work: ti.template(), c, last: ti.template()):
    """Return the first place of chunk c, or of the last nodes, in their list, and one past its end."""
    first, end = 0, model.n_nodes
    if ti.static(last):
        end = terms.n_last[0]
    elif ti.static(work.divided):
        first, end = c << work.chunk_shift, ti.min(end, (c + 1) << work.chunk_shift)
    return first, end


@ti.func
def node_at(terms: ti.template(), work: ti.template(), at, last: ti.template()):
    """Return the node at a place of a chunk, or of the last nodes."""
    i = at
    if ti.static(last):
        i = terms.last[at]
    return i


@ti.func
def is_later(terms: ti.template(), work: ti.template(), i, last: ti.template()):
    """Whether node i is a last node, not passed with its chunk."""
    later = False
    if ti.static(work.has_last(terms) and not last):
        later = terms.place[i] == IS_LAST
    return later


@ti.func
def _times_last(model: ti.template(), A: ti.template(), terms: ti.template(), first, end, above, x: ti.template()):
    """Sum of the blocks first <= at < end at last nodes with a number larger than `above` times x there."""
    y = ti.Vector([0.0, 0.0, 0.0, 0.0], model.real)
    for at in range(first, end):
        j = A.column[at]
        if terms.place[j] == IS_LAST and j > above:
            y += padded_times(A.value[at], x[j])
    return ti.Vector([y[0], y[1], y[2]])


@ti.func
def _times_others(model: ti.template(), A: ti.template(), terms: ti.template(), c, first, end, x: ti.template()):
    """Sum of the blocks first <= at < end at other nodes times x there."""
    y = ti.Vector([0.0, 0.0, 0.0, 0.0], model.real)
    for at in range(first, end):
        j = A.column[at]
        if terms.place[j] != IS_LAST:
            y += padded_times(A.value[at], x[j])
    keep_padding_lane(model, A, c, y)
    return ti.Vector([y[0], y[1], y[2]])


@ti.func
def _end(A: ti.template(), terms: ti.template(), work: ti.template(), row):
    """One past the last entry of a half-row in L or L^T."""
    end = A.row_start[row + 1]
    if ti.static(A.crossed and work.is_shared(terms)):
        end = A.apart_start[row]
    return end


@ti.func
def times_below(
    model: ti.template(), A: ti.template(), terms: ti.template(), work: ti.template(), c, i, x: ti.template(), last: ti.template()
):
    """(L x)_i, for x that is 0 at last nodes not passed so far."""
    y = ti.Vector([0.0, 0.0, 0.0], model.real)
    if ti.static(last):
        y = off_diagonal_times(model, A, c, i, x)
    else:
        y = partial_row_times(model, A, c, A.row_start[i], _end(A, terms, work, i), x)
    return y


@ti.func
def times_above(
    model: ti.template(), A: ti.template(), terms: ti.template(), work: ti.template(), c, i, x: ti.template(), last: ti.template()
):
    """(L^T x)_i, of neighbours of last nodes without what `times_last_above` adds."""
    y, row = ti.Vector([0.0, 0.0, 0.0], model.real), i + model.n_nodes
    if ti.static(last):
        for half in range(2):
            y += _times_last(
                model, A, terms, A.row_start[i + half * model.n_nodes], A.row_start[i + half * model.n_nodes + 1], i, x
            )
    else:
        y = partial_row_times_backward(model, A, c, A.row_start[row], _end(A, terms, work, row), x)
    return y


@ti.func
def times_last_above(model: ti.template(), A: ti.template(), terms: ti.template(), work: ti.template(), i, x: ti.template()):
    """Part of (L^T x)_i that `times_above` leaves out: at last nodes before the diagonal, or apart."""
    row, beside = i + model.n_nodes, terms.place[i] == BESIDE
    first = A.row_start[i]
    # elsewhere an empty loop, which costs less than a branch
    y = _times_last(model, A, terms, first, ti.select(beside, A.row_start[i + 1], first), -1, x)
    if ti.static(A.crossed):
        first = A.apart_start[row]
        y += _times_last(model, A, terms, first, ti.select(beside, A.row_start[row + 1], first), -1, x)
    return y


@ti.func
def times_apart(model: ti.template(), A: ti.template(), terms: ti.template(), work: ti.template(), c, i, x: ti.template()):
    """(E x)_i of a node that is not last."""
    y = ti.Vector([0.0, 0.0, 0.0], model.real)
    for half in range(2):
        row = i + half * model.n_nodes
        if ti.static(work.has_last(terms)):
            y += _times_others(model, A, terms, c, A.apart_start[row], A.row_start[row + 1], x)
        else:
            y += partial_row_times(model, A, c, A.apart_start[row], A.row_start[row + 1], x)
    return y


@ti.func
def clear_last(model: ti.template(), terms: ti.template(), work: ti.template(), x: ti.template()):
    """Set x at the last nodes to 0, so that products before their turn leave them out."""
    if ti.static(work.has_last(terms)):
        for at in range(terms.n_last[0]):
            x[terms.last[at]] = ti.Vector.zero(model.real, 3)


@kernel
def find_last(model: ti.template(), A: ti.template(), terms: ti.template(), work: ti.template()):
    """Find the last nodes of new terms, and their neighbours."""
    ti.loop_config(serialize=model.serial)
    for i in range(model.n_nodes):
        terms.place[i] = PLAIN
    ti.loop_config(serialize=True)
    for _ in range(1):
        for c in range(terms.count[0]):
            home = ti.Vector([NO_CHUNK, NO_CHUNK])  # first chunk of each parity
            for e in range(terms.first[c], terms.first[c] + terms.arity[c]):
                chunk = terms.node[e] >> work.chunk_shift
                for parity in ti.static((EVEN, ODD)):
                    if chunk % 2 == parity:
                        home[parity] = ti.min(home[parity], chunk)
            for e in range(terms.first[c], terms.first[c] + terms.arity[c]):
                i = terms.node[e]
                if i >> work.chunk_shift != home[EVEN] and i >> work.chunk_shift != home[ODD]:
                    terms.place[i] = IS_LAST
        n = 0
        for i in range(model.n_nodes):
            if terms.place[i] == IS_LAST:
                terms.last[n] = i
                n += 1
        terms.n_last[0] = n
        for at in range(n):
            for half in range(2):
                row = terms.last[at] + half * model.n_nodes
                for entry in range(A.row_start[row], A.row_start[row + 1]):
                    j = A.column[entry]
                    terms.place[j] = ti.max(terms.place[j], BESIDE)
