"""Second-order tets in files:

* their corners give the mesh of the same file of first order, in every format and for any order of the edges, without a warning
  if edges are straight;
* curved edges are counted in a warning with the largest deviation; nodes off the edges are rejected;
* they can be combined with first-order tets, second-order boundary elements, unused vertices and welding.
"""

import contextlib
import io
from pathlib import Path

import meshio
import numpy as np
import pytest

from taisoft.errors import MeshError
from taisoft.mesh.files import read_mesh
from taisoft.mesh.nodes import make_nodes
from taisoft.mesh.shapes import ball_mesh, box_mesh
from taisoft.mesh.topology import EDGES

MESH = box_mesh((2, 1, 1), (0.3, 0.1, 1.0 / 3.0), center=(0.1, 0.2, 0.3))
NODES = make_nodes(MESH, 2)
CELLS = NODES.elements[:, [0, 1, 2, 3, 4, 7, 5, 6, 8, 9]]  # VTK's order of the edges: 01, 12, 02, 03, 13, 23


def write(path: Path, points=NODES.positions, cells=CELLS, others=(), **options) -> Path:
    with contextlib.redirect_stdout(io.StringIO()), contextlib.redirect_stderr(io.StringIO()):
        meshio.write(path, meshio.Mesh(points, [*others, ("tetra10", cells)]), **options)
    return path


def equals_mesh(mesh) -> bool:
    return np.array_equal(mesh.vertices, MESH.vertices) and np.array_equal(mesh.tets, MESH.tets)


FORMATS = [(ending, {}) for ending in (".vtk", ".vtu", ".inp", ".mdpa", ".vol")]
FORMATS += [(".msh", {"file_format": version, "binary": binary}) for version in ("gmsh22", "gmsh") for binary in (False, True)]


@pytest.mark.parametrize("ending, options", FORMATS)
def test_corners_make_the_mesh(tmp_path, ending, options):
    mesh = read_mesh(write(tmp_path / f"part{ending}", **options))
    assert equals_mesh(mesh) and mesh.warnings == []


@pytest.mark.parametrize("seed", range(3))
def test_edges_may_have_any_order(tmp_path, seed):
    cells = np.hstack([CELLS[:, :4], 0 * CELLS[:, 4:]])
    cells[:, 4:] = CELLS[:, 4:][:, np.random.default_rng(seed).permutation(6)]
    mesh = read_mesh(write(tmp_path / "part.vtk", cells=cells))
    assert equals_mesh(mesh) and mesh.warnings == []


def test_second_order_tetgen_files(tmp_path):
    rows = [f"{i} {x:.17g} {y:.17g} {z:.17g}" for i, (x, y, z) in enumerate(NODES.positions, 1)]
    (tmp_path / "t.node").write_text("\n".join([f"{len(rows)} 3 0 0", *rows]))
    rows = [" ".join(map(str, [i, *(nodes + 1)])) for i, nodes in enumerate(NODES.elements, 1)]
    (tmp_path / "t.ele").write_text("\n".join([f"{len(rows)} 10 0", *rows]))
    assert equals_mesh(read_mesh(tmp_path / "t.ele"))
    (tmp_path / "t.ele").write_text("1 5 0\n1 1 2 3 4 5\n")
    with pytest.raises(MeshError, match="t.ele: tets must have 4 or 10 nodes, not 5"):
        read_mesh(tmp_path / "t.ele")


