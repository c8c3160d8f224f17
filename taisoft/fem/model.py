"""Model: the constant arrays of a scene, and its `State`. Structure of arrays over all bodies, elements in blocks of SIMD lanes.

Kernels are compiled for laws, orders, flags and precision. Topology, rest shape and sizes are constant but run-time data, as are
gravity, material numbers, loads and constraint masks. Nodes keep the order of the bodies and of their meshes. Tets are grouped
by order, quadrature and law; a kernel runs one group's blocks in one loop. A body whose regions follow several laws has blocks in
several groups. Its last block in each is padded with copies of its last tet there that have volume 0.
"""

from dataclasses import dataclass, replace
from typing import Any

import numpy as np
import taichi as ti

from taisoft.backend import parallel
from taisoft.backend.arrays import Count, FieldArena, download, upload
from taisoft.backend.lists import SPREAD
from taisoft.backend.runtime import Runtime
from taisoft.errors import SceneError
from taisoft.fem import reference, springs
from taisoft.fem.chunks import FOLDED, SweepOrder
from taisoft.fem.dependents import DependentTable, build_dependents, dependent_table
from taisoft.fem.laws import LAWS, law_of, volume_floor
from taisoft.fem.loads import SceneLoads
from taisoft.fem.mean_dilatation import MeanDilatation, build_mean_dilatation
from taisoft.fem.node_graph import NodeGraph
from taisoft.fem.pattern import MATRIX_BLOCKS, model_graph
from taisoft.fem.pressure import PressureTable, build_pressures
from taisoft.fem.rigid_tets import RigidTets, build_rigid_tets
from taisoft.fem.spring_table import SpringTable
from taisoft.fem.state import State, build_state
from taisoft.fem.terms import terms_of
from taisoft.ranges import owners
from taisoft.scene.rigid import RigidBody
from taisoft.scene.scene import Body, Scene

# Quadrature points from which loops on the CPU are divided into chunks; below, one thread is faster on every machine
CHUNKED_FROM = 20_000
LOOP_SECONDS = 3e-9  # of one thread per quadrature point, in the loops with least work
CHUNKS = {"cpu": 32, "cuda": 65_536}
# |Dm| |Dm^-1| above which F is formed in f64: in f32 its rounding error, 6e-8 times this number, would be a strain above 6e-6.
# Regular tets have 3, those of a sheet whose cells are 30 times as wide as thick about 60
ILL_CONDITIONED = 100.0


@dataclass(frozen=True)
class Group:
    """Blocks of one element type and law, and the offsets of their data in the flat arrays."""

    law: Any  # module of taisoft.fem.laws, or VolumeFloor of one
    order: int
    n_nodes: int  # of an element
    n_points: int
    mean_dilatation: bool
    rigid: bool  # of rigid bodies, whose strains are as small as the rounding of f32
    first: Count  # first block
    last: Count  # one past the last block
    nodes_at: Count  # offset in Model.nodes
    force_at: Count  # offset in State.element_force, in vectors of lanes
    matrix_at: Count  # offset in the assembly buffer
    points_at: Count  # first row in Model.points
    real: Any = None  # Taichi type of stress
    strain_real: Any = None  # Taichi type in which the deformation gradient is formed


@dataclass(frozen=True, eq=False)
class MassMatrix:
    """Symmetric mass matrix [kg] with the stiffness pattern and one number per node pair, the same for each axis."""

    row_start: Any  # (2 n_nodes + 1) i32: half-rows as in `node_graph.NodeGraph`
    column: Any  # (2 n_pairs) i32
    value: Any  # (2 n_pairs)
    diagonal: Any  # (n_nodes)


