"""The tets of all bodies in blocks of SIMD lanes: their groups, and what kernels know of each.

Tets are grouped by order, quadrature and law; a kernel runs one group's blocks in one loop. A body whose regions follow several
laws has blocks in several groups. Its last block in each is padded with copies of its last tet there that have volume 0.
"""

from typing import Any

import numpy as np
import taichi as ti

from taisoft.errors import SceneError
from taisoft.fem import reference
from taisoft.fem.dependent_table import dependent_table
from taisoft.fem.laws import fibres, lane_law, law_of, viscosity, volume_floor
from taisoft.fem.model import Group, Layout, Setup
from taisoft.fem.pattern import MATRIX_BLOCKS
from taisoft.fem.springs import spring_table
from taisoft.mesh import quadratic
from taisoft.scene.laws import LAWS
from taisoft.scene.rigid import RigidBody
from taisoft.scene.scene import Body, Scene

# see `laws.additions`; each has `applies(body)`, and SWITCH if the plan may turn it off
ADDITIONS = (fibres, viscosity)


def additions_of(body: Body, on: dict[str, bool]) -> tuple[int, ...]:
    """The additions to a body's laws, as indices into ADDITIONS. on: the plan's switches."""
    return tuple(k for k, one in enumerate(ADDITIONS) if on.get(getattr(one, "SWITCH", None), True) and one.applies(body))


