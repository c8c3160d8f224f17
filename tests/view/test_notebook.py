"""What notebooks show: short reprs, pictures, HTML of scenes, simulators and results, films and the interactive view."""

import base64
import json
import re

import numpy as np
import pytest

import taisoft as ts
from taisoft.errors import OutputError
from taisoft.records import BodyError
from taisoft.view import interactive
from taisoft.view.offscreen import Offscreen
from tests.output.png import decode
from tests.view.fake_simulator import FakeSimulator, beam_scene


@pytest.fixture(scope="module")
def ran():
    """A simulator, its result and the film of its run."""
    scene = beam_scene(cells=(6, 2, 2))
    film = ts.Film((96, 54))
    with ts.Simulator(scene, dt=1 / 60) as sim:
        result = sim.run(0.1, on_frame=film, fps=30)
        yield sim, result, film


def shown(thing) -> str | None:
    """The HTML that a notebook displays."""
    return thing._repr_html_()


def test_reprs_of_a_run_are_short(ran):
    sim, result, _ = ran
    expected = r"RunReport: ok, 0\.1 s in 6 steps of 0\.0166667 s, \d+\.\d\d s of wall time, \d+\.\d\d s to compile"
    assert re.fullmatch(expected, repr(result))
    step = repr(result.step_reports[-1])
    assert re.match(r"StepReport\(t = 0\.1 s: \d+ Newton iterations, residual .*, min J .*, kinetic .* J, elastic .* J\)$", step)
    n = sim.scene.bodies[0].mesh.n_tets
    assert repr(sim) == f"Simulator(1 body, {n} tets; implicit_euler, f32 on cpu; t = 0.1 s after 6 steps of 0.0166667 s)"
    for record in (sim.scene, sim.scene.bodies[0], sim.energies(), sim.contacts(), sim.plan, sim.scene.bodies[0].nodes):
        assert len(repr(record)) < 400 and "\n" not in repr(record), type(record)


def test_a_report_lists_its_first_problems():
    report = ts.RunReport(status="degraded", problems=[f"problem {k}" for k in range(7)], interrupted=True)
    report.step_reports = [ts.StepReport(time=1.0, converged=False, n_contacts=3, substeps=4)] * 1000
    report.error_estimate = ts.ErrorEstimate(time=0.0123, excursion=2.0, bodies={"a": BodyError(time=0.1)})
    first, *lines = repr(report).splitlines()
    assert first.startswith("RunReport: degraded, ended early, 0 s in 0 steps")
    assert lines[:6] == [*(f"  problem {k}" for k in range(5)), "  and 2 more problems"]
    assert lines[6:] == ["  ErrorEstimate(time 1.2 %; relative to an excursion of 2 m)"]
    assert "4 substeps, 3 contacts" in repr(report.step_reports[0]) and repr(report.step_reports[0]).endswith("not converged)")
    assert "times=float64 (50,)" in repr(ts.KeyFrames(times=np.arange(50.0), values=np.zeros(50)))
    assert "times=[0.0, 1.0]" in repr(ts.KeyFrames(times=[0, 1], values=[2, 3]))


def test_a_picture_is_that_of_the_renderer(ran):
    sim, size = ran[0], (96, 54)
    picture, default = sim.picture(size, "stretch"), sim.picture(size)
    assert np.array_equal(picture, Offscreen(sim.scene, size, colour="stretch").image(sim))
    assert default.shape == (54, 96, 3) and default.dtype == np.uint8 and not np.array_equal(picture, default)
    assert np.array_equal(default, sim.picture(size, "stress"))


def test_bad_sizes_and_colours_are_refused(ran):
    for arguments, message in (
        ({"size": (0, 10)}, "a picture of 0 x 10 pixels cannot be drawn: both must be 1 to 16384"),
        ({"size": (1.5, 2)}, r"must be two whole numbers, width and height, not \(1.5, 2\)"),
        ({"size": (10, 10**9)}, "a picture of 10 x 1000000000 pixels cannot be drawn"),
        ({"colour": "rainbow"}, "colour must be one of body, stress, stretch, speed, pressure, slip, error, not 'rainbow'"),
    ):
        for make in (ran[0].picture, ts.Film):
            with pytest.raises(OutputError, match=message):
                make(**arguments)


def pictures_in(page: str) -> list[np.ndarray]:
    return [decode(base64.b64decode(text)) for text in re.findall(r'data:image/png;base64,([^"&]+)["&]', page)]


def test_a_scene_shows_its_start_and_a_simulator_its_state(ran, monkeypatch):
    scene, sim = beam_scene(), ran[0]
    (picture,) = pictures_in(page := shown(scene))
    assert picture.shape == (360, 640, 3) and "Scene(gravity=(0.0, -9.81, 0.0), bodies=[&#x27;beam&#x27;])" in page
    assert np.array_equal(picture, Offscreen(scene, (640, 360)).image(FakeSimulator(scene)))  # at t = 0
    assert np.array_equal(pictures_in(page := shown(sim))[0], sim.picture((640, 360)))
    assert repr(sim) in page and re.search(r"von Mises stress, red: \d+ Pa or more", page)
    monkeypatch.setattr("taisoft.view.notebook.MAX_NODES", 10)
    assert shown(scene) is None and shown(ts.Scene()) is None, "nothing to draw gives the repr alone"


