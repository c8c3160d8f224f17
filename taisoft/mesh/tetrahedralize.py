"""A surface filled with tets by fTetWild, which the extra `mesh` brings (wildmeshing, MPL 2.0).

It takes surfaces with faults too, keeps within an envelope round them, and decides by winding numbers what is inside. It
prints at length, and may end its process on what it cannot do: so it runs in a process of its own.
Source: Hu, Schneider, Wang, Zorin, Panozzo 2020, Fast tetrahedral meshing in the wild.
"""

import os
import subprocess
import sys
import tempfile
import warnings
from importlib.util import find_spec
from pathlib import Path

import numpy as np

from taisoft.errors import MeshError
from taisoft.mesh.content import one_line
from taisoft.mesh.surface_mesh import INWARD, SurfaceMesh
from taisoft.mesh.tet_mesh import TetMesh

EDGES_PER_DIAGONAL = 20  # where no length is given
ENVELOPE = 0.1  # of the edge length
QUALITY = 10.0  # AMIPS energy that no tet should be above: 3 is a regular tet
ROUNDS = 80  # of optimisation at most


def tetrahedralize(surface: SurfaceMesh, edge_length: float | None = None, envelope: float | None = None) -> TetMesh:
    """A tetrahedral mesh of what the surface encloses.

    edge_length: of the tets [m], about; None for a twentieth of the diagonal. envelope: how far the new surface may lie from the
    old one [m]; None for a tenth of edge_length. Faults of the surface are told as a warning. Raises MeshError where the
    extra `mesh` is missing, nothing is enclosed, or the mesher fails.
    """
    if not isinstance(surface, SurfaceMesh):
        raise MeshError(f"tetrahedralize needs a SurfaceMesh (see read_surface), not {type(surface).__name__}")
    name, diagonal = surface.source, float(np.linalg.norm(np.ptp(surface.vertices, axis=0)))
    edge_length = _length(name, "edge_length", edge_length, diagonal / EDGES_PER_DIAGONAL, diagonal)
    envelope = _length(name, "envelope", envelope, ENVELOPE * edge_length, diagonal)
    if find_spec("wildmeshing") is None:
        raise MeshError(f"{name}: tetrahedralize needs the package wildmeshing: pip install 'taisoft[mesh]'")
    faults = surface.faults()
    for text in faults:
        warnings.warn(f"{name}: {text}", UserWarning, stacklevel=2)
    inward = faults == [INWARD]
    triangles = surface.triangles[:, ::-1] if inward else surface.triangles
    vertices, tets = _in_a_process(name, surface.vertices, triangles, edge_length / diagonal, envelope / diagonal)
    if len(tets) == 0:
        raise MeshError(f"{name}: the surface encloses nothing: no tets were made")
    edges = vertices[tets[:, 1:]] - vertices[tets[:, :1]]
    turned = np.linalg.det(edges) < 0
    tets[turned] = tets[turned][:, [0, 2, 1, 3]]
    used, inverse = np.unique(tets, return_inverse=True)
    mesh = TetMesh(vertices[used], inverse.reshape(-1, 4), source=name)
    lost = abs(mesh.volumes.sum() - abs(surface.volume))
    if (inward or not faults) and lost > envelope * surface.area:
        raise MeshError(
            f"{name}: the tets fill {mesh.volumes.sum():.4g} m^3 of {abs(surface.volume):.4g}, more off than an envelope of "
            f"{envelope:.3g} m allows: take a smaller edge_length"
        )
    return mesh


def _length(name: str, what: str, value, default: float, diagonal: float) -> float:
    if value is None:
        return default
    if isinstance(value, bool) or not isinstance(value, (int, float, np.number)) or not 0.0 < value < diagonal:
        raise MeshError(f"{name}: {what} must be a length above 0 and below the diagonal, {diagonal:.4g} m, not {value!r}")
    return float(value)


def _in_a_process(name: str, vertices: np.ndarray, triangles: np.ndarray, length: float, envelope: float):
    """Vertices (n,3) and tets (m,4); length and envelope as parts of the diagonal."""
    middle = vertices.mean(axis=0)  # far from the origin digits would be lost
    with tempfile.TemporaryDirectory(prefix="taisoft-") as folder:
        given, made = Path(folder, "surface.npz"), Path(folder, "tets.npz")
        np.savez(given, vertices=vertices - middle, triangles=triangles, numbers=(length, envelope))
        command = [sys.executable, "-c", f"import {__name__} as m; m._mesh({str(given)!r}, {str(made)!r})"]
        path = os.pathsep.join([str(Path(__file__).resolve().parents[2]), os.environ.get("PYTHONPATH", "")])
        child = subprocess.Popen(
            command, stdin=subprocess.DEVNULL, stdout=subprocess.DEVNULL, stderr=subprocess.PIPE, cwd=folder,
            env=os.environ | {"PYTHONPATH": path},
        )  # fmt: skip
        try:
            told = child.communicate()[1]
        finally:  # a signal must not leave it behind
            child.kill()
            child.wait()
        if child.returncode != 0 or not made.is_file():
            lines = told.decode("utf-8", "replace").split("\n")
            said = next((line for line in reversed(lines) if line.strip()), f"exit status {child.returncode}")
            raise MeshError(f"{name}: the mesher failed: {one_line(said)}")
        with np.load(made, allow_pickle=False) as found:
            return found["vertices"] + middle, found["tets"]


def _mesh(given: str, made: str) -> None:
    """What the process does."""
    import wildmeshing

    with np.load(given, allow_pickle=False) as surface:
        vertices, triangles, (length, envelope) = surface["vertices"], surface["triangles"], surface["numbers"]
    mesher = wildmeshing.Tetrahedralizer(
        stop_quality=QUALITY, max_its=ROUNDS, edge_length_r=float(length), epsilon=float(envelope)
    )
    mesher.set_log_level(6)
    mesher.set_mesh(vertices, triangles.astype(np.int32))
    mesher.tetrahedralize()
    found, tets, _ = mesher.get_tet_mesh()
    np.savez(made, vertices=np.asarray(found, dtype=np.float64), tets=np.asarray(tets, dtype=np.int64))
