"""How thick a mesh is below its surface, and how far too stiffly linear tets bend there.

A ray goes inwards from the middle of every surface triangle, along its normal, from tet to tet until it comes out: its
length is the thickness t there. Each tet that it crosses counts for the ray's length in it over the tet's extent along the
ray, which sums to the number of layers n: of a grid, the number of its cells. The triangle's edges a, b, c give the length
of the tets across, h^2 = (a^2 + b^2 + c^2) / 4, of a rectangular cell half the square of its diagonal.

A linear tet has one strain where bending needs one that changes sign through the thickness, so thin parts bend too
stiffly, by about 1 + LAYERS / n^2 + LENGTH h^2 / t^2. The two numbers are fitted to cantilevers of 1 to 4 layers, cells 1/8
to 10 times as long as the beam is thick, both patterns of `box_mesh`, and Poisson's ratios of 0 and 0.3: the estimate is
0.6 to 1.4 times what they show. Weak: ratios above 0.4 are stiffer still, and since it is not known which way a part
will bend, the triangle's edges count alike.
"""

from dataclasses import dataclass
from weakref import WeakKeyDictionary

import numpy as np

from taisoft.mesh.tet_mesh import TetMesh
from taisoft.mesh.topology import TET_FACES, Faces, connected_pieces

LAYERS, LENGTH = 1.5, 1.4  # of the estimate above
MOST_RAYS = 20_000  # of a larger surface every second triangle has one, or every third, ...
MOST_TETS = 24  # that a ray crosses before it is given up: what is behind so many is not thin in tets
SLENDER = 2.5  # a part bends where the body's length is at least so many times its thickness
TOO_STIFF = 2.0  # times too stiff: what bends less than half as far as it should is told
SHARE = 0.5  # of the surface over which a body must be thin and too stiff


@dataclass(frozen=True)
class Bending:
    """Where linear tets bend too stiffly. stiffness: how many times, about; layers: of tets through the thickness, about."""

    stiffness: float
    layers: float


_found: "WeakKeyDictionary[TetMesh, Bending | None]" = WeakKeyDictionary()  # of meshes, which never change


def coarse_bending(mesh: TetMesh) -> Bending | None:
    """The medians over the surface where the mesh is thin and too stiff for linear tets; None where that is less than half.

    The same whatever the mesh's place, size and turn, and the order of its vertices and tets.
    """
    if mesh not in _found:
        _found[mesh] = _coarse_bending(mesh)
    return _found[mesh]


def _coarse_bending(mesh: TetMesh) -> Bending | None:
    some = np.arange(0, len(mesh.surface), -(-len(mesh.surface) // MOST_RAYS))
    thickness, layers = measure_thickness(mesh, some)
    if not np.isfinite(thickness).any():
        return None
    a, b, c = np.moveaxis(mesh.vertices[mesh.surface[some]], 1, 0)
    h2 = sum(((p - q) ** 2).sum(axis=1) for p, q in ((a, b), (b, c), (c, a))) / 4.0
    stiffness = 1.0 + LAYERS / layers**2 + LENGTH * h2 / thickness**2  # 1 where the thickness is infinite
    coarse = (SLENDER * thickness <= _lengths(mesh)[some]) & (stiffness >= TOO_STIFF)
    areas = np.linalg.norm(np.cross(b - a, c - a), axis=1)
    if areas[coarse].sum() < SHARE * areas.sum():
        return None
    return Bending(*(_median(values[coarse], areas[coarse]) for values in (stiffness, layers)))


def measure_thickness(mesh: TetMesh, triangles: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Thickness [m] and layers of tets (k,) below surface triangles (k,); infinite both behind more than MOST_TETS."""
    one, other = Faces(mesh.tets).pairs().T
    behind = np.full(4 * mesh.n_tets, -1)  # the row of a face's other side
    behind[one], behind[other] = other, one
    a, b, c = np.moveaxis(mesh.vertices[mesh.surface[triangles]], 1, 0)
    start = (a + b + c) / 3.0
    inward = -np.cross(b - a, c - a)
    inward /= np.linalg.norm(inward, axis=1, keepdims=True)
    n = len(triangles)
    thickness, layers, length, count = np.full(n, np.inf), np.full(n, np.inf), np.zeros(n), np.zeros(n)
    ray, tet = np.arange(n), mesh.surface_tets[triangles]
    for _ in range(MOST_TETS):
        corners = mesh.vertices[mesh.tets[tet]] - start[ray][:, None]
        along = np.einsum("rij,rj->ri", corners, inward[ray])
        out, face = _leaves(corners, inward[ray])
        out = np.maximum(out, length)
        count = count + (out - length) / (along.max(axis=1) - along.min(axis=1))
        across = behind[4 * tet + face]
        ended = across < 0
        thickness[ray[ended]], layers[ray[ended]] = out[ended], count[ended]
        ray, tet, length, count = ray[~ended], across[~ended] // 4, out[~ended], count[~ended]
        if not len(ray):
            break
    return thickness, layers


def _leaves(corners: np.ndarray, direction: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Where lines from the origin leave tets: the way along unit directions (r,3), and the face; corners: (r,4,3)."""
    best, face = np.full(len(corners), np.inf), np.zeros(len(corners), dtype=np.int64)
    for k, (i, j, l) in enumerate(TET_FACES):
        normal = np.cross(corners[:, j] - corners[:, i], corners[:, l] - corners[:, i])
        speed = np.einsum("rj,rj->r", normal, direction)
        height = np.einsum("rj,rj->r", normal, corners[:, i])
        with np.errstate(divide="ignore", invalid="ignore"):
            at = np.where(speed > 0.0, height / speed, np.inf)
        nearer = at < best
        best[nearer], face[nearer] = at[nearer], k
    return best, face


def _lengths(mesh: TetMesh) -> np.ndarray:
    """For each surface triangle the length [m] of its piece: of a box with the same largest second moment of volume."""
    piece = connected_pieces(mesh.tets, mesh.n_verts)[1] if mesh.n_components > 1 else np.zeros(mesh.n_verts, dtype=int)
    of_tet, tets = piece[mesh.tets[:, 0]], mesh.tets.T
    volume = np.bincount(of_tet, mesh.volumes)
    # The integral of a function of degree 2 over a tet: 4/5 of its volume times the value in the middle, 1/20 at each corner.
    at_corners = sum(np.bincount(corner, mesh.volumes, mesh.n_verts) for corner in tets) / 20.0
    at_middles = 0.8 * mesh.volumes
    x = mesh.vertices - mesh.vertices.mean(axis=0)  # those far from the origin keep their digits
    center = np.stack([np.bincount(piece, 5.0 * at_corners * column) for column in x.T], axis=1) / volume[:, None]
    x = x - center[piece]
    middle = sum(x[corner] for corner in tets) / 4.0
    moments = np.empty((len(volume), 3, 3))
    for i, j in np.ndindex(3, 3):
        moments[:, i, j] = np.bincount(piece, at_corners * x[:, i] * x[:, j])
        moments[:, i, j] += np.bincount(of_tet, at_middles * middle[:, i] * middle[:, j])
    return np.sqrt(12.0 * np.linalg.eigvalsh(moments / volume[:, None, None])[:, -1])[piece[mesh.surface[:, 0]]]


def _median(values: np.ndarray, weights: np.ndarray) -> float:
    order = np.argsort(values)
    total = np.cumsum(weights[order])
    return float(values[order][np.searchsorted(total, 0.5 * total[-1])])
