"""Model: the arrays of a scene. One structure of arrays over all bodies, elements in blocks of SIMD lanes.

Topology, rest shape and law are constant (a kernel is compiled for them); gravity, material numbers, loads and
constraint masks are run-time data. Nodes keep the order of the bodies and of their meshes. Tets are grouped by law
(a kernel runs one law's blocks in one loop), and a body's last block is padded with copies of its last tet of volume 0.
"""

import difflib
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
import taichi as ti

from taisoft import elements
from taisoft.errors import SceneError
from taisoft.materials import LAWS
from taisoft.runtime import FieldArena, Runtime
from taisoft.scene.scene import Body, Material, Scene

PARALLEL_FROM = 100_000  # tets from which parallel loops beat one serial kernel on the CPU (50 us to wake the threads)


@dataclass(frozen=True, eq=False)
class Model:
    """Fields and compile-time constants that kernels take as one template argument."""

    real: Any  # Taichi type of everything but positions
    lanes: int
    serial: bool  # loops run on one thread
    n_nodes: int
    n_blocks: int
    laws: tuple  # (law module, first block, one past its last block)
    x: Any  # (n_nodes) 3-vectors f64: positions [m]
    v: Any  # (n_nodes) 3-vectors: velocities [m/s]
    verts: Any  # (n_blocks, 4, lanes) i32: nodes of each tet
    Dm_inv: Any  # (n_blocks, 9, lanes) [1/m]
    volume: Any  # (n_blocks, lanes) [m^3]
    block_body: Any  # (n_blocks) i32
    law_constants: Any  # (n_bodies, 4)
    corner: Any  # (n_blocks * 12 * lanes): corner forces [N], per block (corner, axis, lane)
    gather_start: Any  # (n_nodes + 1) i32: rows of gather_entry
    gather_entry: Any  # (4 n_tets) i32: base index into corner
    mass: Any  # (n_nodes) lumped mass [kg]
    free: Any  # (n_nodes) 3-vectors: 1 on free axes, 0 on constrained ones
    gravity: Any  # () 3-vector [m/s^2]
    loads: Any  # (n_nodes) 3-vectors [N], or None: tractions and forces
    node_body: Any  # (n_nodes) i32, or None: only where damping needs it
    damping: Any  # (n_bodies, 2), or None: mass damping [1/s], stiffness damping [s]
    loaded: bool  # which of the above are on
    damped: bool
    stiffness_damping: bool
    scalars: Any  # (16) f64: what a kernel tells the host
    partial: Any  # (chunks, 8) f64: partial sums, added in a fixed order
    chunks: int


@dataclass(frozen=True)
class Layout:
    """Where bodies and tets lie in the model, for the host."""

    node_start: np.ndarray  # (n_bodies + 1)
    block_start: np.ndarray  # (n_bodies,) first block of each body
    n_tets: np.ndarray  # (n_bodies,)
    mass: np.ndarray  # (n_nodes,) [kg]
    rest: np.ndarray  # (n_nodes, 3) rest positions, placed

    def nodes(self, body: int) -> slice:
        """The rows of a body's nodes."""
        return slice(self.node_start[body], self.node_start[body + 1])


