"""Connections and pressures in what a run writes:

* polylines go through the points of springs and tendons, also on obstacles that move, and have their tensions;
* pictures show them in the colours of their tensions, crosses at attached nodes, and arrows of pressures, and only where asked;
* USD holds a BasisCurves for each spring and tendon with its points and tension in every frame, and passes the validators;
* `frames.csv` has tensions, volumes, pressures and poses in every frame, and is continued by a resumed run.
"""

import csv

import numpy as np
import pytest
from pxr import Usd, UsdGeom

import taisoft as ts
from taisoft.output.connection_lines import ConnectionLines
from taisoft.output.frame_table import FrameTable
from taisoft.output.usd import UsdWriter
from taisoft.view.colouring import COLOURS
from taisoft.view.connection_layer import ATTACHED_COLOUR, PRESSURE_COLOUR
from taisoft.view.offscreen import Offscreen
from tests.cli.command import run, write
from tests.dynamics.scenes import cube, rubber
from tests.fem.oracle_springs import OracleSprings
from tests.output.usd_stage import faults


def connected(exact: bool = True) -> ts.Scene:
    """Two cubes under a beam that moves, on springs and tendons, one tighter than the other; the second hangs on the first."""
    scene = ts.Scene()
    scene.contact_forces = False
    scene.add_body(cube(), rubber(), name="a")
    scene.add_body(cube(), rubber(), name="b", position=(0.0, -0.9, 0.0))
    lift = ts.KeyFrames((0.0, 0.1), translations=[(0, 0, 0), (0.2, 0.1, 0)], rotations=[(0, 0, 0), (0, 0, 0.2)])
    scene.add_obstacle(ts.Box((0, 2.2, 0), (2, 0.2, 0.3)), name="beam", path=lift)
    scene.add_spring(("a", (0.4, 0.3, 0.4)), ("beam", (1.0, 2.0, 0.0)), 3000.0, rest_length=1.0, name="spring 1")
    scene.add_tendon([("beam", (-1, 2, 0.2)), ("a", (-0.4, 0.4, 0.5)), ("b", 3), ("beam", (1, 2, 0))], 9e3, name="line")
    scene.add_tendon([("beam", (0, 2, 0.3)), ("a", (0, 0.45, 0.5))], length=9.0, stiffness=10.0, name="slack")
    scene.attach("b", lambda X: X[:, 1] > 0.4, "a", None if exact else 2e4, name="joint")
    return scene


@pytest.mark.parametrize("exact", [True, False])
def test_polylines_run_through_the_points(exact):
    scene = connected(exact)
    lines = ConnectionLines(scene, [one for one in scene.connections if one not in scene.exact_attachments])
    with ts.Simulator(scene, dt=5e-3, precision="f64") as sim:
        for _ in range(8):
            sim.step()
        x, beam, oracle = sim.positions(), scene.obstacle("beam"), OracleSprings(connected(exact))
        points = lines.points(x, sim.time)
        expected = []
        for one in (*scene.springs, *scene.tendons):
            for point in one.points:
                row, place = oracle.point(point.owner, point.position)
                expected.append(row @ x if row.any() else beam.points_at(sim.time, beam.undisplaced(0.0, place[None]))[0])
        assert np.abs(points[: len(expected)] - expected).max() < 1e-12
        assert lines.tensions(sim)[:3] == pytest.approx([sim.joint_force(one) for one in ("spring 1", "line", "slack")])
        assert sim.tensions() == {name: sim.joint_force(name) for name in ("spring 1", "line", "slack")}
        ends, line = lines.segments
        assert np.bincount(line)[:3].tolist() == [1, 3, 1] and (np.diff(ends) == 1).all()
        if not exact:
            nodes = scene.attachments[0].nodes
            apart = points[len(expected) :].reshape(-1, 2, 3)
            assert np.abs(apart[:, 0] - sim.positions("b")[nodes]).max() == 0.0
            pulls = np.linalg.norm(sim.joint_force("joint"), axis=1)
            assert lines.tensions(sim)[3:] == pytest.approx(pulls)
            assert pulls == pytest.approx(2e4 * np.linalg.norm(apart[:, 0] - apart[:, 1], axis=1))


def close_to(image: np.ndarray, colour) -> int:
    return int((np.abs(image.astype(int) - 255 * np.asarray(colour)).max(axis=2) < 25).sum())


def picture(sim, layers) -> np.ndarray:
    drawing = Offscreen(sim.scene, (640, 360), layers=layers)
    try:
        return drawing.image(sim)
    finally:
        drawing.close()


