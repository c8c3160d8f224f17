"""Nearly incompressible bodies with mean dilatation: a preconditioner of `pcg` that holds volumes, and steps that keep them.

The system is A = B + G^T C G, with a row of G for each patch's gradient and C = diag(beta^2 k) (`patch_terms`). With D, the 3x3
diagonal blocks of B, the preconditioner is the inverse of D + G^T C G, by Woodbury's formula
    D^-1 - D^-1 G^T S^-1 G D^-1,   S = C^-1 + G D^-1 G^T.
The eigenvalues of A relative to it lie between 1 and those of B relative to D: however large lambda is, the iterations are at
most those of block Jacobi without the volume terms. S has a row for each patch and couples patches that share a node, like a
matrix of pressures; it has a banded Cholesky factor.
Weakness: the band, so bodies thick in all directions are left to `gauss_seidel`, as are contacts; on CUDA to `Jacobi`.
"""

from dataclasses import dataclass
from typing import Any

import numpy as np
import scipy.sparse as sp
import taichi as ti
from scipy.sparse.csgraph import reverse_cuthill_mckee

from taisoft.backend.arrays import Count, FieldArena, download
from taisoft.backend.runtime import kernel
from taisoft.fem.mean_dilatation import find_dilatations
from taisoft.fem.model import Model
from taisoft.linear.banded import Band, factorise, solve_banded
from taisoft.linear.block_csr import BlockCsr, block_times, definite_inverse
from taisoft.linear.patch_terms import patch_stiffness
from taisoft.linear.pcg_work import dot64, sum_products

STIFF = 10.0  # lambda over mu above which the preconditioner is worth its cost
LARGEST_WORK = 100_000_000  # operations of a factorisation


@dataclass(frozen=True, eq=False)
class VolumeSystem:
    """S and its right-hand side, patches in their own order or that of reverse Cuthill-McKee, whichever has the narrower band.

    A `pcg.Preconditioner`, after `prepare_volumes`.
    """

    n_patches: Count
    band: Band  # S, then its factor
    place: Any  # (n_patches) i32: row of each patch
    node_start: Any  # (n_nodes + 1) i32: rows of row and column
    row: Any  # i32: row of S of each patch of each node
    column: Any  # 3-vectors: D^-1 G^T for that node and patch
    target: Any  # (n_patches) f64: dilatation of each patch that a correction leads to
    rhs: Any  # (n_patches) f64: right-hand side, then the solution

    @ti.func
    def prepare(self, model: ti.template(), A: ti.template(), terms: ti.template(), work: ti.template(), i, same_matrix):
        """Nothing."""

    @ti.func
    def apply(self, model: ti.template(), work: ti.template()):
        """z = (D + G^T C G)^-1 r."""
        ti.loop_config(serialize=True)
        for _ in range(1):
            for p in range(self.n_patches):
                self.rhs[p] = 0.0
            for i in range(model.n_nodes):
                r = work.r[i]
                for n in range(self.node_start[i], self.node_start[i + 1]):
                    self.rhs[self.row[n]] = self.rhs[self.row[n]] + ti.cast(self.column[n].dot(r), ti.f64)
            solve_banded(self.band, self.rhs)
            for i in range(model.n_nodes):
                z = block_times(work.inverse[i], work.r[i])
                for n in range(self.node_start[i], self.node_start[i + 1]):
                    z -= ti.cast(self.rhs[self.row[n]], model.real) * self.column[n]
                work.z[i] = z
        sum_products(model, work)


