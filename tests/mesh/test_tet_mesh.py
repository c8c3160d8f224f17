"""TetMesh:

* the surface is closed, oriented outward and encloses the tets' volume; each triangle is a face of its tet;
* every tet is positive; a fully inverted mesh is flipped with a warning, single inverted tets are rejected or flipped on request;
* invalid coordinates and indices, tets without volume, duplicates, faces of three tets and unused vertices are rejected with
  index and rule;
* components are counted; edge and vertex joints and coincident vertices cause warnings; arrays are read-only copies.
"""

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from hypothesis.extra import numpy as hnp

from taisoft.errors import MeshError
from taisoft.mesh.shapes import box_mesh
from taisoft.mesh.tet_mesh import TetMesh
from taisoft.mesh.topology import TET_FACES, merge_labels

CORNER = np.array([(0.0, 0, 0), (1, 0, 0), (0, 1, 0), (0, 0, 1)])  # a positive tet
ONE = np.array([(0, 1, 2, 3)])


def box_arrays() -> tuple[np.ndarray, np.ndarray]:
    """Writable vertices and tets of a valid box of 40 tets."""
    mesh = box_mesh((2, 2, 2), (1.0, 1.0, 1.0))
    return mesh.vertices.copy(), mesh.tets.copy()


def signed_volume(vertices: np.ndarray, surface: np.ndarray) -> float:
    """Volume inside an oriented closed surface, by the divergence theorem."""
    x = vertices[surface]
    return float(np.einsum("ij,ij->", x[:, 0], np.cross(x[:, 1], x[:, 2])) / 6.0)


def test_faces_of_a_single_tet_point_outward():
    mesh = TetMesh(CORNER, ONE)
    assert mesh.volumes == pytest.approx([1.0 / 6.0])
    assert len(mesh.surface) == 4
    x = mesh.vertices[mesh.surface]
    normals = np.cross(x[:, 1] - x[:, 0], x[:, 2] - x[:, 0])
    assert (np.einsum("ij,ij->i", normals, x[:, 0] - CORNER.mean(axis=0)) > 0).all()


def test_surface_is_closed_and_encloses_the_volume():
    vertices, tets = box_arrays()
    rng = np.random.default_rng(3)
    mesh = TetMesh(vertices + rng.uniform(-0.05, 0.05, vertices.shape), tets[rng.permutation(len(tets))])
    directed = mesh.surface[:, [[0, 1], [1, 2], [2, 0]]].reshape(-1, 2)
    edges, reversed_edges = {tuple(e) for e in directed}, {tuple(e[::-1]) for e in directed}
    assert len(edges) == len(directed) and edges == reversed_edges  # every edge once in each direction
    assert signed_volume(mesh.vertices, mesh.surface) == pytest.approx(mesh.volumes.sum(), rel=1e-12)
    faces = np.sort(mesh.tets[mesh.surface_tets][:, TET_FACES], axis=2)
    assert (faces == np.sort(mesh.surface, axis=1)[:, None]).all(axis=2).any(axis=1).all()


def test_surface_is_the_set_of_faces_of_one_tet():
    vertices, tets = box_arrays()
    owners: dict[frozenset, int] = {}
    for tet in tets:
        for k in range(4):
            face = frozenset(np.delete(tet, k).tolist())
            owners[face] = owners.get(face, 0) + 1
    expected = {face for face, count in owners.items() if count == 1}
    assert {frozenset(triangle) for triangle in TetMesh(vertices, tets).surface.tolist()} == expected


def test_arrays_are_copies_and_read_only():
    vertices, tets = box_arrays()
    mesh = TetMesh(vertices, tets)
    vertices[0], tets[0] = 99.0, 0
    assert mesh.vertices.max() < 99.0 and mesh.tets[0].any()
    for array in (mesh.vertices, mesh.tets, mesh.surface, mesh.surface_tets, mesh.volumes):
        with pytest.raises(ValueError, match="read-only"):
            array[0] = 0


@pytest.mark.parametrize(
    "value, message",
    [
        (np.nan, "is not finite"),
        (np.inf, "is not finite"),
        (-np.inf, "is not finite"),
        (1e39, r"is 1e\+39 m"),  # beyond f32
    ],
)
def test_invalid_coordinates_are_rejected(value, message):
    vertices, tets = box_arrays()
    vertices[17, 1] = value
    with pytest.raises(MeshError, match=f"vertex 17 coordinate 1 {message}"):
        TetMesh(vertices, tets)


