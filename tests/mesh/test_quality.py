"""Shape quality of tets:

* the mean ratio is 1 for a regular tet, falls to 0 as the tet is flattened, and does not depend on size;
* a mesh warns of nearly flat tets with their number and the worst; grids and meshes from meshers give no warning.
"""

import numpy as np
import pytest

from taisoft.mesh.files import read_mesh
from taisoft.mesh.quality import edge_lengths, mean_ratio
from taisoft.mesh.shapes import box_mesh, sheet_mesh
from taisoft.mesh.tet_mesh import TetMesh

REGULAR = np.array([(1.0, 1, 1), (-1, 1, -1), (1, -1, -1), (-1, -1, 1)])
ONE = np.array([(0, 1, 2, 3)])


def quality(mesh: TetMesh) -> np.ndarray:
    return mean_ratio(edge_lengths(mesh.vertices, mesh.tets), mesh.volumes)


@pytest.mark.parametrize("scale", [1e-5, 1.0, 1e5])
def test_mean_ratio_of_a_regular_tet_and_of_a_corner(scale):
    assert quality(TetMesh(scale * REGULAR, ONE)) == pytest.approx([1.0])
    corner = TetMesh(scale * np.array([(0.0, 0, 0), (1, 0, 0), (0, 1, 0), (0, 0, 1)]), ONE)
    # volume 1/6, three edges of 1 and three of sqrt 2
    assert quality(corner) == pytest.approx([12 * 0.5 ** (2 / 3) / 9])


def test_edges_are_ordered_by_their_vertices():
    lengths = edge_lengths(np.array([(0.0, 0, 0), (1, 0, 0), (0, 2, 0), (0, 0, 3)]), ONE)
    assert lengths == pytest.approx(np.sqrt([[1, 4, 9, 5, 10, 13]]))


def test_nearly_flat_tets_are_warned_of_with_the_worst():
    box = box_mesh((1, 1, 1), (1.0, 1.0, 1.0))  # five good tets; two flat ones are added on the face x = -1/2
    vertices = np.vstack([box.vertices, [(-0.501, -1 / 6, 1 / 6), (-0.5003, 1 / 6, -1 / 6)]])
    tets = np.vstack([box.tets, [(0, 1, 3, 8), (0, 3, 2, 9)]])
    with pytest.warns(UserWarning, match=r"^part: 2 tets are nearly flat .* the worst is tet 6 with 0\.0064: explicit"):
        mesh = TetMesh(vertices, tets, source="part")
    assert len(mesh.warnings) == 1 and quality(mesh)[:5].min() > 0.5
    # area 1/2, height 3e-4, edges of 1, 1 and sqrt 2, and those from the centroid
    assert quality(mesh)[6] == pytest.approx(12 * (1.5e-4) ** (2 / 3) / (4 + 4 / 3), rel=1e-6)


@pytest.mark.parametrize("pattern", ["five", "six"])
def test_cells_are_warned_of_at_an_aspect_ratio_of_1000_but_not_of_200(pattern):
    assert sheet_mesh((3, 3), (0.3, 0.1 / 200, 0.3), pattern=pattern).warnings == []
    with pytest.warns(UserWarning, match="nearly flat"):
        sheet_mesh((3, 3), (0.3, 0.1 / 1000, 0.3), pattern=pattern)


@pytest.mark.parametrize("name", ["Armadillo13K", "bar-2523", "bunny", "mat20x20", "octocat", "sphere1K"])
def test_meshes_from_meshers_give_no_warning(shared, name):
    assert read_mesh(shared / "meshes" / f"{name}.msh").warnings == []