def make_layout(scene: Scene, lanes: int, on: dict[str, bool]) -> tuple[Layout, dict[tuple, np.ndarray]]:
    """Where the nodes and tets of a scene stand, and the tets of each of its groups, by their kind. Raises SceneError."""
    node_start = np.cumsum([0, *(body.n_nodes for body in scene.bodies)])
    tet_start = np.cumsum([0, *(body.mesh.n_tets for body in scene.bodies)])
    parts: dict[tuple, list[np.ndarray]] = {}  # tets of one body and one law, padded to whole blocks, by their kind
    for body, first in zip(scene.bodies, tet_start):
        composition, mean = body.composition, body.dilatation == "mean"
        for law in composition.laws:
            if mean and getattr(lane_law(law), "dilatation", None) is None:
                raise SceneError(f'body {body.name!r}: its law {law} has no mean dilatation: give it dilatation="local"')
            switches = composition.has_volume_floor, mean, isinstance(body, RigidBody), additions_of(body, on), body.is_curved
            kind, tets = (body.order, body.quadrature_degree, list(LAWS).index(law), *switches), composition.tets_of_law(law)
            padded = np.minimum(np.arange(-(-len(tets) // lanes) * lanes), len(tets) - 1)
            parts.setdefault(kind, []).append(first + tets[padded])
    kinds = {kind: np.concatenate(parts[kind]) for kind in sorted(parts)}
    tet_of_lane = np.concatenate(list(kinds.values()))
    lane_of_tet = np.unique(tet_of_lane, return_index=True)[1]
    rest = np.concatenate([body.rest_positions + body.position for body in scene.bodies])
    dependents = dependent_table(scene)
    tables = dependents, spring_table(scene, dependents)
    return Layout(node_start, tet_start, tet_of_lane, lane_of_tet, rest, lanes, *tables), kinds


def model_fields(setup: Setup, kinds: dict[tuple, np.ndarray]) -> dict[str, Any]:
    """Fields of Model: groups of tets, and their arrays. kinds: see `make_layout`."""
    layout, arena, real, by_tet = setup.layout, setup.arena, setup.runtime.real, setup.on["elasticity_by_tet"]
    elements, Dm_inv, volumes = _tets(setup.scene, layout)
    strain_real = _strain_type(setup, elements, Dm_inv)
    groups = _groups(kinds, layout.lanes, real, strain_real)
    nodes = [elements[tets, : group.n_nodes] for tets, group in zip(kinds.values(), groups)]
    volume = np.zeros(len(layout.tet_of_lane))  # 0 in padding
    volume[layout.lane_of_tet] = volumes
    start, entry = _gather_table(nodes, groups, volume > 0, layout)
    rest_real = ti.f64 if setup.on["rigid_bodies"] else strain_real
    body = np.searchsorted(layout.tet_start, layout.tet_of_lane[:: layout.lanes], side="right") - 1
    return {
        "groups": groups,
        "n_blocks": groups[-1].last,
        "nodes": arena.filled("nodes", ti.i32, np.concatenate([layout.blocks(own).reshape(-1) for own in nodes])),
        **_rule_fields(setup),
        **_curved_fields(setup, kinds, elements, volumes, rest_real),
        "Dm_inv": arena.filled("Dm_inv", rest_real, layout.blocks(Dm_inv[layout.tet_of_lane].reshape(-1, 9))),
        "volume": arena.filled("volume", real, volume.reshape(-1, layout.lanes)),
        "block_body": arena.filled("block_body", ti.i32, body),
        "elasticity_by_tet": by_tet,
        "law_constants": arena.filled("law_constants", ti.f64, law_table(setup.scene, layout, by_tet)),
        "gather_start": arena.filled("gather_start", ti.i32, start),
        "gather_entry": arena.filled("gather_entry", ti.i32, entry),
    }


def _tets(scene: Scene, layout: Layout) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Nodes (n_tets, 4 or 10) of all tets, their Dm^-1 (n_tets, 3, 3) [1/m] and volumes (n_tets,) [m^3]."""
    n_tets, width = len(layout.lane_of_tet), max(body.nodes.elements.shape[1] for body in scene.bodies)
    elements, Dm_inv, volumes = np.zeros((n_tets, width), dtype=np.int64), np.zeros((n_tets, 3, 3)), np.zeros(n_tets)
    for k, body in enumerate(scene.bodies):
        # sort nodes: F and V do not depend on their order, and every node pair then has the same direction in all its tets.
        # Mid-edge nodes are numbered like their ends, so they can be sorted separately
        own, rows = body.nodes.elements, layout.tets(k)
        own = np.concatenate([np.sort(own[:, :4], axis=1), np.sort(own[:, 4:], axis=1)], axis=1)
        Dm_inv[rows], volumes[rows] = reference.inverse_rest_edges(body.mesh.vertices, own[:, :4])
        elements[rows, : own.shape[1]] = own + layout.node_start[k]
        if body.is_curved:
            volumes[rows] = reference.rest_volumes(body)
    return elements, Dm_inv, volumes


def _strain_type(setup: Setup, elements: np.ndarray, Dm_inv: np.ndarray) -> Any:
    """Taichi type in which F = Ds Dm^-1 is formed: f64 if |Dm| |Dm^-1| in the Frobenius norm is large for an elastic tet.

    In f32 the rounding of F, 6e-8 times this number, would be a strain above 6e-6. Regular tets have 3, those of a sheet whose
    cells are 30 times as wide as thick about 60. Rigid tets form F in f64 anyway.
    """
    if setup.runtime.real == ti.f64:
        return ti.f64
    elastic = np.concatenate([np.full(body.mesh.n_tets, not isinstance(body, RigidBody)) for body in setup.scene.bodies])
    x = setup.layout.rest[elements[:, :4]]
    squares = np.prod([np.einsum("eij,eij->e", a, a) for a in (x[:, 1:] - x[:, :1], Dm_inv)], axis=0)
    return ti.f64 if np.sqrt(squares[elastic].max(initial=0.0)) > 100.0 else ti.f32


def _groups(kinds: dict[tuple, np.ndarray], lanes: int, real: Any, strain_real: Any) -> tuple[Group, ...]:
    n_points = {degree: len(quadratic.quadrature(degree).weights) for _, degree, *_ in kinds}
    groups, laws, last, nodes_at, force_at, matrix_at, curved_at = [], list(LAWS), 0, 0, 0, 0, 0
    for (order, degree, law, floor, mean, rigid, added, curved), tets in kinds.items():
        n_nodes, first, last = len(reference.unit_mass(order)), last, last + len(tets) // lanes
        points_at = sum(n for other, n in n_points.items() if 1 < other < degree)  # order 1 has degree 1 and no table
        offsets = first, last, nodes_at, force_at, matrix_at, points_at, curved_at
        types = (ti.f64, ti.f64) if rigid else (real, strain_real)
        law = law_of(laws[law], (volume_floor,) * floor + tuple(ADDITIONS[k] for k in added))
        groups.append(Group(law, order, n_nodes, n_points[degree], mean, rigid, curved, *offsets, *types))
        nodes_at += len(tets) * n_nodes
        force_at += (last - first) * n_nodes * 3
        matrix_at += (last - first) * MATRIX_BLOCKS[order] * 9
        curved_at += (last - first) * n_points[degree] if curved else 0
    return tuple(groups)


def _rule_fields(setup: Setup) -> dict[str, Any]:
    """Quadrature rules of quadratic tets, and their points."""
    degrees = sorted({body.quadrature_degree for body in setup.scene.bodies if body.order == 2})
    rules = tuple(quadratic.quadrature(degree) for degree in degrees)
    if not rules:
        return {"rules": rules}
    points, weights = np.concatenate([rule.points for rule in rules]), np.concatenate([rule.weights for rule in rules])
    # from the four barycentric derivatives; l_0 = 1 - l_1 - l_2 - l_3
    slopes = quadratic.shape_derivatives(2, points)[:, 1:]
    table = np.column_stack([weights, (slopes[:, :, 1:] - slopes[:, :, :1]).reshape(len(points), 27)])
    return {"rules": rules, "points": setup.arena.filled("points", ti.f64, table)}


def _curved_fields(
    setup: Setup, kinds: dict[tuple, np.ndarray], elements: np.ndarray, volumes: np.ndarray, real
) -> dict[str, Any]:
    """Rest shapes of bodies with curved edges at their quadrature points. real: Taichi type of `Dm_inv`."""
    rest, tables = np.concatenate([body.rest_positions for body in setup.scene.bodies]), []
    for (_, degree, *_, curved), tets in kinds.items():
        if curved:
            J = quadratic.jacobians(rest[elements[tets]], quadratic.quadrature(degree).points)
            ratio = np.abs(np.linalg.det(J)) / (6.0 * volumes[tets, None])
            values = np.concatenate([np.linalg.inv(J).reshape(*ratio.shape, 9), ratio[..., None]], axis=2)
            blocks = values.reshape(-1, setup.layout.lanes, *values.shape[1:]).transpose(0, 2, 3, 1)
            tables.append(blocks.reshape(-1, 10, setup.layout.lanes))
    return {"curved": setup.arena.filled("curved", real, np.concatenate(tables))} if tables else {}


def _gather_table(nodes: list[np.ndarray], groups: tuple[Group, ...], is_tet: np.ndarray, layout: Layout):
    """CSR table from node to its entries in the element force buffer, in block order. is_tet: lanes that are not padding."""
    ids, entries, lanes = [], [], layout.lanes
    for own, group in zip(nodes, groups):
        lane = np.flatnonzero(is_tet[group.first * lanes : group.last * lanes])
        base = (lane // lanes)[:, None] * (3 * group.n_nodes * lanes) + (lane % lanes)[:, None]
        ids.append(own[lane].reshape(-1))
        entries.append((group.force_at * lanes + base + 3 * lanes * np.arange(group.n_nodes)).reshape(-1))
    node, entry = np.concatenate(ids), np.concatenate(entries)
    start = np.concatenate([[0], np.cumsum(np.bincount(node, minlength=len(layout.rest)))])
    return start, entry[np.argsort(node, kind="stable")]


def law_table(scene: Scene, layout: Layout, by_tet: bool) -> np.ndarray:
    """Law constants (n_bodies, c), or (n_blocks, c, lanes) if they may differ between the tets of a body; c as many as needed.

    With a volume floor, its two constants follow those of the law. Under mean dilatation the law has no volumetric part, since
    the patches have it; the floor has lambda.
    """
    compositions = [body.composition for body in scene.bodies]
    width = max(lane_law(law).N_CONSTANTS + 2 * one.has_volume_floor for one in compositions for law in one.laws)
    start = layout.tet_start if by_tet else np.arange(len(scene.bodies) + 1)
    table = np.zeros((start[-1], width))
    for body, first, last in zip(scene.bodies, start, start[1:]):
        own, mean = body.composition, body.dilatation == "mean"
        for name in own.laws:
            law, tets = LAWS[name], own.tets_of_law(name) if by_tet else np.zeros(1, dtype=np.int64)
            given = (*own.lame, own.dilatation_modulus, own.number("volume_floor"), *map(own.number, law.parameters))
            mu, lam, modulus, floor, *numbers = (np.broadcast_to(one, last - first)[tets] for one in given)
            of_floor = volume_floor.table(floor, mu, lam) if own.has_volume_floor else ()
            if mean:
                lam, numbers = lam - modulus, [0.0 * x if one == law.modulus else x for one, x in zip(law.parameters, numbers)]
            along = own.fibres[tets].T if "I4" in law.arguments else ()
            for c, values in enumerate((*lane_law(name).constants(mu, lam, *numbers), *along, *of_floor)):
                table[first + tets, c] = values
    return layout.blocks(table[layout.tet_of_lane]) if by_tet else table
