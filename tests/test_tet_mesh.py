"""What a TetMesh promises:

* the surface is closed, points outwards and bounds exactly the volume of the tets, each triangle a face of its owner;
* every tet is positive; all inverted are flipped and told, some are refused or, on request, flipped and listed;
* coordinates that are not finite, indices that do not exist, tets without volume or given twice, faces of three tets
  and left-over vertices are refused with the index and the rule;
* pieces are counted, joints and coincident vertices told; the arrays are copies and read-only.
"""

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from hypothesis.extra import numpy as hnp

from taisoft.errors import MeshError
from taisoft.mesh.shapes import box_mesh
from taisoft.mesh.tet_mesh import TetMesh, merge_labels
from taisoft.mesh.topology import TET_FACES

CORNER = np.array([(0.0, 0, 0), (1, 0, 0), (0, 1, 0), (0, 0, 1)])  # a positive tet
ONE = np.array([(0, 1, 2, 3)])


def parts() -> tuple[np.ndarray, np.ndarray]:
    """Writable vertices and tets of a good box of 40 tets."""
    mesh = box_mesh((2, 2, 2), (1.0, 1.0, 1.0))
    return mesh.vertices.copy(), mesh.tets.copy()


def signed_volume(vertices: np.ndarray, surface: np.ndarray) -> float:
    """Volume inside an oriented closed surface, by the divergence theorem."""
    x = vertices[surface]
    return float(np.einsum("ij,ij->", x[:, 0], np.cross(x[:, 1], x[:, 2])) / 6.0)


def test_single_tet_has_its_four_faces_outwards():
    mesh = TetMesh(CORNER, ONE)
    assert mesh.volumes == pytest.approx([1.0 / 6.0])
    assert len(mesh.surface) == 4
    x = mesh.vertices[mesh.surface]
    normals = np.cross(x[:, 1] - x[:, 0], x[:, 2] - x[:, 0])
    assert (np.einsum("ij,ij->i", normals, x[:, 0] - CORNER.mean(axis=0)) > 0).all()


def test_surface_is_closed_outward_and_owned():
    vertices, tets = parts()
    rng = np.random.default_rng(3)
    mesh = TetMesh(vertices + rng.uniform(-0.05, 0.05, vertices.shape), tets[rng.permutation(len(tets))])
    directed = mesh.surface[:, [[0, 1], [1, 2], [2, 0]]].reshape(-1, 2)
    there, back = {tuple(e) for e in directed}, {tuple(e[::-1]) for e in directed}
    assert len(there) == len(directed) and there == back  # every edge once in each sense
    assert signed_volume(mesh.vertices, mesh.surface) == pytest.approx(mesh.volumes.sum(), rel=1e-12)
    faces = np.sort(mesh.tets[mesh.surface_tets][:, TET_FACES], axis=2)
    assert (faces == np.sort(mesh.surface, axis=1)[:, None]).all(axis=2).any(axis=1).all()


def test_surface_is_what_counting_faces_one_by_one_gives():
    vertices, tets = parts()
    owners: dict[frozenset, int] = {}
    for tet in tets:
        for k in range(4):
            face = frozenset(np.delete(tet, k).tolist())
            owners[face] = owners.get(face, 0) + 1
    expected = {face for face, count in owners.items() if count == 1}
    assert {frozenset(triangle) for triangle in TetMesh(vertices, tets).surface.tolist()} == expected


def test_arrays_are_copies_and_read_only():
    vertices, tets = parts()
    mesh = TetMesh(vertices, tets)
    vertices[0], tets[0] = 99.0, 0
    assert mesh.vertices.max() < 99.0 and mesh.tets[0].any()
    for array in (mesh.vertices, mesh.tets, mesh.surface, mesh.surface_tets, mesh.volumes):
        with pytest.raises(ValueError, match="read-only"):
            array[0] = 0


@pytest.mark.parametrize("value", [np.nan, np.inf, -np.inf])
def test_coordinate_not_finite(value):
    vertices, tets = parts()
    vertices[17, 1] = value
    with pytest.raises(MeshError, match="vertex 17 coordinate 1 is not finite"):
        TetMesh(vertices, tets)


