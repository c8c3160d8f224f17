"""Bodies coloured by stress, stretch or speed:

* a bar stretched by s has stretch s at every node, linear and quadratic, in any orientation;
* the scale ends at 1, 2 or 5 times a power of ten, rises immediately, does not flicker, and falls when it is far too high;
* a resumed run continues the scale of the same quantity;
* markers and obstacles keep their colours, unknown names are refused;
* pictures by stress differ from those in the bodies' colours; `taisoft run --colour` makes them, with a colour bar if it can.
"""

import json

import numpy as np
import pytest

import taisoft as ts
from taisoft.cli import recording
from taisoft.errors import OutputError
from taisoft.view.colouring import COLOURS, Colouring, round_up
from taisoft.view.offscreen import Offscreen
from taisoft.view.scene_view import MARKER_COLOUR, Surfaces
from tests.cli.command import BEAM, run, write
from tests.output.png import decode
from tests.view.fake_simulator import FakeSimulator, beam_scene


@pytest.mark.parametrize("order", [1, 2])
def test_stretch(order):
    scene = beam_scene(order=order)
    sim, colouring = FakeSimulator(scene), Colouring(scene, Surfaces(scene), "stretch")
    turn = np.array([[0.0, -1, 0], [1, 0, 0], [0, 0, 1]])
    x = sim.positions()
    sim.positions = lambda name=None: x * (1.3, 0.9, 0.9) @ turn
    assert np.allclose(colouring.values("stretch", sim), 1.3)
    colouring.base(sim)
    assert colouring.low == 1.0 and colouring.span == pytest.approx(0.5)
    assert colouring.legend()[0][0].strip() == "1.5" and np.array_equal(colouring.legend()[0][1], COLOURS[-1])


def test_the_scale_does_not_flicker():
    scene = beam_scene()
    colouring, spans = Colouring(scene, Surfaces(scene), "speed"), []
    values = [3.0, 2.1, 4.9, 5.1, 4.8, *[5.2, 4.9] * 50, *[0.3] * 2000]
    sim = FakeSimulator(scene)
    for value in values:
        sim.velocities = lambda value=value: np.full((sim.positions().shape), value / np.sqrt(3))
        colouring.base(sim)
        spans.append(colouring.span)
    assert spans[:4] == [5.0, 5.0, 5.0, 10.0] and set(spans[3:105]) == {10.0}
    assert spans[-1] == 0.5 and (np.diff(spans[105:]) <= 0).all()
    assert [round_up(v) for v in (1.0, 1.1, 2.3, 0.07, 5e4)] == [1.0, 2.0, 5.0, 0.1, 5e4]


@pytest.mark.parametrize("after", [0.0, 0.01])
def test_a_scale_continues_from_what_is_kept(after):
    """A picture of the time at which it is kept is drawn again, so its step of the running maximum must not count twice."""
    scene = beam_scene()
    sim = FakeSimulator(scene)

    def image(drawing, time, speed):
        sim.time, sim.velocities = time, lambda: np.full(sim.positions().shape, speed / np.sqrt(3))
        drawing.image(sim)

    first, other, later = (Offscreen(scene, (32, 18), colour=colour) for colour in ("speed", "stress", "speed"))
    image(first, 0.0, 3.0)
    image(first, 0.1, 0.1)
    kept = json.loads(json.dumps(first.kept(0.1 + after)))  # plain data
    later.resume(kept)
    other.resume(kept)
    assert other.colouring.scale == ("stress", 0.0, 0.0)
    if after == 0.0:
        image(later, 0.1, 0.1)
    assert later.colouring.scale == first.colouring.scale and first.colouring.scale[1] == pytest.approx(0.998 * 3.0, rel=1e-5)
    assert later.camera.distance == first.camera.distance


def test_markers_and_obstacles_keep_their_colours():
    scene = beam_scene()
    scene.add_obstacle(ts.HalfSpace((0, -3, 0), (0, 1, 0)))
    surfaces, sim = Surfaces(scene), FakeSimulator(scene)
    sim.time = 1.0
    base = Colouring(scene, surfaces, "stress").base(sim)
    kept = (base == surfaces.colours).all(axis=1)
    marked = (surfaces.colours == MARKER_COLOUR).all(axis=1)
    grey = surfaces.colours.max(axis=1) - surfaces.colours.min(axis=1) < 0.1
    assert marked.any() and kept[marked | grey].all() and not kept[~(marked | grey)].any()
    with pytest.raises(OutputError, match="colour 'heat' is unknown"):
        Colouring(scene, surfaces, "heat")


def test_pictures_by_stress():
    scene, images = beam_scene(), []
    sim = FakeSimulator(scene)
    sim.time = 1.0
    for colour in ("body", "stress"):
        images.append(Offscreen(scene, (160, 90), colour=colour).image(sim).astype(int))
    own, stress = images
    differs = np.abs(own - stress).max(axis=2) > 30
    assert 0.03 < differs.mean() < 0.4, "bodies only"
    red = stress[..., 0] - stress[..., 2] > 60
    assert red[:, 80:].any() and not red[:, :60].any(), "the stress of FakeSimulator grows along x"


def test_colour_option(tmp_path, monkeypatch, capsys):
    """With a colour bar at the lower left, or a line that says why there is none."""
    scene, missing = write(tmp_path / "beam.py", BEAM), "text in pictures needs Pillow: pip install 'taisoft[plot]'"
    pictures = []
    for name, colour, reason in (("own", "body", ""), ("bar", "stress", ""), ("bare", "stress", missing)):
        monkeypatch.setattr(recording, "text_missing", lambda reason=reason: reason)
        assert run(scene, "--out", tmp_path / name, "--no-usd", "--colour", colour) == 0
        assert (f"pictures have no colour bar: {missing}" in capsys.readouterr().err) == bool(reason)
        pictures.append(decode((tmp_path / name / "frames" / "00003.png").read_bytes()).astype(int))
    own, bar, bare = pictures
    corner = np.s_[640:710, :250]
    assert np.array_equal(own[corner], bare[corner]) and (np.abs(bar - bare)[corner].max(axis=2) > 60).mean() > 0.1
    assert (np.abs(own - bare).max(axis=2) > 30).mean() > 0.03
    with pytest.raises(SystemExit, match="2"):
        run(scene, "--colour", "heat")