@dataclass(frozen=True, eq=False)
class Model:
    """Constant arrays, their sizes (`Count`), structure and the state: one template argument of kernels."""

    real: Any  # Taichi type of everything but positions
    strain_real: Any  # Taichi type in which the deformation gradient is formed
    lanes: int
    serial: bool  # loops run on one thread
    on_cpu: bool
    n_nodes: Count
    n_blocks: Count
    groups: tuple  # of Group
    state: State  # positions, velocities, scratch
    terms: tuple  # modules of fem.terms
    nodes: Any  # i32: nodes of each tet, per block (node, lane); corners, then mid-edge nodes, each ascending
    rules: tuple  # reference.Quadrature of the order 2 groups, in ascending degree
    points: Any  # (points, 28), or None: weight and dN_a/d(l_1, l_2, l_3) of nodes 1 to 9 at the points of these rules
    Dm_inv: Any  # (n_blocks, 9, lanes) [1/m]
    volume: Any  # (n_blocks, lanes) [m^3]
    block_body: Any  # (n_blocks) i32
    law_constants: Any  # (n_bodies, 4), or (n_blocks, 4, lanes) if elasticity_by_tet; 6 numbers if some body has a volume floor
    gather_start: Any  # (n_nodes + 1) i32: first entry of each node in gather_entry
    gather_entry: Any  # i32: base index into State.element_force of each node of each tet
    mass: Any  # (n_nodes) lumped mass [kg]
    gravity_mass: Any  # (n_nodes) mass used for weight [kg]: the lumped mass, or int rho N_a dV
    mass_matrix: Any  # MassMatrix, or None: consistent mass
    free: Any  # (n_nodes) 3-vectors: 1 on free axes, 0 on constrained ones
    gravity: Any  # () 3-vector [m/s^2]
    springs: Any  # fem.springs.Springs, or None
    dependents: Any  # fem.dependents.Dependents, or None
    loads: Any  # (n_nodes) 3-vectors [N], or None: tractions and forces
    amplitudes: Any  # f64, or None: present values of the loads that are one number, see `fem.loads.scalar_loads`
    pressure: PressureTable | None
    rigid_tets: RigidTets | None  # to be damped, or moved as rigid bodies
    node_body: Any  # (n_nodes) i32; None unless damping needs it
    damping: Any  # (n_bodies, 2), or None: mass damping [1/s], stiffness damping [s]
    consistent: bool  # mass_matrix is used
    loaded: bool
    damped: bool
    stiffness_damping: bool
    spring_damping: bool
    mean_dilatation: bool  # of some group
    mean: MeanDilatation | None
    elasticity_by_tet: bool  # law_constants may differ between the tets of a body
    chunks: int  # of a loop, each with its own partial sums

    @property
    def spread(self) -> int:
        """Iterations of a loop per chunk, see `fem.chunks`."""
        return 1 if self.serial else SPREAD["cpu" if self.on_cpu else "cuda"]

    @property
    def sums(self) -> int:
        """Partial sums that `fem.chunks.total` adds."""
        return self.chunks if self.on_cpu else min(self.chunks, FOLDED)

    @property
    def sweep(self) -> SweepOrder:
        """Order of a Gauss-Seidel sweep, which is divided in scenes whose loops are, on the CPU."""
        return SweepOrder.of(self.n_nodes) if self.on_cpu and self.chunks > 1 else SweepOrder()

    @property
    def has_dependents(self) -> bool:
        """Whether nodes are attached exactly."""
        return self.dependents is not None

    @property
    def has_springs(self) -> bool:
        """Whether there are springs, tendons or attachments."""
        return self.springs is not None

    @property
    def depends_on_velocity(self) -> bool:
        """Whether forces other than mass damping depend on velocities."""
        return self.stiffness_damping or self.spring_damping

    @property
    def has_rigid_tets(self) -> bool:
        """Whether rigid bodies are damped or moved apart from others."""
        return self.rigid_tets is not None

    @property
    def has_pressure(self) -> bool:
        """Whether pressures act on surfaces."""
        return self.pressure is not None


