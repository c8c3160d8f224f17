"""Guesses whether a mesh file was written in millimetres: taisoft reads every file as metres."""

import warnings

import numpy as np

from taisoft.mesh.tet_mesh import TetMesh

MILLIMETRES_ABOVE = 20.0  # longest side in file units: soft bodies of more than 20 m are rare, parts of 20 mm are not
MILLIMETRE = "--scale 0.001"  # the option that corrects it


def longest_side(vertices: np.ndarray) -> float:
    """Return the longest side of the bounding box of vertices (n,3)."""
    return float(np.ptp(vertices, axis=0).max())


def warn_millimetres(meshes: dict[str, TetMesh]) -> None:
    """Warn of each mesh, by name, that is so large as if its file were in millimetres; those made as a shape are meant so."""
    for name, mesh in meshes.items():
        longest = longest_side(mesh.vertices)
        if mesh.recipe is None and longest > MILLIMETRES_ABOVE:
            text = f"its longest side is {longest:.4g} m; was its file in millimetres? taisoft scene and tetrahedralize have"
            warnings.warn(f"mesh of {name!r}: {text} {MILLIMETRE}", UserWarning, stacklevel=2)
