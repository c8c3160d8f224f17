"""Boxes and strips, their matrices, and models whose sweeps are divided."""

from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass, replace
from types import SimpleNamespace

import numpy as np
import scipy.sparse as sp
import taichi as ti

import taisoft as ts
from taisoft.backend.arrays import FieldArena
from taisoft.fem.chunks import SweepOrder
from taisoft.fem.model import Model
from taisoft.linear import block_csr
from taisoft.linear.pcg_work import build_pcg
from taisoft.stability import hooke_stiffness
from tests.dynamics.scenes import dynamics, rubber

CHUNKS = 7  # of loops
WIDE = (10, 10, 10)  # cells of a box whose matrix has a wide band


@dataclass(frozen=True, eq=False)
class Divided(Model):
    """A model whose sweeps have chunks of 2^shift nodes, which the package gives large meshes alone."""

    shift: int = 30

    @property
    def sweep(self) -> SweepOrder:
        return SweepOrder(self.shift)


def divided(model: Model, arena: FieldArena, shift: int, serial: bool) -> Divided:
    partial = arena.field(f"partial_{serial}", ti.f64, (CHUNKS, model.state.partial.shape[1]))
    state = replace(model.state, partial=partial)
    return Divided(**vars(model) | {"shift": shift, "serial": serial, "chunks": CHUNKS, "state": state})


def held_box(cells=WIDE, shuffled: bool = False) -> ts.Scene:
    """A box clamped at its left end, another of whose nodes is held along one axis. shuffled: nodes in a random order."""
    scene, mesh = ts.Scene(), ts.box_mesh(cells, (2.0, 1.0, 1.0))
    if shuffled:
        order = np.random.default_rng(8).permutation(len(mesh.vertices))
        mesh = ts.TetMesh(mesh.vertices[order], np.argsort(order)[mesh.tets])
    body = scene.add_body(mesh, rubber(), name="box")
    body.fix(lambda X: X[:, 0] < -0.99)
    body.fix([int(np.argmax(body.rest_positions.sum(axis=1)))], axes="y")
    return scene


def strip() -> ts.Scene:
    """A slender body, clamped at its left end; its right end is led for 0.11 s."""
    scene = ts.Scene()
    body = scene.add_body(ts.box_mesh((100, 1, 10), (10.0, 0.1, 1.0)), rubber(young=1e9), name="strip")
    body.fix(lambda X: X[:, 0] < -4.99)
    body.move(lambda X: X[:, 0] > 4.99, ts.KeyFrames([0.0, 0.11], [(0.0, 0.0, 0.0), (0.0, 0.055, 0.0)], release=True))
    return scene


def fill(m: Model, A: block_csr.BlockCsr, K: sp.bsr_matrix) -> None:
    """Store a matrix with the node graph's pattern, its indices sorted."""
    n, half_rows = m.n_nodes, np.diff(A.row_start.to_numpy())
    keys = np.repeat(np.arange(n), np.diff(K.indptr)) * n + K.indices
    at = np.searchsorted(keys, np.repeat(np.arange(2 * n), half_rows) % n * n + A.column.to_numpy())
    for field, blocks in ((A.value, K.data[at]), (A.diagonal, K.data[np.searchsorted(keys, np.arange(n) * (n + 1))])):
        field.from_numpy(block_csr.packed(blocks.astype(field.host.dtype)))


@contextmanager
def assembled(
    scene: ts.Scene, shift: float = 0.0, chunk_shift: int | None = None, serial: bool = True
) -> Iterator[SimpleNamespace]:
    """The stiffness of a scene at rest plus shift [N/m], on the device and, the identity on constrained axes, on the host."""
    with dynamics(scene, dt=1 / 60, precision="f64", integrator="implicit_euler") as made:
        arena = FieldArena()
        m = made.model if chunk_shift is None else divided(made.model, arena, chunk_shift, serial)
        A, w = block_csr.build_block_csr(m, arena), build_pcg(m, arena)
        K = (hooke_stiffness(scene.bodies[0]) + shift * sp.identity(3 * m.n_nodes)).tobsr((3, 3))
        K.sort_indices()
        fill(m, A, K)
        free = m.free.to_numpy() > 0.0
        f = sp.diags(1.0 * free.reshape(-1))
        matrix = (f @ K @ f + sp.identity(free.size) - f).tobsr((3, 3))
        matrix.sort_indices()
        w.rhs.from_numpy(np.random.default_rng(7).standard_normal(free.shape).astype(made.runtime.np_real))
        yield SimpleNamespace(model=m, A=A, work=w, matrix=matrix, free=free, x=made.state.layout.rest)
        arena.release()


def error(found: SimpleNamespace) -> float:
    """Largest residual of the solution in `work` on free axes, over the largest right-hand side; it is 0 on the others."""
    y, rhs = (part.to_numpy().astype(np.float64) for part in (found.work.y, found.work.rhs))
    assert np.isfinite(y).all() and not y[~found.free].any()
    residual = found.matrix @ y.reshape(-1) - (found.free * rhs).reshape(-1)
    return float(np.abs(residual).max() / np.abs(rhs).max())