@pytest.mark.parametrize("index", [27, 1000, -1, -27, 2**62])
def test_indices_out_of_range_are_rejected(index):
    vertices, tets = box_arrays()
    tets[5, 2] = index
    with pytest.raises(MeshError, match=rf"^part.msh: tet 5: vertex {index} does not exist \(27 vertices") as error:
        TetMesh(vertices, tets, source="part.msh")
    assert "subtract 1" not in str(error.value)


def test_one_based_indices_are_recognised():
    vertices, tets = box_arrays()
    with pytest.raises(MeshError, match="vertex 27 does not exist .* count from 1, subtract 1"):
        TetMesh(vertices, tets + 1)


def test_unsigned_indices_do_not_wrap_around():
    vertices, tets = box_arrays()
    tets = tets.astype(np.uint64)
    tets[5, 2] = 2**64 - 1
    with pytest.raises(MeshError, match="tet 5: vertex 18446744073709551615 does not exist"):
        TetMesh(vertices, tets)


def test_single_inverted_tets_are_rejected_or_flipped_on_request():
    vertices, tets = box_arrays()
    upright = TetMesh(vertices, tets)
    tets[[7, 30]] = tets[[7, 30]][:, [1, 0, 2, 3]]
    with pytest.raises(MeshError, match="2 of 40 tets are inverted, the first is tet 7"):
        TetMesh(vertices, tets)
    with pytest.warns(UserWarning, match="2 of 40 inverted tets have been flipped: 7, 30"):
        mesh = TetMesh(vertices, tets, fix_orientation=True)
    assert mesh.flipped.tolist() == [7, 30] and len(mesh.warnings) == 1
    assert np.linalg.det(mesh.vertices[mesh.tets][:, 1:] - mesh.vertices[mesh.tets][:, :1]).min() > 0
    assert np.allclose(mesh.volumes, upright.volumes)


def test_mirrored_mesh_is_flipped_with_one_warning():
    vertices, tets = box_arrays()
    with pytest.warns(UserWarning, match="all 40 tets are inverted"):
        mesh = TetMesh(vertices * (-1, 1, 1), tets)
    assert len(mesh.warnings) == 1 and len(mesh.flipped) == 40
    assert signed_volume(mesh.vertices, mesh.surface) == pytest.approx(1.0)


@pytest.mark.parametrize("scale", [1e-6, 1.0, 1e6])
@pytest.mark.parametrize("height", [0.0, 1e-10, -1e-10])
def test_tets_without_volume_are_rejected(scale, height):
    vertices = CORNER.copy()
    vertices[3] = (0.3, 0.3, height)
    with pytest.raises(MeshError, match="tet 0 has no volume"):
        TetMesh(vertices * scale, ONE)


@pytest.mark.parametrize("scale", [1e-6, 1.0, 1e6])
def test_nearly_flat_tet_is_accepted_with_a_warning(scale):
    vertices = CORNER.copy()
    vertices[3] = (0.3, 0.3, 1e-6)
    with pytest.warns(UserWarning, match="1 tets are nearly flat"):
        assert TetMesh(vertices * scale, ONE).volumes[0] > 0


def test_repeated_vertex_is_rejected():
    vertices, tets = box_arrays()
    tets[9, 3] = tets[9, 0]
    with pytest.raises(MeshError, match="tet 9 names a vertex twice"):
        TetMesh(vertices, tets)


def test_duplicate_tet_is_rejected():
    vertices, tets = box_arrays()
    with pytest.raises(MeshError, match="tets 4 and 40 have the same four vertices"):
        TetMesh(vertices, np.vstack([tets, tets[4:5, [1, 2, 0, 3]]]))


@pytest.mark.parametrize(
    "vertices, tets, message",
    [
        (np.empty((0, 3)), ONE, "no vertices"),
        ([], [], "no vertices"),
        (CORNER, np.empty((0, 4), dtype=int), "no tetrahedra"),
        (CORNER, [], "no tetrahedra"),
        (CORNER[:, :2], ONE, r"shape \(n, 3\), not \(4, 2\)"),
        (CORNER, ONE[:, :3], r"shape \(m, 4\), not \(1, 3\)"),
        (CORNER, ONE.astype(float), "tets must be integers"),
        ([["a", "b", "c"]], ONE, "vertices must be numbers"),
        ([[0, 0, 0], [1, 2]], ONE, "vertices must be"),
        (CORNER.astype(complex), ONE, "vertices must be numbers"),
        (None, ONE, "vertices must be numbers"),
    ],
)
def test_invalid_arrays_are_rejected(vertices, tets, message):
    with pytest.raises(MeshError, match=message):
        TetMesh(vertices, tets)


