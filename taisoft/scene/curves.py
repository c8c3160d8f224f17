"""Curved edges: where the mid-edge nodes of a body's surface lie at rest.

On a shape, the midpoint of an edge moves to the nearest point of the shape. On a smooth surface through the vertices, it moves
along the normals n_i, n_j of its ends, as the cubic edge of a PN triangle does,
    x = (x_i + x_j)/2 - ((x_j - x_i).n_i n_i - (x_j - x_i).n_j n_j) / 8,
and on a sharp edge along the tangents t_i, t_j of the curve of sharp edges, x = (x_i + x_j)/2 + |x_j - x_i| (t_i - t_j) / 8.
Both are scaled by a factor that tends to 1 with the angle to the edge and is exact for arcs of circles. Normals and tangents are
weighted so that those of vertices on a sphere or a circle are exact.
Sources: Vlachos, Peters, Boyd, Mitchell, Curved PN triangles, 2001; Max, Weights for computing vertex normals from facet normals,
J. Graphics Tools 4, 1999.
Weak: normals at a sharp edge see one side only, and are of first order there unless the surface is straight across it.
"""

import numpy as np
from scipy.sparse import coo_matrix
from scipy.sparse.csgraph import connected_components

from taisoft.errors import SceneError, value_text
from taisoft.mesh import quadratic
from taisoft.mesh.nodes import PARTS, Nodes
from taisoft.mesh.sdf import nearest_points
from taisoft.mesh.surface_mesh import SurfaceMesh
from taisoft.mesh.tet_mesh import TetMesh
from taisoft.mesh.topology import distinct_edges, normals_and_heights, triangle_edges
from taisoft.scene.obstacles import Capsule, Sphere

Curve = str | Sphere | Capsule | SurfaceMesh
ON_SHAPE = 0.01  # of an edge: vertices at most this far from a shape lie on it
STEEPEST = 0.9  # squared sine between an edge and the surface at its end, from which it counts as this
ALONG = 0.5  # cosine between the normals of a face and of the shape from which on the face lies on it, not across it
SHARP = np.cos(np.radians(40.0))  # cosine of the angle between faces beyond which their edge is sharp


def middle_nodes(what: str, mesh: TetMesh, order: int, curve: Curve | None) -> np.ndarray | None:
    """Return the mid-edge nodes (k,3) [m] of a body in the order of `distinct_edges`, None if all edges are straight.

    curve: as for `Scene.add_body`. what: start of messages. Raises SceneError.
    """
    if curve is not None and order == 1:
        raise SceneError(f"{what}: curve needs order=2: linear tets have straight edges")
    if order == 1 or curve is None:
        return mesh.mid_edge if order == 2 else None
    if isinstance(curve, str) and curve == "straight":
        return None
    edges = distinct_edges(mesh.tets)[0]
    middles = mesh.vertices[edges].mean(axis=1) if mesh.mid_edge is None else mesh.mid_edge.copy()
    if isinstance(curve, str) and curve == "smooth":
        ends, found = _smooth(mesh)
    elif isinstance(curve, (Sphere, Capsule, SurfaceMesh)):
        ends, found = _on_shape(what, mesh, curve)
    else:
        kinds = 'a Sphere, a Capsule, a SurfaceMesh, "smooth" or "straight"'
        raise SceneError(f"{what}: curve must be {kinds}, not {value_text(curve)}")
    n = mesh.n_verts
    middles[np.searchsorted(edges[:, 0] * n + edges[:, 1], ends[:, 0] * n + ends[:, 1])] = found
    return middles


