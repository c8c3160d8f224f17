"""The scene's colliders, bodies and then obstacles, as the search sees them: surfaces and frames. On the host."""

import numpy as np

from taisoft.collision.surface import Topology, make_topology
from taisoft.errors import MeshError
from taisoft.mesh.quality import mean_surface_edge
from taisoft.mesh.sdf_grid import SdfGrid, cached_sdf_grid
from taisoft.model import Layout
from taisoft.scene.body import Body
from taisoft.scene.collision import principal_extents
from taisoft.scene.obstacles import Box, HalfSpace, MeshObstacle, Obstacle
from taisoft.scene.scene import Scene

THINNEST = 0.25  # of the mean surface edge: least thickness of a collider, since open meshes have none


def body_grid(body: Body, cells: int, margin: float) -> SdfGrid:
    """A body's signed distances at rest, to `margin` [m] beyond its surface but no farther than a quarter of its size.

    Farther out a sample adds the way to the grid. Raises MeshError, naming the body, where the grid cannot be made.
    """
    size = float(np.ptp(body.nodes.positions, axis=0).max())
    try:
        return cached_sdf_grid(body.nodes.positions, body.nodes.surface, cells, margin=min(margin, 0.25 * size))
    except MeshError as error:
        raise MeshError(f"body {body.name!r}: its distance field cannot be made: {error}") from None


def collider_surfaces(scene: Scene, layout: Layout) -> tuple[Topology, np.ndarray]:
    """Triangles of all colliders, and (v,3) their vertices at rest [m]: of obstacles where they were given."""
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
    """Origin (3,) [m] and rotation (3,3) of an obstacle's own frame at a time."""
    translation, rotation = obstacle.pose(t)
    return obstacle.shape.pivot + translation, rotation @ obstacle.shape.frame()


def prescribed_vertices(topology: Topology, nodes: np.ndarray, moves: np.ndarray) -> np.ndarray:
    """(v,3) [m]: how far each vertex is led, nan where it is not. nodes (k,): of the model; moves (k,3) [m], nan likewise."""
    whole = np.full((len(topology.node), 3), np.nan)
    on = np.flatnonzero(topology.node >= 0)
    where = np.full(max(topology.node.max(initial=-1), np.max(nodes, initial=-1)) + 1, -1)
    where[topology.node[on]] = on
    prescribed = where[nodes] >= 0  # not those inside
    whole[where[nodes[prescribed]]] = moves[prescribed]
    return whole


def collider_thickness(collider: Body | Obstacle, edge: float) -> float:
    """How thick a body or an obstacle is [m]: a half space without end, others their smallest extent.

    A bowl or a ring is thinner than its box: no surface counts as thicker than twice the plate of its volume and area.
    """
    if isinstance(collider, Body):
        return _surface_thickness(collider.nodes.positions, collider.nodes.surface)
    if isinstance(collider.shape, HalfSpace):
        return np.inf
    if isinstance(collider.shape, MeshObstacle):  # an open one has none
        return max(_surface_thickness(collider.shape.vertices, collider.shape.triangles), THINNEST * edge)
    if isinstance(collider.shape, Box):
        return 2.0 * float(np.min(collider.shape.half_extents))
    return 2.0 * float(collider.shape.radius)


def _surface_thickness(x: np.ndarray, triangles: np.ndarray) -> float:
    """[m], of a surface with vertices x."""
    a, b, c = (x[triangles[:, k]] - x.mean(axis=0) for k in range(3))
    cross = np.cross(b - a, c - a)
    volume, area = abs(np.einsum("ij,ij->", a, cross)) / 6.0, 0.5 * np.linalg.norm(cross, axis=1).sum()
    return min(float(principal_extents(x, triangles).min()), 4.0 * volume / area)


def collider_edge(collider: Body | Obstacle) -> float:
    """Mean surface edge of a body [m]; of an obstacle, however fine, without end."""
    if isinstance(collider, Body):
        return mean_surface_edge([(collider.nodes.positions, collider.nodes.surface)])
    return np.inf
