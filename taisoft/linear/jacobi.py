"""Block Jacobi, a preconditioner of `pcg`: inverses of the diagonal blocks, or of what replaces indefinite ones.

It takes any number of threads, coupling terms and borders, but two to three times the iterations of `gauss_seidel`.
"""

from dataclasses import dataclass

import taichi as ti

from taisoft.fem.chunks import chunk_entry, chunk_size
from taisoft.fem.state import OTHER_SUM
from taisoft.linear import pcg_work
from taisoft.linear.block_csr import block_times
from taisoft.linear.pcg_work import RUNNING, STATUS, dot64


@dataclass(frozen=True, eq=False)
class Jacobi:
    """See `pcg.Preconditioner`. It prepares itself."""

    @ti.func
    def prepare(self, model: ti.template(), A: ti.template(), terms: ti.template(), work: ti.template(), i, same_matrix):
        """Set diagonal and inverse of node i."""
        pcg_work.precondition(model, A, terms, work, i, same_matrix)

    @ti.func
    def apply(self, model: ti.template(), work: ti.template()):
        """z = B r."""
        ti.loop_config(serialize=model.serial)
        for task in range(model.chunks * model.spread):
            if task % model.spread == 0 and work.state[STATUS] == RUNNING:
                c, n, s = task // model.spread, model.n_nodes, ti.cast(0.0, ti.f64)
                for at in range(chunk_size(model, c, n)):
                    s += self.apply_at(work, chunk_entry(model, c, at, n))
                model.state.partial[c, OTHER_SUM] = s

    @ti.func
    def apply_at(self, work: ti.template(), i):
        """Set z of node i; return its r.z."""
        r = work.r[i]
        z = block_times(work.inverse[i], r)
        work.z[i] = z
        return dot64(r, z)


JACOBI = Jacobi()