def test_coordinate_beyond_32_bits():
    vertices, tets = parts()
    vertices[17, 2] = 1e39
    with pytest.raises(MeshError, match=r"vertex 17 coordinate 2 is 1e\+39 m"):
        TetMesh(vertices, tets)


@pytest.mark.parametrize("bad", [27, 1000, -1, -27, 2**62])
def test_index_that_does_not_exist(bad):
    vertices, tets = parts()
    tets[5, 2] = bad
    with pytest.raises(MeshError, match=rf"tet 5: vertex {bad} does not exist \(27 vertices") as told:
        TetMesh(vertices, tets)
    assert "subtract 1" not in str(told.value)


def test_indices_that_count_from_one():
    vertices, tets = parts()
    with pytest.raises(MeshError, match="vertex 27 does not exist .* count from 1, subtract 1"):
        TetMesh(vertices, tets + 1)


def test_unsigned_indices_do_not_wrap_round():
    vertices, tets = parts()
    tets = tets.astype(np.uint64)
    tets[5, 2] = 2**64 - 1
    with pytest.raises(MeshError, match="tet 5: vertex 18446744073709551615 does not exist"):
        TetMesh(vertices, tets)


def test_some_inverted_tets_are_refused_or_flipped_on_request():
    vertices, tets = parts()
    good = TetMesh(vertices, tets)
    tets[[7, 30]] = tets[[7, 30]][:, [1, 0, 2, 3]]
    with pytest.raises(MeshError, match="2 of 40 tets are inverted, the first is tet 7"):
        TetMesh(vertices, tets)
    with pytest.warns(UserWarning, match="2 of 40 inverted tets have been flipped: 7, 30"):
        mesh = TetMesh(vertices, tets, fix_orientation=True)
    assert mesh.flipped.tolist() == [7, 30] and len(mesh.warnings) == 1
    assert np.linalg.det(mesh.vertices[mesh.tets][:, 1:] - mesh.vertices[mesh.tets][:, :1]).min() > 0
    assert np.allclose(mesh.volumes, good.volumes)


def test_a_mirrored_mesh_is_flipped_with_one_warning():
    vertices, tets = parts()
    with pytest.warns(UserWarning, match="all 40 tets are inverted"):
        mesh = TetMesh(vertices * (-1, 1, 1), tets)
    assert len(mesh.warnings) == 1 and len(mesh.flipped) == 40
    assert signed_volume(mesh.vertices, mesh.surface) == pytest.approx(1.0)


@pytest.mark.parametrize("scale", [1e-6, 1.0, 1e6])
@pytest.mark.parametrize("height", [0.0, 1e-10, -1e-10])
def test_tet_without_volume(scale, height):
    vertices = CORNER.copy()
    vertices[3] = (0.3, 0.3, height)
    with pytest.raises(MeshError, match="tet 0 has no volume"):
        TetMesh(vertices * scale, ONE)


@pytest.mark.parametrize("scale", [1e-6, 1.0, 1e6])
def test_a_flat_but_solid_tet_is_accepted(scale):
    vertices = CORNER.copy()
    vertices[3] = (0.3, 0.3, 1e-6)
    with pytest.warns(UserWarning, match="1 tets are nearly flat"):
        assert TetMesh(vertices * scale, ONE).volumes[0] > 0


def test_tet_that_names_a_vertex_twice():
    vertices, tets = parts()
    tets[9, 3] = tets[9, 0]
    with pytest.raises(MeshError, match="tet 9 names a vertex twice"):
        TetMesh(vertices, tets)


def test_tet_given_twice():
    vertices, tets = parts()
    with pytest.raises(MeshError, match="tets 4 and 40 have the same four vertices"):
        TetMesh(vertices, np.vstack([tets, tets[4:5, [1, 2, 0, 3]]]))


