"""TetMesh: a closed outward surface; inverted tets are rejected or flipped; invalid arrays are rejected with index and rule;
doubtful meshes cause one warning; the mean ratio of a tet is 1 if it is regular and does not depend on size.
"""

import numpy as np
import pytest

from taisoft.errors import MeshError
from taisoft.mesh.quality import edge_lengths, mean_ratio, mean_surface_edge
from taisoft.mesh.shapes import box_mesh
from taisoft.mesh.tet_mesh import TetMesh
from taisoft.mesh.topology import TET_FACES, merged_points

CORNER = np.array([(0.0, 0, 0), (1, 0, 0), (0, 1, 0), (0, 0, 1)])  # a positive tet
REGULAR = np.array([(1.0, 1, 1), (-1, 1, -1), (1, -1, -1), (-1, -1, 1)])
TWO_BELOW = np.vstack([CORNER, [(0.0, 0, -1), (1.0, 1, -2)]])
ONE = np.array([(0, 1, 2, 3)])


def box_arrays() -> tuple[np.ndarray, np.ndarray]:
    """Writable vertices and tets of a valid box of 40 tets."""
    mesh = box_mesh((2, 2, 2), (1.0, 1.0, 1.0))
    return mesh.vertices.copy(), mesh.tets.copy()


def signed_volume(mesh: TetMesh) -> float:
    """Volume inside the surface, by the divergence theorem."""
    x = mesh.vertices[mesh.surface]
    return float(np.einsum("ij,ij->", x[:, 0], np.cross(x[:, 1], x[:, 2])) / 6.0)


def test_surface_is_closed_and_encloses_the_volume():
    vertices, tets = box_arrays()
    rng = np.random.default_rng(3)
    mesh = TetMesh(vertices + rng.uniform(-0.05, 0.05, vertices.shape), tets[rng.permutation(len(tets))])
    directed = mesh.surface[:, [[0, 1], [1, 2], [2, 0]]].reshape(-1, 2)
    edges, reversed_edges = {tuple(e) for e in directed}, {tuple(e[::-1]) for e in directed}
    assert len(edges) == len(directed) and edges == reversed_edges  # every edge once in each direction
    assert signed_volume(mesh) == pytest.approx(mesh.volumes.sum(), rel=1e-12)
    faces = np.sort(mesh.tets[mesh.surface_tets][:, TET_FACES], axis=2)
    assert (faces == np.sort(mesh.surface, axis=1)[:, None]).all(axis=2).any(axis=1).all()
    assert TetMesh(CORNER, ONE).volumes == pytest.approx([1.0 / 6.0])


def test_arrays_are_copies_and_read_only():
    vertices, tets = box_arrays()
    mesh = TetMesh(vertices, tets)
    vertices[0], tets[0] = 99.0, 0
    assert mesh.vertices.max() < 99.0 and mesh.tets[0].any()
    assert not any(a.flags.writeable for a in (mesh.vertices, mesh.tets, mesh.surface, mesh.surface_tets, mesh.volumes))


def test_single_inverted_tets_are_rejected_or_flipped_on_request_and_mirrored_meshes_flipped():
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
    vertices, tets = box_arrays()
    with pytest.warns(UserWarning, match="all 40 tets are inverted"):
        mesh = TetMesh(vertices * (-1, 1, 1), tets)
    assert len(mesh.warnings) == 1 and len(mesh.flipped) == 40 and signed_volume(mesh) == pytest.approx(1.0)


def test_tets_without_volume_are_rejected_at_any_scale():
    for scale in (1e-6, 1.0, 1e6):
        for height in (0.0, 1e-10, -1e-10):
            with pytest.raises(MeshError, match="tet 0 has no volume"):
                TetMesh(scale * np.array([*CORNER[:3], (0.3, 0.3, height)]), ONE)
        with pytest.warns(UserWarning, match="1 tets are nearly flat"):
            TetMesh(scale * np.array([*CORNER[:3], (0.3, 0.3, 1e-6)]), ONE)


def changed(what: int, index, value):
    """Vertices (0) and tets (1) of the box with one number changed."""
    arrays = box_arrays()
    arrays[what][index] = value
    return arrays


@pytest.mark.parametrize(
    "vertices, tets, message",
    [
        (*changed(0, (17, 1), np.nan), "vertex 17 coordinate 1 is not finite"),
        (*changed(0, (17, 1), 1e39), r"vertex 17 coordinate 1 is 1e\+39 m"),  # beyond f32
        (*changed(1, (5, 2), 27), r"tet 5: vertex 27 does not exist \(27 vertices, counted from 0\)$"),
        (*changed(1, (5, 2), -1), r"tet 5: vertex -1 does not exist \(27 vertices, counted from 0\)$"),
        (box_arrays()[0], box_arrays()[1] + 1, "tet .*: vertex 27 does not exist .* count from 1, subtract 1"),
        (CORNER, [(0, 1, 2, 1)], "tet 0 names a vertex twice"),
        (CORNER, [(0, 1, 2, 3), (1, 2, 0, 3)], "tets 0 and 1 have the same four vertices"),
        (np.vstack([CORNER, [(2.0, 2, 2)]]), ONE, "vertex 4 belongs to no tet"),
        (TWO_BELOW, [(0, 1, 2, 3), (0, 2, 1, 4), (0, 2, 1, 5)], r"face \(0, 1, 2\) is shared by 3 tets \(0, 1, 2\)"),
        (np.empty((0, 3)), ONE, "no vertices found"),
        (CORNER, ONE[:, :3], r"tets must have shape \(m, 4\), not \(1, 3\)"),
        (CORNER, ONE.astype(float), "tets must be integers"),
        (None, ONE, "vertices must be numbers"),
    ],
)
def test_invalid_arrays_are_rejected(vertices, tets, message):
    with pytest.raises(MeshError, match=f"^part.msh: {message}"):
        TetMesh(vertices, tets, source="part.msh")


