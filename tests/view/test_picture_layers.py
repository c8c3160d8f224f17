"""Layers of images:

* lines have their layer's colours, and are hidden by what is in front of them;
* a line is drawn as a band of its width in any direction, clipped at the near plane, and left out if not finite;
* fixed nodes are shown by default; arrows beyond the bodies are inside the image; unknown names are refused.
"""

import numpy as np
import pytest

from taisoft.backend.runtime import open_kind, open_runtime
from taisoft.errors import OutputError
from taisoft.output.camera import Camera
from taisoft.view.offscreen import Offscreen, stroke
from taisoft.view.raster import Raster
from taisoft.view.scene_view import IMPULSE_COLOUR, LAYERS, NORMAL_COLOUR, TRACTION_COLOUR, WIRE_COLOUR
from tests.view.fake_simulator import FakeSimulator, beam_scene
from tests.view.test_view import SIZE, body_mask

LARGE = (640, 360)
LINES = {"wires": (WIRE_COLOUR,), "contacts": (NORMAL_COLOUR, IMPULSE_COLOUR), "tractions": (TRACTION_COLOUR,)}


def scene_with_contacts_and_loads():
    scene = beam_scene(("one", "two"), cells=(4, 2, 2))
    scene.bodies[1].add_traction(lambda c: c[:, 1] > 0.49, (0, -50.0, 0))
    sim = FakeSimulator(scene)
    sim.time = 1.0
    contacts = sim.contacts()
    contacts.point = np.array([[-1.0, 0.8, 0.3], [1.0, 0.2, 0.5]])
    contacts.normal = np.array([[0.0, 1, 0], [0.0, 0, 1]])
    sim.contacts = lambda: contacts
    return scene, sim


def picture(scene, sim, layers):
    drawing = Offscreen(scene, LARGE, layers=layers)
    try:
        return drawing.image(sim).astype(int)
    finally:
        drawing.close()


def covered(points, triangles, size=(80, 80), near=0.1):
    """The samples that triangles cover."""
    runtime = open_runtime(*(open_kind() or ("cpu", "f32")))
    try:
        return Raster(size).inverse_depths(points, triangles, near) > 0
    finally:
        runtime.close()


def has_colour(image, colour):
    return np.abs(image - 255 * np.asarray(colour)).max(axis=2) < 40


@pytest.mark.parametrize("layers", [LAYERS, ("wires",), ("contacts", "tractions")])
def test_lines_are_drawn_in_their_colours(layers):
    scene, sim = scene_with_contacts_and_loads()
    drawn, plain = picture(scene, sim, layers), picture(scene, sim, tuple(set(layers) & {"fixed_nodes"}))
    lines = np.abs(drawn - plain).max(axis=2) > 20
    assert 0.003 < lines.mean() < 0.2
    for name, colours in LINES.items():
        for colour in colours:
            assert (has_colour(drawn, colour).sum() > has_colour(plain, colour).sum() + 5) == (name in layers), name


def test_hidden_lines_are_not_drawn():
    scene, sim = scene_with_contacts_and_loads()
    plain, wired = (picture(scene, sim, layers) for layers in ((), ("wires",)))
    lines = np.abs(wired - plain).max(axis=2) > 20
    inside = body_mask(plain)
    outline = inside & ~np.all([np.roll(inside, by, axis) for axis in (0, 1) for by in (-2, 2)], axis=0)
    assert (lines & ~inside & ~outline).sum() < 0.2 * lines.sum(), "wires are drawn on the bodies"
    scene.bodies[0].position[:], drawing = (0, 0, 0), Offscreen(scene, LARGE, layers=("wires",))
    ends, _ = drawing.layers.lines(sim, drawing.camera)
    length = np.linalg.norm(np.diff(drawing.camera.project(ends, LARGE)[:, :2].reshape(-1, 2, 2), axis=1), axis=2).sum()
    assert lines.sum() < 0.85 * 1.25 * length, "some of them are hidden"


def test_fixed_nodes_are_the_only_default_layer():
    scene, sim = scene_with_contacts_and_loads()
    default = Offscreen(scene, LARGE).image(sim)
    assert np.array_equal(default, picture(scene, sim, ("fixed_nodes",)))
    bare = picture(scene, sim, ())
    dark = (default < 60).all(axis=2)
    assert dark.sum() > 50 and not (bare < 60).all(axis=2).any(), "fixed nodes are dark balls"


def test_arrows_beyond_the_bodies_are_inside_the_image():
    scene, sim = scene_with_contacts_and_loads()
    plain, marked = (picture(scene, sim, layers) for layers in ((), ("tractions",)))
    top = np.flatnonzero(body_mask(plain).any(axis=1)).min()
    assert has_colour(marked[: top - 5], TRACTION_COLOUR).sum() > 20


def test_unknown_layers_are_refused():
    with pytest.raises(OutputError, match="layer 'wire' is unknown: it must be one of wires, contacts"):
        Offscreen(beam_scene(), SIZE, layers=("wire",))


@pytest.mark.parametrize("angle", [0, 30, 90, 200, 315])
def test_a_band_has_its_width(angle):
    u, v = 30.0 * np.cos(np.radians(angle)), 30.0 * np.sin(np.radians(angle))
    ends = np.array([[40.0, 40, 2], [40 + u, 40 + v, 4], [5, 5, 1], [5, 5, 1]])
    corners, triangles = stroke(ends, 4.0)
    mask = covered(corners, triangles)
    assert mask.sum() == pytest.approx(120, abs=15)
    row, column = np.argwhere(mask).T + 0.5
    distance = np.abs(((column - 40) * v - (row - 40) * u) / 30)
    assert distance.max() <= 2.01, "within half the width of the line"


def test_lines_are_clipped_at_the_near_plane():
    camera = Camera(target=np.zeros(3), distance=10.0, azimuth=0.0, elevation=0.0)
    ahead, behind = np.array([0.0, 1, 0]), np.array([0.0, 1, 20])
    ends = np.array([ahead, behind, behind, ahead, ahead, 2 * ahead, behind, behind + 1, ahead, [0, np.nan, 0]])
    colours = np.repeat(np.arange(10) / 10, 3).reshape(-1, 3)
    clipped, kept = camera.clipped_lines(ends, colours)
    assert len(clipped) == len(kept) == 6
    assert np.allclose(clipped[[0, 3]], ahead) and np.allclose(clipped[[1, 2]], (0, 1, 9.8), atol=1e-4)
    assert np.array_equal(clipped[4:], ends[4:6]) and np.array_equal(kept[4:], colours[4:6])
    assert np.allclose(kept[1], 0.049, atol=1e-5)
