"""`taisoft draw`: the pictures of a finished run again, and other ones, without computing; what it refuses."""

import numpy as np
import pytest

from taisoft.cli import main
from taisoft.cli.recording import make_video
from taisoft.errors import OutputError
from tests.cli.command import BEAM, run, write
from tests.output.png import decode

SIZE = ("--size", "160x90")


def draw(*arguments) -> int:
    return main(["draw", *map(str, arguments)])


def pictures(folder) -> dict[str, bytes]:
    return {path.name: path.read_bytes() for path in (folder / "frames").iterdir()}


@pytest.fixture(scope="module")
def finished(tmp_path_factory):
    folder = tmp_path_factory.mktemp("finished")
    path = write(folder / "scene.py", BEAM)
    assert run(path, "--out", folder / "out", "--no-usd", "--camera", "position = [3, 2, 9], fov = 30", *SIZE) == 0
    path.unlink()
    return folder / "out"


def test_the_same_options_give_the_same_bytes(finished, capsys):
    assert draw(finished, *SIZE) == 0
    assert pictures(finished / "drawn") == pictures(finished) and len(pictures(finished)) == 4
    assert f"(4 of 4 frames of {finished})" in capsys.readouterr().out
    assert draw(finished, *SIZE) == 3 and "already holds results (frames/)" in capsys.readouterr().err
    assert draw(finished, *SIZE, "--overwrite", "--colour", "speed") == 0
    assert pictures(finished / "drawn") != pictures(finished)


def test_another_look(finished, tmp_path):
    (tmp_path / "camera.toml").write_text("[camera]\nposition = [[0, 0, 9], [0, 0, 18]]\ntimes = [0, 0.1]\n")
    (tmp_path / "look.toml").write_text('background = "#0000ff"\n[camera]\nposition = [5, 5, 5]\n')
    look = (
        "--look",
        tmp_path / "look.toml",
        "--camera",
        tmp_path / "camera.toml",
        "--set",
        "beam.colour='#00ff00'",
        "--layers",
        "none",
    )
    assert draw(finished, "--out", tmp_path / "green", *look, *SIZE) == 0
    first, last = (decode(pictures(tmp_path / "green")[name]).astype(int) for name in ("00000.png", "00003.png"))
    sizes = [(one[..., 1] - one[..., 0] > 60).sum() for one in (first, last)]
    assert first[0, 0].tolist() == [0, 0, 255]
    assert sizes[0] == pytest.approx(4 * sizes[1], rel=0.3), "the camera moves back to twice the distance"


@pytest.mark.parametrize(
    "arguments, status, text",
    [
        (
            ("--colour", "slip"),
            2,
            "colour 'slip' cannot be drawn: frame 0 has kept stress, speed; run it again with --keep stress,speed,slip",
        ),
        (("--scale", "2"), 2, "--scale is that of a quantity, so it needs --colour"),
        (("--camera", "position = [[0, 0, 9], [0, 0, 8]]"), 2, "camera: key frames of position, target or fov need times [s]"),
        (("--look", "none.toml"), 2, "none.toml: the file cannot be read: No such file"),
        (("--camera", "position = [0, 0, 0]"), 2, "camera.position and target must differ"),
        (("--camera", "place = [0, 0, 0]"), 2, "camera.place is not"),
        (("--camera", "position = 3 2"), 2, "--camera position = 3 2: write a .toml file, or keys as in"),
        (("--camera", "none.toml"), 2, "--camera none.toml: the file cannot be read: No such file"),
        (
            ("--camera", "position = [0, 0, 9], follow = 'bean'"),
            2,
            "camera: follow: no body is called 'bean' (did you mean beam?)",
        ),
        (("--camera", "position = [0, 0, 9]", "--view", "0", "0"), 2, "--view gives the automatic camera's direction"),
        (("--set", "beam.color=#ffffff"), 2, "--set beam.color=#ffffff: write NAME.colour="),
        (("--set", "bean.colour=#ffffff"), 2, "no body or obstacle is called 'bean' (did you mean beam?)"),
        (("--set", "beam.opacity=2"), 2, "opacity must be at least 0.02 and at most 1, not 2"),
        (("--set", "beam.colour=null"), 2, "there is no value"),
        (("--slow", "2"), 2, "--slow is the speed of the film, so it needs --video"),
    ],
)
def test_refusals(finished, tmp_path, capsys, arguments, status, text):
    assert draw(finished, "--out", tmp_path / "new", *arguments) == status
    assert text in capsys.readouterr().err and not (tmp_path / "new").exists()


def test_the_run_itself_stays(finished, tmp_path, capsys):
    before = pictures(finished)
    assert draw(finished, "--out", finished, "--overwrite") == 2 and "it is the folder of a run" in capsys.readouterr().err
    assert draw(tmp_path) == 2 and "there are no states of a run" in capsys.readouterr().err
    assert pictures(finished) == before


def test_a_run_that_keeps_nothing(beam, tmp_path, capsys):
    """It removes what was drawn of the earlier one."""
    (tmp_path / "out/drawn/frames").mkdir(parents=True)
    (tmp_path / "out/drawn/frames/00000.png").touch()
    assert run(beam, "--out", tmp_path / "out") == 3 and "drawn/frames/" in capsys.readouterr().err
    assert run(beam, "--out", tmp_path / "out", "--keep", "none", "--no-usd", "--no-frames", "--overwrite") == 0
    assert not (tmp_path / "out/states").exists() and not any((tmp_path / "out/drawn/frames").iterdir())
    capsys.readouterr()
    for keep, text in (("stres", "not 'stres'; did you mean 'stress'?"), ("error", "needs --error")):
        assert run(beam, "--out", tmp_path / "new", "--keep", keep) == 2 and text in capsys.readouterr().err


def test_a_resumed_run_keeps_the_same_and_starts_its_automatic_camera_anew(beam, tmp_path, capsys):
    """A film needs all its pictures."""
    out, own = tmp_path / "out", ("--camera", "position = [-90, 1, -90]")
    assert run(beam, "--out", out, "--seconds", "0.07", "--keep", "speed,stretch", "--no-usd", *own, *SIZE) == 0
    resumed = ("--out", out, "--resume", out / "checkpoint.npz", "--no-usd", *SIZE)
    for keep in ("speed", "none"):
        assert run(beam, *resumed, "--keep", keep) == 3
        assert f"--keep {keep}: the run that is resumed keeps speed,stretch" in capsys.readouterr().err
    assert run(beam, *resumed) == 0 and draw(out, *SIZE, "--colour", "stretch", "--caption") == 0
    last = decode(pictures(out)["00003.png"]).astype(int)
    assert (np.ptp(last, axis=2) > 40).mean() > 0.1, "the body fills the picture again"
    (out / "drawn/frames/00001.png").unlink()
    with pytest.raises(OutputError, match="video.mp4 cannot be made: pictures are missing between 0 and 3"):
        make_video(out / "drawn", 30.0)
