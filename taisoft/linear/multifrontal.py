"""Multifrontal Cholesky factorisation A = L L^T of a sparse matrix whose pattern stays, on the host, by dense BLAS.

The nodes are eliminated in an order of minimum degree. A front is a dense matrix: some columns of L, and the rows that these
fill. Once its columns are eliminated, what is left of it is added to the front of the next column among its rows, its parent.
Fronts are merged where that is faster, since a small one costs its calls. Forward substitutions with many right sides, as W of
contacts needs, go front by front, too; those with one run in kernels, see `factor`.
Source: Duff and Reid, "The Multifrontal Solution of Indefinite Sparse Symmetric Linear Equations", ACM TOMS 9, 1983; Liu, "The
Multifrontal Method for Sparse Matrix Solution", SIAM Review 34, 1992.
"""

from collections.abc import Callable

import numpy as np
import scipy.linalg as sl
import scipy.sparse as sp
import scipy.sparse.linalg as spl

from taisoft.ranges import owners


class Multifrontal:
    """Factor of matrices of one pattern.

    Front k has the columns first[k] to first[k + 1] of L, in the order of elimination, and below these the rows of
    row[start[k]:start[k + 1]]. Its numbers, from at[k] on, are three matrices, column by column: columns of L, (width, width) and
    (below, width), and (below, below) that is left for its parent.
    """

    # [s]: a front's calls, a multiplication and addition, and adding one number to the parent's, measured on one core
    CALLS, FLOP, ADDITION = 2e-5, 1e-10, 4e-9

    def __init__(self, start: np.ndarray, column: np.ndarray, d: int = 3, calls: float = CALLS):
        """start (n + 1), column: blocks (d, d) of each row, symmetric, with all diagonal ones. calls [s]: the fewer, the less L
        stores."""
        n, axis, self._calls = len(start) - 1, np.arange(d), calls
        columns, rows, parents = _merge(*_eliminate(start, column, _minimum_degree(start, column)), d, self._cost)
        self.order = (d * np.concatenate(columns)[:, None] + axis).reshape(-1)  # old index of each unknown
        self.place = np.empty(d * n, dtype=np.int64)
        self.place[self.order] = np.arange(d * n)
        below = [(np.sort(self.place[d * rest])[:, None] + axis).reshape(-1) for rest in rows]
        self.width, self.n_below = d * np.array([len(own) for own in columns]), np.array([len(rest) for rest in below])
        self.first, self.start = (np.concatenate([[0], np.cumsum(sizes)]) for sizes in (self.width, self.n_below))
        self.row = np.concatenate(below)
        self._keys = owners(self.n_below) * len(self.order) + self.row  # ascending
        self.at = np.concatenate([[0], np.cumsum((self.width + self.n_below) ** 2 - self.width * self.n_below)])
        self._left = []  # places of the lower triangle of what a front leaves, and where that is added
        for k, parent in enumerate(parents):
            j, i = (below[k][at] for at in np.triu_indices(len(below[k])))
            self._left.append((self._places(k, i, j), self._places(parent, i, j)))
        self.keep_in(np.zeros(self.at[-1]))
        # fronts without a parent end the parts of A that are not coupled: (first front, end)
        ends = np.flatnonzero(parents < 0) + 1
        self.parts = list(zip([0, *ends[:-1].tolist()], ends.tolist()))
        # entries of the blocks that lie in the lower triangle, and their places
        i = self.place[d * owners(np.diff(start))[:, None, None] + axis[:, None]]
        i, j = (one.reshape(-1) for one in np.broadcast_arrays(i, self.place[d * column.astype(np.int64)[:, None, None] + axis]))
        self.lower = np.flatnonzero(i >= j)
        self._entries = self.places(i[self.lower], j[self.lower])
        self.seconds = sum(map(self._cost, self.width.tolist(), self.n_below.tolist()))  # expected, of a factorisation
        self.n_entries = int((self.width * (self.width + self.n_below)).sum())  # of L

    def _cost(self, width: int, below: int) -> float:
        size = width + below
        return self._calls + self.FLOP * (size**3 - below**3) / 3 + self.ADDITION * below**2 / 2

    def unknowns_of(self, part: tuple[int, int]) -> slice:
        """Unknowns of a part, in the order of elimination."""
        return slice(self.first[part[0]], self.first[part[1]])

    def places(self, i: np.ndarray, j: np.ndarray) -> np.ndarray:
        """Where entries (i, j) of A, i >= j in the order of elimination, are in `values`."""
        return self._places(owners(self.width)[j], i, j)

    def _places(self, k: int | np.ndarray, i: np.ndarray, j: np.ndarray) -> np.ndarray:
        """Where entries (i, j), i >= j, of fronts k are in `values`."""
        n, width, first, end, start = len(self.order), self.width[k], self.first[k], self.first[k + 1], self.start[k]
        row, column = (np.where(u < end, u - first, width - start + np.searchsorted(self._keys, k * n + u)) for u in (i, j))
        return self.at[k] + row + np.where(row < width, column * width, width * (width - 1) + column * self.n_below[k])

    def keep_in(self, values: np.ndarray) -> None:
        """Keep the numbers of all fronts in this array from now on."""
        self.values, self._matrices = values, []
        for at, w, b in zip(self.at, self.width, self.n_below):
            parts, shapes = np.split(values[at : at + w * w + b * w + b * b], [w * w, w * w + b * w]), ((w, w), (b, w), (b, b))
            self._matrices.append([part.reshape(shape, order="F") for part, shape in zip(parts, shapes)])

    def factorise(self, entries: np.ndarray) -> None:
        """Factorise the matrix with these entries in `lower`. Raise numpy.linalg.LinAlgError if it is not positive definite."""
        self.values[:] = 0.0
        self.values[self._entries] = entries
        for (top, low, rest), (left, into) in zip(self._matrices, self._left):
            if sl.lapack.dpotrf(top, lower=1, clean=0, overwrite_a=1)[1] != 0:
                raise np.linalg.LinAlgError("the matrix is not positive definite")
            if len(low):
                sl.blas.dtrsm(1.0, top, low, side=1, lower=1, trans_a=1, overwrite_b=1)
                sl.blas.dsyrk(-1.0, low, beta=1.0, c=rest, lower=1, overwrite_c=1)
                self.values[into] += self.values[left]

    def forward(self, part: tuple[int, int], right: np.ndarray) -> None:
        """Replace right sides (n, q), in the order of elimination of a part, by L^-1 times them."""
        start = self.first[part[0]]
        for k in range(*part):
            own, (top, low, _) = right[self.first[k] - start : self.first[k + 1] - start], self._matrices[k]
            if own.any():
                sl.blas.dtrsm(1.0, top, own.T, side=1, lower=1, trans_a=1, overwrite_b=1)
                if len(low):
                    right[self.row[self.start[k] : self.start[k + 1]] - start] -= low @ own


