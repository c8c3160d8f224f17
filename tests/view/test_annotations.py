"""Text and plots over pictures:

* plots are at the right, with lines in their colours; a caption is at the bottom, with the colour bar; nothing else changes;
* both scale with the picture; without Pillow they are refused;
* `taisoft run --plots --caption --layers` draws them, and refuses unknown names and what is not modelled.
"""

import numpy as np
import pytest

from taisoft.errors import OutputError
from taisoft.view import annotations
from taisoft.view.annotations import Annotations
from taisoft.view.colouring import COLOURS, Colouring
from taisoft.view.offscreen import Offscreen
from taisoft.view.plots import PLOTS, QUANTITIES
from taisoft.view.scene_view import Surfaces
from tests.cli.command import BEAM, run, write
from tests.output.test_frames import decode
from tests.view.fake_simulator import FakeSimulator, beam_scene
from tests.view.test_plots import filled
from tests.view.test_view import body_mask

SIZE = (640, 360)


def grey(size=SIZE):
    return np.full((size[1], size[0], 3), 120, dtype=np.uint8)


def bounds(picture, before):
    """Return left, top, right, bottom of the differing pixels."""
    rows, columns = np.nonzero((picture != before).any(axis=2))
    return columns.min(), rows.min(), columns.max() + 1, rows.max() + 1


def near(picture, colour, by=60):
    return np.abs(picture.astype(int) - np.round(255 * np.array(colour))).max(axis=2) < by


@pytest.mark.parametrize("size", [SIZE, (1280, 720), (300, 300)])
def test_plots_are_at_the_right(size):
    plots, sim, unit = filled(), FakeSimulator(beam_scene()), size[1] / 720
    for names in (["contacts"], list(PLOTS)):
        plots.shown = {name: name in names for name in PLOTS}
        before = grey(size)
        picture = Annotations(plots).draw(before, sim, 3)
        assert (before == 120).all() and picture.shape == before.shape and picture.dtype == np.uint8
        left, top, right, bottom = bounds(picture, before)
        assert left >= size[0] - 317 * unit and right <= size[0] - 15 * unit and top >= 15 * unit
        assert bottom <= (156 if len(names) == 1 else 705) * unit
        part = picture[top:bottom, left:right]
        assert (part > 230).all(axis=2).mean() > 0.25, "background"
        for series in PLOTS[names[-1]].series:
            assert near(part, series.colour).sum() > 30, series.name
    plots.shown = dict.fromkeys(PLOTS, False)
    assert np.array_equal(Annotations(plots).draw(grey(size), sim, 3), grey(size))


def test_lines_show_their_values():
    plots, sim = filled(300), FakeSimulator(beam_scene())
    column, half = QUANTITIES.index("n_contacts"), len(plots.history.times) // 2
    for part, value in ((slice(0, half), 1.0), (slice(half, None), 4.5)):
        plots.history.low[part, column] = plots.history.high[part, column] = value
    plots.shown = {name: name == "contacts" for name in PLOTS}
    picture = Annotations(plots).draw(grey((1280, 720)), sim, 0)
    rows, columns = np.nonzero(near(picture[30:140, 975:1255], PLOTS["contacts"].series[0].colour))
    low, high = rows[columns < 100], rows[(columns > 180) & (rows > 8)]  # below the text of the last value, in the same colour
    assert np.ptp(low) < 4 and np.ptp(high) < 4 and low.min() == pytest.approx(high.min() + 0.7 * 92, abs=2)


def test_a_caption_is_at_the_bottom():
    sim, scene = FakeSimulator(beam_scene()), beam_scene()
    sim.time = 0.5
    plain = Annotations(name="bücher").draw(grey(), sim, 7)
    left, top, right, bottom = bounds(plain, grey())
    assert left < 12 and 190 < right < 340 and 318 < top < 336 and bottom <= 355
    colouring = Colouring(scene, Surfaces(scene), "stress")
    colouring.base(sim)
    coloured = Annotations(name="bücher", colouring=colouring).draw(grey(), sim, 7)
    scale = coloured[bounds(coloured, grey())[1] : top, :120]
    assert body_mask(scale).mean() > 0.1 and scale.shape[0] > 20
    assert np.array_equal(coloured[top + 1 :], plain[top + 1 :])
    later = Annotations(name="bücher").draw(grey(), sim, 8)
    assert not np.array_equal(later, plain), "frame number"


@pytest.mark.parametrize("size", [(160, 90), (64, 36)])
def test_a_colour_bar_fits_a_small_picture(size):
    """There the steps of the bar are narrower than a pixel."""
    sim, scene = FakeSimulator(beam_scene()), beam_scene()
    colouring = Colouring(scene, Surfaces(scene), "stress")
    colouring.base(sim)
    coloured = Annotations(name="beam", colouring=colouring).draw(grey(size), sim, 7)
    plain = Annotations(name="beam").draw(grey(size), sim, 7)
    assert (coloured != plain).any()


