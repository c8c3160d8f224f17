"""`taisoft info MESH`: a mesh file's contents, the quality of its tets, and the warnings a run would give.

For a surface: why it does not bound a solid, and how to fill it with tets.
"""

import shlex
import warnings
from argparse import Namespace
from pathlib import Path

import numpy as np

from taisoft.mesh.files import read_mesh
from taisoft.mesh.surface_mesh import FORMATS, SurfaceMesh, read_surface
from taisoft.mesh.tet_mesh import TetMesh, edge_lengths, mean_ratio

POOR_QUALITY = 0.1  # mean ratio below which a tet stiffens its surroundings and slows the solver noticeably
MILLIMETRES_ABOVE = 20.0  # longest side in file units: soft bodies of more than 20 m are rare, parts of 20 mm are not
TINY_BELOW = 1e-3  # soft bodies under 1 mm are rare


def command(arguments: Namespace) -> int:
    """Print counts, size, likely unit, quality and problems. Raises MeshError if the file is not a mesh."""
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", UserWarning)  # they are listed as problems below
        if Path(arguments.mesh).suffix.lower() in FORMATS:
            lines = describe_surface(read_surface(arguments.mesh))
        else:
            lines = describe(read_mesh(arguments.mesh))
    print(arguments.mesh)
    for name, text in lines:
        print(f"  {name:<10} {text}")
    return 0


def describe_surface(surface: SurfaceMesh) -> list[tuple[str, str]]:
    """Return (name, text) lines about a surface; lengths in the file's own unit."""
    x, faults = surface.vertices, surface.faults()
    a, b, c = np.moveaxis(x[surface.triangles], 1, 0)
    lengths = np.concatenate([np.linalg.norm(p - q, axis=1) for p, q in ((a, b), (b, c), (c, a))])
    pieces = "1 piece" if surface.n_pieces == 1 else f"{surface.n_pieces} pieces"
    lines = _head(f"{len(x)} vertices, {len(surface.triangles)} triangles, {pieces}; no tets", x)
    lines += [
        ("area", f"{surface.area:.6g}"),
        ("volume", f"{surface.volume:.6g}" if surface.closed else "none, it is open"),
        ("edges", f"{lengths.min():.4g} to {lengths.max():.4g}, median {np.median(lengths):.4g}"),
    ]
    lines += _listed("problems", [*surface.warnings, *faults])
    mesh_name = f"{Path(surface.source).stem}.msh"
    return lines + [("next", f"fill it with tets: taisoft tetrahedralize {shlex.join([surface.source, '--out', mesh_name])}")]


def _head(counts: str, vertices: np.ndarray) -> list[tuple[str, str]]:
    low, high = vertices.min(axis=0), vertices.max(axis=0)
    return [
        ("counts", counts),
        ("box", f"{_triple(low)} to {_triple(high)}, size {_triple(high - low)}"),
        ("unit", unit_guess(float((high - low).max()))),
    ]


def _listed(name: str, texts: list[str]) -> list[tuple[str, str]]:
    return [(name if i == 0 else "", text) for i, text in enumerate(texts or ["none"])]


def describe(mesh: TetMesh) -> list[tuple[str, str]]:
    """Return (name, text) lines about a mesh; lengths in the file's own unit."""
    lengths = edge_lengths(mesh.vertices, mesh.tets)
    quality = mean_ratio(lengths, mesh.volumes)
    pieces = "1 piece" if mesh.n_components == 1 else f"{mesh.n_components} pieces"
    counts = f"{mesh.n_verts} vertices, {mesh.n_tets} tets, {len(mesh.surface)} surface triangles, {pieces}"
    lines = _head(counts, mesh.vertices) + [
        ("volume", f"{mesh.volumes.sum():.6g}"),
        ("edges", f"{lengths.min():.4g} to {lengths.max():.4g}, median {np.median(lengths):.4g}"),
        (
            "quality",
            f"mean ratio {quality.min():.3f} (tet {quality.argmin()}) to {quality.max():.3f}, median"
            f" {np.median(quality):.3f}; 1 is a regular tet, {np.count_nonzero(quality < POOR_QUALITY)} are below {POOR_QUALITY}",
        ),
    ]
    return lines + _listed("problems", mesh.warnings)


def unit_guess(longest: float) -> str:
    """Guess the unit of a file from its longest side; taisoft itself reads every file as metres."""
    if longest > MILLIMETRES_ABOVE:
        return f"read as metres, the longest side is {longest:.4g} m; probably millimetres: scale by 0.001"
    if longest < TINY_BELOW:
        return f"read as metres, the longest side is {longest:.4g} m; very small: is the file scaled?"
    return f"metres, probably (longest side {longest:.4g} m)"


def _triple(values: np.ndarray) -> str:
    return "(" + ", ".join(f"{value:.5g}" for value in values) + ")"
