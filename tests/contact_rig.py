"""Contact problems in fields, one of each form and kind of loop, that tests fill again and again."""

import contact_oracle as oracle
import numpy as np
import scipy.sparse as sp

from taisoft.contact import problem
from taisoft.runtime import FieldArena, open_runtime

CAPACITY, N_NODES, BLOCKS = 300, 40, 4096


class Rig:
    """One problem of each form, on one thread and on all, in one runtime."""

    def __init__(self):
        self.runtime = open_runtime("cpu", "f32")  # contacts are f64 there too
        self.arena, self._made = [], {}

    def close(self) -> None:
        for arena in self.arena:
            arena.release()
        self.runtime.close()

    def _of(self, matrix: bool, serial: bool) -> problem.ContactProblem:
        if (matrix, serial) not in self._made:
            self.arena.append(FieldArena())
            build = problem.build_matrix_problem if matrix else problem.build_node_problem
            self._made[matrix, serial] = build(self.arena[-1], CAPACITY, BLOCKS if matrix else N_NODES, serial)
        return self._made[matrix, serial]

    def nodes(self, contacts: oracle.NodeContacts, serial: bool = True) -> problem.ContactProblem:
        p, k = self._of(False, serial), len(contacts.arity)
        for name in ("node", "arity", "weight", "normal", "tangent", "friction", "inverse_mass", "b"):
            values = getattr(contacts, name)
            _fill(getattr(p, name), values.reshape(k, 3) if name == "b" else values)
        self._ready(p, k)
        problem.index_nodes(p)
        problem.find_factors(p)
        return p

    def matrix(self, W, b: np.ndarray, mu: np.ndarray, serial: bool = True) -> problem.ContactProblem:
        p, k = self._of(True, serial), len(mu)
        blocks = sp.csr_matrix(W).tobsr((3, 3))
        blocks.sort_indices()
        for field, values in (
            (p.row_start, blocks.indptr), (p.column, blocks.indices), (p.block, blocks.data.reshape(-1, 9)),
            (p.b, b.reshape(k, 3)), (p.friction, mu),
        ):  # fmt: skip
            _fill(field, values)
        self._ready(p, k)
        problem.find_factors(p)
        return p

    def _ready(self, p: problem.ContactProblem, k: int) -> None:
        p.count[0] = k
        p.r.fill(0.0)
        _fill(p.order, np.arange(k))


def _fill(field, values: np.ndarray) -> None:
    whole = np.zeros((field.shape[0], *values.shape[1:]), np.float64 if values.dtype.kind == "f" else np.int32)
    whole[: len(values)] = values
    field.from_numpy(whole)


def impulses(p: problem.ContactProblem) -> np.ndarray:
    return p.r.to_numpy()[: p.count[0]]
