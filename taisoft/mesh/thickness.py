"""Estimate a mesh's thickness below its surface, and by how much linear tets are too stiff in bending there.

A ray runs inwards from the centroid of every surface triangle, against its normal, from tet to tet until it leaves the
mesh. Its length is the local thickness t. Each crossed tet contributes the ray's length in it over the tet's extent along the
ray; the sum is the number of layers n, on a grid the number of its cells. The triangle's edges a, b, c give the tangential size
of the tets, h^2 = (a^2 + b^2 + c^2) / 4; for a rectangular cell this is half the square of its diagonal.

A linear tet has constant strain, but bending strain changes sign through the thickness. Thin parts are therefore too stiff in
bending, by a factor of about 1 + LAYERS / n^2 + LENGTH h^2 / t^2. The two coefficients are fitted to cantilevers of 1 to 4
layers, cells 1/8 to 10 times as long as the beam is thick, both patterns of `box_mesh`, and Poisson's ratios of 0 and 0.3; the
estimate is 0.6 to 1.4 times the measured factor. Weak: ratios above 0.4 are even stiffer, and the direction of bending is
unknown, so the triangle's edges have equal weight.
"""

from dataclasses import dataclass
from weakref import WeakKeyDictionary

import numpy as np

from taisoft.mesh.quality import volume_moments
from taisoft.mesh.tet_mesh import TetMesh
from taisoft.mesh.topology import TET_FACES, Faces, connected_pieces

LAYERS, LENGTH = 1.5, 1.4  # coefficients of the estimate above
MAX_RAYS = 20_000  # on larger surfaces only every second, third, ... triangle has a ray
MAX_CROSSED_TETS = 24  # maximum number of tets that a ray crosses; with more layers a part is not thin
MIN_SLENDERNESS = 2.5  # smallest length over thickness of a part that bends
MIN_STIFFNESS = 2.0  # stiffness factor from which a warning is issued: deflections are halved
MIN_FRACTION = 0.5  # smallest fraction of the surface that must be thin and too stiff


@dataclass(frozen=True)
class Bending:
    """Approximate bending error. stiffness: factor by which linear tets are too stiff; layers: tets through the thickness."""

    stiffness: float
    layers: float


_cache: "WeakKeyDictionary[TetMesh, Bending | None]" = WeakKeyDictionary()  # results by mesh; meshes are immutable


def coarse_bending(mesh: TetMesh) -> Bending | None:
    """Return area-weighted medians over the surface that is thin and too stiff with linear tets; None if it is less than half.

    Independent of the mesh's position, size and rotation, and of the order of vertices and tets.
    """
    if mesh not in _cache:
        _cache[mesh] = _coarse_bending(mesh)
    return _cache[mesh]


def _coarse_bending(mesh: TetMesh) -> Bending | None:
    sampled = np.arange(0, len(mesh.surface), -(-len(mesh.surface) // MAX_RAYS))
    thickness, layers = measure_thickness(mesh, sampled)
    if not np.isfinite(thickness).any():
        return None
    a, b, c = np.moveaxis(mesh.vertices[mesh.surface[sampled]], 1, 0)
    h2 = sum(((p - q) ** 2).sum(axis=1) for p, q in ((a, b), (b, c), (c, a))) / 4.0
    stiffness = 1.0 + LAYERS / layers**2 + LENGTH * h2 / thickness**2  # 1 if the thickness is infinite
    coarse = (MIN_SLENDERNESS * thickness <= _lengths(mesh)[sampled]) & (stiffness >= MIN_STIFFNESS)
    areas = np.linalg.norm(np.cross(b - a, c - a), axis=1)
    if areas[coarse].sum() < MIN_FRACTION * areas.sum():
        return None
    return Bending(*(_median(values[coarse], areas[coarse]) for values in (stiffness, layers)))


def measure_thickness(mesh: TetMesh, triangles: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return thickness (k,) [m] and tet layers (k,) below surface triangles (k,); both inf beyond MAX_CROSSED_TETS."""
    one, other = Faces(mesh.tets).pairs().T
    opposite = np.full(4 * mesh.n_tets, -1)  # row of the same face in the neighbouring tet
    opposite[one], opposite[other] = other, one
    a, b, c = np.moveaxis(mesh.vertices[mesh.surface[triangles]], 1, 0)
    start = (a + b + c) / 3.0
    inward = -np.cross(b - a, c - a)
    inward /= np.linalg.norm(inward, axis=1, keepdims=True)
    n = len(triangles)
    thickness, layers, length, count = np.full(n, np.inf), np.full(n, np.inf), np.zeros(n), np.zeros(n)
    ray, tet = np.arange(n), mesh.surface_tets[triangles]
    for _ in range(MAX_CROSSED_TETS):
        corners = mesh.vertices[mesh.tets[tet]] - start[ray][:, None]
        along = np.einsum("rij,rj->ri", corners, inward[ray])
        exit_length, face = _exit_points(corners, inward[ray])
        exit_length = np.maximum(exit_length, length)
        count = count + (exit_length - length) / (along.max(axis=1) - along.min(axis=1))
        across = opposite[4 * tet + face]
        ended = across < 0
        thickness[ray[ended]], layers[ray[ended]] = exit_length[ended], count[ended]
        ray, tet, length, count = ray[~ended], across[~ended] // 4, exit_length[~ended], count[~ended]
        if not len(ray):
            break
    return thickness, layers


def _exit_points(corners: np.ndarray, direction: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return where rays from the origin leave tets: distance along unit directions (r,3), and face. corners: (r,4,3)."""
    distance, face = np.full(len(corners), np.inf), np.zeros(len(corners), dtype=np.int64)
    for k, (i, j, l) in enumerate(TET_FACES):
        normal = np.cross(corners[:, j] - corners[:, i], corners[:, l] - corners[:, i])
        slope = np.einsum("rj,rj->r", normal, direction)
        height = np.einsum("rj,rj->r", normal, corners[:, i])
        with np.errstate(divide="ignore", invalid="ignore"):
            candidate = np.where(slope > 0.0, height / slope, np.inf)
        nearer = candidate < distance
        distance[nearer], face[nearer] = candidate[nearer], k
    return distance, face


def _lengths(mesh: TetMesh) -> np.ndarray:
    """Return the length [m] of each surface triangle's part: that of a box with the same largest second moment of volume."""
    part = connected_pieces(mesh.tets, mesh.n_verts)[1][mesh.surface[:, 0]]
    lengths = np.empty(len(part))
    order = np.argsort(part, kind="stable")
    for own in np.split(order, np.cumsum(np.bincount(part))[:-1]):
        used, triangles = np.unique(mesh.surface[own], return_inverse=True)
        covariance = volume_moments(mesh.vertices[used], triangles.reshape(-1, 3))[2]
        lengths[own] = np.sqrt(12.0 * np.linalg.eigvalsh(covariance)[-1])
    return lengths


def _median(values: np.ndarray, weights: np.ndarray) -> float:
    order = np.argsort(values)
    total = np.cumsum(weights[order])
    return float(values[order][np.searchsorted(total, 0.5 * total[-1])])