def _minimum_degree(start: np.ndarray, column: np.ndarray) -> np.ndarray:
    """Order (n) of elimination, old indices, by SuperLU's minimum degree on the pattern."""
    n = len(start) - 1
    degree = np.diff(start)
    values = np.where(column == owners(degree), 1.0 + degree[owners(degree)], -1.0)  # positive definite: by its diagonal
    pattern = sp.csc_matrix((values, column, start), shape=(n, n))
    factor = spl.splu(pattern, permc_spec="MMD_AT_PLUS_A", diag_pivot_thresh=0.0, options={"SymmetricMode": True})
    return np.argsort(factor.perm_c)


def _eliminate(start: np.ndarray, column: np.ndarray, order: np.ndarray) -> tuple[list, list, np.ndarray]:
    """Columns and rows below, old indices, and parent of each front of one node, in an order of elimination."""
    n, place = len(order), np.empty(len(order), dtype=np.int64)
    place[order] = np.arange(n)
    below: list[set] = [set() for _ in range(n)]
    parents = np.full(n, -1)
    for k, i in enumerate(order):
        own = below[k]
        own.update(place[column[start[i] : start[i + 1]]].tolist())
        own -= {j for j in own if j <= k}
        if own:
            parents[k] = parent = min(own)
            below[parent] |= own
    return [[i] for i in order.tolist()], [{int(order[j]) for j in own} for own in below], parents


def _merge(
    columns: list, rows: list, parents: np.ndarray, d: int, cost: Callable[[int, int], float]
) -> tuple[list, list, np.ndarray]:
    """Merge fronts with their parents where that is faster; return those left, children before parents, part by part."""
    n, children = len(columns), [[] for _ in columns]
    into = np.arange(len(columns))
    for k in range(n):
        mine = []
        for child in children[k]:
            w, below, more = d * len(columns[k]), d * len(rows[k]), d * len(columns[child])
            apart = cost(w, below) + cost(more, d * len(rows[child]))
            if cost(w + more, below) <= apart:
                columns[k], into[child] = columns[child] + columns[k], k
                mine += children[child]
            else:
                mine.append(child)
        children[k] = mine
        if parents[k] >= 0:
            children[parents[k]].append(k)
    left, stack = [], [k for k in range(n) if into[k] == k and parents[k] < 0]
    while stack:  # parents first, then reversed
        k = stack.pop()
        left.append(k)
        stack += children[k]
    left.reverse()
    number = {k: at for at, k in enumerate(left)}
    found = np.full(len(left), -1)
    for k in left:
        for child in children[k]:
            found[number[child]] = number[k]
    return [np.array(columns[k]) for k in left], [np.array(sorted(rows[k]), dtype=np.int64) for k in left], found