def curved_ball() -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Points, cells and the (k,2) surface edges of a ball whose surface edges are bent onto the sphere."""
    ball = ball_mesh(1.0, 4)
    nodes = make_nodes(ball, 2)
    edges = np.unique(np.sort(ball.surface[:, [[0, 1], [1, 2], [2, 0]]].reshape(-1, 2), axis=1), axis=0)
    points, middles = nodes.positions.copy(), np.setdiff1d(nodes.surface, ball.surface)
    points[middles] /= np.linalg.norm(points[middles], axis=1, keepdims=True)
    return points, nodes.elements, edges


def test_curved_edges_are_straightened_with_a_warning(tmp_path):
    points, cells, edges = curved_ball()
    a, b = points[edges[:, 0]], points[edges[:, 1]]
    deviation = (1 - 0.5 * np.linalg.norm(a + b, axis=1)) / np.linalg.norm(a - b, axis=1)
    with pytest.warns(UserWarning, match="part.vtu: .* curved"):
        mesh = read_mesh(write(tmp_path / "part.vtu", points, cells))
    assert np.array_equal(mesh.vertices, ball_mesh(1.0, 4).vertices) and len(mesh.warnings) == 1
    message = mesh.warnings[0]
    assert message.startswith(f"{len(edges)} edges of second-order tets are curved")
    assert f"the largest deviation is {deviation.max():.2g} of the edge's length, between vertices " in message
    worst = [int(word) for word in message.split("between vertices ")[1].split(" of ")[0].split(" and ")]
    assert deviation[(edges == worst).all(axis=1)] == pytest.approx(deviation.max())


@pytest.mark.parametrize("shift, n_warnings", [(0.9e-6, 0), (1.1e-6, 1)])
def test_deviation_below_a_millionth_counts_as_straight(tmp_path, shift, n_warnings, recwarn):
    points = NODES.positions.copy()
    edge = MESH.n_verts + 4
    a, b = next(c[list(EDGES[k])] for c in CELLS for k in range(6) if NODES.elements[(CELLS == c).all(1)][0, 4 + k] == edge)
    points[edge] += shift * np.linalg.norm(points[a] - points[b]) * np.array([0.6, 0, 0.8])
    mesh = read_mesh(write(tmp_path / "part.vtu", points))
    assert len(mesh.warnings) == n_warnings and all("1 edges of" in text and "1.1e-06" in text for text in mesh.warnings)


def test_nodes_off_the_edges_are_rejected(tmp_path):
    points = NODES.positions.copy()
    points[MESH.n_verts :] += 1.0
    mixed = CELLS[:, [0, 4, 1, 5, 2, 3, 6, 7, 8, 9]]
    for path in (write(tmp_path / "a.vtu", points), write(tmp_path / "b.vtu", cells=mixed), write(tmp_path / "c.post")):
        with pytest.raises(MeshError, match=f"{path.name}: the tets' ten nodes are not four corners and then one on each"):
            read_mesh(path)


def test_node_indices_out_of_range_are_rejected(tmp_path):
    cells = CELLS.copy()
    cells[3, 7] = 99
    with pytest.raises(MeshError, match="part.vtk: second-order tet 3: node 99 does not exist"):
        read_mesh(write(tmp_path / "part.vtk", cells=cells))
    cells[3, 2] = 99
    with pytest.raises(MeshError, match="part.vtk: tet 3: vertex 99 does not exist"):
        read_mesh(write(tmp_path / "part.vtk", cells=cells))


def test_both_orders_with_boundary_elements_and_unused_vertices(tmp_path):
    points = np.vstack([[(9.0, 9, 9)], NODES.positions])
    others = [("line3", CELLS[:1, [0, 1, 4]] + 1), ("triangle6", CELLS[:2, [0, 1, 2, 4, 5, 6]] + 1), ("tetra", MESH.tets[:4] + 1)]
    with pytest.warns(UserWarning):
        mesh = read_mesh(write(tmp_path / "part.vtk", points, CELLS[4:] + 1, others))
    n_unused = 1 + len(np.setdiff1d(CELLS[:4], [*CELLS[4:].flat, *MESH.tets.flat]))  # midside nodes of no second-order tet
    assert equals_mesh(mesh) and n_unused > 1
    assert mesh.warnings == [
        "1 line3, 2 triangle6 elements next to the tets are not used",
        f"{n_unused} vertices of no tet are left out, the first is vertex 0 of the file",
    ]


def test_midside_node_that_is_a_corner_of_another_tet_stays(tmp_path):
    """A tet on half of another one's edge, as after one-sided refinement."""
    box = make_nodes(box_mesh((1, 1, 1), (1.0, 1.0, 1.0)), 2)
    points = np.vstack([box.positions, [(-0.5, -2.0, -2.0), (0.0, -2.0, -1.0)]])
    corner, middle = box.elements[1, 0], box.elements[1, 4]
    n = len(box.positions)
    path = write(tmp_path / "part.vtk", points, box.elements, [("tetra", np.array([[corner, middle, n, n + 1]]))])
    with pytest.warns(UserWarning, match="joined at a vertex only"):
        mesh = read_mesh(path, fix_orientation=True)
    assert mesh.n_verts == 8 + 3 and mesh.n_tets == 6


def test_welding_merges_corners(tmp_path):
    one = make_nodes(box_mesh((1, 1, 1), (1.0, 1.0, 1.0), pattern="six"), 2)
    points = np.vstack([one.positions, one.positions + (1.0, 0, 0)])
    path = write(tmp_path / "part.vtk", points, np.vstack([one.elements, one.elements + len(one.positions)]))
    with pytest.warns(UserWarning, match="4 vertices were welded"):
        mesh = read_mesh(path, weld=0.0)
    assert mesh.n_verts == 12 and mesh.n_components == 1 and len(mesh.warnings) == 1
