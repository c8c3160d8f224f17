"""Pictures of scenes without a display, driver or window: camera, layers, lines and colours; a process holds one window."""

import json
import sys

import numpy as np
import pytest

import taisoft as ts
from taisoft.attributes import thawed
from taisoft.backend.runtime import open_kind, open_runtime
from taisoft.errors import OutputError, SimulationError
from taisoft.mesh.placing import FROM_Y_UP
from taisoft.output.viewpoint import Viewpoint, start_positions
from taisoft.view.colouring import GRADIENT, Colouring, lit_colours, round_up
from taisoft.view.layers import IMPULSE_COLOUR, NORMAL_COLOUR, TRACTION_COLOUR, WIRE_COLOUR
from taisoft.view.offscreen import Offscreen, stroke
from taisoft.view.raster import Raster
from taisoft.view.scene_view import MARKER_COLOUR, Surfaces
from taisoft.view.window.ggui import Canvas
from taisoft.view.window.window import show
from tests.dynamics.scenes import rubber
from tests.view.drawing import SIZE, body_mask, needs_vulkan, sampled
from tests.view.fake_simulator import FakeSimulator, beam_scene

LARGE = (640, 360)


def test_bent_beam_moves_down_in_the_picture():
    """The same picture whatever precision is open, and none is claimed between pictures."""
    scene = beam_scene()
    sim, drawing = FakeSimulator(scene), Offscreen(scene, SIZE)
    straight, free = drawing.image(sim), open_kind() is None
    runtime = open_runtime("cpu", "f64")
    again = drawing.image(sim)
    assert np.array_equal(straight, again) and open_kind() == ("cpu", "f64") and free
    runtime.close()
    sim.time = 1.0
    bent = drawing.image(sim)
    assert straight.shape == (180, 320, 3) and straight.dtype == np.uint8
    before, after = body_mask(straight), body_mask(bent)
    assert 0.05 < before.mean() < 0.5
    assert np.argwhere(after)[:, 0].mean() > np.argwhere(before)[:, 0].mean() + 5  # rows count downward
    assert (straight[0] > 235).all() and (straight[-1] > 195).all() and (straight[-1] < 215).all()  # lighter at the top
    assert straight[before].max() > 150, "the body is lit"
    drawing.close()
    with pytest.raises(OutputError, match="^a picture cannot be drawn: its renderer is closed$"):
        drawing.image(sim)


def test_falling_body_stays_in_the_picture():
    scene = beam_scene()
    sim, drawing = FakeSimulator(scene), Offscreen(scene, SIZE)
    first = drawing.camera.distance
    drawing.image(sim)
    assert drawing.camera.distance == first
    sim.positions = lambda: scene.bodies[0].rest_positions - (0, 5, 0)
    mask = body_mask(drawing.image(sim))
    assert first < drawing.camera.distance < 4 * first
    assert 170 <= np.flatnonzero(mask.any(axis=1)).max() <= 175, "complete, with a border of 3 % below"
    image = Offscreen(scene, SIZE, Viewpoint(np.array([0.0, 100.0, 0.0]), 5.0)).image(FakeSimulator(scene))
    assert not body_mask(image).any() and image.std(axis=1).max() == 0, "the background alone"
    drawing.look_from(SIZE, azimuth=90.0, elevation=0.0)  # along the beam
    assert np.allclose(drawing.camera.forward, (-1, 0, 0))
    assert np.ptp(drawing.camera.project(start_positions(scene), SIZE)[:, 0]) < 0.5 * SIZE[0]


def test_a_scene_with_z_up_is_one_with_y_up_turned():
    """Of two bodies that slide and touch each other, the ground, a wall and a ball: positions to rounding, and
    pictures but for a few pixels."""
    found = []
    for up in ("y", "z"):
        turn, scene = FROM_Y_UP[up], ts.Scene(up=up)
        for name, mesh in (("box", ts.box_mesh((2, 2, 2), (0.4, 0.4, 0.4))), ("ball", ts.ball_mesh(0.2, 2, (0.1, 0.41, 0.05)))):
            turned = ts.TetMesh((mesh.vertices + (0, 0.201, 0)) @ turn.T, mesh.tets)
            scene.add_body(turned, ts.Material(young=1e5), name=name, velocity=turn @ (0.5, -0.5, 0.2))
        scene.add_ground()
        scene.add_obstacle(ts.HalfSpace(turn @ (0, 0, -0.21), turn @ (0, 0, 1)))
        scene.add_obstacle(ts.Sphere(turn @ (0.45, 0.2, 0.1), 0.2))
        with ts.Simulator(scene, dt=0.01, precision="f64") as sim:
            pictures = [sim.picture(SIZE)]
            n_contacts = [sim.step().n_contacts for _ in range(6)]
            found.append((n_contacts, sim.positions() @ turn, np.array([*pictures, sim.picture(SIZE)])))
    (n, x, pictures), (n_turned, x_turned, pictures_turned) = found
    assert n == n_turned and max(n) > 4 and np.abs(x - x_turned).max() < 1e-13
    assert (pictures != pictures_turned).mean() < 1e-3 and body_mask(pictures[0]).mean() > 0.05


