"""Second derivative of mean dilatation: k g g^T for each patch, with k = lambda_p / V_p and the gradient g of V_p theta_p.

The derivative of the stress under fixed pressures is in the element blocks. Here each tet writes its nodal gradients to the
buffer of element blocks, before these, each node of a patch gathers its own, and each node pair adds k g_i g_j^T of its patches.
"""

from dataclasses import dataclass
from typing import Any

import numpy as np
import taichi as ti

from taisoft.backend.arrays import Count, FieldArena
from taisoft.fem.lanes import (
    add_forces,
    broadcast,
    deformation_gradient,
    position_differences,
    rest_gradients,
    rest_gradients_of_F,
    store_lanes,
    volumes,
    zero_forces,
)
from taisoft.fem.mean_dilatation import find_dilatations
from taisoft.fem.model import Model
from taisoft.fem.pattern import MATRIX_BLOCKS, group_nodes, patch_nodes, patch_pairs


@dataclass(frozen=True, eq=False)
class PatchTerms:
    """Gradients by patch and node: an entry for each node of each patch, in ascending order."""

    n_entries: Count
    patch: Any  # (n_entries) i32
    gradient: Any  # (n_entries) 3-vectors [m^2]
    gather_start: Any  # (n_entries + 1) i32: rows of gather
    gather: Any  # i32: index into the buffer of element blocks, lanes times the first number plus the lane
    pair_start: Any  # (n_edges + 1) i32: rows of first and second
    first: Any  # i32: entry of node i in a patch of both nodes of the edge i < j
    second: Any  # i32: entry of node j
    node_start: Any  # (n_nodes + 1) i32: rows of entry
    entry: Any  # i32: entries of each node, ascending


def build_patch_terms(model: Model, arena: FieldArena, prefix: str, edge_of_pair: np.ndarray, n_edges: int) -> PatchTerms:
    """Build the tables. edge_of_pair: the edge of each of `patch_pairs`."""
    patch, node = patch_nodes(model)
    first, second = patch_pairs(patch)
    key, lanes, of_lane = patch * model.n_nodes + node, model.lanes, model.mean.patch.to_numpy().reshape(-1).astype(np.int64)
    entries, places = [], []
    for g, lane, own in group_nodes(model):
        if g.mean_dilatation:
            entries.append(np.searchsorted(key, of_lane[g.first * lanes + lane][:, None] * model.n_nodes + own).reshape(-1))
            base = g.matrix_at + (lane // lanes)[:, None] * (MATRIX_BLOCKS[g.order] * 9) + 3 * np.arange(g.n_nodes)
            places.append((base * lanes + (lane % lanes)[:, None]).reshape(-1))
    entry, place = np.concatenate(entries), np.concatenate(places)

    def rows(name: str, of: np.ndarray, n: int, *columns: tuple[str, np.ndarray]) -> dict[str, Any]:
        """Tables by rows 0 to n - 1: the start of each row, and columns, whose items belong to the rows `of`."""
        order = np.argsort(of, kind="stable")
        start = np.concatenate([[0], np.cumsum(np.bincount(of, minlength=n))])
        return {
            field: arena.field(f"{prefix}_patch_{field}", ti.i32, len(data), data.astype(np.int32))
            for field, data in ((name, start), *((column, values[order]) for column, values in columns))
        }

    return PatchTerms(
        n_entries=len(key),
        patch=arena.field(f"{prefix}_patch", ti.i32, len(key), patch.astype(np.int32)),
        gradient=arena.vectors(f"{prefix}_patch_gradient", model.real, len(key)),
        **rows("gather_start", entry, len(key), ("gather", place)),
        **rows("pair_start", edge_of_pair, n_edges, ("first", first), ("second", second)),
        **rows("node_start", node, model.n_nodes, ("entry", np.arange(len(key)))),
    )


@ti.func
def patch_stiffness(m: ti.template(), p):
    """k of patch p [Pa/m^3], in f64."""
    return m.mean.modulus[p] / m.mean.volume[p]


@ti.func
def find_gradients(m: ti.template(), A: ti.template()):
    """Compute dilatations and gradients at x, as top-level loops of a kernel; uses A.element."""
    find_dilatations(m)
    for g in ti.static(m.groups):
        if ti.static(g.mean_dilatation):
            ti.loop_config(serialize=m.serial)
            for b in range(g.first, g.last):
                element_gradients(m, g, A, b)
    ti.loop_config(serialize=m.serial)
    for k in range(A.patches.n_entries):
        s = ti.Vector([0.0, 0.0, 0.0], m.real)
        for n in range(A.patches.gather_start[k], A.patches.gather_start[k + 1]):
            at = A.patches.gather[n]
            s += ti.Vector([A.element[at], A.element[at + m.lanes], A.element[at + 2 * m.lanes]])
        A.patches.gradient[k] = s


@ti.func
def element_gradients(m: ti.template(), g: ti.template(), A: ti.template(), b):
    """Write the derivatives of V sum_q w_q theta(F_q) by the nodes of block b, three numbers each, to A.element."""
    X, N = position_differences(m, g, b), rest_gradients_of_F(m, g, b)
    M, V = rest_gradients(m, b, m.real), volumes(m, b, m.real)
    S = zero_forces(m, g)
    for q in range(g.n_points):
        F = deformation_gradient(m, g, X, N, b, q, m.real)
        G = g.law.dilatation_gradient(F)
        add_forces(m, g, S, G, M, b, q)
    base = g.matrix_at + (b - g.first) * (MATRIX_BLOCKS[g.order] * 9)
    for i in ti.static(range(3)):
        total = broadcast(ti.cast(0.0, m.real), m.lanes)
        for a in ti.static(range(1, g.n_nodes)):
            total += S[3 * a - 3 + i]
            store_lanes(m, A.element, base + (3 * a + i), V * S[3 * a - 3 + i])
        store_lanes(m, A.element, base + i, -V * total)


@ti.func
def add_patches(m: ti.template(), A: ti.template(), e, s: ti.template(), projected: ti.template()):
    """Add k g_i g_j^T of the patches of edge e to the stored block s. projected: none with a negative k."""
    for n in range(A.patches.pair_start[e], A.patches.pair_start[e + 1]):
        first = A.patches.first[n]
        k = ti.cast(patch_stiffness(m, A.patches.patch[first]), m.real)
        if ti.static(projected):
            k = ti.max(k, ti.cast(0.0, m.real))
        g, h = A.patches.gradient[first], A.patches.gradient[A.patches.second[n]]
        for r in ti.static(range(3)):
            for c in ti.static(range(3)):
                s[4 * c + r] += k * g[r] * h[c]