@dataclass(frozen=True)
class Layout:
    """Host-side index ranges of bodies and tets in the model, and the tables of its connections."""

    node_start: np.ndarray  # (n_bodies + 1)
    tet_start: np.ndarray  # (n_bodies + 1), among the tets of all bodies
    tet_of_lane: np.ndarray  # (n_blocks * lanes,) tet among those of all bodies; padding repeats the tet before it
    lane_of_tet: np.ndarray  # (n_tets,) its lane, counted through all blocks
    rest: np.ndarray  # (n_nodes, 3) rest positions in the scene [m]
    lanes: int
    dependents: DependentTable | None
    springs: SpringTable | None

    def nodes(self, body: int) -> slice:
        """Rows of a body's nodes."""
        return slice(self.node_start[body], self.node_start[body + 1])

    def tets(self, body: int) -> slice:
        """Rows of a body's tets."""
        return slice(self.tet_start[body], self.tet_start[body + 1])


def _layout(scene: Scene, lanes: int) -> tuple[Layout, tuple[Group, ...]]:
    bodies, laws = scene.bodies, list(LAWS)
    tet_start = np.concatenate([[0], np.cumsum([b.mesh.n_tets for b in bodies])])
    parts: dict[tuple, list[np.ndarray]] = {}  # tets of one body and one law, by their kind
    for k, b in enumerate(bodies):
        for law in b.composition.laws:
            floor, mean, rigid = b.composition.has_volume_floor, b.dilatation == "mean", isinstance(b, RigidBody)
            if mean and not hasattr(LAWS[law], "dilatation"):
                raise SceneError(f'body {b.name!r}: its law {law} has no mean dilatation: give it dilatation="local"')
            kind = b.order, b.quadrature_degree, laws.index(law), floor, mean, rigid
            parts.setdefault(kind, []).append(tet_start[k] + b.composition.tets_of_law(law))
    n_points = {degree: len(reference.quadrature(degree).weights) for _, degree, *_ in parts}
    tet_of_lane = []
    groups, block, nodes_at, force_at, matrix_at = [], 0, 0, 0, 0
    for kind in sorted(parts):
        order, degree, law, floor, *switches = kind
        first = block
        for tets in parts[kind]:
            padded = -(-len(tets) // lanes) * lanes
            tet_of_lane.append(tets[np.minimum(np.arange(padded), len(tets) - 1)])
            block += padded // lanes
        n_nodes, count = len(reference.unit_mass(order)), (block - first) * lanes
        points_at = sum(n for other, n in n_points.items() if 1 < other < degree)  # order 1 has degree 1 and no table
        offsets = first, block, nodes_at, force_at, matrix_at, points_at
        groups.append(Group(law_of(laws[law], floor), order, n_nodes, n_points[degree], *switches, *offsets))
        nodes_at += count * n_nodes
        force_at += (block - first) * n_nodes * 3
        matrix_at += (block - first) * MATRIX_BLOCKS[order] * 9
    rest = np.concatenate([b.rest_positions + b.position for b in bodies])
    node_start = np.concatenate([[0], np.cumsum([b.n_nodes for b in bodies])])
    tet_of_lane = np.concatenate(tet_of_lane)
    lane_of_tet = np.unique(tet_of_lane, return_index=True)[1]
    dependents = dependent_table(scene)
    tables = dependents, springs.spring_table(scene, dependents)
    return Layout(node_start, tet_start, tet_of_lane, lane_of_tet, rest, lanes, *tables), tuple(groups)


def _rule_table(rules: tuple[reference.Quadrature, ...]) -> np.ndarray:
    """Table (points, 28) of `Model.points`."""
    points, weights = np.concatenate([r.points for r in rules]), np.concatenate([r.weights for r in rules])
    # from the four barycentric derivatives; l_0 = 1 - l_1 - l_2 - l_3
    s = reference.shape_derivatives(2, points)[:, 1:]
    return np.column_stack([weights, (s[:, :, 1:] - s[:, :, :1]).reshape(len(points), 27)])


def _packed_tets(scene: Scene, layout: Layout, groups: tuple[Group, ...], lanes: int):
    """Node ids, a list with one (lanes, n_nodes) array per group; Dm^-1 and volume (0 in padding) of every lane."""
    n_tets, width = len(layout.lane_of_tet), max(g.n_nodes for g in groups)
    elements, Dm_inv, volumes = np.zeros((n_tets, width), dtype=np.int64), np.zeros((n_tets, 3, 3)), np.zeros(n_tets)
    for k, body in enumerate(scene.bodies):
        # sort nodes: F and V do not depend on their order, and every node pair then has the same direction in all its tets.
        # Mid-edge nodes are numbered like their ends, so they can be sorted separately
        own, rows = body.nodes.elements, layout.tets(k)
        own = np.concatenate([np.sort(own[:, :4], axis=1), np.sort(own[:, 4:], axis=1)], axis=1)
        Dm_inv[rows], volumes[rows] = reference.inverse_rest_edges(body.mesh.vertices, own[:, :4])
        elements[rows, : own.shape[1]] = own + layout.node_start[k]
    nodes = [elements[layout.tet_of_lane[g.first * lanes : g.last * lanes], : g.n_nodes] for g in groups]
    volume = np.zeros(len(layout.tet_of_lane))
    volume[layout.lane_of_tet] = volumes
    return nodes, Dm_inv[layout.tet_of_lane], volume


def _worst_condition(nodes, Dm_inv: np.ndarray, layout: Layout, groups: tuple[Group, ...]) -> float:
    """The largest |Dm| |Dm^-1| of a tet in the Frobenius norm: the amplification of rounding in F = Ds Dm^-1; 0 if all are
    rigid, whose F is formed in f64 anyway."""
    elastic = np.repeat([not g.rigid for g in groups], [len(own) for own in nodes])
    x = layout.rest[np.concatenate([own[:, :4] for own in nodes])[elastic]]
    squares = ((x[:, 1:] - x[:, :1]) ** 2).sum(axis=(1, 2)) * (Dm_inv[elastic] ** 2).sum(axis=(1, 2))
    return float(np.sqrt(squares.max(initial=0.0)))


def _gather_table(nodes, groups: tuple[Group, ...], real: np.ndarray, n_nodes: int, lanes: int):
    """CSR table from node to its entries in the element force buffer, in block order."""
    ids, entries = [], []
    for own, g in zip(nodes, groups):
        lane = np.flatnonzero(real[g.first * lanes : g.last * lanes])
        base = (lane // lanes)[:, None] * (3 * g.n_nodes * lanes) + (lane % lanes)[:, None]
        ids.append(own[lane].reshape(-1))
        entries.append((g.force_at * lanes + base + 3 * lanes * np.arange(g.n_nodes)).reshape(-1))
    node, entry = np.concatenate(ids), np.concatenate(entries)
    order = np.argsort(node, kind="stable")
    start = np.concatenate([[0], np.cumsum(np.bincount(node, minlength=n_nodes))])
    return start.astype(np.int32), entry[order].astype(np.int32)


def lane_layout(values: np.ndarray, lanes: int) -> np.ndarray:
    """Reorder (n_blocks*lanes, c) to (n_blocks, c, lanes)."""
    return values.reshape(-1, lanes, values.shape[1]).transpose(0, 2, 1)


def _local_lame(body: Body) -> tuple:
    """Lamé's parameters (mu, lambda) of the energy of each quadrature point: lambda is 0 if the patches have its part."""
    mu, lam = body.composition.lame
    return (mu, 0.0 * lam) if body.dilatation == "mean" else (mu, lam)


def _floor_constants(body: Body) -> tuple:
    """Constants of the volume floor, each a number or one for each tet; under mean dilatation, too, with lambda."""
    return volume_floor.constants(body.composition.number("volume_floor"), *body.composition.lame)


def law_table(scene: Scene, layout: Layout, by_tet: bool) -> np.ndarray:
    """Law constants (n_bodies, 4), or (n_blocks, 4, lanes) if they may differ between the tets of a body.

    If some body has a volume floor, its two constants follow: 6 instead of 4.
    """
    has_floor = any(b.composition.has_volume_floor for b in scene.bodies)
    if not by_tet:
        table = np.array([LAWS[b.composition.first.law].constants(*_local_lame(b)) for b in scene.bodies])
        return np.column_stack([table, [_floor_constants(b) for b in scene.bodies]]) if has_floor else table
    table = np.zeros((len(layout.lane_of_tet), 6 if has_floor else 4))
    for k, body in enumerate(scene.bodies):
        for c, values in enumerate(_floor_constants(body) if has_floor else ()):
            table[layout.tets(k), 4 + c] = values
        mu, lam = (np.broadcast_to(x, body.mesh.n_tets) for x in _local_lame(body))
        for law in body.composition.laws:
            tets = body.composition.tets_of_law(law)
            for c, values in enumerate(LAWS[law].constants(mu[tets], lam[tets])):
                table[layout.tet_start[k] + tets, c] = values
    return lane_layout(table[layout.tet_of_lane], layout.lanes)


def build_model(scene: Scene, runtime: Runtime, arena: FieldArena, on: dict[str, bool]) -> tuple[Model, Layout]:
    """Allocate and fill the model of a scene. on: the plan's switches; features that are off allocate nothing."""
    lanes, real, npr = runtime.lanes, runtime.real, runtime.np_real
    layout, groups = _layout(scene, lanes)
    n_nodes, n_blocks = len(layout.rest), groups[-1].last
    nodes, Dm_inv, volume = _packed_tets(scene, layout, groups, lanes)
    start, entry = _gather_table(nodes, groups, volume > 0, n_nodes, lanes)
    block_body = (np.searchsorted(layout.tet_start, layout.tet_of_lane[::lanes], side="right") - 1).astype(np.int32)
    work = sum((g.last - g.first) * lanes * g.n_points for g in groups)
    chunks = 1 if runtime.arch == "cpu" and work < CHUNKED_FROM else CHUNKS[runtime.arch]
    serial = runtime.arch == "cpu" and (chunks == 1 or not parallel.pays(work * LOOP_SECONDS))
    strain_real = ti.f64 if real == ti.f32 and _worst_condition(nodes, Dm_inv, layout, groups) > ILL_CONDITIONED else real
    types = {True: (ti.f64, ti.f64), False: (real, strain_real)}
    groups = tuple(replace(g, **dict(zip(("real", "strain_real"), types[g.rigid]))) for g in groups)
    damped = on["mass_damping"] or on["stiffness_damping"]
    n_bodies = len(scene.bodies)
    node_body = owners(np.diff(layout.node_start)).astype(np.int32)
    velocity = np.concatenate([np.broadcast_to(b.velocity, b.rest_positions.shape) for b in scene.bodies])
    flat_nodes = np.concatenate([lane_layout(own, lanes).reshape(-1) for own in nodes])
    dependents, table = layout.dependents, layout.springs
    scene_loads = SceneLoads(scene, table)
    n_amplitudes = scene_loads.n_amplitudes
    laws = law_table(scene, layout, on["elasticity_by_tet"])
    rules = tuple(reference.quadrature(d) for d in sorted({b.quadrature_degree for b in scene.bodies if b.order == 2}))
    points = _rule_table(rules) if rules else None
    rest_real = ti.f64 if on["rigid_bodies"] else strain_real
    rest_lanes = lane_layout(Dm_inv.reshape(-1, 9), lanes).astype(npr if rest_real == real else np.float64)
    weight = mass = arena.field("mass", real, n_nodes, reference.lumped_masses(scene, dependents).astype(npr))
    if on["consistent_weight"]:
        weight = arena.field("gravity_mass", real, n_nodes, reference.gravity_masses(scene, dependents).astype(npr))
    rigid_tets = None
    if on["rigid_damping"] or on["rigid_motion"]:
        rigid_tets = build_rigid_tets(scene, layout.node_start, dependents, arena)
    model = Model(
        real=real,
        strain_real=strain_real,
        lanes=lanes,
        serial=serial,
        on_cpu=runtime.arch == "cpu",
        n_nodes=n_nodes,
        n_blocks=n_blocks,
        groups=groups,
        terms=terms_of(on | {"rigid_damping": on["rigid_damping"] and rigid_tets is not None}),
        state=build_state(arena, runtime, layout.rest, velocity, 3 * len(flat_nodes), chunks),
        nodes=arena.field("nodes", ti.i32, len(flat_nodes), flat_nodes.astype(np.int32)),
        rules=rules,
        points=arena.field("points", ti.f64, (len(points), 28), points) if rules else None,
        Dm_inv=arena.field("Dm_inv", rest_real, (n_blocks, 9, lanes), rest_lanes),
        volume=arena.field("volume", real, (n_blocks, lanes), volume.reshape(n_blocks, lanes).astype(npr)),
        block_body=arena.field("block_body", ti.i32, n_blocks, block_body),
        law_constants=arena.field("law_constants", ti.f64, laws.shape, laws),
        gather_start=arena.field("gather_start", ti.i32, n_nodes + 1, start),
        gather_entry=arena.field("gather_entry", ti.i32, len(entry), entry),
        mass=mass,
        gravity_mass=weight,
        mass_matrix=None,
        free=arena.vectors("free", real, n_nodes, np.ones((n_nodes, 3), dtype=npr)),
        gravity=arena.vectors("gravity", real, 1, np.asarray(scene.gravity, dtype=npr)[None]),
        dependents=build_dependents(dependents, arena) if dependents is not None else None,
        springs=springs.build_springs(table, arena, on["assembled_stiffness"]) if on["springs"] else None,
        loads=arena.vectors("loads", real, n_nodes, scene_loads.at(0.0).astype(npr)) if on["loads"] else None,
        amplitudes=arena.field("amplitudes", ti.f64, n_amplitudes, scene_loads.amplitudes([0.0])[0]) if n_amplitudes else None,
        pressure=None,
        rigid_tets=rigid_tets,
        node_body=arena.field("node_body", ti.i32, n_nodes, node_body) if damped else None,
        damping=arena.field("damping", real, (n_bodies, 2), damping_table(scene).astype(npr)) if damped else None,
        consistent=on["consistent_mass"],
        loaded=on["loads"],
        damped=damped,
        stiffness_damping=on["stiffness_damping"],
        spring_damping=on["spring_damping"],
        mean_dilatation=on["mean_dilatation"],
        mean=build_mean_dilatation(scene, layout, arena) if on["mean_dilatation"] else None,
        elasticity_by_tet=on["elasticity_by_tet"],
        chunks=chunks,
    )
    needs_graph = on["consistent_mass"] or (on["pressure"] and on["assembled_stiffness"])
    graph = model_graph(model)[0] if needs_graph else None
    if on["consistent_mass"]:
        model = replace(model, mass_matrix=_build_mass_matrix(scene, dependents, model, arena, graph))
    if on["pressure"]:
        model = replace(model, pressure=build_pressures(scene, layout.node_start, arena, graph, dependents))
    return model, layout


def _build_mass_matrix(
    scene: Scene, dependents: DependentTable | None, model: Model, arena: FieldArena, graph: NodeGraph
) -> MassMatrix:
    mass = MassMatrix(
        row_start=arena.field("mass_row_start", ti.i32, 2 * model.n_nodes + 1, graph.row_start.astype(np.int32)),
        column=arena.field("mass_column", ti.i32, len(graph.column), graph.column.astype(np.int32)),
        value=arena.field("mass_value", model.real, len(graph.column)),
        diagonal=arena.field("mass_diagonal", model.real, model.n_nodes),
    )
    upload_mass_matrix(scene, dependents, mass)
    return mass


def upload_mass_matrix(scene: Scene, dependents: DependentTable | None, mass: MassMatrix) -> None:
    """Fill the device matrix from the bodies' densities."""
    M = reference.mass_matrix(scene, dependents)
    start, column = download([mass.row_start, mass.column])
    rows = owners(np.diff(start)) % (len(start) // 2)
    upload([(mass.value, np.asarray(M[rows, column]).reshape(-1)), (mass.diagonal, M.diagonal())])


def damping_table(scene: Scene) -> np.ndarray:
    """Mass damping [1/s] and stiffness damping [s] of each body (n_bodies, 2)."""
    materials = [b.composition.first for b in scene.bodies]
    return np.array([[material.mass_damping, material.stiffness_damping] for material in materials])
