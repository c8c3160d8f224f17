"""Files for ParaView, read back by meshio; of a run, and of a resumed one; the same data for pyvista."""

import base64
import shutil
import sys
import xml.etree.ElementTree as ET
from pathlib import Path
from types import SimpleNamespace

import meshio
import numpy as np
import pytest

import taisoft as ts
from taisoft.dynamics.readout import nodal_impulses
from taisoft.errors import OutputError
from taisoft.output.nodal_fields import von_mises
from taisoft.records import Energies
from tests.cli.command import BEAM, LED, run, write
from tests.view.fake_simulator import RUBBER, FakeSimulator

GENTLE = LED.replace("{body}", "return (0, -t, 0)")
OPTIONS = ("--vtu", "--no-usd", "--no-frames")


class Touching(FakeSimulator):
    """With what is written of a simulator whose bodies touch."""

    touches = True
    write_vtu, to_pyvista = ts.Simulator.write_vtu, ts.Simulator.to_pyvista

    def velocities(self, name=None):
        return 2.0 * self.positions(name)

    def stress(self, name=None):
        return super().stress(name) + 10.0 * np.array([(0, 1, 2), (1, 0, 3), (2, 3, 0)])

    def contact_pressure(self, body):
        nodes = np.unique(self.scene.body(body).nodes.surface)
        vectors = np.column_stack([nodes, 2 * nodes, 3 * nodes])
        state = np.array(["open", "stick", "slip"], dtype=object)[nodes % 3]
        fields = {"pressure": 1.0 * nodes, "traction": vectors, "slip": -vectors, "accumulated_slip": 5.0 * nodes, "state": state}
        return SimpleNamespace(index=nodes, **fields)

    def energies(self):
        return Energies(kinetic=1.0, elastic=2.0, gravity=-3.0, loads=4.0)


@pytest.fixture(scope="module")
def written(tmp_path_factory):
    """A stand-in for the simulator of a quadratic body with regions and a linear one, and the file of its state."""
    path = tmp_path_factory.mktemp("vtu") / "state.vtu"
    box = ts.box_mesh((3, 1, 1), (1.5, 0.5, 0.5))
    regions = np.where(box.vertices[box.tets].mean(axis=1)[:, 0] < 0, 4, 7)
    scene = ts.Scene()
    scene.add_body(ts.TetMesh(box.vertices, box.tets, regions=regions), RUBBER, name="a & <b>", order=2, position=(0, 0.25, 0))
    with pytest.warns(UserWarning, match="bends about"):
        scene.add_body(box, RUBBER, name="linear", position=(0.1, 0.76, 0))
    sim = Touching(scene)
    sim.time = 0.05
    sim.write_vtu(path)
    return sim, path


def test_points_cells_and_data_come_back_from_meshio(written):
    sim, path = written
    mesh = meshio.read(path)
    quadratic, linear = sim.scene.bodies
    assert np.array_equal(mesh.points, sim.positions())
    assert [block.type for block in mesh.cells] == ["tetra10", "tetra"]
    assert np.array_equal(mesh.cells[1].data, quadratic.n_nodes + linear.nodes.elements)
    assert np.array_equal(np.sort(mesh.cells[0].data), np.sort(quadratic.nodes.elements))
    start = np.concatenate([body.rest_positions + body.position for body in sim.scene.bodies])
    impulses, sigma = nodal_impulses(sim.contacts(), len(start)), sim.stress()
    assert np.abs(impulses).max() > 0 and np.abs(sigma).max() > 100
    for name, values in {"displacement": mesh.points - start, "velocity": sim.velocities(), "contact_impulse": impulses}.items():
        assert np.array_equal(mesh.point_data[name], values.astype(np.float32)), name
    cells = {name: np.concatenate(blocks) for name, blocks in mesh.cell_data.items()}
    six = np.stack([sigma[:, i, j] for i, j in ((0, 0), (1, 1), (2, 2), (0, 1), (1, 2), (0, 2))], axis=1)
    assert np.array_equal(cells["stress"], six.astype(np.float32))
    assert np.array_equal(cells["von_mises"], von_mises(sigma).astype(np.float32))
    assert np.array_equal(cells["body"], np.repeat([0, 1], [len(quadratic.mesh.tets), len(linear.mesh.tets)]))
    assert np.array_equal(cells["region"], np.concatenate([quadratic.mesh.regions, np.zeros(len(linear.mesh.tets))]))
    expected = {name: getattr(sim.energies(), name) for name in ("kinetic", "elastic", "gravity", "loads", "dissipated")}
    expected |= {"TimeValue": sim.time, "body a & <b>": 0, "body linear": 1}
    assert {name: value.item() for name, value in mesh.field_data.items()} == expected
    # VTK's file format: nodes 4 to 9 of type 24 lie on the edges 01, 12, 20, 03, 13, 23
    rest, tets, edges = quadratic.rest_positions, mesh.cells[0].data, ((0, 1), (1, 2), (2, 0), (0, 3), (1, 3), (2, 3))
    middles = np.stack([rest[tets[:, edge]].mean(axis=1) for edge in edges], axis=1)
    assert np.allclose(rest[tets[:, 4:]], middles, atol=1e-12)
    again = ts.read_mesh(path)
    assert again.mid_edge is not None and again.n_tets == len(sigma) and again.region_ids == (0, 4, 7)


