"""Shapes and poses of a robot's geoms as obstacles."""

import warnings
from typing import TYPE_CHECKING, Any

import numpy as np
from scipy.spatial import ConvexHull

from taisoft.errors import SceneError
from taisoft.mesh.shapes import ball_mesh
from taisoft.mesh.topology import normals_and_heights
from taisoft.scene.obstacles import DEGENERATE, Box, Capsule, HalfSpace, MeshObstacle, Shape, Sphere

if TYPE_CHECKING:
    from taisoft.scene.robot import PlacedRobot

AROUND = 48  # edges of a cylinder's circle, whose radius is then short by 0.2 % between its corners
BALL_CELLS = 12  # of the ball that an ellipsoid is made of


def placed_pose(placed: "PlacedRobot", shape: Shape, data: Any, geom: int) -> tuple[np.ndarray, np.ndarray]:
    """Return translation (3,) [m] and rotation (3,3), about the shape's pivot, of a geom at MuJoCo's present data."""
    rotation = placed.axes @ data.geom_xmat[geom].reshape(3, 3)
    return placed.position + placed.axes @ data.geom_xpos[geom] + rotation @ shape.pivot - shape.pivot, rotation


def shape_of(model: Any, geom: int, what: str) -> Shape:
    """Return a geom's shape in the geom's own frame. what: start of messages. Raises SceneError for one that is not supported."""
    from mujoco import mjtGeom

    kind, (a, b, c), zero = model.geom_type[geom], model.geom_size[geom].tolist(), np.zeros(3)
    if kind == mjtGeom.mjGEOM_PLANE:
        return HalfSpace(zero, (0.0, 0.0, 1.0))
    if kind == mjtGeom.mjGEOM_SPHERE:
        return Sphere(zero, a)
    if kind == mjtGeom.mjGEOM_CAPSULE:
        return Capsule((0.0, 0.0, -b), (0.0, 0.0, b), a)
    if kind == mjtGeom.mjGEOM_BOX:
        return Box(zero, (a, b, c))
    if kind == mjtGeom.mjGEOM_CYLINDER:
        angle = 2.0 * np.pi * np.arange(AROUND) / AROUND
        ring = np.stack([a * np.cos(angle), a * np.sin(angle), np.full(AROUND, b)], axis=1)
        return _hull(np.concatenate([ring, ring * (1.0, 1.0, -1.0)]))
    if kind == mjtGeom.mjGEOM_ELLIPSOID:
        ball = ball_mesh(1.0, BALL_CELLS)
        return _of_used(ball.vertices * (a, b, c), ball.surface)
    if kind == mjtGeom.mjGEOM_MESH:
        return _mesh(model, int(model.geom_dataid[geom]), what)
    raise SceneError(f"{what}: a geom of type {mjtGeom(kind).name} cannot be touched: leave its link out by links=")


def _mesh(model: Any, k: int, what: str) -> MeshObstacle:
    """Return a mesh as it is, without doubled vertices and triangles without area; or its convex hull."""
    first, n = model.mesh_vertadr[k], model.mesh_vertnum[k]
    vertices = model.mesh_vert[first : first + n].astype(np.float64)
    first, n = model.mesh_faceadr[k], model.mesh_facenum[k]
    vertices, where = np.unique(vertices, axis=0, return_inverse=True)
    triangles = where.reshape(-1)[model.mesh_face[first : first + n]]
    if np.linalg.det(vertices[triangles]).sum() < 0.0:  # six times the volume: it is inside out, and a solid for MuJoCo
        triangles = triangles[:, ::-1]
    try:
        return MeshObstacle(vertices, triangles[normals_and_heights(vertices, triangles)[1] > DEGENERATE])
    except SceneError as error:
        text = str(error).removeprefix("mesh obstacle: ")
        warnings.warn(f"{what}: its mesh bounds no solid ({text}): bodies touch its convex hull", UserWarning, stacklevel=4)
        return _hull(vertices)


def _hull(points: np.ndarray) -> MeshObstacle:
    """Return the convex hull of points (n,3)."""
    hull = ConvexHull(points)
    normals, heights = normals_and_heights(points, hull.simplices)
    is_inward = (normals * hull.equations[:, :3]).sum(axis=1) < 0.0
    triangles = np.where(is_inward[:, None], hull.simplices[:, ::-1], hull.simplices)
    return _of_used(points, triangles[heights > DEGENERATE])


def _of_used(vertices: np.ndarray, triangles: np.ndarray) -> MeshObstacle:
    """Return a mesh of the vertices that its triangles use."""
    used, triangles = np.unique(triangles, return_inverse=True)
    return MeshObstacle(vertices[used], triangles.reshape(-1, 3))