@pytest.mark.parametrize(
    "vertices, tets, rule",
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
def test_arrays_of_another_kind(vertices, tets, rule):
    with pytest.raises(MeshError, match=rule):
        TetMesh(vertices, tets)


def test_vertex_of_no_tet():
    with pytest.raises(MeshError, match="vertex 4 belongs to no tet"):
        TetMesh(np.vstack([CORNER, [(2.0, 2, 2)]]), ONE)


def test_face_of_three_tets():
    vertices = np.vstack([CORNER, [(0.0, 0, -1), (1.0, 1, -2)]])
    tets = [(0, 1, 2, 3), (0, 2, 1, 4), (0, 2, 1, 5)]
    with pytest.raises(MeshError, match=r"face \(0, 1, 2\) is shared by 3 tets \(0, 1, 2\)"):
        TetMesh(vertices, tets)


def test_neighbours_on_the_same_side_of_their_face_are_told():
    vertices = np.vstack([CORNER, [(0.3, 0.3, 2.0)]])
    with pytest.warns(UserWarning, match="1 pairs of neighbouring tets overlap.*tets 0 and 1"):
        TetMesh(vertices, [(0, 1, 2, 3), (0, 1, 2, 4)])


def two_boxes(shift) -> TetMesh:
    """Two unit boxes of one cell, the second shifted; vertices in the same place become one."""
    box = box_mesh((1, 1, 1), (1.0, 1.0, 1.0), pattern="six")
    vertices = np.vstack([box.vertices, box.vertices + np.asarray(shift, dtype=float)])
    labels = merge_labels(vertices, 1e-9)
    first = np.unique(labels, return_index=True)[1]
    return TetMesh(vertices[first], labels[np.vstack([box.tets, box.tets + box.n_verts])])


def test_pieces_are_counted():
    mesh = two_boxes((5, 0, 0))
    assert mesh.n_components == 2 and mesh.warnings == []


def test_parts_that_share_a_face_are_one():
    mesh = two_boxes((1, 0, 0))
    assert mesh.n_verts == 12 and mesh.n_components == 1 and mesh.warnings == []


def test_edge_joint_is_told():
    with pytest.warns(UserWarning, match="joined at an edge only at 1 edges"):
        mesh = two_boxes((1, 1, 0))
    assert mesh.n_components == 1 and len(mesh.warnings) == 1


def test_vertex_joint_is_told():
    with pytest.warns(UserWarning, match="joined at a vertex only at 1 vertices"):
        mesh = two_boxes((1, 1, 1))
    assert mesh.n_components == 1 and len(mesh.warnings) == 1


def test_coincident_vertices_are_told():
    box = box_mesh((1, 1, 1), (1.0, 1.0, 1.0), pattern="six")
    vertices = np.vstack([box.vertices, box.vertices + (1.0, 0, 0)])
    with pytest.warns(UserWarning, match="4 vertices coincide with another one, the first is vertex 8 on vertex 4"):
        mesh = TetMesh(vertices, np.vstack([box.tets, box.tets + 8]))
    assert mesh.n_components == 2


def test_messages_start_with_the_source():
    with pytest.raises(MeshError, match="^part.msh: tet 0: vertex 9"):
        TetMesh(CORNER, [(0, 1, 2, 9)], source="part.msh")


def test_merge_labels_joins_through_others_and_keeps_the_order():
    points = np.array([(3.0, 0, 0), (0, 0, 0), (0.9, 0, 0), (1.8, 0, 0), (0, 0, 0), (-0.0, 0, 0)])
    assert merge_labels(points, 0.0).tolist() == [0, 1, 2, 3, 1, 1]
    assert merge_labels(points, 1.0).tolist() == [0, 1, 1, 1, 1, 1]


@settings(max_examples=100, deadline=None)
@given(
    hnp.arrays(np.float64, st.tuples(st.integers(0, 6), st.integers(2, 4)), elements=st.floats(width=32)),
    hnp.arrays(np.int64, st.tuples(st.integers(0, 6), st.integers(3, 5)), elements=st.integers(-2, 7)),
)
@pytest.mark.filterwarnings("ignore::UserWarning")
def test_any_arrays_give_a_sound_mesh_or_a_mesh_error(vertices, tets):
    try:
        mesh = TetMesh(vertices, tets)
    except MeshError:
        return
    x = mesh.vertices[mesh.tets]
    assert (mesh.volumes > 0).all() and (np.linalg.det(x[:, 1:] - x[:, :1]) > 0).all() and len(mesh.surface) >= 4
