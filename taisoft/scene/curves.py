"""Curved edges: where the mid-edge nodes of a body's surface lie at rest.

On a shape, the midpoint of an edge moves to the nearest point of the shape. On a smooth surface through the vertices, it moves
along the normals n_i, n_j of its ends, as the cubic edge of a PN triangle does,
    x = (x_i + x_j)/2 - ((x_j - x_i).n_i n_i - (x_j - x_i).n_j n_j) / 8,
and on a sharp edge along the tangents t_i, t_j of the curve of sharp edges, x = (x_i + x_j)/2 + |x_j - x_i| (t_i - t_j) / 8.
Both are scaled by a factor that tends to 1 with the angle to the edge and is exact for arcs of circles. Normals and tangents are
weighted so that those of vertices on a sphere or a circle are exact; an edge from a sharp edge into the surface, where a normal
would see one side only, is the arc that its other end begins.
Sources: Vlachos, Peters, Boyd, Mitchell, Curved PN triangles, 2001; Max, Weights for computing vertex normals from facet normals,
J. Graphics Tools 4, 1999.
Weak: an edge that crosses a strip of one element between two sharp edges has normals of one side.
"""

import numpy as np

from taisoft.errors import SceneError, value_text
from taisoft.mesh import quadratic
from taisoft.mesh.distances import Triangles
from taisoft.mesh.nodes import PARTS, Nodes
from taisoft.mesh.surface_mesh import SurfaceMesh
from taisoft.mesh.tet_mesh import TetMesh
from taisoft.mesh.topology import HALF_EDGES, distinct_edges, linked_groups, normals_and_heights, triangle_edges
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
    word = curve if isinstance(curve, str) else None
    if curve is not None and order == 1:
        raise SceneError(f"{what}: curve needs order=2: linear tets have straight edges")
    if order == 1 or word == "straight" or curve is None:
        return mesh.mid_edge if order == 2 and curve is None else None
    edges = distinct_edges(mesh.tets)[0]
    middles = mesh.vertices[edges].mean(axis=1) if mesh.mid_edge is None else mesh.mid_edge.copy()
    if word == "smooth":
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
        nearest, triangle = Triangles(curve.vertices, curve.triangles).closest(points)
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
    half = np.sort(faces[:, HALF_EDGES].reshape(-1, 2), axis=1)  # half-edge 3t + k begins at corner k of face t
    edges, edge, counts = np.unique(half, axis=0, return_inverse=True, return_counts=True)
    first = np.cumsum(counts) - counts
    one, other = np.argsort(edge.reshape(-1), kind="stable")[np.stack([first, first + 1])]  # the surface is closed
    facing = normals_and_heights(x, faces)[0]
    sharp = (counts != 2) | (np.einsum("ex,ex->e", facing[one // 3], facing[other // 3]) < SHARP)
    end = (np.arange(faces.size).reshape(-1, 3)[:, [1, 2, 0]]).reshape(-1)  # corner at the end of each half-edge
    normal = _corner_normals(x[faces], np.stack([one, end[one]])[:, ~sharp], np.stack([end[other], other])[:, ~sharp])
    upward = faces.reshape(-1)[one] == edges[:, 0]
    i, j = normal[np.where(upward, one, end[one])], normal[np.where(upward, end[one], one)]
    chord = x[edges[:, 1]] - x[edges[:, 0]]
    lengths = np.linalg.norm(chord, axis=1, keepdims=True)
    a, b = np.isin(edges, edges[sharp]).T[..., None]  # at a sharp edge one side shows: the arc follows from its other end
    i, j = np.where(a & ~b, _mirrored(j, chord / lengths), i), np.where(b & ~a, _mirrored(i, chord / lengths), j)
    bulge = np.zeros_like(chord)
    for n, sign in ((i, -1.0), (j, 1.0)):
        sine = np.einsum("ex,ex->e", chord, n)[:, None] / lengths
        cosine = np.sqrt(1.0 - np.minimum(sine**2, STEEPEST))
        bulge += sign * lengths * sine / (4.0 * cosine * (1.0 + cosine)) * n
    bulge[sharp] = _along_sharp(x, edges[sharp])
    return edges, x[edges].mean(axis=1) + bulge


def _corner_normals(corners: np.ndarray, same: np.ndarray, also: np.ndarray) -> np.ndarray:
    """Return the unit normals (3t,3) of the corners of faces (t,3,3). same, also: corners that share one, pair by pair."""
    group = linked_groups(same.reshape(-1), also.reshape(-1), 3 * len(corners))[1]
    to_next, to_last = np.roll(corners, -1, axis=1) - corners, np.roll(corners, 1, axis=1) - corners
    weight = np.einsum("tkx,tkx->tk", to_next, to_next) * np.einsum("tkx,tkx->tk", to_last, to_last)
    parts = (np.cross(to_next, to_last) / weight[..., None]).reshape(-1, 3)
    return _unit(np.stack([np.bincount(group, part) for part in parts.T], axis=1))[group]


def _along_sharp(x: np.ndarray, edges: np.ndarray) -> np.ndarray:
    """Return what the middles of sharp edges (k,2) are moved by (k,3). A vertex where other than two of them meet, or where they
    turn by more than SHARP, is a corner; an edge with one corner is an arc, one with two is straight."""
    n, start = len(edges), np.concatenate([edges[:, 0], edges[:, 1]])
    out = x[np.concatenate([edges[:, 1], edges[:, 0]])] - x[start]
    length = np.linalg.norm(out, axis=1, keepdims=True)
    total, both = (np.stack([np.bincount(start, part, len(x)) for part in v.T], axis=1) for v in (out / length**2, out / length))
    # a circle through three points has the tangent out/|out|^2 - other/|other|^2 at the one in the middle
    tangent = _unit(2.0 * out / length**2 - total[start])
    turn = 1.0 - 0.5 * np.einsum("ex,ex->e", both, both)[start]  # cosine of the angle by which two edges turn
    corner = ((np.bincount(start)[start] != 2) | (turn < SHARP))[:, None]
    along, other = out / length, np.roll(tangent, n, axis=0)  # at the other end
    tangent = np.where(corner, _mirrored(other, along), tangent)  # an arc leaves a corner in the mirror image of its end
    level = np.einsum("ex,ex->e", tangent[:n] - tangent[n:], along[:n])[:, None]  # twice the mean cosine
    bulge = length[:n] * (tangent[:n] + tangent[n:]) / (4.0 + 2.0 * np.maximum(level, 0.0))
    return np.where(corner[:n] & corner[n:], 0.0, bulge)


def _mirrored(vectors: np.ndarray, along: np.ndarray) -> np.ndarray:
    """Return vectors (e,3) mirrored along unit vectors (e,3)."""
    return vectors - 2.0 * np.einsum("ex,ex->e", vectors, along)[:, None] * along


def _unit(vectors: np.ndarray) -> np.ndarray:
    return vectors / np.maximum(np.linalg.norm(vectors, axis=1, keepdims=True), np.finfo(float).tiny)