def has_colour(image, colour):
    return np.abs(image - 255 * np.asarray(colour)).max(axis=2) < 40


def test_layers_are_drawn_where_they_are_seen():
    """Of two bent beams, a load and two contacts."""
    scene = beam_scene(("one", "two"), cells=(4, 2, 2))
    scene.bodies[1].add_traction(lambda c: c[:, 1] > 0.49, (0, -50.0, 0))
    sim = FakeSimulator(scene)
    sim.time = 1.0
    draw = [Offscreen(scene, LARGE, layers=layers) for layers in ((), ("wires",), ("contacts", "tractions"), ("fixed_nodes",))]
    plain, wired, arrows, fixed = (drawing.image(sim).astype(int) for drawing in draw)
    for image, present in ((wired, (True, False, False, False)), (arrows, (False, True, True, True))):
        assert 0.003 < (np.abs(image - plain).max(axis=2) > 20).mean() < 0.2
        for colour, shown in zip((WIRE_COLOUR, NORMAL_COLOUR, IMPULSE_COLOUR, TRACTION_COLOUR), present):
            assert (has_colour(image, colour).sum() > has_colour(plain, colour).sum() + 5) == shown
    inside = body_mask(plain)
    top = np.flatnonzero(inside.any(axis=1)).min()
    assert has_colour(arrows[: top - 5], TRACTION_COLOUR).sum() > 20, "also beyond the bodies"
    lines = np.abs(wired - plain).max(axis=2) > 20
    outline = inside & ~np.all([np.roll(inside, by, axis) for axis in (0, 1) for by in (-2, 2)], axis=0)
    assert (lines & ~inside & ~outline).sum() < 0.2 * lines.sum(), "wires are drawn on the bodies"
    ends, _ = draw[1].layers.lines(sampled(sim), draw[1].camera)
    length = np.linalg.norm(np.diff(draw[1].camera.project(ends, LARGE)[:, :2].reshape(-1, 2, 2), axis=1), axis=2).sum()
    assert lines.sum() < 0.85 * 1.25 * length, "some of them are hidden"
    dark = (fixed < 60).all(axis=2)
    assert dark.sum() > 50 and not (plain < 60).all(axis=2).any(), "fixed nodes are dark balls"
    assert np.array_equal(Offscreen(scene, LARGE).image(sim), fixed), "a default layer"
    with pytest.raises(OutputError, match="layer must be one of contacts, tractions, .*, not 'wire'; did you mean 'wires'"):
        Offscreen(scene, SIZE, layers=("wire",))


def test_a_band_has_its_width():
    runtime = open_runtime("cpu", "f32")
    for angle in (0, 30, 200):
        u, v = 30.0 * np.cos(np.radians(angle)), 30.0 * np.sin(np.radians(angle))
        ends = np.array([[40.0, 40, 2], [40 + u, 40 + v, 4], [5, 5, 1], [5, 5, 1]])
        mask = Raster((80, 80)).inverse_depths(*stroke(ends, 4.0), 0.1) > 0
        assert mask.sum() == pytest.approx(120, abs=15)
        row, column = np.argwhere(mask).T + 0.5
        assert (np.abs(((column - 40) * v - (row - 40) * u) / 30) <= 2.01).all(), "within half the width of the line"
    runtime.close()


@pytest.mark.parametrize("order", [1, 2])
def test_a_stretched_bar_has_its_stretch_at_every_node(order):
    scene = beam_scene(order=order)
    sim, colouring = FakeSimulator(scene), Colouring(Surfaces(scene), "stretch")
    turn = np.array([[0.0, -1, 0], [1, 0, 0], [0, 0, 1]])
    x = sim.positions()
    sim.positions = lambda name=None: x * (1.3, 0.9, 0.9) @ turn
    state = sampled(sim, (), "stretch")
    assert np.allclose(state.values["stretch"], 1.3)
    colouring.base(state)
    assert colouring.low == 1.0 and colouring.span == pytest.approx(0.5)
    assert colouring.legend()[0][0].strip() == "1.5" and np.array_equal(colouring.legend()[0][1], GRADIENT[-1])


def with_speed(sim, speed):
    sim.velocities = lambda: np.full(sim.positions().shape, speed / np.sqrt(3))
    return sim


