"""Pictures of scenes and what they need:

* surfaces are split at sharp edges only, normals point outward, and midside nodes are drawn;
* pictures need no display, driver or window: bodies move in them, and the camera follows; runs do not change;
* without a display or a driver a window is rejected with an error;
* windows leave no files behind; a process holds one window, which keeps the runtime from being initialised again.
"""

import os
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest

import taisoft as ts
from taisoft.backend.runtime import open_kind, open_runtime
from taisoft.errors import OutputError, SimulationError
from taisoft.output.camera import Camera, start_positions
from taisoft.view.ggui import Canvas, vulkan_missing, window_holder
from taisoft.view.offscreen import Offscreen
from taisoft.view.scene_view import MARKER_COLOUR, Surfaces, smoothing_groups, vertex_normals
from tests.view.fake_simulator import FakeSimulator, beam_scene

ROOT = Path(__file__).resolve().parents[2]
SIZE = (320, 180)
needs_vulkan = pytest.mark.skipif(bool(vulkan_missing()), reason="no Vulkan driver: Debian package mesa-vulkan-drivers")


# --- surfaces ---


def test_box_has_sharp_edges():
    mesh = ts.box_mesh((2, 3, 4), (1, 1, 1))
    nodes, corners = smoothing_groups(mesh.vertices, mesh.surface)
    assert np.array_equal(nodes[corners], mesh.surface)
    assert len(nodes) == 2 * (3 * 4 + 4 * 5 + 3 * 5)  # sides share no vertices
    normals = vertex_normals(mesh.vertices[nodes], corners)
    assert np.allclose(np.abs(normals).max(axis=1), 1.0)
    assert (np.einsum("ij,ij->i", normals, mesh.vertices[nodes]) > 0.4).all()


def test_ball_is_smooth():
    mesh = ts.ball_mesh(2.0, 8)
    nodes, corners = smoothing_groups(mesh.vertices, mesh.surface)
    assert np.array_equal(np.sort(nodes), np.unique(mesh.surface))  # no vertex is split
    normals = vertex_normals(mesh.vertices[nodes], corners)
    assert (np.einsum("ij,ij->i", normals, mesh.vertices[nodes]) > 2.0 * np.cos(np.radians(12))).all()


@pytest.mark.parametrize("order", [1, 2])
def test_drawn_surface_follows_the_body_and_marks_fixed_nodes(order):
    scene = beam_scene(("one", "two"), order=order)
    surfaces, sim = Surfaces(scene), FakeSimulator(scene)
    x, normals = surfaces.of_bodies(sim)
    sim.time = 1.0
    moved, _ = surfaces.of_bodies(sim)
    assert len(x) == len(normals) == len(surfaces.colours)
    assert np.allclose(np.linalg.norm(normals, axis=1), 1.0)
    assert surfaces.triangles.min() == 0 and surfaces.triangles.max() == len(x) - 1
    assert (moved[:, 1] <= x[:, 1] + 1e-12).all() and (x[:, 1] - moved[:, 1]).max() > 1.0
    drawn_colours = np.unique(surfaces.colours, axis=0)
    assert len(drawn_colours) == 3  # two bodies and the markers
    n_fixed = len(np.intersect1d(scene.bodies[0].constraints[0].nodes, scene.bodies[0].nodes.surface))
    assert n_fixed == (2 * order + 1) ** 2  # the left end
    assert (surfaces.colours == MARKER_COLOUR).all(axis=1).sum() == 2 * n_fixed * 66  # vertices of a marker
    # vertex normals agree with the winding of triangles
    a, b, c = (x[surfaces.triangles[:, k]] for k in range(3))
    winding = np.einsum("ij,ij->i", np.cross(b - a, c - a), normals[surfaces.triangles].sum(axis=1))
    assert (winding > 0).all()


def test_second_order_body_is_drawn_like_a_first_order_body_of_half_the_cell_size():
    drawn = []
    for cells, order in (((4, 2, 2), 2), ((8, 4, 4), 1)):  # with the same surface nodes
        scene = beam_scene(cells=cells, order=order)
        surfaces, sim = Surfaces(scene), FakeSimulator(scene)
        sim.time = 1.0
        x, normals = surfaces.of_bodies(sim)
        body = (surfaces.colours != MARKER_COLOUR).any(axis=1)
        drawn.append((x[body], normals[body]))
    (coarse, coarse_normals), (fine, fine_normals) = drawn
    nearest = np.linalg.norm(coarse[:, None] - fine[None], axis=2) + (coarse_normals @ fine_normals.T < 0.9)
    assert len(coarse) == len(fine)
    assert nearest.min(axis=1).max() < 1e-12 and nearest.min(axis=0).max() < 1e-12


