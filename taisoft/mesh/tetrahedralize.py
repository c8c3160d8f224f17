"""Fill a surface with tets by fTetWild (package wildmeshing, MPL 2.0, installed by the extra `mesh`).

fTetWild accepts faulty surfaces, stays within an envelope around them, and finds the inside by winding numbers. It prints a
lot and may end its process on failure, so it runs in a subprocess.
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

EDGES_PER_DIAGONAL = 20  # default edge length: the diagonal over this
ENVELOPE = 0.1  # default envelope over the edge length
QUALITY = 10.0  # target upper bound of the tets' AMIPS energy: 3 for a regular tet
MAX_ITERATIONS = 80  # maximum number of optimisation iterations


def tetrahedralize(surface: SurfaceMesh, edge_length: float | None = None, envelope: float | None = None) -> TetMesh:
    """Return a tetrahedral mesh of the volume enclosed by a surface.

    edge_length: approximate edge length of the tets [m]; None for a twentieth of the diagonal. envelope: largest distance [m]
    of the new surface from the old one; None for a tenth of edge_length. Warns of the surface's faults. Raises MeshError if the
    extra `mesh` is missing, nothing is enclosed, or the mesher fails.
    """
    if not isinstance(surface, SurfaceMesh):
        raise MeshError(f"tetrahedralize needs a SurfaceMesh (see read_surface), not {type(surface).__name__}")
    name, diagonal = surface.source, float(np.linalg.norm(np.ptp(surface.vertices, axis=0)))
    edge_length = _checked_length(name, "edge_length", edge_length, diagonal / EDGES_PER_DIAGONAL, diagonal)
    envelope = _checked_length(name, "envelope", envelope, ENVELOPE * edge_length, diagonal)
    if find_spec("wildmeshing") is None:
        raise MeshError(f"{name}: tetrahedralize needs the package wildmeshing: pip install 'taisoft[mesh]'")
    faults = surface.faults()
    for text in faults:
        warnings.warn(f"{name}: {text}", UserWarning, stacklevel=2)
    inward = faults == [INWARD]
    triangles = surface.triangles[:, ::-1] if inward else surface.triangles
    vertices, tets = _run_mesher(name, surface.vertices, triangles, edge_length / diagonal, envelope / diagonal)
    if len(tets) == 0:
        raise MeshError(f"{name}: the surface encloses nothing: no tets were made")
    edges = vertices[tets[:, 1:]] - vertices[tets[:, :1]]
    inverted = np.linalg.det(edges) < 0
    tets[inverted] = tets[inverted][:, [0, 2, 1, 3]]
    used, inverse = np.unique(tets, return_inverse=True)
    mesh = TetMesh(vertices[used], inverse.reshape(-1, 4), source=name)
    volume_error = abs(mesh.volumes.sum() - abs(surface.volume))
    if (inward or not faults) and volume_error > envelope * surface.area:
        raise MeshError(
            f"{name}: the tets fill {mesh.volumes.sum():.4g} m^3 of {abs(surface.volume):.4g}, a larger difference than an "
            f"envelope of {envelope:.3g} m allows: use a smaller edge_length"
        )
    return mesh


def _checked_length(name: str, what: str, value, default: float, diagonal: float) -> float:
    if value is None:
        return default
    if isinstance(value, bool) or not isinstance(value, (int, float, np.number)) or not 0.0 < value < diagonal:
        raise MeshError(f"{name}: {what} must be a length above 0 and below the diagonal, {diagonal:.4g} m, not {value!r}")
    return float(value)


def _run_mesher(name: str, vertices: np.ndarray, triangles: np.ndarray, length: float, envelope: float):
    """Run the mesher in a subprocess; return vertices (n,3) and tets (m,4). length, envelope: fractions of the diagonal."""
    center = vertices.mean(axis=0)  # centre the surface: far from the origin digits are lost
    with tempfile.TemporaryDirectory(prefix="taisoft-") as folder:
        source, result = Path(folder, "surface.npz"), Path(folder, "tets.npz")
        np.savez(source, vertices=vertices - center, triangles=triangles, numbers=(length, envelope))
        command = [sys.executable, "-c", f"import {__name__} as m; m._mesh({str(source)!r}, {str(result)!r})"]
        path = os.pathsep.join([str(Path(__file__).resolve().parents[2]), os.environ.get("PYTHONPATH", "")])
        child = subprocess.Popen(
            command,
            stdin=subprocess.DEVNULL,
            stdout=subprocess.DEVNULL,
            stderr=subprocess.PIPE,
            cwd=folder,
            env=os.environ | {"PYTHONPATH": path},
        )
        try:
            stderr = child.communicate()[1]
        finally:  # do not leave the process running after a signal
            child.kill()
            child.wait()
        if child.returncode != 0 or not result.is_file():
            lines = stderr.decode("utf-8", "replace").split("\n")
            message = next((line for line in reversed(lines) if line.strip()), f"exit status {child.returncode}")
            raise MeshError(f"{name}: the mesher failed: {one_line(message)}")
        with np.load(result, allow_pickle=False) as found:
            return found["vertices"] + center, found["tets"]


def _mesh(source: str, result: str) -> None:
    """Entry point of the subprocess: read a surface from `source`, write its tets to `result`."""
    import wildmeshing

    with np.load(source, allow_pickle=False) as surface:
        vertices, triangles, (length, envelope) = surface["vertices"], surface["triangles"], surface["numbers"]
    mesher = wildmeshing.Tetrahedralizer(
        stop_quality=QUALITY, max_its=MAX_ITERATIONS, edge_length_r=float(length), epsilon=float(envelope)
    )
    mesher.set_log_level(6)
    mesher.set_mesh(vertices, triangles.astype(np.int32))
    mesher.tetrahedralize()
    points, tets, _ = mesher.get_tet_mesh()
    np.savez(result, vertices=np.asarray(points, dtype=np.float64), tets=np.asarray(tets, dtype=np.int64))