def test_a_result_shows_numbers_and_problems(ran):
    page = shown(ran[1])
    assert page.startswith("<div") and "<b>RunReport: ok, 0.1 s in 6 steps" in page
    smallest = min(step.min_volume_ratio for step in ran[1].step_reports)
    assert f"<td>smallest J</td><td>{smallest:.4g}</td>" in page
    page = shown(ts.RunReport(status="failed", problems=["<script>"]))
    assert "<table>" not in page and "&lt;script&gt;" in page


def test_a_film_holds_a_picture_a_frame(ran, tmp_path):
    film = ran[2]
    assert len(film) == 4 and np.allclose(film.times, np.arange(4) / 30) and repr(film) == "Film(4 pictures, t = 0 to 0.1 s)"
    film.save(tmp_path / "film.html")
    page = film.as_html()
    assert (tmp_path / "film.html").read_text() == page and "http" not in page
    data = json.loads(re.search(r"const film = (\{.*?\}),", page)[1])
    assert data["times"] == film.times and data["scales"] == film.scales and len(film.scales) == 4
    assert re.fullmatch(r"von Mises stress, red: \S+ Pa or more", film.scales[-1])
    found = [decode(base64.b64decode(url.split(",")[1])) for url in data["pictures"]]
    assert all(picture.shape == (54, 96, 3) for picture in found) and not np.array_equal(found[0], found[-1])
    assert shown(film).startswith('<iframe srcdoc="') and shown(ts.Film()) is None and ts.Film()
    for one, name, message in (
        (ts.Film(), "a.html", "the film holds no picture"),
        (film, "a.txt", r"a\.txt: the name of a page must end in \.html"),
        (film, "none/a.html", "cannot write"),
    ):
        with pytest.raises(OutputError, match=message):
            one.save(tmp_path / name)


def test_a_film_of_a_run_on_disk(tmp_path):
    (tmp_path / "frames").mkdir()
    for name in ("00000", "00001", "00002", "00010", "mine"):
        (tmp_path / "frames" / f"{name}.png").write_text(name)
    assert ts.Film.read(tmp_path, fps=10).times == [0.0, 0.1, 0.2, 1.0]
    for folder, message in ((tmp_path, "the run cannot be read"), (tmp_path / "frames", "there are no pictures of a run")):
        with pytest.raises(OutputError, match=message):
            ts.Film.read(folder)
    for settings in ({"fps": 20, "dt": 0.001}, {"fps": None, "dt": 0.05}):
        (tmp_path / "report.json").write_text(json.dumps({"settings": settings}))
        film = ts.Film.read(tmp_path)
        assert film.times == [0.0, 0.05, 0.1, 0.5] and film.scales == [""] * 4
        assert film.pngs == [b"00000", b"00001", b"00002", b"00010"]


def test_an_interactive_view_makes_a_page(tmp_path, capfd, monkeypatch):
    pytest.importorskip("viser")
    scene = beam_scene(("a", "b"), order=2)
    scene.add_obstacle(ts.Sphere((0, -3, 0), 0.5), path=lambda t: ((t, 0, 0), np.eye(3)))
    scene.add_obstacle(ts.HalfSpace((0, -4, 0), (0, 1, 0)))
    view, sim = ts.InteractiveView(), FakeSimulator(scene)
    assert shown(view) is None
    for k in range(5):
        sim.time = k / 10
        view(sim, k, None)
    assert repr(view) == "InteractiveView(5 frames, t = 0 to 0.4 s)"
    view.save(tmp_path / "view.html")
    page = (tmp_path / "view.html").read_text()
    assert re.search(r">von Mises stress, red: \d+ Pa or more(, at the end)?</div></body>", page)
    assert recorded(page)["durationSeconds"] == pytest.approx(0.4)
    kinds = [message["type"] for _, message in recorded(page)["messages"]]
    assert kinds.count("GlbMessage") == 5 and kinds.count("MeshMessage") == 2
    assert shown(view).startswith('<iframe srcdoc="')
    assert capfd.readouterr() == ("", "")
    with pytest.raises(OutputError, match="an interactive view shows one scene"):
        view(FakeSimulator(beam_scene()))
    with pytest.raises(OutputError, match="the view holds no frame"):
        ts.InteractiveView().as_html()
    with pytest.raises(OutputError, match="colour must be one of .*, not 'x'"):
        ts.InteractiveView("x")
    monkeypatch.setattr(interactive, "find_spec", lambda name: None)
    with pytest.raises(OutputError, match=r"needs the package viser: pip install 'taisoft\[notebook\]'"):
        ts.InteractiveView()


def recorded(page: str) -> dict:
    """What viser's recording in a page holds."""
    import msgspec
    import zstandard

    data = base64.b64decode(re.search(r'__VISER_EMBED_DATA__="([^"]+)"', page)[1])
    content = zstandard.ZstdDecompressor().decompress(data[8:], max_output_size=int.from_bytes(data[:8], "little"))
    length = int.from_bytes(content[:8], "little")
    return msgspec.msgpack.decode(content[8 : 8 + length])