@pytest.mark.filterwarnings("ignore:body")
def test_pictures_show_connections_and_pressures():
    scene = connected()
    scene.body("a").add_pressure(lambda c: c[:, 2] > 0.54, 2e3)
    with ts.Simulator(scene, dt=5e-3) as sim:
        sim.step()
        plain, both = picture(sim, ()), picture(sim, ("connections", "pressures"))
        for colour, layer in ((COLOURS[-1], "connections"), (COLOURS[0], "connections"), (ATTACHED_COLOUR, "connections")):
            assert close_to(both, colour) > close_to(plain, colour) + 8 < close_to(picture(sim, (layer,)), colour)
        assert close_to(both, PRESSURE_COLOUR) > close_to(plain, PRESSURE_COLOUR) + 8
        assert np.array_equal(picture(sim, ("fixed_nodes", "connections", "pressures")), both)  # the default
        drawing = Offscreen(scene, (64, 36))
        drawing.image(sim)
        kept = drawing.kept(sim.time + 1.0)
        assert kept["tension"] == pytest.approx(9e3) and kept["pressure"] == 2e3
        drawing.resume(kept | {"tension": 5.0, "pressure": 6.0})
        assert (drawing.layers.connections.peak, drawing.layers.pressures.peak) == (5.0, 6.0)
        drawing.close()


