"""Follower pressure as sparse trilinear forms of the nodes, in NumPy.

The force of a pressure p on node i of a surface x(s, t), s and t along two edges of its triangle, is
    f_i = -p int N_i x_s cross x_t ds dt = -p sum_(b<c) w_ibc (x_b - x_i) cross (x_c - x_i),
    w_ibc = int N_i (N_b,s N_c,t - N_c,s N_b,t) ds dt,
with the shape functions of the flat triangle, or of the curved one with six nodes. The integrals are exact. On a closed surface
f = -p dV/dx, V the enclosed volume, and -df/dx is symmetric. In general its symmetric part has the blocks
    S_ij = p sum_c u_ijc [x_c - x_i]x,   u_ijc = -(w_ijc - w_jic) / 2,
with [a]x b = a cross b, and S_ii = 0. Terms of neighbouring triangles are added here, and those that cancel are dropped.
Source: Bonet, Wood, Nonlinear Continuum Mechanics for Finite Element Analysis, 2nd ed. 2008, sections 8.5.2 and 9.5.2.
"""

from dataclasses import dataclass
from functools import cache
from typing import Any

import numpy as np
import taichi as ti

from taisoft.fem.dependent_table import DependentTable
from taisoft.fem.model import Setup
from taisoft.fem.node_graph import NodeGraph
from taisoft.mesh.quadratic import triangle_rule
from taisoft.ranges import entries_of
from taisoft.scene.body import Body
from taisoft.scene.loads import Cavity, Pressure
from taisoft.scene.scene import Scene

CANCELLED = 1e-12  # weights below it are rounding; others are above 1e-3


@dataclass(frozen=True, eq=False)
class PressureTable:
    """Terms of the forces and of the stiffness of all pressures, by node."""

    force_start: Any  # (n_nodes + 1) i32: first force term of each node
    force_nodes: Any  # 3-vectors i32: b, c, and the index of p in Model.amplitudes
    force_weight: Any  # f64: w_ibc
    stiffness_start: Any  # (n_nodes + 1) i32: by row of the matrix; None in explicit steps, as the next two
    stiffness_nodes: Any  # 4-vectors i32: entry of the matrix, -1 on the diagonal, c, the index of p, and i
    stiffness_weight: Any  # f64: u_ijc, times the weights of the independent nodes of row and column in i and j
    has_potential: Any  # i32, of each pressure: 1 if energies count its work
    is_prepared: bool  # forces are computed before any node moves: in explicit steps
    force: Any  # (n_nodes) 3-vectors f64 [N]: scratch of explicit steps, else None


def pressures_of(scene: Scene) -> list[tuple[int, Pressure | Cavity]]:
    """All pressures and cavities of a scene, each with the number of its body, in the order of Model.amplitudes."""
    return [(k, load) for k, body in enumerate(scene.bodies) for load in body.loads if isinstance(load, (Pressure, Cavity))]


@cache
def triangle_weights(order: int) -> np.ndarray:
    """w (n, n, n) of a triangle with n = 3 or 6 nodes, those between the corners 0 and 1, 1 and 2, 2 and 0 last."""
    weights, value, slope = triangle_rule(order)
    product = np.einsum("q,iq,bq,cq->ibc", weights, value, slope[:, 0], slope[:, 1])
    return product - product.transpose(0, 2, 1)


