"""Contact problems in fields, one of each form and kind of loop, that tests fill again and again."""

import numpy as np

from taisoft.backend.arrays import FieldArena
from taisoft.contact import problem
from tests.contact import contact_oracle as oracle

CAPACITY, N_NODES, BLOCKS = 700, 40, 4096


class Rig:
    """One problem of each form, on one thread and on all."""

    def __init__(self):
        self._arenas = [FieldArena() for _ in range(4)]
        forms = {False: (problem.build_node_problem, N_NODES), True: (problem.build_matrix_problem, BLOCKS)}
        kinds = [(matrix, serial) for matrix in forms for serial in (True, False)]
        self._of = {(m, s): forms[m][0](arena, CAPACITY, forms[m][1], s) for arena, (m, s) in zip(self._arenas, kinds)}

    def close(self) -> None:
        while self._arenas:
            self._arenas.pop().release()

    def nodes(self, contacts: oracle.NodeContacts, serial: bool = True) -> problem.ContactProblem:
        p, k = self._of[False, serial], len(contacts.arity)
        for name in ("node", "arity", "weight", "normal", "tangent", "friction", "inverse_mass", "b"):
            values = getattr(contacts, name)
            problem.fill_field(getattr(p, name), values.reshape(k, 3) if name == "b" else values)
        p.count[0] = k
        p.r.fill(0.0)
        problem.fill_field(p.sweep.order, np.arange(k))
        problem.index_nodes(p)
        problem.find_factors(p)
        return p

    def matrix(self, W, b: np.ndarray, mu: np.ndarray, serial: bool = True) -> problem.ContactProblem:
        p = self._of[True, serial]
        p.r.fill(0.0)
        problem.fill_matrix_problem(p, W, b, mu)
        return p


def impulses(p: problem.ContactProblem) -> np.ndarray:
    return p.r.to_numpy()[: p.count[0]]
