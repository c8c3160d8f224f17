"""Meshes with curved edges: their mid-edge nodes are read from files in any order of the edges, written, and read back."""

import meshio
import numpy as np
import pytest

import taisoft as ts
from taisoft.mesh.topology import distinct_edges

BALL = ts.ball_mesh(1.0, 4)
MIDDLES = ts.Scene().add_body(BALL, ts.Material(), order=2, curve=ts.Sphere((0, 0, 0), 1.0)).rest_positions[BALL.n_verts :]
MESH = ts.TetMesh(BALL.vertices, BALL.tets, mid_edge=MIDDLES, regions=np.arange(BALL.n_tets) % 2 + 1)
EDGES = ((0, 1), (0, 2), (0, 3), (1, 2), (1, 3), (2, 3))
# the edges of nodes 4 to 9 by the formats' manuals
ORDERS = {"gmsh": (0, 3, 1, 2, 5, 4), "vtk": (0, 3, 1, 2, 4, 5)}


def on_sphere(mesh: ts.TetMesh) -> None:
    """Check the middles of surface edges, which lie on the unit sphere."""
    edges = distinct_edges(mesh.tets)[0]
    ends = np.sort(mesh.surface[:, [(0, 1), (1, 2), (2, 0)]].reshape(-1, 2), axis=1)
    rows = np.searchsorted(edges[:, 0] * mesh.n_verts + edges[:, 1], ends[:, 0] * mesh.n_verts + ends[:, 1])
    assert np.abs(np.linalg.norm(mesh.mid_edge[rows], axis=1) - 1.0).max() < 1e-15
    assert np.linalg.norm(mesh.vertices[ends].mean(axis=1), axis=1).min() < 0.96


@pytest.mark.parametrize("name", ["a.msh", "a.vtk", "a.vtu"])
def test_round_trips(name, tmp_path):
    ts.write_mesh(tmp_path / name, MESH)
    again = ts.read_mesh(tmp_path / name)
    assert again.warnings == () and np.array_equal(again.tets, MESH.tets) and np.array_equal(again.regions, MESH.regions)
    assert np.array_equal(again.vertices, MESH.vertices) and np.array_equal(again.mid_edge, MIDDLES)
    on_sphere(again)


def test_written_nodes_lie_on_the_edges_of_the_format(tmp_path):
    ts.write_mesh(tmp_path / "a.vtu", MESH)
    record = meshio.read(tmp_path / "a.vtu")
    cells, x = record.cells_dict["tetra10"], record.points
    ends = cells[:, :4][:, np.array(EDGES)[list(ORDERS["vtk"])]]
    assert np.linalg.norm(x[cells[:, 4:]] - x[ends].mean(axis=2), axis=2).max() < 0.13
    assert np.array_equal(MESH.to_meshio().cells[0].data, cells)


@pytest.mark.parametrize("version", ["2.2", "4.1"])
def test_gmsh_files(version, tmp_path):
    """As Gmsh writes them: nodes of tets of type 11 in its own order of the edges."""
    nodes = np.concatenate([BALL.vertices, MIDDLES])
    tets = np.concatenate([BALL.tets, BALL.n_verts + distinct_edges(BALL.tets)[1][:, ORDERS["gmsh"]]], axis=1) + 1
    n, m = len(nodes), len(tets)
    points = [" ".join(f"{x:.17g}" for x in row) for row in nodes]
    ids = [" ".join(map(str, row)) for row in tets.tolist()]
    if version == "2.2":
        rows = ["$Nodes", n, *(f"{k} {row}" for k, row in enumerate(points, 1)), "$EndNodes", "$Elements", m]
        rows += [*(f"{k} 11 2 0 1 {row}" for k, row in enumerate(ids, 1)), "$EndElements"]
    else:
        rows = ["$Nodes", f"1 {n} 1 {n}", f"3 1 0 {n}", *range(1, n + 1), *points, "$EndNodes"]
        rows += ["$Elements", f"1 {m} 1 {m}", f"3 1 11 {m}", *(f"{k} {row}" for k, row in enumerate(ids, 1)), "$EndElements"]
    text = "\n".join(map(str, ["$MeshFormat", f"{version} 0 8", "$EndMeshFormat", *rows]))
    (tmp_path / "a.msh").write_text(text + "\n")
    mesh = ts.read_mesh(tmp_path / "a.msh")
    assert np.array_equal(mesh.vertices, BALL.vertices) and np.array_equal(mesh.mid_edge, MIDDLES)
    on_sphere(mesh)


def test_mixed_orders_and_disagreement(tmp_path):
    cells, points = MESH.to_meshio().cells[0].data, MESH.to_meshio().points
    mixed = meshio.Mesh(points, [("tetra", cells[:100, :4]), ("tetra10", cells[100:])])
    with pytest.warns(UserWarning, match="vertices of no tet are left out"):
        mesh = ts.TetMesh.from_meshio(mixed)
    edges, of_tet = distinct_edges(BALL.tets)
    second = np.isin(np.arange(len(edges)), of_tet[100:])
    assert np.array_equal(mesh.mid_edge[second], MIDDLES[second])
    assert np.array_equal(mesh.mid_edge[~second], BALL.vertices[edges[~second]].mean(axis=1))
    cells, points = cells.copy(), np.concatenate([points, points[cells[0, 4:5]] + 0.01])
    cells[0, 4] = len(points) - 1
    with pytest.raises(ts.MeshError, match=r"tets have different nodes on the edge between vertices \d+ and \d+"):
        ts.TetMesh.from_meshio(meshio.Mesh(points, [("tetra10", cells)]))


def test_medit_files_lose_them_with_a_warning(tmp_path):
    with pytest.warns(UserWarning, match=r"a.mesh: .mesh cannot hold mid-edge nodes"):
        ts.write_mesh(tmp_path / "a.mesh", MESH)
    again = ts.read_mesh(tmp_path / "a.mesh")
    assert again.mid_edge is None and np.array_equal(again.tets, MESH.tets)