def test_the_scale_does_not_flicker():
    scene = beam_scene()
    sim, colouring, spans = FakeSimulator(scene), Colouring(Surfaces(scene), "speed"), []
    state = sampled(sim)
    for value in [3.0, 2.1, 4.9, 5.1, 4.8, *[5.2, 4.9] * 50, *[0.3] * 2000]:
        state.values["speed"] = np.full(len(state.x), value)
        colouring.base(state)
        spans.append(colouring.span)
    assert spans[:4] == [5.0, 5.0, 5.0, 10.0] and set(spans[3:105]) == {10.0}
    assert spans[-1] == 0.5 and (np.diff(spans[105:]) <= 0).all()
    assert [round_up(v) for v in (1.0, 1.1, 2.3, 0.07, 5e4)] == [1.0, 2.0, 5.0, 0.1, 5e4]


def test_a_scale_continues_from_what_is_kept():
    """A picture of the time at which it is kept is drawn again, so its step of the running maximum must not count twice."""
    scene = beam_scene()
    sim = FakeSimulator(scene)

    def image(drawing, time, speed):
        sim.time = time
        drawing.image(with_speed(sim, speed))

    first, other, *later = (Offscreen(scene, (32, 18), colour=colour) for colour in ("speed", "stress", "speed", "speed"))
    image(first, 0.0, 3.0)
    image(first, 0.1, 0.1)
    for drawing, after in zip((*later, other), (0.0, 0.01, 0.0)):
        drawing.resume(json.loads(json.dumps(first.kept(0.1 + after))))  # plain data
    assert other.colouring.scale == ("stress", 0.0, 0.0)
    image(later[0], 0.1, 0.1)
    for drawing in later:
        assert drawing.colouring.scale == first.colouring.scale and 2.9 < first.colouring.scale[1] < 3.0
        assert drawing.camera.distance == first.camera.distance


def test_bodies_alone_are_coloured_by_stress():
    scene = beam_scene()
    scene.add_obstacle(ts.HalfSpace((0, -3, 0), (0, 1, 0)))
    surfaces, sim = Surfaces(scene), FakeSimulator(scene)
    sim.time = 1.0
    base = Colouring(surfaces, "stress").base(sampled(sim, (), "stress"))
    kept = (base == surfaces.colours).all(axis=1)
    grey = surfaces.colours.max(axis=1) - surfaces.colours.min(axis=1) < 0.1
    marked = (surfaces.colours == MARKER_COLOUR).all(axis=1)
    assert marked.any() and np.array_equal(kept, marked | grey)
    scene = beam_scene()
    own, stress = (Offscreen(scene, (160, 90), colour=colour).image(sim).astype(int) for colour in ("body", "stress"))
    assert 0.03 < (np.abs(own - stress).max(axis=2) > 30).mean() < 0.4
    red = stress[..., 0] - stress[..., 2] > 60
    assert red[:, 80:].any() and not red[:, :60].any(), "the stress of FakeSimulator grows along x"


def walls(opacity: float, of_ground: float = 1.0) -> ts.Scene:
    """A red beam in front of a blue one, above a ground."""
    scene = beam_scene(("near", "far"))
    for body, colour, z in zip(scene.bodies, ("#ff0000", "#0000ff"), (1.0, -1.0)):
        body.colour, body.position = colour, (0, 0, z)
    scene.bodies[0].opacity = opacity
    scene.add_ground(-2.0, colour="#00ff00", opacity=of_ground)
    return scene


FRONT = Viewpoint(np.zeros(3), 9.0, azimuth=0.0, elevation=10.0)