def _layout(scene: Scene, lanes: int) -> tuple[Layout, tuple]:
    counts = [len(b.rest_positions) for b in scene.bodies]
    n_tets = np.array([b.mesh.n_tets for b in scene.bodies])
    blocks = -(-n_tets // lanes)
    block_start = np.zeros(len(counts), dtype=np.int64)
    laws, next_block = [], 0
    for name, law in LAWS.items():
        first = next_block
        for k, body in enumerate(scene.bodies):
            if body.material.law == name:
                block_start[k] = next_block
                next_block += int(blocks[k])
        if next_block > first:
            laws.append((law, first, next_block))
    rest = np.concatenate([b.rest_positions + b.position for b in scene.bodies])
    node_start = np.concatenate([[0], np.cumsum(counts)])
    return Layout(node_start, block_start, n_tets, body_masses(scene), rest), tuple(laws)


def body_masses(scene: Scene) -> np.ndarray:
    """Lumped masses of all nodes, bodies in order [kg]."""
    return np.concatenate(
        [elements.lumped_mass(b.mesh.tets, b.mesh.volumes, b.material.density, b.mesh.n_verts) for b in scene.bodies]
    )


def body_loads(scene: Scene) -> np.ndarray:
    """Nodal forces of tractions and forces (n_nodes, 3) [N]; forces are spread over their nodes by lumped mass."""
    parts = []
    for body in scene.bodies:
        total = np.zeros((body.mesh.n_verts, 3))
        for t in body.tractions:
            total += elements.traction_forces(body.mesh.vertices, body.mesh.surface[t.triangles], t.value)
        mass = elements.lumped_mass(body.mesh.tets, body.mesh.volumes, 1.0, body.mesh.n_verts)
        for f in body.forces:
            total[f.nodes] += np.outer(mass[f.nodes] / mass[f.nodes].sum(), f.value)
        parts.append(total)
    return np.concatenate(parts)


def _packed_tets(scene: Scene, layout: Layout, n_blocks: int, lanes: int):
    """Node ids (n_blocks*lanes, 4), Dm^-1 and volumes of every lane, and which lanes hold a real tet."""
    verts = np.zeros((n_blocks * lanes, 4), dtype=np.int64)
    Dm_inv, volume = np.zeros((n_blocks * lanes, 3, 3)), np.zeros(n_blocks * lanes)
    real = np.zeros(n_blocks * lanes, dtype=bool)
    for k, body in enumerate(scene.bodies):
        # ascending vertices: F and V do not mind, and every mesh edge then has one direction in all its tets
        tets = np.sort(body.mesh.tets, axis=1)
        inverse, v = elements.inverse_rest_edges(body.mesh.vertices, tets)
        first, m = layout.block_start[k] * lanes, body.mesh.n_tets
        last = first + -(-m // lanes) * lanes
        padded = np.minimum(np.arange(last - first), m - 1)
        verts[first:last] = tets[padded] + layout.node_start[k]
        Dm_inv[first:last], volume[first : first + m], real[first : first + m] = inverse[padded], v, True
    return verts, Dm_inv, volume, real


def _gather_table(verts: np.ndarray, real: np.ndarray, n_nodes: int, lanes: int) -> tuple[np.ndarray, np.ndarray]:
    """CSR from node to the corner-buffer entries of its tets, in block order."""
    lane = np.flatnonzero(real)
    node = verts[lane].reshape(-1)
    entry = ((lane // lanes)[:, None] * 12 + np.arange(4) * 3) * lanes + (lane % lanes)[:, None]
    order = np.argsort(node, kind="stable")
    start = np.concatenate([[0], np.cumsum(np.bincount(node, minlength=n_nodes))])
    return start.astype(np.int32), entry.reshape(-1)[order].astype(np.int32)


def lane_layout(values: np.ndarray, lanes: int) -> np.ndarray:
    """(n_blocks*lanes, c) to (n_blocks, c, lanes)."""
    return values.reshape(-1, lanes, values.shape[1]).transpose(0, 2, 1)


def material_table(materials: list[Material]) -> np.ndarray:
    """Law constants (n_bodies, 4)."""
    return np.array([LAWS[m.law].constants(m.mu, m.lam) for m in materials])


def build_model(scene: Scene, runtime: Runtime, arena: FieldArena, on: dict[str, bool]) -> tuple[Model, Layout]:
    """Allocate and fill the model of a scene. on: the plan's switches; what is off allocates nothing."""
    lanes, real, npr = runtime.lanes, runtime.real, runtime.np_real
    layout, laws = _layout(scene, lanes)
    n_nodes, n_blocks = len(layout.rest), laws[-1][2]
    verts, Dm_inv, volume, present = _packed_tets(scene, layout, n_blocks, lanes)
    start, entry = _gather_table(verts, present, n_nodes, lanes)
    block_body = np.zeros(n_blocks, dtype=np.int32)
    for k in range(len(scene.bodies)):
        block_body[layout.block_start[k] : layout.block_start[k] + -(-layout.n_tets[k] // lanes)] = k
    serial = runtime.arch == "cpu" and int(layout.n_tets.sum()) < PARALLEL_FROM
    chunks = 1 if serial else (64 if runtime.arch == "cpu" else 4096)
    damped = on["mass_damping"] or on["stiffness_damping"]
    n_bodies = len(scene.bodies)
    node_body = np.repeat(np.arange(n_bodies, dtype=np.int32), np.diff(layout.node_start))
    velocity = np.concatenate([np.broadcast_to(b.velocity, b.rest_positions.shape) for b in scene.bodies])
    model = Model(
        real=real, lanes=lanes, serial=serial, n_nodes=n_nodes, n_blocks=n_blocks, laws=laws,
        x=arena.vectors("x", ti.f64, n_nodes, layout.rest),
        v=arena.vectors("v", real, n_nodes, velocity.astype(npr)),
        verts=arena.field("verts", ti.i32, (n_blocks, 4, lanes), lane_layout(verts, lanes).astype(np.int32)),
        Dm_inv=arena.field("Dm_inv", real, (n_blocks, 9, lanes), lane_layout(Dm_inv.reshape(-1, 9), lanes).astype(npr)),
        volume=arena.field("volume", real, (n_blocks, lanes), volume.reshape(n_blocks, lanes).astype(npr)),
        block_body=arena.field("block_body", ti.i32, n_blocks, block_body),
        law_constants=arena.field(
            "law_constants", ti.f64, (n_bodies, 4), material_table([b.material for b in scene.bodies])
        ),
        corner=arena.field("corner", real, n_blocks * 12 * lanes),
        gather_start=arena.field("gather_start", ti.i32, n_nodes + 1, start),
        gather_entry=arena.field("gather_entry", ti.i32, len(entry), entry),
        mass=arena.field("mass", real, n_nodes, layout.mass.astype(npr)),
        free=arena.vectors("free", real, n_nodes, np.ones((n_nodes, 3), dtype=npr)),
        gravity=arena.vectors("gravity", real, 1, np.asarray(scene.gravity, dtype=npr)[None]),
        loads=arena.vectors("loads", real, n_nodes, body_loads(scene).astype(npr)) if on["loads"] else None,
        node_body=arena.field("node_body", ti.i32, n_nodes, node_body) if damped else None,
        damping=arena.field("damping", real, (n_bodies, 2), damping_table(scene).astype(npr)) if damped else None,
        loaded=on["loads"], damped=damped, stiffness_damping=on["stiffness_damping"],
        scalars=arena.field("scalars", ti.f64, 16),
        partial=arena.field("partial", ti.f64, (chunks, 8)),
        chunks=chunks,
    )  # fmt: skip
    return model, layout


def damping_table(scene: Scene) -> np.ndarray:
    """Mass damping [1/s] and stiffness damping [s] per body (n_bodies, 2)."""
    return np.array([[b.material.mass_damping, b.material.stiffness_damping] for b in scene.bodies])


CHANGEABLE = ("young", "poisson", "density", "mass_damping", "stiffness_damping")


def changed_material(body: Body, numbers: dict[str, float], on: dict[str, bool]) -> None:
    """Give a body a material with new numbers; the law, and damping that is compiled out, cannot change while it runs."""
    for name, value in numbers.items():
        if name not in CHANGEABLE:
            near = difflib.get_close_matches(name, CHANGEABLE, 1)
            hint = f" (did you mean {near[0]}?)" if near else ""
            raise SceneError(f"body '{body.name}': {name} cannot change while it runs{hint}; {', '.join(CHANGEABLE)} can")
        if name in on and not on[name] and value != 0.0:
            raise SceneError(
                f"body '{body.name}': {name} was 0 everywhere at the start and is not modelled; "
                "start with a small value to change it later"
            )
    try:
        body.material = replace(body.material, **numbers)
    except SceneError as error:
        raise SceneError(f"body '{body.name}': {error}") from None
