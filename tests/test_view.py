"""Pictures and the live window:

* the camera frames a scene whichever way it turns, and projects as a pinhole does;
* surfaces are split at sharp edges only, their normals point outward, and nodes in the middle of edges are drawn;
* the NumPy renderer covers, orders and colours pixels as a plain loop over pixels does;
* Taichi's renderer and the NumPy one draw the same picture, upright; a body that moves, moves in the picture;
* without a Vulkan driver pictures are drawn in software, and one line says which package is missing;
* without a display or a driver a window is refused with a sentence, and the process lives on;
* a window leaves no file behind, and a file of the name it would have used stays as it is;
* a process holds one window, and an open one keeps the runtime from being initialised anew.
"""

import os
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest
from fake_simulator import RUBBER, FakeSimulator, beam_scene

import taisoft as ts
from taisoft.backend.runtime import open_kind, open_runtime
from taisoft.errors import OutputError, SimulationError
from taisoft.output.camera import BORDER, FILL, Camera
from taisoft.view.ggui import Canvas, vulkan_missing, window_holder
from taisoft.view.offscreen import MAX_COORDINATE, Offscreen, rasterise
from taisoft.view.scene_view import MARKER_COLOUR, Surfaces, smoothing_groups, vertex_normals

ROOT = Path(__file__).resolve().parents[1]
SIZE = (320, 180)
needs_vulkan = pytest.mark.skipif(bool(vulkan_missing()), reason="no Vulkan driver: Debian package mesa-vulkan-drivers")


# --- camera ---


@pytest.mark.parametrize("azimuth, elevation", [(0, 0), (32, 20), (140, -60), (270, 89)])
def test_framing_shows_everything(azimuth, elevation):
    points = np.random.default_rng(0).uniform(-1, 1, (200, 3)) * (4, 1, 1) + (10, 20, 30)
    camera = Camera.framing(points, azimuth=azimuth, elevation=elevation)
    seen = camera.project(points, SIZE)
    assert (seen[:, 2] > 0).all()
    shares = np.abs(2 * seen[:, :2] / SIZE - 1).max(axis=0)  # of the picture's width and height
    assert shares.max() == pytest.approx(FILL)
    assert np.allclose(camera.project(camera.target[None], SIZE), [[160, 90, camera.distance]])


def test_projection_is_a_pinhole():
    camera = Camera(target=np.zeros(3), distance=10.0, azimuth=0.0, elevation=0.0, fov=90.0)
    seen = camera.project(np.array([[1.0, 0, 0], [0, 2.0, 0], [0, 0, 5.0], [1.0, 0, 5.0]]), (200, 100))
    # at 10 m the half height of 50 pixels is 10 m: 5 pixels a metre, 10 at 5 m; x right, y up, z towards the eye
    assert np.allclose(seen, [[105, 50, 10], [100, 40, 10], [100, 50, 5], [110, 50, 5]])


def test_moving_the_camera():
    camera = Camera(target=np.zeros(3), distance=10.0, azimuth=350.0, elevation=80.0)
    turned = camera.orbit(20.0, 50.0)
    assert turned.azimuth == pytest.approx(10.0) and turned.elevation == 89.0
    assert np.linalg.norm(turned.position - turned.target) == pytest.approx(10.0)
    assert camera.zoom(0.5).distance == 5.0
    shifted = camera.pan(0.0, 0.25)  # a quarter of the picture's height up
    assert shifted.project(np.zeros((1, 3)), SIZE)[0, 1] == pytest.approx(90 + 45, abs=1e-9)


def test_the_camera_moves_back_from_moving_bodies():
    camera = Camera(target=np.zeros(3), distance=10.0, azimuth=0.0, elevation=0.0, fov=90.0)
    near = np.array([[0.0, 1, 0], [2, 0, 0]])
    border = 1 - BORDER
    assert camera.widened(near, (200, 100), 100.0) == camera
    for far in ([0.0, -20 * border, 0], [40 * border, 0, 0], [0, 10 * border, 10], [0, 0, 20]):
        assert camera.widened(np.array([far, [0, np.nan, 0]]), (200, 100), 100.0).distance == pytest.approx(20.0)
    assert camera.widened(np.array([[0.0, 900, 0]]), (200, 100), 15.0).distance == 15.0


