"""Directions of fibres at rest: as given to a body, and along a harmonic field between two parts of a mesh."""

import numpy as np

from taisoft.errors import MeshError, SceneError, reason
from taisoft.mesh.tet_mesh import TetMesh
from taisoft.scene import checks


def directions(what: str, mesh: TetMesh, fibres) -> np.ndarray:
    """Return the unit vectors (m,3) of directions (3,), (m,3), or a function of the tets' centroids (m,3); 0 where they are 0."""
    if callable(fibres):
        try:
            fibres = fibres(mesh.vertices[mesh.tets].mean(axis=1))
        except Exception as error:  # a user's function may raise anything
            raise SceneError(f"{what}: the function of fibres failed: {reason(error)}") from error
    given = checks.array(fibres, f"{what}: fibres", ((3,), (mesh.n_tets, 3)))
    largest = np.abs(given).max(axis=-1, keepdims=True)
    given = np.where((largest > 0.0) & (largest < 1e-100), given / np.where(largest > 0.0, largest, 1.0), given)  # squares vanish
    length = np.linalg.norm(given, axis=-1, keepdims=True)
    is_given = (length == 0.0) | (np.abs(length - 1.0) < 1e-15)  # so that unit vectors from files keep their bits
    unit = np.array(np.broadcast_to(given / np.where(is_given, 1.0, length), (mesh.n_tets, 3)))
    unit.setflags(write=False)
    return unit


def harmonic_fibres(mesh: TetMesh, start, end) -> np.ndarray:
    """Return unit vectors (m,3) along the gradient of a harmonic field: 0 on the vertices `start`, 1 on those of `end`.

    start, end: vertex ids, a bool mask (n,), or a callable that gets the vertices (n,3) and returns such a
    mask. The field solves Laplace's equation on linear tets, without flux through the rest of the surface, as usual for the
    fibres of muscles between two tendons (Choi and Blemker, "Skeletal muscle fascicle arrangements can be reconstructed using a
    Laplacian vector field simulation", PLoS ONE 8, 2013). Raises SceneError if no vertex is chosen or one is in both, MeshError
    for a tet without a gradient, such as in a part of the mesh that `start` and `end` do not both touch.
    """
    import scipy.sparse as sp
    from scipy.sparse.linalg import spsolve

    ends = [
        checks.selection(w, mesh.vertices, f"harmonic_fibres: {what}", "vertex") for w, what in ((start, "start"), (end, "end"))
    ]
    if len(both := np.intersect1d(*ends)):
        raise MeshError(f"harmonic_fibres: vertex {both[0]} is chosen by start and by end")
    corners = mesh.vertices[mesh.tets]
    inverse = np.linalg.inv(corners[:, 1:] - corners[:, :1])  # (m,3,3), columns: gradients of the last three corners' weights
    gradients = np.concatenate([-inverse.sum(axis=2, keepdims=True), inverse], axis=2)
    K = mesh.volumes[:, None, None] * np.einsum("eia,eib->eab", gradients, gradients)
    rows, columns = np.broadcast_to(mesh.tets[:, :, None], K.shape), np.broadcast_to(mesh.tets[:, None], K.shape)
    K = sp.csr_matrix((K.ravel(), (rows.ravel(), columns.ravel())), shape=(mesh.n_verts, mesh.n_verts))
    u, free = np.full(mesh.n_verts, 0.5), np.ones(mesh.n_verts, dtype=bool)
    u[ends[0]], u[ends[1]], free[np.concatenate(ends)] = 0.0, 1.0, False
    _, piece = sp.csgraph.connected_components(K, directed=False)
    free &= np.isin(piece, piece[~free])  # the field is constant in parts that touch neither
    if free.any():
        u[free] = spsolve(K[free][:, free].tocsc(), -(K[free][:, ~free] @ u[~free]))
    field = np.einsum("eia,ea->ei", gradients, u[mesh.tets])
    length = np.linalg.norm(field, axis=1)
    flat = length * np.ptp(mesh.vertices, axis=0).max() < 1e-9  # of 1 over the mesh's size: rounding
    if flat.any():
        raise MeshError(f"harmonic_fibres: the field has no gradient in tet {int(np.argmax(flat))}")
    return field / length[:, None]
