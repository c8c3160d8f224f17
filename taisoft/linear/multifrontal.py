"""Multifrontal Cholesky factorisation A = L L^T of a sparse matrix whose pattern stays, on the host, by dense BLAS.

The nodes are eliminated in an order of minimum degree. A front is a dense matrix: some columns of L, and the rows that these
fill. Once its columns are eliminated, what is left of it is added to the front of the next column among its rows, its parent.
Fronts are merged where that is faster, since a small one costs its calls. Forward substitutions with many right sides, as W of
contacts needs, go front by front, too.
Source: Duff and Reid, "The Multifrontal Solution of Indefinite Sparse Symmetric Linear Equations", ACM TOMS 9, 1983; Liu, "The
Multifrontal Method for Sparse Matrix Solution", SIAM Review 34, 1992.
"""

from dataclasses import dataclass

import numpy as np
import scipy.linalg as sl
import scipy.sparse as sp
import scipy.sparse.linalg as spl

from taisoft.ranges import owners

D = 3  # unknowns of a node


@dataclass(frozen=True, eq=False)
class Front:
    """Columns first to end of L and the rows below them, all in the order of elimination."""

    first: int
    end: int
    below: np.ndarray  # rows below the columns, ascending
    at: int  # where its matrix (m, m), column by column, begins among those of all fronts
    children: tuple[int, ...]
    kept: np.ndarray  # places in what is left of it, column by column: its lower triangle,
    into: np.ndarray  # and where that is added in the parent's matrix

    @property
    def width(self) -> int:
        return self.end - self.first

    @property
    def size(self) -> int:
        return self.width + len(self.below)