def test_a_transparent_body_shows_what_is_behind_it():
    """In proportion, whatever the order of the bodies, and markers and a ground as well."""
    images = [Offscreen(scene, SIZE, FRONT).image(FakeSimulator(scene)).astype(float) for scene in map(walls, (1.0, 0.6, 0.05))]
    middle = np.array([image[SIZE[1] // 2 - 3, SIZE[0] // 2] for image in images])
    assert (np.diff(middle[:, 0]) < -30).all() and (np.diff(middle[:, 2]) > 30).all()
    scene = walls(0.6)
    with thawed(scene):
        scene.bodies = scene.bodies[::-1]
    assert np.abs(Offscreen(scene, SIZE, FRONT).image(FakeSimulator(scene)) - images[1]).max() <= 1
    surfaces = Surfaces(scene)
    assert set(surfaces.opacities[(surfaces.colours == MARKER_COLOUR).all(axis=1)]) == {0.6, 1.0}
    wired = Offscreen(walls(0.05), SIZE, FRONT, layers=("wires",)).image(FakeSimulator(scene))
    assert (wired.max(axis=2) < 60).any(), "lines are opaque"
    ground, clear = ((Offscreen(scene, SIZE, FRONT).image(FakeSimulator(scene))) for scene in (walls(1.0), walls(1.0, 0.1)))
    low = ground[-20:].astype(int) - clear[-20:]
    assert (low[..., 0] < -50).all() and (low[..., 1] < 50).all(), "the light background comes through"


def test_a_scene_has_its_own_lights_and_background():
    """Without lights there is that of the sky, which has no direction from left to right."""
    images = []
    for lights in ((), (ts.Light((-1, 0, 0), 0.9, "#ff8000"),)):
        scene = ts.Scene()
        scene.add_body(ts.ball_mesh(1.0, 8), rubber(), colour="#808080")
        scene.lights, scene.background = lights, ("#102030", "#405060")
        images.append(Offscreen(scene, (120, 120), FRONT).image(FakeSimulator(scene)).astype(int))
        assert images[-1][0, 0].tolist() == [16, 32, 48] and images[-1][-1, 0].tolist() == [64, 80, 96]
    plain, lit = images
    assert np.abs(plain - plain[:, ::-1]).max() <= 6 and np.abs((lit - plain)[:, :55]).max() <= 1
    added = (lit - plain)[60, 60:].max(axis=0)  # on the right
    assert added[0] > 70 and added[1] == pytest.approx(added[0] * 128 / 255, abs=3) and added[2] == 0


@pytest.mark.skipif(not sys.platform.startswith("linux"), reason="DISPLAY names displays on Linux only")
@pytest.mark.parametrize("display, reason", [("", "DISPLAY is not set"), (":4711", "':4711' does not answer")])
def test_without_a_display_a_window_is_refused(display, reason, monkeypatch):
    monkeypatch.setenv("DISPLAY", display)
    with pytest.raises(OutputError, match=f"cannot open a window.*{reason}"):
        show(FakeSimulator(beam_scene()))


@needs_vulkan
def test_a_process_has_one_window_which_leaves_no_files(tmp_path, monkeypatch):
    """A file of the user's stays."""
    monkeypatch.chdir(tmp_path)
    surfaces = Surfaces(beam_scene())
    first = Canvas(surfaces, SIZE, visible=False)
    try:
        first.pixels(0, 0, *SIZE)
        with pytest.raises(OutputError, match="a window holds the only one a process can have"):
            Canvas(surfaces, SIZE, visible=False)
        with pytest.raises(SimulationError, match="a window is open"):
            open_runtime("cpu", "f64" if open_kind()[1] == "f32" else "f32")
    finally:
        first.close()
        first.close()
    assert list(tmp_path.iterdir()) == []
    (tmp_path / "imgui.ini").write_text("[Window][mine]\n")
    Canvas(surfaces, SIZE, visible=False).close()
    assert "[Window][mine]" in (tmp_path / "imgui.ini").read_text()


@needs_vulkan
def test_the_window_blends_transparent_surfaces_from_far_to_near():
    """As pictures do, to a few pixels, in whatever order the bodies were added."""
    scenes = walls(0.5), walls(0.5)
    with thawed(scenes[1]):
        scenes[1].bodies = scenes[1].bodies[::-1]
    for scene in scenes:
        drawing = Offscreen(scene, SIZE, FRONT)
        state = sampled(FakeSimulator(scene))
        x, normals = drawing.surfaces.with_obstacles(drawing.surfaces.of_bodies(state), state, FRONT.position)
        colours, lines = lit_colours(x, normals, drawing.surfaces.colours, FRONT), (np.zeros((0, 3)), np.zeros((0, 3)))
        canvas = Canvas(drawing.surfaces, SIZE, visible=False)
        try:
            for _ in range(2):  # the first picture of a window may be empty
                canvas.draw(x, colours, FRONT, (1, 1, 1), lines)
                shown = canvas.pixels(0, 0, *SIZE).astype(int)
        finally:
            canvas.close()
        expected = drawing.image(state)
        middle = slice(SIZE[1] // 2 - 10, SIZE[1] // 2 + 5), slice(SIZE[0] // 4, 3 * SIZE[0] // 4)
        assert (np.abs(shown - expected)[middle].max(axis=2) > 8).mean() < 0.03


@needs_vulkan
def test_lines_that_are_gone_are_not_drawn_any_more():
    surfaces = Surfaces(beam_scene())
    camera, n = Viewpoint.framing(np.array([(-1.0, -1, -1), (1, 1, 1)])), len(surfaces.colours)
    ends, red = np.array([(-0.5, 0, 0), (0.5, 0, 0), (0, -0.5, 0), (0, 0.5, 0)]), np.tile((1.0, 0.0, 0.0), (4, 1))
    canvas, pictures = Canvas(surfaces, SIZE, visible=False, n_segments=4), []
    try:
        for rows in (2, 4, 2):
            canvas.draw(np.zeros((n, 3)), np.zeros((n, 3)), camera, (1, 1, 1), (ends[:rows], red[:rows]))
            pictures.append(canvas.pixels(0, 0, *SIZE))
    finally:
        canvas.close()
    assert np.array_equal(pictures[0], pictures[2]) and not np.array_equal(pictures[0], pictures[1])