@pytest.mark.filterwarnings("ignore:body")
@pytest.mark.parametrize("pressure", [3e3, -3e3])
def test_arrows_point_along_the_force(pressure):
    block = ts.box_mesh((3, 3, 3), (3, 3, 3))
    hollow = np.abs(block.vertices[block.tets].mean(axis=1)).max(axis=1) > 0.5
    scene = ts.Scene(gravity=(0, 0, 0))
    body = scene.add_body(ts.TetMesh(block.vertices, block.tets[hollow]), rubber(young=1e7), name="block")
    body.add_cavity(lambda c: np.abs(c).max(axis=1) < 0.6, pressure=pressure, name="gas")
    with ts.Simulator(scene, dt=1e-3) as sim:
        drawing = Offscreen(scene, (64, 36), layers=("pressures",))
        camera = drawing.camera
        ends, _ = drawing.layers.lines(sim, camera)
        ends = camera.position + (ends - camera.position) / 0.1  # they are drawn in front
        shafts = np.abs(ends[: len(ends) // 3]).max(axis=1).reshape(-1, 2)  # start and tip, in the norm whose unit ball is a cube
        assert len(shafts) >= 10 and ((shafts[:, 1] - shafts[:, 0]) * np.sign(pressure) > 0.05).all()
        assert (shafts[:, 1] if pressure > 0 else shafts[:, 0]) == pytest.approx(np.full(len(shafts), 0.5), abs=1e-3)
        drawing.close()


def test_usd_holds_curves(tmp_path):
    scene, wanted = connected(), []
    writer = UsdWriter(tmp_path, scene, fps=30.0, chunk_frames=2)
    with ts.Simulator(scene, dt=5e-3) as sim:
        for index in range(5):
            if index:
                sim.step()
            writer.frame(sim, index)
            lines = ConnectionLines(scene, [*scene.springs, *scene.tendons])
            wanted.append((lines.points(sim.positions(), sim.time), sim.tensions()))
    writer.close()
    stage = Usd.Stage.Open(str(tmp_path / "scene.usdc"))
    assert faults(stage) == []
    for index, (points, tensions) in enumerate(wanted):
        places = {"spring 1": slice(0, 2), "line": slice(2, 6), "slack": slice(6, 8)}
        for name, rows in places.items():
            legal = name.replace(" ", "_")
            curve = UsdGeom.BasisCurves(stage.GetPrimAtPath(f"/World/{legal}"))
            assert curve.GetPrim().GetDisplayName() == name and curve.GetTypeAttr().Get() == "linear"
            assert list(curve.GetCurveVertexCountsAttr().Get()) == [rows.stop - rows.start]
            own = np.array(curve.GetPointsAttr().Get(index))
            assert np.array_equal(own, points[rows].astype(np.float32))
            low, high = np.array(curve.GetExtentAttr().Get(index))
            assert (low < own.min(axis=0)).all() and (high > own.max(axis=0)).all()
            tension = UsdGeom.PrimvarsAPI(curve).GetPrimvar("tension")
            assert tension.GetInterpolation() == "uniform" and list(tension.Get(index)) == [np.float32(tensions[name])]


SCENE = '''"""A cube on a tendon that is wound, beside a balloon."""
import numpy as np
import taisoft as ts

solver = {"dt": 0.01, "seconds": 0.2, "fps": 20}


def build():
    scene = ts.Scene()
    scene.contact_forces = False
    scene.add_body(ts.box_mesh((1, 1, 1), (1, 1, 1)), ts.Material(young=1e5), name="cube")
    scene.add_obstacle(ts.Sphere((0, 9, 0), 1), name="pin")
    winding = ts.KeyFrames((0.0, 0.2), values=(2.5, 2.4))
    scene.add_tendon([("pin", (0, 3, 0)), ("cube", (0, 0.5, 0))], length=winding, name="rope, long")
    block = ts.box_mesh((3, 3, 3), (3, 3, 3), (5, 0, 0))
    hollow = np.abs(block.vertices[block.tets].mean(axis=1) - (5, 0, 0)).max(axis=1) > 0.5
    body = scene.add_body(ts.TetMesh(block.vertices, block.tets[hollow]), ts.Material(young=1e5), name="block")
    body.add_cavity(lambda c: np.abs(c - (5, 0, 0)).max(axis=1) < 0.6, volume=1.05, name="water")
    return scene
'''


@pytest.mark.filterwarnings("ignore:body")
def test_a_table_of_frames(tmp_path):
    path, out, whole = write(tmp_path / "scene.py", SCENE), tmp_path / "out", tmp_path / "whole"
    options = ("--no-frames", "--no-usd")
    assert run(path, "--out", whole, *options) == 0
    rows = list(csv.DictReader(open(whole / "frames.csv", newline="")))
    assert list(rows[0]) == ["frame", "time", "tension of rope, long [N]", "volume of water [m^3]", "pressure of water [Pa]"]
    assert [row["frame"] for row in rows] == ["0", "1", "2", "3", "4"]
    assert [float(row["time"]) for row in rows] == pytest.approx([0.0, 0.05, 0.1, 0.15, 0.2])
    assert all(float(row["volume of water [m^3]"]) == pytest.approx(1.05, rel=1e-5) for row in rows[1:])
    assert float(rows[-1]["tension of rope, long [N]"]) > 1e3 and float(rows[-1]["pressure of water [Pa]"]) > 0.0
    assert run(path, "--out", out, "--seconds", "0.1", *options) == 0
    assert len((out / "frames.csv").read_text().splitlines()) == 4
    assert run(path, "--out", out, "--resume", out / "checkpoint.npz", *options) == 0
    assert (out / "frames.csv").read_bytes() == (whole / "frames.csv").read_bytes()


def test_poses_of_rigid_bodies(tmp_path):
    """A box that turns by half a turn and falls."""
    scene = ts.Scene(gravity=(0, -2, 0))
    mesh = ts.box_mesh((1, 1, 1), (1, 0.6, 0.3), (0, 0, 0.1))
    spin = {"angular_velocity": (0, 0, -2 * np.pi), "velocity": (1, 0, 0)}
    scene.add_rigid_body(mesh, density=1000.0, name="box", position=(0, 5, 0), **spin)
    table = FrameTable(tmp_path, scene)
    with ts.Simulator(scene, dt=0.0025, integrator="implicit_midpoint", precision="f64") as sim:
        for index in range(3):
            table.frame(sim, index)
            for _ in range(100 if index < 1 else 60):
                sim.step()
    table.close()
    rows = list(csv.DictReader(open(tmp_path / "frames.csv", newline="")))
    names = [f"{axis} of box [m]" for axis in "xyz"] + [f"q{part} of box" for part in "wxyz"]
    assert list(rows[0]) == ["frame", "time", *names]
    for row, t in zip(rows, (0.0, 0.25, 0.4)):
        angle = (2 * np.pi * t + np.pi) % (2 * np.pi) - np.pi
        expected = [t, 5 - t**2, 0.1, np.cos(angle / 2), 0, 0, -np.sin(angle / 2)]
        assert float(row["time"]) == pytest.approx(t)
        assert [float(row[name]) for name in names] == pytest.approx(expected, abs=5e-3)


def test_scenes_without_have_no_table():
    scene = ts.Scene()
    scene.add_body(cube(), rubber(), name="a").add_pressure(lambda c: c[:, 0] > 0.4, 1.0)
    assert not FrameTable.needed(scene)
    scene.add_spring(("a", 0), ("a", 7), 1.0)
    assert FrameTable.needed(scene)