def test_a_colour_bar_alone():
    """Its ends have the colours of the ends of the scale, and it follows the scale."""
    sim, scene = FakeSimulator(beam_scene()), beam_scene()
    colouring = Colouring(scene, Surfaces(scene), "stress")
    drawing = Annotations(colouring=colouring)
    assert np.array_equal(drawing.draw(grey((1280, 720)), sim, 0), grey((1280, 720))), "no scale yet"
    pictures = []
    for sim.time in (0.0, 0.0, 9.0):
        colouring.base(sim)
        pictures.append(drawing.draw(grey((1280, 720)), sim, 0))
    left, top, right, bottom = bounds(pictures[0], grey((1280, 720)))
    assert 8 < left < 18 and 230 < right < 252 and 640 < top and bottom <= 704
    bar = pictures[0][681, 16:236]
    assert np.abs(bar[[0, 110, -1]] - 255 * COLOURS[[0, 2, -1]]).max() < 6
    assert np.array_equal(pictures[0], pictures[1]) and not np.array_equal(pictures[1], pictures[2])
    assert np.array_equal(pictures[2][681, 16:236], bar), "only the numbers differ"


def test_a_caption_beside_plots_leaves_the_bodies_visible():
    sim, scene, plots = FakeSimulator(beam_scene()), beam_scene(), filled()
    picture = Offscreen(scene, SIZE).image(sim)
    both = Annotations(plots, "beam").draw(picture, sim, 0)
    assert np.array_equal(both[10:280, : SIZE[0] - 160], picture[10:280, : SIZE[0] - 160])


def test_missing_pillow_is_reported(monkeypatch):
    monkeypatch.setattr(annotations, "find_spec", lambda name: None if name == "PIL" else 1)
    with pytest.raises(OutputError, match=r"text in pictures needs Pillow: pip install 'taisoft\[plot\]'"):
        Annotations(name="beam")


# --- command ---


def test_a_run_draws_plots_and_captions(tmp_path):
    path = write(tmp_path / "beam.py", BEAM)
    options = ("--plots", "energies,step_time", "--caption", "--layers", "wires")
    assert run(path, "--out", tmp_path / "out", "--no-usd", "--fps", 10, *options) == 0
    first, last = (decode(file.read_bytes()) for file in sorted((tmp_path / "out" / "frames").iterdir()))
    energies, step_time = last[30:140, 970:], last[170:280, 970:]
    for series in PLOTS["energies"].series[:3]:
        assert near(energies, series.colour).sum() > 40, series.name
    assert near(step_time, PLOTS["step_time"].series[0].colour).sum() > 20
    assert (last[650:710, 10:600] < 60).all(axis=2).sum() > 500, "caption"
    body = body_mask(last)
    dark = (last[200:500, 300:900] < 70).all(axis=2)
    assert dark.sum() > 500 and body.sum() > 20 * dark.sum() / 2, "wires"
    assert not np.array_equal(first[650:710], last[650:710])


@pytest.mark.parametrize(
    "arguments, message",
    [
        (["--plots", "energy"], "--plots energy: 'energy' is not a valid name (did you mean energies?); there are energies, "),
        (["--plots", "energies,"], "'' is not a valid name"),
        (["--layers", "wires,contact"], "'contact' is not a valid name (did you mean contacts?)"),
        (["--layers", "contacts"], "--layers contacts: contact forces are not modelled (one body, and nothing that it could"),
        (["--plots", "contacts"], "plot 'contacts' is not available: contact forces are not modelled (one body, and nothing"),
        (["--plots", "iterations"], "plot 'iterations' is not available: steps of symplectic_euler are explicit"),
        (["--caption", "--no-frames"], "--caption needs --out, the folder to write to, and pictures, so it excludes --no-frames"),
        (["--plots", "energies", "--no-frames"], "--plots needs --out"),
        (["--layers", "none", "--no-frames"], "--layers needs --out"),
    ],
)
def test_what_cannot_be_shown_is_refused(beam, tmp_path, capsys, arguments, message):
    assert run(beam, "--out", tmp_path / "out", *arguments) == 2
    error = capsys.readouterr().err
    assert message in error and error.count("\n") == 1
    assert not (tmp_path / "out").exists()


def test_captions_without_pillow_are_refused(beam, tmp_path, capsys, monkeypatch):
    monkeypatch.setattr(annotations, "find_spec", lambda name: None)
    assert run(beam, "--out", tmp_path / "out", "--caption") == 2
    assert "--caption: text in pictures needs Pillow and matplotlib" in capsys.readouterr().err
    assert not (tmp_path / "out").exists()