def test_a_floor_that_reaches_behind_the_eye():
    """Against rays through the middle of every pixel; triangles in front stay as they are, those behind go. Not to be dropped
    as too large, either, in a picture of many pixels."""
    half = 30.0
    floor = [[-half, 0, -half], [half, 0, -half], [half, 0, half], [-half, 0, half]]
    corners = np.array([*floor, [0, 1, -9], [1, 1, -9], [0, 2, -9], [0, 1, 9], [1, 1, 9], [0, 2, 9]])
    shades, triangles = (corners + half) / (2 * half), np.array([[0, 2, 1], [0, 3, 2], [4, 5, 6], [7, 8, 9]])
    camera = Camera(target=np.array([0.0, 0.5, 0.0]), distance=3.0, azimuth=20.0, elevation=10.0)
    x, cut, colours = camera.clipped(corners, triangles, shades, SIZE)
    assert not (cut == 7).any() and np.array_equal(x[: len(corners)], corners) and (cut == [4, 5, 6]).all(axis=1).sum() == 1
    image, (width, height) = np.zeros((SIZE[1], SIZE[0], 3), dtype=np.uint8), SIZE
    below = (cut != [4, 5, 6]).all(axis=1)
    drawn = rasterise(camera.project(x, SIZE), cut[below], colours, camera.clipping[0], image)
    focal = height / 2 / np.tan(np.radians(camera.fov) / 2)
    v, u = np.mgrid[:height, :width] + 0.5
    ray = np.stack([(u - width / 2) / focal, (height / 2 - v) / focal, np.ones_like(u)], axis=-1) @ camera.axes
    with np.errstate(divide="ignore"):
        far = -camera.position[1] / ray[..., 1]
    hit = camera.position + far[..., None] * ray
    expected = (far > camera.clipping[0]) & (np.abs(hit[..., [0, 2]]) < half).all(axis=-1)
    assert (drawn != expected).mean() < 0.005 and 0.4 < expected.mean() < 0.8
    both = drawn & expected
    assert np.abs(image[both] / 255 - (hit[both] + half) / (2 * half))[:, [0, 2]].max() < 0.02
    large = np.abs(camera.project(camera.clipped(corners, triangles, shades, (2560, 1440))[0], (2560, 1440))[len(corners) :, :2])
    assert 1e4 < large.max() < 0.5 * MAX_COORDINATE
    for value in (np.nan, np.inf):
        bad = corners.copy()
        bad[4] = value
        assert not (camera.clipped(bad, triangles, shades, SIZE)[1] == 4).any()


# --- surfaces ---


def test_a_box_keeps_its_edges():
    mesh = ts.box_mesh((2, 3, 4), (1, 1, 1))
    nodes, corners = smoothing_groups(mesh.vertices, mesh.surface)
    assert np.array_equal(nodes[corners], mesh.surface)
    assert len(nodes) == 2 * (3 * 4 + 4 * 5 + 3 * 5)  # each side with vertices of its own
    normals = vertex_normals(mesh.vertices[nodes], corners)
    assert np.allclose(np.abs(normals).max(axis=1), 1.0)
    assert (np.einsum("ij,ij->i", normals, mesh.vertices[nodes]) > 0.4).all()


def test_a_ball_is_smooth():
    mesh = ts.ball_mesh(2.0, 8)
    nodes, corners = smoothing_groups(mesh.vertices, mesh.surface)
    assert np.array_equal(np.sort(nodes), np.unique(mesh.surface))  # no vertex is split
    normals = vertex_normals(mesh.vertices[nodes], corners)
    assert (np.einsum("ij,ij->i", normals, mesh.vertices[nodes]) > 2.0 * np.cos(np.radians(12))).all()


@pytest.mark.parametrize("order", [1, 2])
def test_drawn_vertices_follow_the_body_and_mark_fixed_nodes(order):
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
    held = len(np.intersect1d(scene.bodies[0].constraints[0].nodes, scene.bodies[0].nodes.surface))
    assert held == (2 * order + 1) ** 2  # all of the left end
    assert (surfaces.colours == MARKER_COLOUR).all(axis=1).sum() == 2 * held * 66  # vertices of a ball
    # every triangle's normals point the way it is wound: outward
    a, b, c = (x[surfaces.triangles[:, k]] for k in range(3))
    winding = np.einsum("ij,ij->i", np.cross(b - a, c - a), normals[surfaces.triangles].sum(axis=1))
    assert (winding > 0).all()


def test_a_second_order_body_is_drawn_as_finely_as_a_first_order_one_of_half_the_size():
    drawn = []
    for cells, order in (((4, 2, 2), 2), ((8, 4, 4), 1)):  # every vertex of the fine grid's surface is a node of the coarse
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


# --- the NumPy renderer ---