def test_the_grid_of_a_simulator_has_what_is_written(written, monkeypatch):
    """By a stand-in for pyvista, which takes the number of nodes before those of each cell."""
    taken = []

    def grid(cells, types, points):
        taken[:] = cells, types, points
        return SimpleNamespace(point_data={}, cell_data={}, field_data={})

    monkeypatch.setitem(sys.modules, "pyvista", SimpleNamespace(UnstructuredGrid=grid))
    sim, path = written
    made, read = sim.to_pyvista(), meshio.read(path)
    rows = [np.insert(block.data, 0, block.data.shape[1], axis=1).ravel() for block in read.cells]
    assert np.array_equal(taken[0], np.concatenate(rows)) and np.array_equal(taken[2], read.points)
    assert taken[1].tolist() == [24] * len(read.cells[0].data) + [10] * len(read.cells[1].data)
    assert all(np.array_equal(made.point_data[name], values) for name, values in read.point_data.items())
    assert all(np.array_equal(made.cell_data[name], np.concatenate(blocks)) for name, blocks in read.cell_data.items())
    assert {name: value.item() for name, value in read.field_data.items()} == {n: v[0] for n, v in made.field_data.items()}


def test_pyvista_gets_what_is_written(written):
    pyvista = pytest.importorskip("pyvista")
    sim, path = written
    grid, read = sim.to_pyvista(), pyvista.read(path)
    assert np.array_equal(grid.points, sim.positions()) and np.array_equal(grid.cells, read.cells)
    assert np.array_equal(grid.celltypes, read.celltypes)
    for given, expected in ((getattr(one, kind) for one in (grid, read)) for kind in ("point_data", "cell_data", "field_data")):
        assert set(given.keys()) == set(expected.keys())
        assert all(np.array_equal(given[name], expected[name]) for name in expected.keys())
    mesh = sim.scene.bodies[0].mesh
    assert mesh.to_pyvista().volume == pytest.approx(mesh.volumes.sum())
    assert mesh.to_pyvista().cell_data["region"].tolist() == mesh.regions.tolist()
    assert ts.SurfaceMesh(mesh.vertices, mesh.surface).to_pyvista().volume == pytest.approx(mesh.volumes.sum())


def test_a_missing_pyvista_is_reported_in_one_sentence(written, monkeypatch):
    monkeypatch.setitem(sys.modules, "pyvista", None)
    for one in (written[0], written[0].scene.bodies[0].mesh):
        with pytest.raises(
            OutputError, match=r"^to_pyvista needs the package pyvista, which .*: pip install 'taisoft\[pyvista\]'$"
        ):
            one.to_pyvista()


def test_megabytes_of_any_numbers_come_back(tmp_path):
    """In several blocks of compressed data, whose header is as VTK's file format says."""
    scene = ts.Scene()
    body = scene.add_body(ts.box_mesh((20, 20, 20), (1, 1, 1)), ts.Material(), name="b")

    class Anywhere(Touching):
        def positions(self, name=None):
            return np.random.default_rng(0).normal(size=(body.n_nodes, 3)) * (1e6, 1.0, 1e-6)

        velocities = positions

    Anywhere(scene).write_vtu(tmp_path / "x.vtu")
    mesh, tets = meshio.read(tmp_path / "x.vtu"), body.nodes.elements
    assert np.array_equal(mesh.points, Anywhere(scene).positions()) and np.array_equal(mesh.cells[0].data, tets)
    array = ET.parse(tmp_path / "x.vtu").find(".//Cells/DataArray")
    n, size, last = np.frombuffer(base64.b64decode(array.text[:32]), "<u8")
    assert n > 1 and (n - 1) * size + last == tets.size * int(array.attrib["type"][-2:]) // 8


