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
        arenas, self._of = iter(self._arenas), {}
        for serial in (True, False):
            entries = problem.NODES * CAPACITY
            self._of[False, serial] = problem.build_node_problem(next(arenas), CAPACITY, N_NODES, serial, entries)
            self._of[True, serial] = problem.build_matrix_problem(next(arenas), CAPACITY, BLOCKS, serial)

    def close(self) -> None:
        while self._arenas:
            self._arenas.pop().release()

    def nodes(self, contacts: oracle.NodeContacts, serial: bool = True) -> problem.ContactProblem:
        p, k = self._of[False, serial], len(contacts.arity)
        for name in ("normal", "tangent", "friction", "inverse_mass", "b"):
            values = getattr(contacts, name)
            problem.fill_field(getattr(p, name), values.reshape(k, 3) if name == "b" else values)
        problem.fill_rows(p, contacts.arity, *contacts.entries[1:])
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