def plain_raster(projected, triangles, colours, near, shape):
    """The same picture, pixel by pixel: the nearest triangle that holds the pixel's centre."""
    image, nearest = np.zeros((*shape, 3)), np.zeros(shape)
    for triangle in triangles:
        p, depth = projected[triangle, :2], projected[triangle, 2]
        if not (depth > near).all():
            continue
        matrix = np.vstack([p.T, np.ones(3)])
        if abs(np.linalg.det(matrix)) < 1e-12:
            continue
        for i in range(shape[0]):
            for j in range(shape[1]):
                weights = np.linalg.solve(matrix, [j + 0.5, i + 0.5, 1.0])
                inverse = weights @ (1.0 / depth)
                if (weights >= 0).all() and inverse > nearest[i, j]:
                    nearest[i, j] = inverse
                    image[i, j] = (weights / depth) @ colours[triangle] / inverse
    return image, nearest > 0


@pytest.mark.parametrize("seed", [0, 1])
def test_raster_equals_a_plain_loop(seed):
    rng = np.random.default_rng(seed)
    shape = (24, 32)
    projected = rng.uniform((-8, -8, 1), (40, 32, 5), (36, 3))  # some of it outside the picture
    projected[0, 2], projected[4, 2] = -1.0, np.nan
    colours, triangles = rng.uniform(0, 1, (36, 3)), np.arange(36).reshape(12, 3)
    expected, covered = plain_raster(projected, triangles, colours, 0.5, shape)
    image = np.zeros((*shape, 3), np.uint8)
    mask = rasterise(projected, triangles, colours, 0.5, image)
    assert 100 < covered.sum() < covered.size
    assert np.array_equal(mask, covered)
    assert np.abs(image.astype(float) - 255 * expected).max() <= 0.51


def test_raster_leaves_no_seam_between_neighbours():
    rng = np.random.default_rng(5)
    projected = np.array([[2.0, 3.0], [58.0, 1.0], [61.0, 37.0], [4.0, 35.0]])
    inner = rng.uniform((10, 8), (50, 30), (1, 2))
    points = np.column_stack([np.vstack([projected, inner]), np.ones(5)])
    triangles = np.array([[0, 1, 4], [1, 2, 4], [2, 3, 4], [3, 0, 4]])
    mask = rasterise(points, triangles, np.ones((5, 3)), 0.1, np.zeros((40, 64, 3), np.uint8))
    assert mask[8:30, 10:50].all()


# --- pictures ---


def body_mask(image):
    """Pixels that are not grey as the background is: the bodies are coloured."""
    wide = image.astype(int)
    return wide.max(axis=2) - wide.min(axis=2) > 20


@pytest.fixture(params=["software", pytest.param("vulkan", marks=needs_vulkan)])
def renderer(request):
    return request.param


def test_picture_of_a_beam(renderer):
    scene = beam_scene()
    sim, drawing = FakeSimulator(scene), Offscreen(scene, SIZE, renderer=renderer)
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
    lower = np.argwhere(after)[:, 0].mean() - np.argwhere(before)[:, 0].mean()
    assert lower > 5, "a beam that bends down moves down in the picture"
    assert (straight[0] > 235).all() and (straight[-1] > 195).all() and (straight[-1] < 215).all()  # lighter above
    assert straight[before].max() > 150, "the body is lit"


@needs_vulkan
def test_both_renderers_draw_the_same_picture():
    scene = beam_scene(("one", "two"))
    scene.add_body(ts.ball_mesh(0.7, 6), RUBBER, name="ball", position=(0.5, -1.3, 0.6), order=2)
    sim, images = FakeSimulator(scene), {}
    sim.time = 0.5
    camera = Camera.framing(np.array([[-2.0, -2, -1], [2, 2, 1]]), azimuth=-50.0, elevation=35.0)
    for name in ("vulkan", "software"):
        drawing = Offscreen(scene, SIZE, camera, name)
        images[name] = drawing.image(sim).astype(int)
        drawing.close()
    difference = np.abs(images["vulkan"] - images["software"]).max(axis=2)
    assert body_mask(images["software"]).mean() > 0.1
    assert np.mean(difference > 3) < 0.005  # pixels on an outline may fall either way


@needs_vulkan
@pytest.mark.parametrize("layers", [(), ("wires",)])
def test_a_picture_that_vulkan_left_empty_is_drawn_in_software(monkeypatch, layers):
    """Empty, or with nothing on it but lines."""
    draw, images = Canvas.draw, []
    for scale in (1.0, 0.0):  # at scale 0 no triangle has an area
        monkeypatch.setattr(Canvas, "draw", lambda self, x, *more, scale=scale: draw(self, scale * x, *more))
        drawing = Offscreen(beam_scene(), SIZE, renderer="vulkan", layers=layers)
        images.append(drawing.image(FakeSimulator(beam_scene())).astype(int))
        drawing.close()
    differ = np.mean(np.abs(images[0] - images[1]).max(axis=2) > 3)
    assert body_mask(images[0]).mean() > 0.05 and differ < (0.02 if layers else 0.005)