def two_boxes(shift) -> TetMesh:
    """Two unit boxes of one cell, the second shifted; coincident vertices are merged."""
    box = box_mesh((1, 1, 1), (1.0, 1.0, 1.0), pattern="six")
    vertices = np.vstack([box.vertices, box.vertices + np.asarray(shift, dtype=float)])
    labels = merged_points(vertices, 1e-9)[1]
    first = np.unique(labels, return_index=True)[1]
    return TetMesh(vertices[first], labels[np.vstack([box.tets, box.tets + box.n_verts])])


def test_merging_is_transitive_and_keeps_the_order_and_components_are_counted():
    points = np.array([(3.0, 0, 0), (0, 0, 0), (0.9, 0, 0), (1.8, 0, 0), (0, 0, 0), (-0.0, 0, 0)])
    assert merged_points(points, 0.0)[1].tolist() == [0, 1, 2, 3, 1, 1]
    assert merged_points(points, 1.0)[1].tolist() == [0, 1, 1, 1, 1, 1]
    for shift, n_verts, n_components in (((5, 0, 0), 16, 2), ((1, 0, 0), 12, 1)):
        mesh = two_boxes(shift)
        assert mesh.n_verts == n_verts and mesh.n_components == n_components and mesh.warnings == ()


@pytest.mark.parametrize(
    "make, message",
    [
        (lambda: two_boxes((1, 1, 0)), "joined at an edge only at 1 edges"),
        (lambda: two_boxes((1, 1, 1)), "joined at a vertex only at 1 vertices"),
        (lambda: TetMesh([*CORNER, (0.3, 0.3, 2.0)], [(0, 1, 2, 3), (0, 1, 2, 4)]), "1 pairs of .* overlap.*tets 0 and 1"),
        (
            lambda: TetMesh(np.vstack([REGULAR, REGULAR + (9, 0, 0), REGULAR + (9, 0, 0)]), np.arange(12).reshape(3, 4)),
            "4 vertices coincide with another one, the first is vertex 8 on vertex 4",
        ),
        (lambda: TetMesh(CORNER + (0, 2e5, 0), ONE), "lies 2e[+]05 m from the origin"),
    ],
)
def test_doubtful_meshes_cause_one_warning(make, message):
    with pytest.warns(UserWarning, match=message):
        assert len(make().warnings) == 1


def quality(mesh: TetMesh) -> np.ndarray:
    return mean_ratio(edge_lengths(mesh.vertices, mesh.tets), mesh.volumes)


def test_mean_ratio_of_a_regular_tet_and_of_a_corner():
    for scale in (1e-5, 1.0, 1e5):
        assert quality(TetMesh(scale * REGULAR, ONE)) == pytest.approx([1.0])
        # volume 1/6, three edges of 1 and three of sqrt 2
        assert quality(TetMesh(scale * CORNER, ONE)) == pytest.approx([12 * 0.5 ** (2 / 3) / 9])


def test_edges_are_ordered_by_their_vertices():
    lengths = edge_lengths(np.array([(0.0, 0, 0), (1, 0, 0), (0, 2, 0), (0, 0, 3)]), ONE)
    assert lengths == pytest.approx(np.sqrt([[1, 4, 9, 5, 10, 13]]))
    right = np.array([(0.0, 0, 0), (3, 0, 0), (0, 4, 0)])  # edges of 3, 4 and 5
    assert mean_surface_edge([(right, ONE[:, :3]), (2 * right, ONE[:, :3])]) == pytest.approx(6.0)


def test_nearly_flat_tets_are_warned_of_with_the_worst():
    box = box_mesh((1, 1, 1), (1.0, 1.0, 1.0))  # five good tets; two flat ones are added on the face x = -1/2
    vertices = np.vstack([box.vertices, [(-0.501, -1 / 6, 1 / 6), (-0.5003, 1 / 6, -1 / 6)]])
    tets = np.vstack([box.tets, [(0, 1, 3, 8), (0, 3, 2, 9)]])
    with pytest.warns(UserWarning, match=r"^part: 2 tets are nearly flat .* the worst is tet 6 with 0\.0064: explicit"):
        mesh = TetMesh(vertices, tets, source="part")
    assert len(mesh.warnings) == 1 and quality(mesh)[:5].min() > 0.5
    # area 1/2, height 3e-4, edges of 1, 1 and sqrt 2, and those from the centroid
    assert quality(mesh)[6] == pytest.approx(12 * (1.5e-4) ** (2 / 3) / (4 + 4 / 3), rel=1e-6)
