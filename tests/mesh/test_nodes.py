"""Nodes of a body: vertices, then edge midpoints sorted by vertex pairs; the linear tets of a second-order element are positive,
fill it and split its octahedron along the shortest diagonal; the linear triangles are their outward boundary.
"""

import itertools

import numpy as np
import pytest

from taisoft.errors import MeshError
from taisoft.mesh.nodes import Nodes, make_nodes
from taisoft.mesh.shapes import ball_mesh, box_mesh
from taisoft.mesh.tet_mesh import TetMesh
from taisoft.mesh.topology import EDGES, TET_FACES, Faces

EVEN = [p for p in itertools.permutations(range(4)) if np.linalg.det(np.eye(4)[list(p)]) > 0]


def random_mesh() -> TetMesh:
    """A box with moved vertices, and the corners of each tet in a random positive order."""
    rng, mesh = np.random.default_rng(0), box_mesh((2, 2, 3), (2, 2, 3))
    corners = np.array(EVEN)[rng.integers(0, 12, mesh.n_tets)]
    x = mesh.vertices + rng.uniform(-0.15, 0.15, mesh.vertices.shape)
    return TetMesh(x, np.take_along_axis(mesh.tets, corners, axis=1))


def volumes(positions: np.ndarray, tets: np.ndarray) -> np.ndarray:
    x = positions[tets]
    return np.linalg.det(x[:, 1:] - x[:, :1]) / 6.0


MESHES = [box_mesh((2, 3, 2), (1, 2, 1)), box_mesh((2, 2, 2), (3, 1, 1), pattern="six"), ball_mesh(1.0, 2), random_mesh()]
each_mesh = pytest.mark.parametrize("mesh", MESHES, ids=repr)


def midpoints(mesh: TetMesh) -> dict[tuple[int, int], int]:
    """The node in the middle of each edge, whose vertices are in ascending order."""
    pairs = sorted({tuple(sorted((int(tet[a]), int(tet[b])))) for tet in mesh.tets for a, b in EDGES})
    return {pair: mesh.n_verts + k for k, pair in enumerate(pairs)}


@each_mesh
def test_edge_midpoints_are_numbered_by_sorted_vertex_pairs(mesh):
    number, nodes = midpoints(mesh), make_nodes(mesh, 2)
    ends = mesh.vertices[np.array(list(number))]
    assert np.array_equal(nodes.positions, np.concatenate([mesh.vertices, ends.mean(axis=1)]))
    for tet, element in zip(mesh.tets, nodes.elements):
        assert element.tolist() == [*tet, *(number[tuple(sorted((int(tet[a]), int(tet[b]))))] for a, b in EDGES)]


@each_mesh
def test_linear_tets_fill_their_element_around_its_shortest_diagonal(mesh):
    nodes = make_nodes(mesh, 2)
    x = nodes.positions
    assert np.allclose(volumes(x, nodes.tets).reshape(-1, 8), mesh.volumes[:, None] / 8, rtol=1e-9)
    assert (nodes.tets.reshape(-1, 32)[:, :, None] == nodes.elements[:, None, :]).any(axis=2).all()
    for element, tets in zip(nodes.elements, nodes.tets.reshape(-1, 8, 4)):
        lengths = np.linalg.norm(x[element[4:7]] - x[element[9:6:-1]], axis=1)
        (chosen,) = [k for k in range(3) if all({element[4 + k], element[9 - k]} <= {*tet} for tet in tets[4:])]
        assert lengths[chosen] <= lengths.min() * (1 + 1e-9)


@each_mesh
def test_linear_triangles_are_the_boundary_of_the_linear_tets(mesh):
    nodes, number = make_nodes(mesh, 2), midpoints(mesh)
    faces = Faces(nodes.tets)
    assert faces.counts.max() <= 2  # neighbours share their four triangles
    assert sorted(map(canonical, faces.triangles[faces.surface()])) == sorted(map(canonical, nodes.surface))
    for (a, b, c), four in zip(mesh.surface.tolist(), nodes.surface.reshape(-1, 4, 3).tolist()):
        ab, bc, ca = (number[tuple(sorted(pair))] for pair in ((a, b), (b, c), (c, a)))
        assert four == [[a, ab, ca], [ab, b, bc], [ca, bc, c], [ab, bc, ca]]
    for order in (1, 2):
        nodes = make_nodes(mesh, order)
        assert (volumes(nodes.positions, nodes.boundary_tets) > 0).all()  # with outward faces
        for triangle, tet in zip(nodes.surface, nodes.boundary_tets):
            assert canonical(triangle) in [canonical(tet[face]) for face in TET_FACES]
            assert tuple(sorted(tet.tolist())) in as_sets(nodes)
        owner = mesh.tets[mesh.surface_tets] if order == 1 else np.repeat(nodes.elements[mesh.surface_tets], 4, axis=0)
        assert (nodes.boundary_tets[:, :, None] == owner[:, None, :]).any(axis=2).all()


def canonical(triangle) -> tuple[int, ...]:
    """The triangle's indices, rotated so that the smallest is first."""
    return tuple(np.roll(triangle, -int(np.argmin(triangle))).tolist())


def as_sets(nodes: Nodes) -> set[tuple[int, ...]]:
    return {tuple(sorted(tet)) for tet in nodes.tets.tolist()}


@each_mesh
def test_the_split_depends_neither_on_the_order_of_corners_nor_on_rounding(mesh):
    """Also in grids, whose octahedra have equal diagonals."""
    rng, first = np.random.default_rng(5), make_nodes(mesh, 2)
    for _ in range(4):
        order = np.array(EVEN)[rng.integers(0, 12, mesh.n_tets)]
        other = make_nodes(TetMesh(mesh.vertices, np.take_along_axis(mesh.tets, order, axis=1)), 2)
        assert np.array_equal(first.positions, other.positions) and as_sets(first) == as_sets(other)
    assert as_sets(first) == as_sets(make_nodes(TetMesh(mesh.vertices + (1e3, -7.7, 0.1), mesh.tets), 2))


def test_first_order_is_the_mesh_and_others_than_2_are_refused():
    mesh = MESHES[0]
    nodes = make_nodes(mesh, 1)
    assert nodes.positions is mesh.vertices and nodes.surface is mesh.surface
    assert nodes.elements is mesh.tets and nodes.tets is mesh.tets
    assert np.array_equal(nodes.boundary_tets, mesh.tets[mesh.surface_tets])
    for order in (0, 3, True, "2"):
        with pytest.raises(MeshError, match="order must be 1 or 2"):
            make_nodes(mesh, order)