def force_terms(nodes: np.ndarray, w: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Nodes (i, b, c), b < c, of the force terms of triangles (k, n), and their weights w_ibc."""
    i, b, c = np.nonzero(np.abs(w) > CANCELLED)
    others = (i != b) & (i != c) & (b < c)
    i, b, c = i[others], b[others], c[others]
    ids = np.stack([nodes[:, i], nodes[:, b], nodes[:, c]], axis=2).reshape(-1, 3)
    weights = np.tile(w[i, b, c], len(nodes))
    swapped = ids[:, 1] > ids[:, 2]
    return np.where(swapped[:, None], ids[:, [0, 2, 1]], ids), np.where(swapped, -weights, weights)


def stiffness_terms(nodes: np.ndarray, w: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Nodes (i, j, c), c other than i, of the stiffness terms of triangles (k, n), and their weights u_ijc."""
    u = -0.5 * (w - w.transpose(1, 0, 2))
    i, j, c = np.nonzero(np.abs(u) > CANCELLED)
    others = (i != j) & (i != c)
    i, j, c = i[others], j[others], c[others]
    return np.stack([nodes[:, i], nodes[:, j], nodes[:, c]], axis=2).reshape(-1, 3), np.tile(u[i, j, c], len(nodes))


def merged(ids: np.ndarray, weights: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Rows of ids (k, m) in ascending order without repetitions, and the sums of their weights; sums that cancel are dropped."""
    rows, place = np.unique(ids, axis=0, return_inverse=True)
    sums = np.bincount(place.reshape(-1), weights, len(rows))
    kept = np.abs(sums) > CANCELLED
    return rows[kept], sums[kept]


class CavityForm:
    """The volume of a cavity as a function of all nodes' positions."""

    def __init__(self, body: Body, cavity: Cavity, first_node: int):
        rows, self._weights = merged(*force_terms(body.face_nodes(cavity.triangles), triangle_weights(body.order)))
        self.nodes, place = np.unique(rows, return_inverse=True)
        self._rows = place.reshape(-1, 3)
        self.nodes = self.nodes + first_node

    def set_amplitudes(self, amplitudes: np.ndarray) -> None:
        """Do nothing: the volume depends on nodes alone."""

    def value_and_gradient(self, x: np.ndarray) -> tuple[float, np.ndarray]:
        """V [m^3], and dV/dx (k, 3) [m^2] at its nodes. x: (n_nodes, 3) [m] of the scene."""
        own = x[self.nodes] - x[self.nodes[0]]
        i, b, c = (own[rows] for rows in self._rows.T)
        parts = -self._weights[:, None] * np.cross(b - i, c - i)
        gradient = np.stack([np.bincount(self._rows[:, 0], parts[:, a], len(own)) for a in range(3)], axis=1)
        return float((own * gradient).sum()) / 3.0, gradient


def cavity_form(scene: Scene, name: str) -> CavityForm:
    """The form of the cavity with this name. Raises SceneError if there is none."""
    body, cavity = scene.cavity(name)
    return CavityForm(body, cavity, scene.first_nodes[body.name])


def all_terms(scene: Scene, node_start: np.ndarray, terms) -> tuple[np.ndarray, np.ndarray]:
    """Rows (i, b, c, index of p) of all pressures of a scene, ascending, and their weights. terms: one of the functions above."""
    ids, weights = [np.zeros((0, 4), dtype=np.int64)], [np.zeros(0)]
    for n, (k, pressure) in enumerate(pressures_of(scene)):
        body = scene.bodies[k]
        nodes = node_start[k] + body.face_nodes(pressure.triangles)
        own, w = merged(*terms(nodes, triangle_weights(body.order)))
        ids.append(np.column_stack([own, np.full(len(own), n)]))
        weights.append(w)
    rows, w = np.concatenate(ids), np.concatenate(weights)
    order = np.argsort(rows[:, 0], kind="stable")
    return rows[order], w[order]


def independent_rows(rows: np.ndarray, weights: np.ndarray, dependents: DependentTable) -> tuple[np.ndarray, np.ndarray]:
    """Replace i and j in rows (k,5) of (i, j, c, index of p, i) by the nodes that they depend on, and weight by their weights."""
    T = dependents.matrix
    for side in (0, 1):
        counts = np.diff(T.indptr)[rows[:, side]]
        entries = entries_of(T.indptr, rows[:, side])
        rows, weights = np.repeat(rows, counts, axis=0), np.repeat(weights, counts) * T.data[entries]
        rows[:, side] = T.indices[entries]
    order = np.argsort(rows[:, 0], kind="stable")
    return rows[order], weights[order]


def matrix_fields(setup: Setup, graph: NodeGraph | None) -> dict[str, Any]:
    """Fields of Model: all pressures. graph: of the matrix, None in explicit steps."""
    scene, arena, n_nodes, dependents = setup.scene, setup.arena, len(setup.layout.rest), setup.layout.dependents

    def table(name: str, rows: np.ndarray, weights: np.ndarray) -> dict:
        start = np.concatenate([[0], np.cumsum(np.bincount(rows[:, 0], minlength=n_nodes))])
        width = rows.shape[1] - 1
        return {
            f"{name}_start": arena.filled(f"pressure_{name}_start", ti.i32, start),
            f"{name}_nodes": arena.vectors(f"pressure_{name}_nodes", ti.i32, len(rows), rows[:, 1:], n=width),
            f"{name}_weight": arena.filled(f"pressure_{name}_weight", ti.f64, weights),
        }

    arrays = table("force", *all_terms(scene, setup.layout.node_start, force_terms))
    if graph is None:
        arrays |= dict.fromkeys(("stiffness_start", "stiffness_nodes", "stiffness_weight"))
    else:
        rows, weights = all_terms(scene, setup.layout.node_start, stiffness_terms)
        rows = np.column_stack([rows, rows[:, 0]])
        if dependents is not None:
            rows, weights = independent_rows(rows, weights, dependents)
        rows[:, 1] = np.where(rows[:, 0] == rows[:, 1], -1, graph.entries(rows[:, 0], rows[:, 1]))
        arrays |= table("stiffness", rows, weights)
    closed = np.array([pressure.has_potential for _, pressure in pressures_of(scene)])
    arrays["has_potential"] = arena.filled("pressure_has_potential", ti.i32, closed)
    arrays["force"] = arena.vectors("pressure_force", ti.f64, n_nodes) if graph is None else None
    return {"pressure": PressureTable(**arrays, is_prepared=graph is None)}