def test_unused_vertex_is_rejected():
    with pytest.raises(MeshError, match="vertex 4 belongs to no tet"):
        TetMesh(np.vstack([CORNER, [(2.0, 2, 2)]]), ONE)


def test_face_of_three_tets_is_rejected():
    vertices = np.vstack([CORNER, [(0.0, 0, -1), (1.0, 1, -2)]])
    tets = [(0, 1, 2, 3), (0, 2, 1, 4), (0, 2, 1, 5)]
    with pytest.raises(MeshError, match=r"face \(0, 1, 2\) is shared by 3 tets \(0, 1, 2\)"):
        TetMesh(vertices, tets)


def test_overlapping_neighbours_cause_a_warning():
    vertices = np.vstack([CORNER, [(0.3, 0.3, 2.0)]])
    with pytest.warns(UserWarning, match="1 pairs of neighbouring tets overlap.*tets 0 and 1"):
        TetMesh(vertices, [(0, 1, 2, 3), (0, 1, 2, 4)])


def two_boxes(shift) -> TetMesh:
    """Two unit boxes of one cell, the second shifted; coincident vertices are merged."""
    box = box_mesh((1, 1, 1), (1.0, 1.0, 1.0), pattern="six")
    vertices = np.vstack([box.vertices, box.vertices + np.asarray(shift, dtype=float)])
    labels = merge_labels(vertices, 1e-9)
    first = np.unique(labels, return_index=True)[1]
    return TetMesh(vertices[first], labels[np.vstack([box.tets, box.tets + box.n_verts])])


@pytest.mark.parametrize("shift, n_verts, n_components", [((5, 0, 0), 16, 2), ((1, 0, 0), 12, 1)])
def test_components_are_counted(shift, n_verts, n_components):
    mesh = two_boxes(shift)
    assert mesh.n_verts == n_verts and mesh.n_components == n_components and mesh.warnings == []


@pytest.mark.parametrize(
    "shift, message", [((1, 1, 0), "joined at an edge only at 1 edges"), ((1, 1, 1), "joined at a vertex only at 1 vertices")]
)
def test_edge_and_vertex_joints_cause_a_warning(shift, message):
    with pytest.warns(UserWarning, match=message):
        mesh = two_boxes(shift)
    assert mesh.n_components == 1 and len(mesh.warnings) == 1


def test_coincident_vertices_cause_a_warning():
    box = box_mesh((1, 1, 1), (1.0, 1.0, 1.0), pattern="six")
    vertices = np.vstack([box.vertices, box.vertices + (1.0, 0, 0)])
    with pytest.warns(UserWarning, match="4 vertices coincide with another one, the first is vertex 8 on vertex 4"):
        mesh = TetMesh(vertices, np.vstack([box.tets, box.tets + 8]))
    assert mesh.n_components == 2


def test_merge_labels_is_transitive_and_keeps_the_order():
    points = np.array([(3.0, 0, 0), (0, 0, 0), (0.9, 0, 0), (1.8, 0, 0), (0, 0, 0), (-0.0, 0, 0)])
    assert merge_labels(points, 0.0).tolist() == [0, 1, 2, 3, 1, 1]
    assert merge_labels(points, 1.0).tolist() == [0, 1, 1, 1, 1, 1]


@settings(max_examples=100, deadline=None)
@given(
    hnp.arrays(np.float64, st.tuples(st.integers(0, 6), st.integers(2, 4)), elements=st.floats(width=32)),
    hnp.arrays(np.int64, st.tuples(st.integers(0, 6), st.integers(3, 5)), elements=st.integers(-2, 7)),
)
@pytest.mark.filterwarnings("ignore::UserWarning")
def test_random_arrays_give_a_valid_mesh_or_a_mesh_error(vertices, tets):
    try:
        mesh = TetMesh(vertices, tets)
    except MeshError:
        return
    x = mesh.vertices[mesh.tets]
    assert (mesh.volumes > 0).all() and (np.linalg.det(x[:, 1:] - x[:, :1]) > 0).all() and len(mesh.surface) >= 4
