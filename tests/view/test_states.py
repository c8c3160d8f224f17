"""States of a run in its folder: the same pictures again, another look, and what is refused."""

import shutil

import numpy as np
import pytest

import taisoft as ts
from taisoft.errors import OutputError, SceneError
from taisoft.view.offscreen import Offscreen
from taisoft.view.sampling import Sampler
from taisoft.view.states import StateWriter, StoredRun
from tests.view.drawing import connected_scene, moving_scene
from tests.view.test_pictures import Shown

SIZE, LAYERS = (160, 90), ("wires", "contacts", "tractions", "pressures", "connections", "fixed_nodes")


class Drawn:
    """A member of the writer that draws every state."""

    def __init__(self, sim):
        self.drawing, self.pictures = Offscreen(Sampler(sim.scene).drawn, SIZE, colour="stress", layers=LAYERS), []

    def frame(self, state, index):
        self.pictures.append(self.drawing.image(state))

    def close(self):
        self.drawing.close()


def written(folder, build, kinds=("speed",)):
    """The pictures of three frames of a run, which is stored in a folder."""
    sim = Shown(build())
    drawn = Drawn(sim)
    writer = StateWriter(folder, Sampler(sim.scene), kinds, [drawn], (LAYERS, "stress"))
    for index in (0, 1, 5):
        sim.time = 0.1 * index
        writer.frame(sim, index)
    writer.close()
    writer.close()
    return drawn.pictures


@pytest.mark.parametrize("build", [connected_scene, moving_scene])
def test_pictures_are_the_same_again(build, tmp_path):
    """Of all layers, by a colour that only the pictures asked for."""
    first, run = written(tmp_path, build), StoredRun(tmp_path)
    assert run.frames == [0, 1, 5] and len(run) == 3
    again = Offscreen(run.scene, SIZE, colour="stress", layers=LAYERS)
    for picture, frame in zip(first, run.frames):
        state = run.state(frame, "stress")
        assert np.array_equal(again.image(state), picture) and state.time == 0.1 * frame
        assert list(state.values) == ["stress"] and list(run.state(frame, "speed").values) == ["speed"]
    assert not np.array_equal(first[0], first[2])


@pytest.fixture(scope="module")
def stored(tmp_path_factory):
    folder = tmp_path_factory.mktemp("run")
    written(folder, moving_scene)
    return folder


def test_another_look(stored):
    run = StoredRun(stored)
    before = run.picture(5, SIZE)
    run.paint("one", colour="#00ff00")
    run.paint("lid", (1, 0, 0))
    painted = run.picture(5, SIZE).astype(int)
    assert run.scene.bodies[0].colour.tolist() == [0, 1, 0] and (painted[..., 1] > painted.max(axis=2) - 1).sum() > 100
    assert (np.abs(painted - before).max(axis=2) > 20).mean() > 0.01
    turned = run.picture(5, SIZE, "speed", ts.Camera((9, 1, 0), (0, 0, 0)))
    assert not np.array_equal(turned, run.picture(None, SIZE, "speed")) and run.scene.camera is None
    run.background, run.lights, run.camera = "#102030", ts.Light((0, -1, 0)), ts.Camera((9, 1, 0), follow="one")
    dark = run.picture(0, SIZE)
    assert (np.abs(dark[0, 0] - (16.0, 32.0, 48.0)) < 2).all() and len(run.lights) == 1


def test_refusals(stored, tmp_path):
    run = StoredRun(stored)
    for call, error, text in (
        (
            lambda: run.picture(0, SIZE, "slip"),
            OutputError,
            "colour 'slip' cannot be drawn: frame 0 has kept speed, stress; .* --keep speed,stress,slip$",
        ),
        (lambda: run.picture(0, SIZE, "slop"), OutputError, "colour must be one of .*; did you mean 'slip'"),
        (lambda: run.state(2), OutputError, "there is no frame 2: they are 0 to 5$"),
        (lambda: run.paint("tow", "#ffffff"), SceneError, "no body or obstacle is called 'tow' .did you mean two"),
        (lambda: run.paint("two", "red"), SceneError, "^'two': colour must be '#rrggbb'"),
        (lambda: run.paint("lid", opacity=0), SceneError, "^'lid': opacity must be at least 0.02"),
        (lambda: run.picture(0, SIZE, camera=(1, 2, 3)), SceneError, "^camera must be a Camera, not tuple"),
        (lambda: run.picture(0, SIZE, camera=ts.Camera((1, 0, 0), follow="tow")), SceneError, "no body is called 'tow'"),
        (lambda: setattr(run, "background", "red"), SceneError, "^scene: background must be '#rrggbb'"),
        (
            lambda: setattr(run, "camera", ts.Camera((1, 0, 0), follow="tow")),
            SceneError,
            "camera: follow: no body is called 'tow'",
        ),
        (lambda: setattr(run, "backgroud", "#ffffff"), SceneError, "no attribute 'backgroud'; did you mean 'background'"),
        (lambda: StoredRun(tmp_path / "none"), OutputError, "none/states: there are no states of a run"),
    ):
        with pytest.raises(error, match=text):
            call()
    copy = tmp_path / "copy"
    shutil.copytree(stored, copy)
    for name, damage in (("00001.npz", b""), ("scene.npz", b"PK\3\4 no archive")):
        (copy / "states" / name).write_bytes(damage)
    with pytest.raises(OutputError, match="scene.npz is no state of a run, or damaged: "):
        StoredRun(copy)
    shutil.copy(stored / "states/scene.npz", copy / "states")
    with pytest.raises(OutputError, match="00001.npz is no state of a run, or damaged: "):
        StoredRun(copy).state(1)


def test_without_states_nothing_is_written(tmp_path):
    assert len(written(tmp_path, moving_scene, ())) == 3 and list(tmp_path.iterdir()) == []


def test_a_write_error_is_raised_later(tmp_path):
    sim = Shown(moving_scene())
    writer = StateWriter(tmp_path, Sampler(sim.scene), ("speed",), [], ((), "body"))
    shutil.rmtree(tmp_path / "states")
    writer.frame(sim, 0)
    for use in (writer.flush, lambda: writer.frame(sim, 1), writer.close):
        with pytest.raises(OutputError, match="cannot write .*00000.npz"):
            use()
    writer.close()