def check_shape(what: str, nodes: Nodes) -> None:
    """Raise SceneError if a curved element is folded: det J <= 0 at a quadrature point, or a linear tet of it is inverted."""
    if nodes.curved is None:
        return
    rows = np.flatnonzero(nodes.curved)
    x = nodes.positions[nodes.elements[rows]]
    least = np.min([quadratic.point_volumes(x, quadratic.quadrature(degree)).min(axis=1) for degree in (2, 4)], axis=0)
    parts = nodes.positions[nodes.tets.reshape(-1, PARTS, 4)[rows]]
    least = np.minimum(least, np.linalg.det(parts[:, :, 1:] - parts[:, :, :1]).min(axis=1))
    if (least <= 0.0).any():
        e = rows[np.argmax(least <= 0.0)]
        raise SceneError(
            f"{what}: tet {e} is folded by its curved edges ({int((least <= 0.0).sum())} such tets): use a finer mesh, move "
            'mid-edge nodes closer to the middles of their edges, or give curve="straight"'
        )


def _nearest(curve: Sphere | Capsule | SurfaceMesh, points: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return the nearest points (p,3) [m] of a shape's surface, and its unit normals there, to points (p,3)."""
    if isinstance(curve, SurfaceMesh):
        nearest, triangle = nearest_points(curve.vertices, curve.triangles, points)
        return nearest, normals_and_heights(curve.vertices, curve.triangles)[0][triangle]
    if isinstance(curve, Sphere):
        centre = curve.center
    else:
        axis = curve.b - curve.a
        centre = curve.a + np.clip((points - curve.a) @ axis / (axis @ axis), 0.0, 1.0)[:, None] * axis
    normal = points - centre
    normal = normal / np.maximum(np.linalg.norm(normal, axis=1, keepdims=True), np.finfo(float).tiny)
    return centre + curve.radius * normal, normal


def _on_shape(what: str, mesh: TetMesh, curve: Sphere | Capsule | SurfaceMesh) -> tuple[np.ndarray, np.ndarray]:
    """Return the edges (k,2) of faces on a shape, ascending, and the nearest points of the shape to their midpoints (k,3)."""
    x, faces = mesh.vertices, mesh.surface
    corners = x[faces]
    longest = np.linalg.norm(corners - np.roll(corners, 1, axis=1), axis=2).max(axis=1)
    distance = np.full(mesh.n_verts, np.inf)
    used = np.unique(faces)
    distance[used] = np.linalg.norm(_nearest(curve, x[used])[0] - x[used], axis=1)
    normals, of_shape = normals_and_heights(x, faces)[0], _nearest(curve, corners.mean(axis=1))[1]
    on = (distance[faces].max(axis=1) <= ON_SHAPE * longest) & (np.abs(np.einsum("tx,tx->t", normals, of_shape)) >= ALONG)
    if not on.any():
        raise SceneError(
            f"{what}: curve: no face of the mesh lies on the {getattr(curve, 'word', 'surface')}; the nearest vertex is "
            f"{distance.min():.3g} m from it"
        )
    edges = triangle_edges(faces[on])[0]
    return edges, _nearest(curve, x[edges].mean(axis=1))[0]


def _smooth(mesh: TetMesh) -> tuple[np.ndarray, np.ndarray]:
    """Return the edges (k,2) of the surface, ascending, and their middle nodes (k,3) on a smooth surface through the vertices."""
    x, faces = mesh.vertices, mesh.surface
    half = np.sort(faces[:, [(0, 1), (1, 2), (2, 0)]].reshape(-1, 2), axis=1)
    edges, edge, counts = np.unique(half, axis=0, return_inverse=True, return_counts=True)
    edge = edge.reshape(-1)
    by_edge = np.argsort(edge, kind="stable")  # half-edge 3t + k runs from corner k of face t
    first = np.cumsum(counts) - counts
    one, other = by_edge[first], by_edge[first + 1]  # of a closed surface; where four faces meet, the edge is sharp
    normals = normals_and_heights(x, faces)[0]
    sharp = (counts != 2) | (np.einsum("ex,ex->e", normals[one // 3], normals[other // 3]) < SHARP)
    # corners of faces around a vertex between sharp edges share a normal: 3t + k is corner k of face t
    follow = lambda h: h // 3 * 3 + (h + 1) % 3  # noqa: E731
    a, b = one[~sharp], other[~sharp]
    links = np.concatenate([np.stack([a, follow(b)]), np.stack([follow(a), b])], axis=1)
    n = faces.size
    fan = connected_components(coo_matrix((np.ones(links.shape[1]), links), (n, n)), directed=False)[1]
    corners = x[faces]
    to_next, to_last = np.roll(corners, -1, axis=1) - corners, np.roll(corners, 1, axis=1) - corners
    weight = np.einsum("tkx,tkx->tk", to_next, to_next) * np.einsum("tkx,tkx->tk", to_last, to_last)
    parts = (np.cross(to_next, to_last) / weight[..., None]).reshape(-1, 3)
    normal = _unit(np.stack([np.bincount(fan, parts[:, k]) for k in range(3)], axis=1))
    ends = x[edges]
    chord, middles = ends[:, 1] - ends[:, 0], ends.mean(axis=1)
    # at half-edge h, the corner at its first vertex and the one at its second; sorted vertices take them in that order
    swapped = faces.reshape(-1)[one] != edges[:, 0]
    i, j = normal[fan[np.where(swapped, follow(one), one)]], normal[fan[np.where(swapped, one, follow(one))]]
    lengths = np.linalg.norm(chord, axis=1)
    rise = np.stack([np.einsum("ex,ex->e", chord, normal) / lengths for normal in (i, j)], axis=1)[:, :, None]
    level = np.sqrt(1.0 - np.minimum(rise**2, STEEPEST))
    rise *= lengths[:, None, None] / (4.0 * level * (1.0 + level))
    bulge = rise[:, 1] * j - rise[:, 0] * i
    bulge[sharp] = _along_sharp(x, edges[sharp])
    return edges, middles + bulge


def _along_sharp(x: np.ndarray, edges: np.ndarray) -> np.ndarray:
    """Return what the middles of sharp edges (k,2) are moved by (k,3). A vertex where other than two of them meet, or where they
    turn by more than SHARP, is a corner; an edge from a corner is an arc."""
    both = np.concatenate([edges, edges[:, ::-1]])
    out = x[both[:, 1]] - x[both[:, 0]]
    squared = np.einsum("ex,ex->e", out, out)[:, None]
    counts = np.bincount(both[:, 0], minlength=len(x))
    # the tangent out/|out|^2 - other/|other|^2 of a circle through three points; of both edges at the vertex, so with either sign
    total = np.stack([np.bincount(both[:, 0], out[:, k] / squared[:, 0], len(x)) for k in range(3)], axis=1)
    facing = np.stack([np.bincount(both[:, 0], out[:, k] / np.sqrt(squared[:, 0]), len(x)) for k in range(3)], axis=1)
    tangent = _unit(2.0 * out / squared - total[both[:, 0]])
    turn = 0.5 * np.einsum("vx,vx->v", facing, facing) - 1.0  # cosine between the two edges, -1 where they are in line
    corner = (counts != 2) | (turn > -SHARP)
    n, chord = len(edges), _unit(out[: len(edges)])
    start, end = tangent[:n], -tangent[n:]
    at_start, at_end = corner[edges[:, 0]], corner[edges[:, 1]]
    mirrored = lambda t: 2.0 * np.einsum("ex,ex->e", t, chord)[:, None] * chord - t  # noqa: E731
    start, end = np.where(at_start[:, None], mirrored(end), start), np.where(at_end[:, None], mirrored(start), end)
    level = np.maximum(np.einsum("ex,ex->e", start + end, chord), 0.0)[:, None]  # twice the cosine
    bulge = np.sqrt(squared[:n]) * (start - end) / (4.0 + 2.0 * level)
    bulge[at_start & at_end] = 0.0
    return bulge


def _unit(vectors: np.ndarray) -> np.ndarray:
    return vectors / np.maximum(np.linalg.norm(vectors, axis=1, keepdims=True), np.finfo(float).tiny)
