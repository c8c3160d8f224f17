"""`taisoft info MESH`: what a mesh file holds, how good its tets are, and what a run would say about it."""

import warnings
from argparse import Namespace

import numpy as np

from taisoft.mesh.files import read_mesh
from taisoft.mesh.quality import edge_lengths, mean_ratio
from taisoft.mesh.tet_mesh import TetMesh

SHARP = 0.1  # mean ratio below which a tet stiffens its surroundings and slows the solver noticeably
MILLIMETRES_ABOVE = 20.0  # longest side in file units: soft bodies of more than 20 m are rare, parts of 20 mm are not
TINY_BELOW = 1e-3  # soft bodies under 1 mm are rare


def command(arguments: Namespace) -> int:
    """Prints counts, size, a guess at the unit, quality and problems. Raises MeshError if the file is no tet mesh."""
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", UserWarning)  # they are listed as problems below
        mesh = read_mesh(arguments.mesh)
    print(arguments.mesh)
    for name, text in describe(mesh):
        print(f"  {name:<10} {text}")
    return 0


def describe(mesh: TetMesh) -> list[tuple[str, str]]:
    """(name, text) lines about a mesh; lengths in the file's own unit."""
    low, high = mesh.vertices.min(axis=0), mesh.vertices.max(axis=0)
    lengths = edge_lengths(mesh.vertices, mesh.tets)
    quality = mean_ratio(lengths, mesh.volumes)
    pieces = "1 piece" if mesh.n_components == 1 else f"{mesh.n_components} pieces"
    lines = [
        ("counts", f"{mesh.n_verts} vertices, {mesh.n_tets} tets, {len(mesh.surface)} surface triangles, {pieces}"),
        ("box", f"{_triple(low)} to {_triple(high)}, size {_triple(high - low)}"),
        ("unit", unit_guess(float((high - low).max()))),
        ("volume", f"{mesh.volumes.sum():.6g}"),
        ("edges", f"{lengths.min():.4g} to {lengths.max():.4g}, median {np.median(lengths):.4g}"),
        (
            "quality",
            f"mean ratio {quality.min():.3f} (tet {quality.argmin()}) to {quality.max():.3f}, median"
            f" {np.median(quality):.3f}; 1 is a regular tet, {np.count_nonzero(quality < SHARP)} are below {SHARP}",
        ),
    ]
    problems = mesh.warnings or ["none"]
    return lines + [("problems" if i == 0 else "", problem) for i, problem in enumerate(problems)]


def unit_guess(longest: float) -> str:
    """A guess at the unit of the file from its longest side; taisoft itself reads every file as metres."""
    if longest > MILLIMETRES_ABOVE:
        return f"read as metres, the longest side is {longest:.4g} m; probably millimetres: scale by 0.001"
    if longest < TINY_BELOW:
        return f"read as metres, the longest side is {longest:.4g} m; very small: is the file scaled?"
    return f"metres, probably (longest side {longest:.4g} m)"


def _triple(values: np.ndarray) -> str:
    return "(" + ", ".join(f"{value:.5g}" for value in values) + ")"