# --- pictures ---


def body_mask(image):
    """Coloured pixels: the background is grey."""
    rgb = image.astype(int)
    return rgb.max(axis=2) - rgb.min(axis=2) > 20


def test_bent_beam_moves_down_in_the_picture():
    scene = beam_scene()
    sim, drawing = FakeSimulator(scene), Offscreen(scene, SIZE)
    try:
        straight = drawing.image(sim)
        again = drawing.image(sim)
        sim.time = 1.0
        bent = drawing.image(sim)
    finally:
        drawing.close()
    assert straight.shape == (180, 320, 3) and straight.dtype == np.uint8
    assert np.array_equal(straight, again)
    before, after = body_mask(straight), body_mask(bent)
    assert 0.05 < before.mean() < 0.5
    assert np.argwhere(after)[:, 0].mean() > np.argwhere(before)[:, 0].mean() + 5  # rows count downward
    assert (straight[0] > 235).all() and (straight[-1] > 195).all() and (straight[-1] < 215).all()  # lighter at the top
    assert straight[before].max() > 150, "the body is lit"


def test_falling_body_stays_in_the_picture():
    scene = beam_scene()
    sim, drawing = FakeSimulator(scene), Offscreen(scene, SIZE)
    try:
        first = drawing.camera.distance
        drawing.image(sim)
        assert drawing.camera.distance == first
        sim.positions = lambda: scene.bodies[0].rest_positions - (0, 5, 0)
        mask = body_mask(drawing.image(sim))
    finally:
        drawing.close()
    assert first < drawing.camera.distance < 4 * first
    rows = np.flatnonzero(mask.any(axis=1))
    assert 170 <= rows.max() <= 175, "complete, with a border of 3 % below"


def test_scene_out_of_view_shows_the_background():
    scene = beam_scene()
    away = Camera(target=np.array([0.0, 100.0, 0.0]), distance=5.0)
    image = Offscreen(scene, SIZE, away).image(FakeSimulator(scene))
    assert not body_mask(image).any() and image.std(axis=1).max() == 0


def test_invalid_settings_are_rejected():
    with pytest.raises(OutputError, match="0 x 10 pixels"):
        Offscreen(beam_scene(), (0, 10))


# --- missing drivers and displays, and windows ---

PROLOGUE = """
import sys
sys.path[:0] = ["tests", "."]
from tests.view.fake_simulator import FakeSimulator, beam_scene
from taisoft.errors import OutputError
from taisoft.view.offscreen import Offscreen
from taisoft.view.window import show
scene = beam_scene()
sim = FakeSimulator(scene, announce=True)
"""
TRY_WINDOW = (
    PROLOGUE
    + """
try:
    show(sim)
except OutputError as error:
    print("rejected:", error)
print(Offscreen(scene, (64, 36)).image(sim).shape)
"""
)


def run_child(code, **variables):
    """stdout and stderr of a child process that must succeed; variables: of its environment, None removes one."""
    environment = {k: v for k, v in (os.environ | variables).items() if v is not None}
    command = [sys.executable, "-c", code]
    child = subprocess.run(command, cwd=ROOT, env=environment, capture_output=True, text=True, timeout=120, check=False)
    assert child.returncode == 0, child.stderr
    return child.stdout, child.stderr


NO_VULKAN = {"VK_ICD_FILENAMES": "/nonexistent", "VK_DRIVER_FILES": "/nonexistent", "DISPLAY": None}


def test_without_vulkan_and_display_pictures_are_drawn():
    code = (
        PROLOGUE
        + """
from taisoft.view.ggui import Canvas
for _ in range(2):
    drawing = Offscreen(scene, (64, 36))
    print("drawn", drawing.image(sim).std() > 5)
    drawing.close()
try:
    Canvas(drawing.surfaces, (64, 36), visible=False)
except OutputError as error:
    print(error)
"""
    )
    out, err = run_child(code, **NO_VULKAN)
    assert out.count("drawn True") == 2
    assert "cannot open a window: there is no Vulkan driver" in out
    assert [line for line in err.splitlines() if not line.startswith(("taisoft: compiling", "RHI Error"))] == []