def is_nearly_incompressible(model: Model) -> bool:
    """Whether some patch has lambda above STIFF mu, and none a lambda of 0 or below."""
    modulus, constants, body, start, tet = download(
        [model.mean.modulus, model.law_constants, model.block_body, model.mean.tet_start, model.mean.tet]
    )
    first = tet[start[:-1]]
    mu = (
        constants[first // model.lanes, 0, first % model.lanes]
        if model.elasticity_by_tet
        else constants[body[first // model.lanes], 0]
    )
    return bool((modulus > STIFF * mu).any() and (modulus > 0.0).all())


def build_volume_system(model: Model, A: BlockCsr, arena: FieldArena) -> VolumeSystem | None:
    """Allocate S; None if its band is too wide."""
    n, (patch, start, entry) = model.mean.n_patches, download([A.patches.patch, A.patches.node_start, A.patches.entry])
    of_node = sp.csr_matrix((np.ones(len(entry), dtype=np.int32), patch[entry], start), shape=(model.n_nodes, n))
    graph = (of_node.T @ of_node).tocoo()
    place, other = np.arange(n, dtype=np.int32), np.empty(n, dtype=np.int32)  # as numbered, which suits meshes made by rows
    other[reverse_cuthill_mckee(graph.tocsr(), symmetric_mode=True)] = np.arange(n)
    width, other_width = (int(np.abs(p[graph.row] - p[graph.col]).max()) + 1 for p in (place, other))
    if other_width < width:
        place, width = other, other_width
    if n * width * width > LARGEST_WORK:
        return None
    return VolumeSystem(
        n_patches=n,
        band=Band(n, width, arena.field("volume_factor", ti.f64, n * width)),
        place=arena.field("volume_place", ti.i32, n, place),
        node_start=A.patches.node_start,
        row=arena.field("volume_row", ti.i32, len(entry), place[patch[entry]]),
        column=arena.vectors("volume_column", model.real, len(entry)),
        target=arena.field("volume_target", ti.f64, n),
        rhs=arena.field("volume_rhs", ti.f64, n),
    )


@kernel
def prepare_volumes(model: ti.template(), A: ti.template(), work: ti.template(), volumes: ti.template(), beta2: ti.f64):
    """Compute D^-1, as work.inverse, and the factor of S, serially. beta2: the square of the beta with which A was formed."""
    t, mean = ti.static((A.patches, model.mean))
    ti.loop_config(serialize=True)
    for _ in range(1):
        for k in range(volumes.n_patches * volumes.band.width):
            volumes.band.factor[k] = 0.0
        for p in range(mean.n_patches):
            volumes.band.factor[volumes.place[p] * volumes.band.width] = 1.0 / (beta2 * patch_stiffness(model, p))
        for i in range(model.n_nodes):
            first, last = t.node_start[i], t.node_start[i + 1]
            D = A.diagonal[i]
            for n in range(first, last):
                g, k = t.gradient[t.entry[n]], ti.cast(beta2 * patch_stiffness(model, t.patch[t.entry[n]]), model.real)
                for r in ti.static(range(3)):
                    for c in ti.static(range(3)):
                        D[4 * c + r] -= k * g[r] * g[c]
            inverse, _P = definite_inverse(model, D, model.free[i])
            work.inverse[i] = inverse
            for n in range(first, last):
                h = block_times(inverse, t.gradient[t.entry[n]])
                volumes.column[n] = h
                for other in range(first, last):
                    below = volumes.row[other] - volumes.row[n]
                    if below >= 0:
                        at = volumes.row[n] * volumes.band.width + below
                        volumes.band.factor[at] = volumes.band.factor[at] + dot64(t.gradient[t.entry[other]], h)
        factorise(volumes.band)


@kernel
def save_volumes(model: ti.template(), volumes: ti.template()):
    """Save the dilatations at x for `restore_volumes`."""
    find_dilatations(model)
    ti.loop_config(serialize=model.serial)
    for p in range(volumes.n_patches):
        volumes.target[p] = model.mean.dilatation[p]


@ti.func
def correct_volumes(model: ti.template(), volumes: ti.template(), x_hat: ti.template(), beta):
    """Correct x, and v = (x - x_hat) / beta, to first order towards the target dilatations, by the smallest change in D, as
    top-level loops of a kernel."""
    find_dilatations(model)
    ti.loop_config(serialize=True)
    for _ in range(1):
        for p in range(volumes.n_patches):
            volumes.rhs[volumes.place[p]] = model.mean.volume[p] * (model.mean.dilatation[p] - volumes.target[p])
        solve_banded(volumes.band, volumes.rhs)
        for i in range(model.n_nodes):
            change = ti.Vector([0.0, 0.0, 0.0], ti.f64)
            for n in range(volumes.node_start[i], volumes.node_start[i + 1]):
                change += volumes.rhs[volumes.row[n]] * ti.cast(volumes.column[n], ti.f64)
            x = model.state.x[i] - change
            model.state.x[i] = x
            model.state.v[i] = (x - x_hat[i]) / beta


@kernel
def restore_volumes(model: ti.template(), volumes: ti.template(), x_hat: ti.template(), beta: ti.f64):
    """Correct x and v towards the saved dilatations, see `correct_volumes`."""
    correct_volumes(model, volumes, x_hat, beta)


@kernel
def step_with_volumes(
    model: ti.template(),
    A: ti.template(),
    volumes: ti.template(),
    base: ti.template(),
    y: ti.template(),
    x_hat: ti.template(),
    beta: ti.f64,
):
    """Set base = x, take the step beta y, and correct it towards the dilatations that it leads to in first order.

    model.mean.dilatation: those at x.
    """
    ti.loop_config(serialize=True)
    for _ in range(1):
        for p in range(volumes.n_patches):
            volumes.rhs[p] = 0.0
        for i in range(model.n_nodes):
            step, x = y[i], model.state.x[i]
            for n in range(volumes.node_start[i], volumes.node_start[i + 1]):
                volumes.rhs[volumes.row[n]] = volumes.rhs[volumes.row[n]] + dot64(A.patches.gradient[A.patches.entry[n]], step)
            base[i] = x
            model.state.x[i] = x + beta * ti.cast(step, ti.f64)
        for p in range(volumes.n_patches):
            volumes.target[p] = model.mean.dilatation[p] + beta * volumes.rhs[volumes.place[p]] / model.mean.volume[p]
    correct_volumes(model, volumes, x_hat, beta)
