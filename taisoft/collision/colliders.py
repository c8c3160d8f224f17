"""Surfaces, frames and sizes of the scene's colliders (bodies, then obstacles) for contact detection, on the host."""

import numpy as np

from taisoft.collision.surface import Topology, make_topology
from taisoft.errors import MeshError
from taisoft.fem.model import Layout
from taisoft.mesh.sdf import SdfGrid, cached_sdf_grid
from taisoft.mesh.tet_mesh import mean_surface_edge
from taisoft.scene.body import Body
from taisoft.scene.collision import principal_extents
from taisoft.scene.obstacles import Box, HalfSpace, MeshObstacle, Obstacle
from taisoft.scene.scene import Scene

MIN_THICKNESS = 0.25  # of the mean surface edge: minimum thickness of a mesh obstacle, since open meshes have none


def body_grid(body: Body, cells: int, margin: float) -> SdfGrid:
    """Compute a body's signed distances at rest, to `margin` [m] beyond its surface but at most a quarter of its size.

    Farther out, samples add the distance to the grid. Raise MeshError, naming the body, if the grid cannot be made.
    """
    size = float(np.ptp(body.nodes.positions, axis=0).max())
    try:
        return cached_sdf_grid(body.nodes.positions, body.nodes.surface, cells, margin=min(margin, 0.25 * size))
    except MeshError as error:
        raise MeshError(f"body {body.name!r}: its distance field cannot be made: {error}") from None


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


def obstacle_frame(obstacle: Obstacle, t: float) -> tuple[np.ndarray, np.ndarray]:
    """Return origin (3,) [m] and rotation (3,3) of an obstacle's own frame at time t [s]."""
    translation, rotation = obstacle.pose(t)
    return obstacle.shape.pivot + translation, rotation @ obstacle.shape.frame()


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


def collider_edge(collider: Body | Obstacle) -> float:
    """Return the mean surface edge of a body [m]; infinite for an obstacle, however fine."""
    if isinstance(collider, Body):
        return mean_surface_edge([(collider.nodes.positions, collider.nodes.surface)])
    return np.inf
