"""Kernels and helpers that evaluate the springs of a `Rig` alone."""

import numpy as np
import taichi as ti

from taisoft.backend.runtime import kernel
from taisoft.fem.terms import springs
from taisoft.fem.terms.elasticity import elastic_forces, prepare_terms
from taisoft.linear import block_csr


@kernel
def spring_forces(m: ti.template(), out: ti.template()):
    """The force of all elements on every node."""
    ti.loop_config(serialize=True)
    for i in range(m.n_nodes):
        out[i] = springs.force(m, i)


def kernel_forces(rig, x, v, model=None) -> np.ndarray:
    model = model or rig.model
    model.state.x.from_numpy(x)
    model.state.v.from_numpy(v.astype(np.float32 if rig.eps > 1e-10 else np.float64))
    elastic_forces(model)
    spring_forces(model, rig.out)
    return rig.out.to_numpy().astype(np.float64)


def assembled(rig, x, beta: float, projected: bool) -> np.ndarray:
    """What the connections add to the matrix of an implicit step, dense."""
    m, A = rig.model, rig.matrix
    m.state.x.from_numpy(x)
    A.value.fill(0.0)
    A.diagonal.fill(0.0)
    add_stiffness(m, A, beta, int(projected))
    return block_csr.to_scipy(m, A).toarray()


@kernel
def add_stiffness(m: ti.template(), A: ti.template(), beta: ti.f64, projected: ti.i32):
    """The springs' part of `to_system`."""
    prepare_terms(m)
    ti.loop_config(serialize=True)
    for i in range(m.n_nodes):
        springs.add_stiffness(m, A, i, beta, projected)