def test_a_falling_body_stays_in_the_picture(renderer):
    scene = beam_scene()
    sim, drawing = FakeSimulator(scene), Offscreen(scene, SIZE, renderer=renderer)
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
    assert 170 <= rows.max() <= 175, "whole, with a border of 3 % below"


def test_a_scene_out_of_sight_is_background():
    scene = beam_scene()
    away = Camera(target=np.array([0.0, 100.0, 0.0]), distance=5.0)
    image = Offscreen(scene, SIZE, away, "software").image(FakeSimulator(scene))
    assert not body_mask(image).any() and image.std(axis=1).max() == 0


def test_wrong_settings_are_refused():
    with pytest.raises(OutputError, match="renderer 'povray' is unknown"):
        Offscreen(beam_scene(), SIZE, renderer="povray")
    with pytest.raises(OutputError, match="0 x 10 pixels"):
        Offscreen(beam_scene(), (0, 10))


# --- what a machine may lack ---

PROLOGUE = """
import sys
sys.path[:0] = ["tests", "."]
from fake_simulator import FakeSimulator, beam_scene
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
    print("refused:", error)
print(Offscreen(scene, (64, 36), renderer="software").image(sim).shape)
"""
)


def run_child(code, **variables):
    """stdout and stderr of a child with these environment variables (None removes one) that must end well."""
    environment = {k: v for k, v in (os.environ | variables).items() if v is not None}
    command = [sys.executable, "-c", code]
    child = subprocess.run(command, cwd=ROOT, env=environment, capture_output=True, text=True, timeout=120, check=False)
    assert child.returncode == 0, child.stderr
    return child.stdout, child.stderr


NO_VULKAN = {"VK_ICD_FILENAMES": "/nonexistent", "VK_DRIVER_FILES": "/nonexistent"}


def test_without_vulkan_pictures_are_drawn_in_software():
    code = (
        PROLOGUE
        + """
for _ in range(2):
    drawing = Offscreen(scene, (64, 36))
    print(drawing.renderer, drawing.image(sim).std() > 5)
    drawing.close()
try:
    Offscreen(scene, renderer="vulkan")
except OutputError as error:
    print(error)
"""
    )
    out, err = run_child(code, **NO_VULKAN)
    assert out.count("software True") == 2
    assert "cannot open a window: there is no Vulkan driver" in out
    assert err.count("mesa-vulkan-drivers") == 1


@pytest.mark.skipif(not sys.platform.startswith("linux"), reason="displays are named by DISPLAY on Linux alone")
@pytest.mark.parametrize("display, reason", [(None, "DISPLAY is not set"), (":4711", "':4711' does not answer")])
def test_without_a_display_a_window_is_refused(display, reason):
    out, _ = run_child(TRY_WINDOW, DISPLAY=display)
    assert "refused: cannot open a window" in out and reason in out
    assert "(36, 64, 3)" in out


@needs_vulkan
def test_a_window_leaves_no_file_behind(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    scene = beam_scene()

    def draw():
        drawing = Offscreen(scene, SIZE, renderer="vulkan")
        drawing.image(FakeSimulator(scene))
        drawing.close()
        return list(tmp_path.iterdir())

    assert draw() == []
    own = tmp_path / "imgui.ini"
    own.write_text("[Window][mine]\n")
    assert draw() == [own]


@needs_vulkan
def test_one_window_at_a_time():
    scene = beam_scene()
    first = Offscreen(scene, SIZE, renderer="vulkan")
    try:
        assert window_holder() == "a picture renderer"
        with pytest.raises(OutputError, match="a picture renderer holds the only one a process can have"):
            Offscreen(scene, SIZE, renderer="vulkan")
        second = Offscreen(scene, SIZE)
        assert second.renderer == "software"
        other = "f64" if open_kind()[1] == "f32" else "f32"
        with pytest.raises(SimulationError, match="a picture renderer is open"):
            open_runtime("cpu", other)
    finally:
        first.close()
        first.close()
    assert window_holder() == ""
    third = Offscreen(scene, SIZE)
    assert third.renderer == "vulkan"
    third.close()


@needs_vulkan
@pytest.mark.parametrize("precision", ["f32", "f64"])
def test_pictures_in_either_precision(precision):
    if open_kind() not in (None, ("cpu", precision)):
        pytest.skip(f"another test holds the runtime as {open_kind()}")
    runtime = open_runtime("cpu", precision)
    drawing = Offscreen(beam_scene(), SIZE, renderer="vulkan")
    try:
        assert body_mask(drawing.image(FakeSimulator(beam_scene()))).mean() > 0.05
    finally:
        drawing.close()
        runtime.close()