@pytest.mark.skipif(not sys.platform.startswith("linux"), reason="DISPLAY names displays on Linux only")
@pytest.mark.parametrize("display, reason", [(None, "DISPLAY is not set"), (":4711", "':4711' does not answer")])
def test_without_a_display_a_window_is_rejected(display, reason):
    out, _ = run_child(TRY_WINDOW, DISPLAY=display)
    assert "rejected: cannot open a window" in out and reason in out
    assert "(36, 64, 3)" in out


@needs_vulkan
def test_windows_leave_no_files_behind(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    surfaces = Surfaces(beam_scene())

    def draw():
        canvas = Canvas(surfaces, SIZE, visible=False)
        canvas.pixels(0, 0, *SIZE)
        canvas.close()
        return list(tmp_path.iterdir())

    assert draw() == []
    ini = tmp_path / "imgui.ini"
    ini.write_text("[Window][mine]\n")
    assert draw() == [ini] and "[Window][mine]" in ini.read_text()


@needs_vulkan
def test_one_window_per_process():
    """Pictures are drawn all the same."""
    scene = beam_scene()
    first = Canvas(Surfaces(scene), SIZE, visible=False)
    try:
        assert window_holder() == "a window"
        with pytest.raises(OutputError, match="a window holds the only one a process can have"):
            Canvas(Surfaces(scene), SIZE, visible=False)
        assert body_mask(Offscreen(scene, SIZE).image(FakeSimulator(scene))).mean() > 0.05
        other = "f64" if open_kind()[1] == "f32" else "f32"
        with pytest.raises(SimulationError, match="a window is open"):
            open_runtime("cpu", other)
    finally:
        first.close()
        first.close()
    assert window_holder() == ""
    Canvas(Surfaces(scene), SIZE, visible=False).close()


def test_a_closed_renderer_refuses_pictures():
    scene = beam_scene()
    drawing = Offscreen(scene, SIZE)
    drawing.close()
    with pytest.raises(OutputError, match="^a picture cannot be drawn: its renderer is closed$"):
        drawing.image(FakeSimulator(scene))


def test_pictures_leave_the_runtime_free():
    """The same picture whatever precision is open, and none is claimed between pictures."""
    scene, images = beam_scene(), []
    drawing = Offscreen(scene, SIZE)
    for precision in ("f64", "f32"):
        runtime = open_runtime("cpu", precision)
        images.append(drawing.image(FakeSimulator(scene)))
        assert open_kind() == ("cpu", precision)
        runtime.close()
        assert open_kind() is None
    images.append(drawing.image(FakeSimulator(scene)))
    assert open_kind() is None and np.array_equal(images[0], images[1]) and np.array_equal(images[1], images[2])


def test_pictures_do_not_change_a_run():
    """The same states, bit by bit."""
    scene, states = beam_scene(cells=(4, 1, 1)), []
    for with_pictures in (False, True):
        with ts.Simulator(scene, dt=1e-3, integrator="symplectic_euler", precision="f32") as sim:
            drawing = Offscreen(scene, SIZE)
            for _ in range(3):
                sim.advance(5)
                if with_pictures:
                    drawing.image(sim)
            states.append((sim.positions(), sim.velocities()))
    assert all(np.array_equal(a, b) for a, b in zip(*states))


def test_the_direction_of_pictures_is_free():
    """From +x the beam, 4 m long along x, shows its end; the camera still moves back from it."""
    scene = beam_scene()
    drawing = Offscreen(scene, SIZE)
    drawing.look_from(scene, 90.0, 0.0)
    points = start_positions(scene)
    assert np.allclose(drawing.camera.forward, (-1, 0, 0)) and np.ptp(drawing.camera.project(points, SIZE)[:, 0]) < 0.5 * SIZE[0]
    before = drawing.camera.distance
    sim = FakeSimulator(scene)
    sim.positions = lambda name=None: 3.0 * points
    drawing.image(sim)
    assert drawing.camera.distance > 2.0 * before and np.allclose(drawing.camera.forward, (-1, 0, 0))