class Multifrontal:
    """Factor of matrices of one pattern."""

    # [s]: a front's calls, a multiplication and addition, and adding one number to the parent's, measured on one core
    CALLS, FLOP, ADDITION = 6e-5, 1e-10, 4e-9

    def __init__(self, start: np.ndarray, column: np.ndarray):
        """start (n + 1), column: blocks of each row, symmetric, with all diagonal ones."""
        n = len(start) - 1
        columns, rows, parents = _merge(*_eliminate(start, column, _minimum_degree(start, column)))
        order = np.concatenate(columns) if n else np.zeros(0, dtype=np.int64)
        self.order = (D * order[:, None] + np.arange(D)).reshape(-1)  # old index of each unknown
        self.place = np.empty(D * n, dtype=np.int64)
        self.place[self.order] = np.arange(D * n)
        self.fronts = _build_fronts(columns, rows, parents, self.place[::D] // D)
        self._matrices = np.zeros(sum(front.size**2 for front in self.fronts))
        self._owner = owners([front.width for front in self.fronts])  # front of each unknown
        self._left: list[np.ndarray] = []  # of each front, once factorised: (width, width) and (below, width)
        # fronts without a parent end the parts of A that are not coupled: (first front, end)
        ends = np.flatnonzero(parents < 0) + 1
        self.parts = list(zip([0, *ends[:-1].tolist()], ends.tolist()))

        self.seconds = sum(self._cost(front.width, len(front.below)) for front in self.fronts)  # expected, of a factorisation
        self.n_entries = sum(front.width * front.size for front in self.fronts)  # of L

    @classmethod
    def _cost(cls, width: int, below: int) -> float:
        size = width + below
        return cls.CALLS + cls.FLOP * (size**3 - below**3) / 3 + cls.ADDITION * below**2 / 2

    def unknowns_of(self, part: tuple[int, int]) -> slice:
        """Unknowns of a part, in the order of elimination."""
        return slice(self.fronts[part[0]].first, self.fronts[part[1] - 1].end)

    def places(self, i: np.ndarray, j: np.ndarray) -> np.ndarray:
        """Where entries (i, j) of A, i >= j in the order of elimination, are among the matrices of all fronts."""
        found = np.empty(len(i), dtype=np.int64)
        of = self._owner[j]
        by = np.argsort(of, kind="stable")
        for k, at in zip(np.unique(of), np.split(by, np.flatnonzero(np.diff(of[by])) + 1)):
            front = self.fronts[k]
            row = i[at] - front.first
            outer = i[at] >= front.end
            row[outer] = front.width + np.searchsorted(front.below, i[at][outer])
            found[at] = front.at + (j[at] - front.first) * front.size + row
        return found

    def factorise(self, values: np.ndarray, places: np.ndarray) -> None:
        """Factorise the matrix with these values at `places`. Raise numpy.linalg.LinAlgError if it is not positive definite."""
        self._matrices[:] = 0.0
        self._matrices[places] = values
        self._left, rest = [], {}
        for k, front in enumerate(self.fronts):
            m, w = front.size, front.width
            flat = self._matrices[front.at : front.at + m * m]
            for child in front.children:
                one = self.fronts[child]
                flat[one.into] += rest.pop(child)[one.kept]
            F = flat.reshape((m, m), order="F")
            top, info = sl.lapack.dpotrf(F[:w, :w], lower=1)
            if info != 0:
                raise np.linalg.LinAlgError("the matrix is not positive definite")
            low = sl.blas.dtrsm(1.0, top, F[w:, :w], side=1, lower=1, trans_a=1) if w < m else np.zeros((0, w))
            self._left.append((top, low))
            if w < m:
                rest[k] = sl.blas.dsyrk(-1.0, low, beta=1.0, c=F[w:, w:], lower=1).reshape(-1, order="F")

    def forward(self, part: tuple[int, int], right: np.ndarray) -> None:
        """Replace right sides (n, q), in the order of elimination of a part, by L^-1 times them."""
        start = self.fronts[part[0]].first
        for front, (top, low) in zip(self.fronts[slice(*part)], self._left[slice(*part)]):
            own = right[front.first - start : front.end - start]
            if not own.any():
                continue
            own[:] = sl.blas.dtrsm(1.0, top, own.T, side=1, lower=1, trans_a=1).T
            if len(front.below):
                right[front.below - start] -= low @ own

    def backward(self, y: np.ndarray) -> np.ndarray:
        """Return L^-T y of y (n) in the order of elimination, in the old order."""
        x = y.copy()
        for front, (top, low) in zip(reversed(self.fronts), reversed(self._left)):
            own = x[front.first : front.end]
            if len(front.below):
                own -= x[front.below] @ low
            own[:] = sl.blas.dtrsv(top, own, lower=1, trans=1)
        found = np.empty_like(x)
        found[self.order] = x
        return found

    def halfway(self, right: np.ndarray) -> np.ndarray:
        """Return L^-1 times a right side (n), in the order of elimination; `backward` of it is A^-1 times that."""
        y = right[self.order]
        for part in self.parts:
            self.forward(part, y[self.unknowns_of(part), None])
        return y


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


def _merge(columns: list, rows: list, parents: np.ndarray) -> tuple[list, list, np.ndarray]:
    """Merge fronts with their parents where that is faster; return those left, children before parents, part by part."""
    n, children = len(columns), [[] for _ in columns]
    cost, into = Multifrontal._cost, np.arange(len(columns))
    for k in range(n):
        mine = []
        for child in children[k]:
            w, below, more = D * len(columns[k]), D * len(rows[k]), D * len(columns[child])
            apart = cost(w, below) + cost(more, D * len(rows[child]))
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


def _build_fronts(columns: list, rows: list, parents: np.ndarray, place: np.ndarray) -> list[Front]:
    """The fronts. place: (n) of each node in the order of elimination."""
    children: list[list[int]] = [[] for _ in columns]
    for k, parent in enumerate(parents):
        if parent >= 0:
            children[parent].append(k)
    ends = np.cumsum([0, *map(len, columns)])
    below = [(D * np.sort(place[one])[:, None] + np.arange(D)).reshape(-1) for one in rows]
    found, at = [], 0
    for k, (first, end) in enumerate(zip(D * ends[:-1], D * ends[1:])):
        n, kept, into = len(below[k]), np.zeros(0, dtype=np.int64), np.zeros(0, dtype=np.int64)
        if (parent := parents[k]) >= 0:
            own = np.concatenate([np.arange(D * ends[parent], D * ends[parent + 1]), below[parent]])
            to = np.searchsorted(own, below[k])
            column, row = np.triu_indices(n)  # of the lower triangle, column by column
            kept, into = column * n + row, to[column] * len(own) + to[row]
        found.append(Front(int(first), int(end), below[k], at, tuple(children[k]), kept, into))
        at += (end - first + n) ** 2
    return found
