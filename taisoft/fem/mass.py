"""Nodal masses of a scene: lumped for explicit steps; for implicit steps consistent in quadratic bodies.

Lumping hardly shifts the frequencies of quadratic tets but distributes their weight wrongly (it is not int rho N_a g dV).
Implicit steps solve linear systems anyway, so they use the consistent matrix there. Linear bodies stay lumped: in a scene with
a quadratic body their rows have zeros off the diagonal.
"""

from dataclasses import dataclass
from typing import Any

import numpy as np
import scipy.sparse as sp
import taichi as ti

from taisoft.backend.arrays import download, upload
from taisoft.fem import reference
from taisoft.scene.scene import Scene


@dataclass(frozen=True, eq=False)
class MassMatrix:
    """Symmetric mass matrix [kg] with the stiffness pattern and one number per node pair, the same for each axis."""

    row_start: Any  # (n_nodes + 1) i32
    column: Any  # (2 n_pairs) i32, ascending in each row, no diagonal
    value: Any  # (2 n_pairs)
    diagonal: Any  # (n_nodes)


def lumped_masses(scene: Scene) -> np.ndarray:
    """Lumped masses (n_nodes,) [kg], bodies in order."""
    return np.concatenate([reference.lumped_mass(b) for b in scene.bodies])


def gravity_masses(scene: Scene) -> np.ndarray:
    """Masses used for weight, int rho N_a dV, (n_nodes,) [kg]."""
    return np.concatenate([reference.gravity_mass(b) for b in scene.bodies])


def mass_matrix(scene: Scene) -> sp.csr_matrix:
    """Mass matrix of implicit steps (n_nodes, n_nodes) [kg]: consistent for bodies of order 2, else lumped."""
    parts = [reference.consistent_mass(b) if b.order == 2 else sp.diags(reference.lumped_mass(b)) for b in scene.bodies]
    return sp.block_diag(parts, format="csr")


def upload_mass_matrix(scene: Scene, mass: MassMatrix) -> None:
    """Fill the device matrix from the bodies' densities."""
    M = mass_matrix(scene)
    start, column = download([mass.row_start, mass.column])
    rows = np.repeat(np.arange(len(start) - 1), np.diff(start))
    upload([(mass.value, np.asarray(M[rows, column]).reshape(-1)), (mass.diagonal, M.diagonal())])


@ti.func
def mass_times(m: ti.template(), i, u: ti.template()):
    """(M u)_i in f64, u a field of nodal 3-vectors."""
    s = ti.Vector([0.0, 0.0, 0.0], ti.f64)
    if ti.static(m.consistent):
        s = ti.cast(m.mass_matrix.diagonal[i], ti.f64) * ti.cast(u[i], ti.f64)
        for k in range(m.mass_matrix.row_start[i], m.mass_matrix.row_start[i + 1]):
            s += ti.cast(m.mass_matrix.value[k], ti.f64) * ti.cast(u[m.mass_matrix.column[k]], ti.f64)
    else:
        s = ti.cast(m.mass[i], ti.f64) * ti.cast(u[i], ti.f64)
    return s
