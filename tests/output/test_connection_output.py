"""Connections, pressures and poses in what a run writes: polylines, pictures, curves of USD, and `frames.csv`."""

import csv
from dataclasses import replace
from types import SimpleNamespace

import numpy as np
import pytest
from pxr import Usd, UsdGeom

import taisoft as ts
from taisoft.output.connection_lines import ConnectionLines
from taisoft.output.frame_table import FrameTable
from taisoft.output.usd import UsdWriter
from taisoft.output.viewpoint import Viewpoint
from taisoft.view.colouring import GRADIENT
from taisoft.view.drawn import DrawnScene, DrawnState
from taisoft.view.layers import ATTACHED_COLOUR, IN_FRONT, PRESSURE_COLOUR, Layers
from taisoft.view.offscreen import Offscreen
from tests.collision.rotations import rotation
from tests.dynamics.scenes import cube, rubber
from tests.fem.oracle_springs import OracleSprings
from tests.output.usd_stage import faults

pytestmark = pytest.mark.filterwarnings("ignore:body")
NAMES = ("spring 1", "line", "slack")


def connected() -> ts.Scene:
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
    scene.attach("b", lambda X: X[:, 1] > 0.4, "a", 2e4, name="joint")
    scene.body("a").add_pressure(lambda c: c[:, 2] > 0.54, 2e3)
    return scene


def test_polylines_run_through_the_points(moved):
    """`lines` draw the attachment by springs too, from each node to its place."""
    scene, sim = moved
    lines = ConnectionLines(scene, scene.connections)
    x, beam, oracle, expected = sim.positions(), scene.obstacle("beam"), OracleSprings(scene), []
    points = lines.points(x, sim.time)
    for one in (*scene.springs, *scene.tendons):
        for point in one.points:
            row, place = oracle.point(point.owner, point.position)
            expected.append(row @ x if row.any() else beam.points_at(sim.time, beam.undisplaced(place[None]))[0])
    assert np.abs(points[: len(expected)] - expected).max() < 1e-6
    assert lines.tensions(sim)[:3] == pytest.approx([sim.joint_force(one) for one in NAMES])
    assert sim.tensions() == {name: sim.joint_force(name) for name in NAMES}
    ends, line = lines.segments
    assert np.bincount(line)[:3].tolist() == [1, 3, 1] and (np.diff(ends) == 1).all()
    apart = points[len(expected) :].reshape(-1, 2, 3)
    assert np.abs(apart[:, 0] - sim.positions("b")[scene.attachments[0].nodes]).max() == 0.0
    pulls = np.linalg.norm(sim.joint_force("joint"), axis=1)
    assert lines.tensions(sim)[3:] == pytest.approx(pulls)
    assert pulls == pytest.approx(2e4 * np.linalg.norm(apart[:, 0] - apart[:, 1], axis=1), rel=1e-3)


@pytest.fixture(scope="module")
def moved():
    """The scene, and a simulator of it after some steps; tests may take more."""
    scene = connected()
    with ts.Simulator(scene, dt=5e-3, integrator="symplectic_euler") as sim:
        for _ in range(8):
            sim.step()
        yield scene, sim


def test_pictures_show_connections_and_pressures(moved):
    def count(image: np.ndarray, colour) -> int:
        return int((np.abs(image.astype(int) - 255 * np.asarray(colour)).max(axis=2) < 25).sum())

    _, sim = moved
    choices = {}, {"layers": ("fixed_nodes",)}, {"layers": ("connections",)}, {"layers": ("pressures",)}
    default, plain, connections, pressures = (Offscreen(sim.scene, (640, 360), **layers).image(sim) for layers in choices)
    for colour in (GRADIENT[-1], GRADIENT[0], ATTACHED_COLOUR, PRESSURE_COLOUR):
        shown = pressures if colour is PRESSURE_COLOUR else connections
        assert min(count(default, colour), count(shown, colour)) > count(plain, colour) + 8
    drawing = Offscreen(sim.scene, (64, 36))
    drawing.image(sim)
    kept = drawing.kept(sim.time + 1.0)
    assert kept["tension"] == pytest.approx(9e3) and kept["pressure"] == 2e3
    drawing.resume(kept | {"tension": 5.0, "pressure": 6.0})
    assert drawing.layers.peaks == {"impulse": 0.0, "tension": 5.0, "pressure": 6.0}


def hollow_scene() -> ts.Scene:
    """A cube of 3 m with a cavity of 1 m, called water, and a pressure of 1 Pa on a side."""
    block, scene = ts.box_mesh((3, 3, 3), (3, 3, 3)), ts.Scene()
    hollow = np.abs(block.vertices[block.tets].mean(axis=1)).max(axis=1) > 0.5
    body = scene.add_body(ts.TetMesh(block.vertices, block.tets[hollow]), rubber(), name="block")
    body.add_pressure(lambda c: c[:, 0] > 1.4, 1.0)
    assert not FrameTable.needed(scene)
    body.add_cavity(lambda c: np.abs(c).max(axis=1) < 0.6, pressure=2.0, name="water")
    assert FrameTable.needed(scene)
    return scene


