"""Surfaces, frames and sizes of the scene's colliders (bodies, then obstacles) for contact detection, on the host."""

from dataclasses import dataclass

import numpy as np

from taisoft.errors import MeshError, reworded
from taisoft.fem.model import Layout
from taisoft.mesh.sdf import SdfGrid, cached_sdf_grid
from taisoft.ranges import owners
from taisoft.scene.body import Body
from taisoft.scene.collision import principal_extents
from taisoft.scene.obstacles import Box, HalfSpace, MeshObstacle, Obstacle
from taisoft.scene.scene import Scene

MIN_THICKNESS = 0.25  # of the mean surface edge: minimum thickness of a mesh obstacle, since open meshes have none


@dataclass(frozen=True)
class Topology:
    """Triangles on the host. Vertices are numbered over all colliders, surface vertices only.

    triangle: (t,3) vertices; body: (t,) collider, ascending; first: (n_bodies + 1,) first triangle of each collider;
    vertex_first: (n_bodies + 1,) first vertex; node: (v,) the model's node, -1 for obstacles; neighbour: (t,3) triangle across
    the edge from corner k to k + 1, -1 if there is none; owns: (t,) bits 0-2 corners, 3-5 edges that this triangle handles on
    behalf of all that share them; ring_start, ring: triangles around each vertex; around_start, around: adjacent vertices.
    """

    triangle: np.ndarray
    body: np.ndarray
    first: np.ndarray
    vertex_first: np.ndarray
    node: np.ndarray
    neighbour: np.ndarray
    owns: np.ndarray
    ring_start: np.ndarray
    ring: np.ndarray
    around_start: np.ndarray
    around: np.ndarray


def make_topology(parts: list[tuple[np.ndarray, np.ndarray]]) -> Topology:
    """Combine the surfaces of all colliders. parts: for each, (t,3) triangles and the (v,) nodes of their vertices."""
    first, vertex_first = (np.cumsum([0, *(len(part[k]) for part in parts)]) for k in range(2))
    t = np.concatenate([triangles + start for (triangles, _), start in zip(parts, vertex_first)]).reshape(-1, 3)
    neighbour, edge_owned = _edge_neighbours(t)
    corners = t.reshape(-1)
    order = np.argsort(corners, kind="stable")
    start = np.concatenate([[0], np.cumsum(np.bincount(corners, minlength=vertex_first[-1]))])
    ring = order // 3
    owner = np.full(vertex_first[-1], -1)
    used = start[1:] > start[:-1]
    owner[used] = ring[start[:-1][used]]  # the first triangle around a vertex
    corner_owned = owner[t] == np.arange(len(t))[:, None]
    bits = np.concatenate([corner_owned, edge_owned], axis=1) @ (1 << np.arange(6))
    body, node = owners(np.diff(first)), np.concatenate([nodes for _, nodes in parts])
    adjacent = _adjacent_vertices(t, vertex_first[-1])
    return Topology(t, body, first, vertex_first, node, neighbour, bits, start, ring, *adjacent)


def _adjacent_vertices(t: np.ndarray, n_verts: int) -> tuple[np.ndarray, np.ndarray]:
    """Return the start of each vertex's list (n_verts + 1,), and the adjacent vertices, ascending."""
    ends = t[:, [0, 1, 1, 2, 2, 0]].reshape(-1, 2)
    code = np.unique(np.concatenate([ends, ends[:, ::-1]]) @ [n_verts, 1])
    return np.searchsorted(code, np.arange(n_verts + 1) * n_verts), code % max(n_verts, 1)