def test_a_name_that_cannot_be_written_is_refused(written, tmp_path):
    for path, error in (
        (tmp_path / "a.vtk", r"a\.vtk: the name .* must end in \.vtu"),
        (tmp_path / "none/a.vtu", "cannot write"),
        (3, "path must be a file's name, not 3"),
    ):
        with pytest.raises(OutputError, match=error):
            written[0].write_vtu(path)
    assert not list(tmp_path.iterdir())


@pytest.fixture(scope="module")
def single(tmp_path_factory) -> Path:
    folder = tmp_path_factory.mktemp("single")
    assert run(write(folder / "scene.py", GENTLE), "--seconds", "0.2", "--out", folder / "out", *OPTIONS) == 0
    return folder / "out"


def test_a_run_writes_a_file_a_frame_and_their_list(single):
    listed = [(one.attrib["file"], float(one.attrib["timestep"])) for one in ET.parse(single / "scene.pvd").iter("DataSet")]
    assert [file for file, _ in listed] == [f"vtu/{k:05d}.vtu" for k in range(7)]
    assert np.allclose([time for _, time in listed], np.arange(7) / 30, atol=1e-12)
    grid = meshio.read(single / listed[-1][0])
    assert grid.field_data["TimeValue"].item() == listed[-1][1]
    assert np.abs(grid.point_data["displacement"]).max() > 0.05


def test_a_resumed_run_continues_the_list(tmp_path, capsys):
    """A broken one is refused before anything is removed; without --vtu later frames leave it."""
    path, out = write(tmp_path / "scene.py", GENTLE), tmp_path / "out"
    assert run(path, "--out", out, "--seconds", str(2 / 30), *OPTIONS) == 0
    early = shutil.copy(out / "checkpoint.npz", tmp_path)
    assert run(path, "--out", out, "--resume", early, "--seconds", "0.1", *OPTIONS) == 0
    text = (out / "scene.pvd").read_text()
    resumed = ("--out", out, "--no-usd", "--no-frames", "--seconds", "0.1", "--resume", early)
    for listed, options, status, n in (("<VTKFile", ["--vtu"], 3, 4), (text, ["--vtu"], 0, 4), (text, [], 0, 2)):
        (out / "scene.pvd").write_text(listed)
        assert run(path, *resumed, *options) == status
        assert [file.name for file in sorted((out / "vtu").iterdir())] == [f"{k:05d}.vtu" for k in range(n)]
    assert f"{out / 'scene.pvd'} cannot be read" in capsys.readouterr().err
    assert [one.attrib["file"] for one in ET.parse(out / "scene.pvd").iter("DataSet")] == ["vtu/00000.vtu", "vtu/00001.vtu"]


def test_results_are_replaced_only_on_request(tmp_path, capsys):
    path, out = write(tmp_path / "scene.py", BEAM), tmp_path / "out"
    (out / "vtu").mkdir(parents=True)
    (out / "vtu" / "00009.vtu").write_text("of another run")
    assert run(path, "--out", out, *OPTIONS) == 3
    assert "already holds results (vtu/)" in capsys.readouterr().err
    assert run(path, "--out", out, "--overwrite", "--vtu", "--error", "--no-usd", "--no-frames") == 0
    assert sorted(path.name for path in (out / "vtu").iterdir()) == [f"{k:05d}.vtu" for k in range(4)]
    first, last = (meshio.read(out / "vtu" / f"{k:05d}.vtu").point_data["estimated_error"] for k in (0, 3))
    assert (first <= 0).all() and last.max() > 0 and len(last) == len(ts.box_mesh((4, 1, 1), (4, 2, 2)).vertices)
    assert run(path, "--out", out, "--overwrite", "--no-usd", "--no-frames", "--seconds", "0.01") == 0
    assert not list(out.rglob("*.vtu")) and not (out / "scene.pvd").exists()
