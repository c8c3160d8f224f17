"""Contact problems in fields, one of each form and kind of loop, that tests fill again and again."""

import numpy as np

from taisoft.backend.arrays import FieldArena
from taisoft.backend.runtime import open_runtime
from taisoft.contact import problem
from tests.contact import contact_oracle as oracle

CAPACITY, N_NODES, BLOCKS = 300, 40, 4096


class Rig:
    """One problem of each form, on one thread and on all, in one runtime."""

    def __init__(self):
        self.runtime = open_runtime("cpu", "f64")
        self.arena, self._made = [], {}

    def close(self) -> None:
        for arena in self.arena:
            arena.release()
        self.arena = []
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
            problem.fill_field(getattr(p, name), values.reshape(k, 3) if name == "b" else values)
        p.count[0] = k
        p.r.fill(0.0)
        problem.fill_field(p.order, np.arange(k))
        problem.index_nodes(p)
        problem.find_factors(p)
        return p

    def matrix(self, W, b: np.ndarray, mu: np.ndarray, serial: bool = True) -> problem.ContactProblem:
        p = self._of(True, serial)
        p.r.fill(0.0)
        problem.fill_matrix_problem(p, W, b, mu)
        return p


def impulses(p: problem.ContactProblem) -> np.ndarray:
    return p.r.to_numpy()[: p.count[0]]
