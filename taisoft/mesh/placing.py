"""Place a mesh from a modelling program: its up axis, its unit, its direction and where it stands.

In this order: the file's up axis turns to that of the scene, the mesh is scaled, turned about x, then y, then z, and moved.
`FROM_Y_UP` and `UP` say what up means: a scene with z up is one with y up, turned by 90 degrees about x.
"""

import warnings

import numpy as np

from taisoft.errors import MeshError
from taisoft.mesh.surface_mesh import SurfaceMesh, as_surface
from taisoft.mesh.tet_mesh import TetMesh
from taisoft.scene.checks import choice, number, vector

TO_Y_UP = {  # up axis -> rotation (3,3) that turns it to y by 90 degrees about another axis
    "x": np.array([[0.0, -1.0, 0.0], [1.0, 0.0, 0.0], [0.0, 0.0, 1.0]]),
    "y": np.eye(3),
    "z": np.array([[1.0, 0.0, 0.0], [0.0, 0.0, 1.0], [0.0, -1.0, 0.0]]),
}
FROM_Y_UP = {up: TO_Y_UP[up].T for up in ("y", "z")}  # up axis of a scene -> rotation (3,3) that turns y to it
UP = {up: turn[:, 1] for up, turn in FROM_Y_UP.items()}  # -> unit vector (3,)


def place(mesh: TetMesh | SurfaceMesh, up: str = "y", scale: float = 1.0, rotate=(0.0, 0.0, 0.0), at=None, to: str = "y"):
    """Return a copy of a mesh or a surface, placed, with its regions, fibres, UVs and subsets.

    up: axis of the given vertices that points up, "x", "y" or "z". to: that of the scene, "y" or "z", to which it is turned: "z"
    to "y" turns (x, y, z) to (x, z, -y), "x" to "y" to (-y, x, z). scale: factor, such as 0.001 for a file in millimetres.
    rotate: (3,) angles [deg] about x, then y, then z, through the origin. at: (3,) [m], where the middle of the bounding box's
    underside goes; None: the mesh stays. Raises MeshError.
    """
    mesh = as_surface(mesh)
    if not isinstance(mesh, (TetMesh, SurfaceMesh)):
        raise MeshError(f"place needs a TetMesh or a SurfaceMesh, not {type(mesh).__name__}")
    turn = placement(up, scale, rotate, to)
    vertices, shift = mesh.vertices @ turn.T, 0.0
    if at is not None:
        shift = vector(at, "place: at", error=MeshError) - underside(vertices, to)
        vertices = vertices + shift
    if isinstance(mesh, SurfaceMesh):
        return SurfaceMesh(vertices, mesh.triangles, mesh.source, list(mesh.warnings), mesh.uvs, mesh.subsets)
    with warnings.catch_warnings(record=True) as found:
        warnings.simplefilter("always")
        fibres = None if mesh.fibres is None else mesh.fibres @ turn.T
        middles = None if mesh.mid_edge is None else mesh.mid_edge @ turn.T + shift
        labels = {"mid_edge": middles, "regions": mesh.regions, "region_names": dict(mesh.region_names), "fibres": fibres}
        labels |= {"surface_uvs": mesh.surface_uvs, "surface_subsets": mesh.surface_subsets}
        placed = TetMesh(vertices, mesh.tets, **labels, source=mesh.source)
    for warning, text in zip(found, placed.warnings):  # one for each
        if text not in mesh.warnings:
            warnings.warn(warning.message, stacklevel=2)
    return placed


def placement(up: str, scale: float, rotate, to: str) -> np.ndarray:
    """Return the matrix (3,3) of `place`. Raises MeshError."""
    from scipy.spatial.transform import Rotation

    choice(up, "place: up", TO_Y_UP, MeshError)
    choice(to, "place: to", FROM_Y_UP, MeshError)
    scale = number(scale, "place: scale", above=0.0, error=MeshError)
    angles = vector(rotate, "place: rotate", error=MeshError)
    turn = Rotation.from_euler("xyz", angles, degrees=True).as_matrix()  # about fixed axes
    whole = np.round(turn)
    turn = np.where(np.abs(turn - whole) < 1e-15, whole, turn)  # quarter turns are exact
    return scale * (turn @ FROM_Y_UP[to] @ TO_Y_UP[up])


def underside(vertices: np.ndarray, up: str) -> np.ndarray:
    """Return the middle of the lower side of the bounding box of vertices (n,3), (3,)."""
    low, high = vertices.min(axis=0), vertices.max(axis=0)
    return np.where(UP[up] > 0.0, low, 0.5 * (low + high))