def _edge_neighbours(t: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return neighbours (t,3) across the edges, -1 at open and non-manifold edges; (t,3) bool: the triangle owns the edge."""
    ends = np.sort(np.stack([t, np.roll(t, -1, axis=1)], axis=2).reshape(-1, 2), axis=1)
    code = ends @ [t.max(initial=0) + 1, 1]
    order = np.argsort(code, kind="stable")
    _, starts, counts = np.unique(code[order], return_index=True, return_counts=True)
    neighbour, owned = np.full(len(order), -1), np.zeros(len(order), dtype=bool)
    a, b = order[starts[counts == 2]], order[starts[counts == 2] + 1]
    neighbour[a], neighbour[b] = b // 3, a // 3
    owned[order[starts]] = True  # the lowest triangle, since the sort is stable
    return neighbour.reshape(-1, 3), owned.reshape(-1, 3)


def body_grid(body: Body, cells: int, margin: float) -> SdfGrid:
    """Compute a body's signed distances at rest, to `margin` [m] beyond its surface but at most a quarter of its size.

    Farther out, samples add the distance to the grid. Raise MeshError, naming the body, if the grid cannot be made.
    """
    size = float(np.ptp(body.nodes.positions, axis=0).max())
    with reworded(MeshError, f"body {body.name!r}: its distance field cannot be made: "):
        return cached_sdf_grid(body.nodes.positions, body.nodes.surface, cells, margin=min(margin, 0.25 * size))


def collider_surfaces(scene: Scene, layout: Layout) -> tuple[Topology, np.ndarray]:
    """Return the triangles of all colliders, and their (v,3) rest vertices [m], those of obstacles as given."""
    parts, rest = [], []
    for k, body in enumerate(scene.bodies):
        nodes, triangles = np.unique(body.nodes.surface, return_inverse=True)
        parts.append((triangles.reshape(-1, 3), nodes + layout.node_start[k]))
        rest.append(body.nodes.positions[nodes])
    for obstacle in scene.obstacles:
        vertices, triangles = obstacle.shape.surface() or (np.zeros((0, 3)), np.zeros((0, 3), dtype=np.int64))
        parts.append((triangles, np.full(len(vertices), -1)))
        rest.append(vertices)
    return make_topology(parts), np.concatenate(rest)


def prescribed_vertices(topology: Topology, nodes: np.ndarray, moves: np.ndarray) -> np.ndarray:
    """Return the prescribed displacements of vertices (v,3) [m], nan where free. nodes: (k,) of the model; moves: (k,3) [m]."""
    displacements = np.full((len(topology.node), 3), np.nan)
    surface_vertices = np.flatnonzero(topology.node >= 0)
    vertex_of_node = np.full(max(topology.node.max(initial=-1), np.max(nodes, initial=-1)) + 1, -1)
    vertex_of_node[topology.node[surface_vertices]] = surface_vertices
    on_surface = vertex_of_node[nodes] >= 0  # without interior nodes
    displacements[vertex_of_node[nodes[on_surface]]] = moves[on_surface]
    return displacements


def collider_thickness(collider: Body | Obstacle, edge: float) -> float:
    """Return the thickness of a body or an obstacle [m]: infinite for a half-space, else its smallest extent.

    Since a bowl or a ring is thinner than its box, no surface is thicker than twice a plate of its volume and area.
    """
    if isinstance(collider, Body):
        return _surface_thickness(collider.nodes.positions, collider.nodes.surface)
    if isinstance(collider.shape, HalfSpace):
        return np.inf
    if isinstance(collider.shape, MeshObstacle):  # an open mesh has no volume
        return max(_surface_thickness(collider.shape.vertices, collider.shape.triangles), MIN_THICKNESS * edge)
    if isinstance(collider.shape, Box):
        return 2.0 * float(np.min(collider.shape.half_extents))
    return 2.0 * float(collider.shape.radius)


def _surface_thickness(x: np.ndarray, triangles: np.ndarray) -> float:
    """Thickness [m] of a surface with vertices x (v,3) [m]."""
    a, b, c = (x[triangles[:, k]] - x.mean(axis=0) for k in range(3))
    cross = np.cross(b - a, c - a)
    volume, area = abs(np.einsum("ij,ij->", a, cross)) / 6.0, 0.5 * np.linalg.norm(cross, axis=1).sum()
    return min(float(principal_extents(x, triangles).min()), 4.0 * volume / area)
