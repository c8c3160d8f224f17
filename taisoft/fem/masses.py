"""Masses of the nodes on the device: lumped, used for weight, and the consistent matrix; see `reference`."""

from dataclasses import dataclass
from typing import Any

import numpy as np
import taichi as ti

from taisoft.backend.arrays import download, upload
from taisoft.fem import reference
from taisoft.fem.dependent_table import DependentTable
from taisoft.fem.model import Setup
from taisoft.fem.node_graph import NodeGraph
from taisoft.ranges import owners
from taisoft.scene.scene import Scene


@dataclass(frozen=True, eq=False)
class MassMatrix:
    """Symmetric mass matrix [kg] with the stiffness pattern and one number per node pair, the same for each axis."""

    row_start: Any  # (2 n_nodes + 1) i32: half-rows as in `node_graph.NodeGraph`
    column: Any  # (2 n_pairs) i32
    value: Any  # (2 n_pairs)
    diagonal: Any  # (n_nodes)


def model_fields(setup: Setup) -> dict[str, Any]:
    """Fields of Model: lumped masses, and masses used for weight where they differ."""
    known, arena, real = (setup.scene, setup.layout.dependents), setup.arena, setup.runtime.real
    weight = mass = arena.filled("mass", real, reference.lumped_masses(*known))
    if setup.on["consistent_weight"]:
        weight = arena.filled("gravity_mass", real, reference.gravity_masses(*known))
    return {"mass": mass, "gravity_mass": weight}


def matrix_fields(setup: Setup, graph: NodeGraph) -> dict[str, Any]:
    """Fields of Model: the consistent mass matrix. graph: of the stiffness matrix."""
    arena, real = setup.arena, setup.runtime.real
    matrix = MassMatrix(
        row_start=arena.filled("mass_row_start", ti.i32, graph.row_start),
        column=arena.filled("mass_column", ti.i32, graph.column),
        value=arena.field("mass_value", real, len(graph.column)),
        diagonal=arena.field("mass_diagonal", real, len(setup.layout.rest)),
    )
    upload_mass_matrix(setup.scene, setup.layout.dependents, matrix)
    return {"consistent": True, "mass_matrix": matrix}


def upload_mass_matrix(scene: Scene, dependents: DependentTable | None, mass: MassMatrix) -> None:
    """Fill the device matrix from the bodies' densities."""
    M = reference.mass_matrix(scene, dependents)
    start, column = download([mass.row_start, mass.column])
    rows = owners(np.diff(start)) % (len(start) // 2)
    upload([(mass.value, np.asarray(M[rows, column]).reshape(-1)), (mass.diagonal, M.diagonal())])