@pytest.mark.parametrize("pressure", [2.0, -2.0])
def test_arrows_point_along_the_force(pressure):
    """A push ends at the surface, a pull begins there; the longest belongs to the highest pressure."""
    scene, camera = hollow_scene(), Viewpoint(np.zeros(3), 10.0)
    drawn = DrawnScene.of(scene)
    drawn.pressed = [(corners, 3.0 / drawn.size * longest) for corners, longest in drawn.pressed]  # as for a scene of 3 m
    state = replace(DrawnState.at_start(drawn), pressures=[1.0, pressure])
    ends = camera.nearer(Layers(drawn, ("pressures",)).lines(state, camera)[0], 1.0 / IN_FRONT)
    n_side = 6 * len(drawn.pressed[0][0])
    shafts = [own[: len(own) // 3].reshape(-1, 2, 3) for own in (ends[:n_side], ends[n_side:])]  # of the side, then of the cavity
    assert shafts[0][:, 1, 0] == pytest.approx(1.5) and np.allclose(shafts[0][:, 0] - shafts[0][:, 1], (0.105, 0, 0))
    start, tip = np.abs(shafts[1]).max(axis=2).T  # in the norm whose unit ball is a cube
    assert len(tip) >= 10 and (tip if pressure > 0 else start) == pytest.approx(0.5)
    assert tip - start == pytest.approx(0.21 * np.sign(pressure))


def test_usd_holds_curves(moved, tmp_path):
    (scene, sim), wanted = moved, []
    writer, lines = UsdWriter(tmp_path, scene, fps=30.0, chunk_frames=2), ConnectionLines(scene, [*scene.springs, *scene.tendons])
    for index in range(3):
        sim.step()
        writer.frame(sim, index)
        wanted.append((sim.time, lines.points(sim.positions(), sim.time), sim.tensions()))
    writer.close()
    stage = Usd.Stage.Open(str(tmp_path / "scene.usdc"))
    assert faults(stage) == []
    for name, rows in zip(NAMES, (slice(0, 2), slice(2, 6), slice(6, 8))):
        curve = UsdGeom.BasisCurves(stage.GetPrimAtPath(f"/World/{name.replace(' ', '_')}"))
        assert curve.GetPrim().GetDisplayName() == name and curve.GetTypeAttr().Get() == "linear"
        assert list(curve.GetCurveVertexCountsAttr().Get()) == [rows.stop - rows.start]
        tension = UsdGeom.PrimvarsAPI(curve).GetPrimvar("tension")
        assert tension.GetInterpolation() == "uniform"
        for time, points, tensions in wanted:
            code = 30.0 * (time - wanted[0][0])
            own = np.array(curve.GetPointsAttr().Get(code))
            assert np.array_equal(own, points[rows].astype(np.float32))
            low, high = np.array(curve.GetExtentAttr().Get(code))
            assert (low < own.min(axis=0)).all() and (high > own.max(axis=0)).all()
            assert list(tension.Get(code)) == [np.float32(tensions[name])]


def stand_in(k: int) -> SimpleNamespace:
    """A simulator in frame k, in which a box has moved and turned by three quarters of a turn about z."""
    return SimpleNamespace(
        time=k / 20,
        tensions=lambda: {"spring": 1.0 + k, "rope, long": 3.0},
        cavity_volume={"water": 1.05}.get,
        cavity_pressure={"water": 10.0 * k}.get,
        pose={"box": (np.array((0.5 * k, -1.0, 0.0)), rotation((0, 0, 1), 1.5 * np.pi))}.get,
    )


def test_a_table_of_frames(tmp_path):
    scene = hollow_scene()
    scene.add_spring(("block", 0), ("block", 7), 1.0, name="spring")
    scene.add_tendon([("block", 0), ("block", 7)], 3.0, name="rope, long")
    mesh = ts.box_mesh((1, 1, 1), (1, 0.6, 0.3), (0, 0, 0.1))
    scene.add_rigid_body(mesh, density=1000.0, name="box", position=(0, 5, 0))
    texts = []
    for first in (0, 2):  # a whole run, and a resumed one
        table = FrameTable(tmp_path, scene, first)
        for index in range(first, 4):
            table.frame(stand_in(index), index)
        table.close()
        texts.append((tmp_path / "frames.csv").read_bytes())
    assert texts[0] == texts[1]
    row = list(csv.DictReader(texts[0].decode().splitlines()))[2]
    expected = {"frame": 2, "time": 0.1, "tension of spring [N]": 3, "tension of rope, long [N]": 3}
    expected |= {"volume of water [m^3]": 1.05, "pressure of water [Pa]": 20}
    expected |= {"x of box [m]": 1, "y of box [m]": 4, "z of box [m]": 0.1}
    expected |= {f"q{part} of box": value for part, value in zip("wxyz", (0.5**0.5, 0, 0, -(0.5**0.5)))}
    assert list(row) == list(expected) and [float(text) for text in row.values()] == pytest.approx(list(expected.values()))
