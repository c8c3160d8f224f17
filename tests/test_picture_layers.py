"""Layers of images:

* both renderers draw the same lines, hidden by what is in front of them; without lines the image stays the same;
* a line is drawn as a band of its width in any direction, clipped at the near plane, and left out if not finite;
* fixed nodes are shown by default; arrows beyond the bodies are inside the image; unknown names are refused.
"""

import numpy as np
import pytest
from fake_simulator import FakeSimulator, beam_scene
from test_view import SIZE, body_mask, needs_vulkan

from taisoft.errors import OutputError
from taisoft.output.camera import Camera
from taisoft.view.offscreen import Offscreen, rasterise, stroke
from taisoft.view.scene_view import IMPULSE_COLOUR, LAYERS, NORMAL_COLOUR, TRACTION_COLOUR

LARGE = (640, 360)


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


def picture(scene, sim, renderer, layers):
    drawing = Offscreen(scene, LARGE, renderer=renderer, layers=layers)
    try:
        return drawing.image(sim).astype(int)
    finally:
        drawing.close()


def has_colour(image, colour):
    return np.abs(image - 255 * np.asarray(colour)).max(axis=2) < 40


@needs_vulkan
@pytest.mark.parametrize("layers", [LAYERS, ("wires",), ("contacts", "tractions")])
def test_both_renderers_draw_the_same_lines(layers):
    scene, sim = scene_with_contacts_and_loads()
    vulkan, software = (picture(scene, sim, renderer, layers) for renderer in ("vulkan", "software"))
    plain = picture(scene, sim, "software", tuple(set(layers) & {"fixed_nodes"}))
    lines = np.abs(software - plain).max(axis=2) > 20
    differ = np.abs(vulkan - software).max(axis=2) > 20
    assert 0.003 < lines.mean() < 0.2
    assert differ.sum() < 0.1 * lines.sum()
    if "contacts" in layers:
        for colour in (NORMAL_COLOUR, IMPULSE_COLOUR, TRACTION_COLOUR):
            assert has_colour(software, colour).sum() > 5 and has_colour(vulkan, colour).sum() > 5


def test_hidden_lines_are_not_drawn():
    scene, sim = scene_with_contacts_and_loads()
    plain, wired = (picture(scene, sim, "software", layers) for layers in ((), ("wires",)))
    lines = np.abs(wired - plain).max(axis=2) > 20
    inside = body_mask(plain)
    outline = inside & ~np.all([np.roll(inside, by, axis) for axis in (0, 1) for by in (-2, 2)], axis=0)
    assert (lines & ~inside & ~outline).sum() < 0.2 * lines.sum(), "wires are drawn on the bodies"
    scene.bodies[0].position[:], drawing = (0, 0, 0), Offscreen(scene, LARGE, renderer="software", layers=("wires",))
    ends, _ = drawing.layers.lines(sim, drawing.camera)
    length = np.linalg.norm(np.diff(drawing.camera.project(ends, LARGE)[:, :2].reshape(-1, 2, 2), axis=1), axis=2).sum()
    assert lines.sum() < 0.85 * 1.25 * length, "some of them are hidden"


def test_fixed_nodes_are_the_only_default_layer():
    scene, sim = scene_with_contacts_and_loads()
    default = Offscreen(scene, LARGE, renderer="software").image(sim)
    assert np.array_equal(default, picture(scene, sim, "software", ("fixed_nodes",)))
    bare = picture(scene, sim, "software", ())
    dark = (default < 60).all(axis=2)
    assert dark.sum() > 50 and not (bare < 60).all(axis=2).any(), "fixed nodes are dark balls"


def test_arrows_beyond_the_bodies_are_inside_the_image():
    scene, sim = scene_with_contacts_and_loads()
    plain, marked = (picture(scene, sim, "software", layers) for layers in ((), ("tractions",)))
    top = np.flatnonzero(body_mask(plain).any(axis=1)).min()
    assert has_colour(marked[: top - 5], TRACTION_COLOUR).sum() > 20


def test_unknown_layers_are_refused():
    with pytest.raises(OutputError, match="layer 'wire' is unknown: it must be one of wires, contacts"):
        Offscreen(beam_scene(), SIZE, renderer="software", layers=("wire",))


@pytest.mark.parametrize("angle", [0, 30, 90, 200, 315])
def test_a_band_has_its_width(angle):
    u, v = 30.0 * np.cos(np.radians(angle)), 30.0 * np.sin(np.radians(angle))
    ends = np.array([[40.0, 40, 2], [40 + u, 40 + v, 4], [5, 5, 1], [5, 5, 1]])
    corners, triangles = stroke(ends, 4.0)
    image = np.zeros((80, 80, 3), dtype=np.uint8)
    mask = rasterise(corners, triangles, np.ones((len(corners), 3)), 0.1, image)
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
