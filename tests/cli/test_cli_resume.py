"""`taisoft run --resume` and the checkpoints of a run:

* a resumed run gives the same files as a single run: pictures, steps.csv and USD bytewise, and the last state;
* so does a run that was interrupted, or killed after writing checkpoints; a failed run keeps its last good state;
* settings that cannot change within a run, a run that is already over, and another scene: status 2, and no file changes.
"""

import signal
from pathlib import Path

import numpy as np
import pytest

from taisoft.checkpoint import read_checkpoint
from tests.cli.command import BEAM, LED, SHORT_OUTPUT, child, report, run, write

GENTLE = LED.replace("{body}", "return (0, -t, 0)")


def usd(folder: Path) -> str:
    """scene.usdc as text."""
    from pxr import Sdf

    return Sdf.Layer.OpenAsAnonymous(str(folder / "scene.usdc")).ExportToString()


def assert_same_folders(a: Path, b: Path, rows: int = 0) -> None:
    """Compare the results of two runs, except for reports; of steps.csv only rows from `rows` on."""
    extra = "checkpoint.previous.npz"  # only where a run wrote two
    names = [sorted(str(path.relative_to(folder)) for path in folder.rglob("*") if path.name != extra) for folder in (a, b)]
    assert names[0] == names[1] and "frames/00006.png" in names[0] and "chunks" not in names[0]
    for picture in (a / "frames").iterdir():
        assert picture.read_bytes() == (b / "frames" / picture.name).read_bytes(), picture.name
    steps = [(folder / "steps.csv").read_text().splitlines() for folder in (a, b)]
    assert len(steps[0]) == 7 and steps[0][rows:] == steps[1][max(0, len(steps[1]) - 7 + rows) :]
    assert usd(a) == usd(b)
    one, other = (read_checkpoint(folder / "checkpoint.npz") for folder in (a, b))
    assert np.array_equal(one.state["simulation"]["x"], other.state["simulation"]["x"])
    assert one.state["simulation"]["step_count"] == other.state["simulation"]["step_count"]


@pytest.fixture(scope="module")
def single(tmp_path_factory) -> Path:
    """The folder of a single run of 0.2 s: frames 0 to 6."""
    folder = tmp_path_factory.mktemp("single")
    assert run(write(folder / "scene.py", GENTLE), "--seconds", "0.2", "--out", folder / "out") == 0
    return folder / "out"


@pytest.fixture
def begun(tmp_path) -> tuple[Path, Path]:
    """A scene file, and the folder of its run of 0.1 s without pictures and USD."""
    path = write(tmp_path / "scene.py", GENTLE)
    assert run(path, "--out", tmp_path / "out", *SHORT_OUTPUT) == 0
    return path, tmp_path / "out"


# --- continuing -------------------------------------------------------------------------------------------------------


def test_two_parts_equal_one_run(single, tmp_path, capsys):
    path, out = write(tmp_path / "scene.py", GENTLE), tmp_path / "out"
    assert run(path, "--out", out) == 0
    assert run(path, "--out", out, "--resume", out / "checkpoint.npz", "--seconds", "0.2") == 0
    assert_same_folders(single, out)
    record = report(out)
    assert record["resumed"] == {"checkpoint": str(out / "checkpoint.npz"), "time": pytest.approx(0.1), "frame": 3}
    assert record["sim_seconds"] == pytest.approx(0.1) and record["steps"] == 24
    assert report(single)["resumed"] is None
    assert f"resumed  from {out / 'checkpoint.npz'}, t = 0.1 s" in capsys.readouterr().out


@pytest.mark.parametrize(
    "options", [("--layers", "contacts"), pytest.param(("--colour", "speed"), marks=pytest.mark.long)], ids=" ".join
)
def test_two_parts_draw_the_pictures_of_one_run(tmp_path, options):
    """The scale of colours and that of impulses depend on earlier pictures; the cube lands before the first part ends."""
    out, single = tmp_path / "out", tmp_path / "single"
    arguments = ("--no-usd", *options)
    assert run("cube_on_box", "--out", out, "--seconds", "0.4", *arguments) == 0
    assert run("cube_on_box", "--out", out, "--resume", out / "checkpoint.npz", "--seconds", "0.8", *arguments) == 0
    assert run("cube_on_box", "--out", single, "--seconds", "0.8", *arguments) == 0
    pictures = [{path.name: path.read_bytes() for path in (folder / "frames").iterdir()} for folder in (out, single)]
    assert pictures[0].keys() == pictures[1].keys() and len(pictures[0]) > 20
    assert [name for name in sorted(pictures[0]) if pictures[0][name] != pictures[1][name]] == []


def test_an_interrupted_run_continues(single, tmp_path):
    raising = f"import signal; signal.raise_signal({int(signal.SIGTERM)}) if 0.1 < t < 0.1042 else None\n    return (0, -t, 0)"
    path, out = write(tmp_path / "scene.py", LED.replace("{body}", raising)), tmp_path / "out"
    assert run(path, "--out", out, "--seconds", "0.2") == 143
    assert 0.1 < read_checkpoint(out / "checkpoint.npz").state["simulation"]["time"] < 0.15
    assert run(path, "--out", out, "--resume", out / "checkpoint.npz", "--seconds", "0.2") == 0
    assert_same_folders(single, out)


def test_a_run_interrupted_between_frames_continues(tmp_path):
    """Implicit runs can stop after any step: step 28 of 48 lies in the middle of frame 4."""
    raising = "import signal; signal.raise_signal(2) if 27.8 < 240 * t < 28.2 else None\n    return (0, -t, 0)"
    implicit = ("--set", "solver.integrator=implicit_euler", "--seconds", "0.2", "--no-frames")
    path, out, single = tmp_path / "scene.py", tmp_path / "out", tmp_path / "single"
    write(path, LED.replace("{body}", raising))
    assert run(path, "--out", out, *implicit) == 130
    assert read_checkpoint(out / "checkpoint.npz").state["simulation"]["step_count"] == 28
    write(path, GENTLE)
    assert run(path, "--out", out, "--resume", out / "checkpoint.npz", *implicit) == 0
    assert run(path, "--out", single, *implicit) == 0
    assert report(out)["resumed"]["frame"] == 4 and report(out)["steps"] == 20
    assert (out / "steps.csv").read_bytes() == (single / "steps.csv").read_bytes()
    assert usd(out) == usd(single)
    one, other = (read_checkpoint(folder / "checkpoint.npz").state for folder in (out, single))
    assert np.array_equal(one["simulation"]["v"], other["simulation"]["v"])
    assert np.array_equal(one["stepper"]["x_now"], other["stepper"]["x_now"])


def test_a_killed_run_continues(single, tmp_path):
    """Killed in frame 6, with checkpoints at frames 2 and 4, before a chunk of USD is full."""
    dying = "import os; t > 0.17 and os._exit(9)\n    return (0, -t, 0)"
    path, out = write(tmp_path / "scene.py", LED.replace("{body}", dying)), tmp_path / "out"
    process = child("run", path, "--headless", "--out", out, "--seconds", "0.2", "--checkpoint-every", str(2 / 30))
    process.communicate(timeout=120)
    assert process.returncode == 9 and not (out / "scene.usdc").exists()
    assert {f"{k:05d}.png" for k in range(5)} <= {path.name for path in (out / "frames").iterdir()}, "those of the checkpoint"
    assert read_checkpoint(out / "checkpoint.npz").state["simulation"]["time"] == pytest.approx(4 / 30)
    write(path, GENTLE)
    assert run(path, "--out", out, "--resume", out / "checkpoint.npz", "--seconds", "0.2") == 0
    assert_same_folders(single, out, rows=5)  # the killed run wrote no rows


def test_a_failed_run_keeps_its_last_good_state(tmp_path):
    failing = LED.replace("{body}", "return (0, -t, 0) if t < 0.05 else (0, float('nan'), 0)")
    path, out = write(tmp_path / "scene.py", failing), tmp_path / "out"
    assert run(path, "--out", out, *SHORT_OUTPUT) == 1
    simulation = read_checkpoint(out / "checkpoint.npz").state["simulation"]
    assert 0.0 < simulation["time"] < 0.05 and np.isfinite(simulation["x"]).all()


def test_a_run_continues_in_another_folder_with_another_dt(begun, tmp_path):
    path, out = begun
    other = tmp_path / "other"
    before = (out / "report.json").read_bytes()
    arguments = ("--resume", out / "checkpoint.npz", "--set", "solver.dt=0.002", "--seconds", "0.15", "--no-usd")
    assert run(path, "--out", other, *arguments) == 0
    assert report(other)["settings"]["dt"] == pytest.approx(1 / 510) and (out / "report.json").read_bytes() == before
    assert sorted(picture.name for picture in (other / "frames").iterdir()) == ["00003.png", "00004.png", "00005.png"]


# --- refused ----------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    "arguments, message",
    [
        (["--precision", "f64"], "precision is f32 there and cannot become f64 in a run"),
        (["--set", "solver.integrator=bdf2"], "integrator is symplectic_euler there and cannot become bdf2"),
        (["--set", "solver.dt=0.5"], "above the estimated stability limit"),
        (["--seconds", "0.1"], "it is already at t = 0.1 s, and the run ends at 0.1 s"),
        (["--checkpoint-every", "-1"], "--checkpoint-every must be greater than 0 s, not -1"),
    ],
)
def test_settings_that_cannot_change_are_refused(begun, capsys, arguments, message):
    path, out = begun
    before = {file.name: file.read_bytes() for file in out.iterdir()}
    capsys.readouterr()
    end = () if "--seconds" in arguments else ("--seconds", "0.2")
    assert run(path, "--out", out, "--resume", out / "checkpoint.npz", *end, *arguments) == 2
    error = capsys.readouterr().err
    assert message in error and error.startswith("taisoft: ") and error.count("\n") == 1
    assert {file.name: file.read_bytes() for file in out.iterdir()} == before


def test_another_scene_is_refused(begun, tmp_path, capsys):
    _, out = begun
    path = write(tmp_path / "beam.py", BEAM)
    assert run(path, "--out", tmp_path / "new", "--resume", out / "checkpoint.npz", "--seconds", "0.2") == 2
    assert "is a checkpoint of another scene, which differs in body 'beam': constraints" in capsys.readouterr().err
    assert not (tmp_path / "new").exists()


def test_other_numbers_are_refused(begun, tmp_path, capsys):
    """They would be ignored, since a resumed run keeps its own."""
    path, out = begun
    arguments = ("--out", tmp_path / "new", *SHORT_OUTPUT, "--resume", out / "checkpoint.npz", "--seconds", "0.15")
    capsys.readouterr()
    assert run(write(tmp_path / "stiffer.py", GENTLE.replace("young=1e5", "young=2e5")), *arguments) == 2
    error = capsys.readouterr().err
    assert "body 'beam': young is 200000.0 in this scene and was 100000.0 at the start" in error
    assert error.startswith("taisoft: ") and error.count("\n") == 1 and not (tmp_path / "new").exists()
    assert run(path, *arguments) == 0


def test_checkpoints_need_a_folder(beam, capsys):
    assert run(beam, "--checkpoint-every", "0.1") == 2
    assert "--checkpoint-every needs --out" in capsys.readouterr().err


def test_another_frame_rate_is_refused(tmp_path, capsys):
    path, out = write(tmp_path / "scene.py", GENTLE), tmp_path / "out"
    assert run(path, "--out", out, "--fps", "60") == 0
    before, pictures = usd(out), sorted((out / "frames").iterdir())
    arguments = ("--resume", out / "checkpoint.npz", "--seconds", "0.2")
    assert run(path, "--out", out, *arguments, "--fps", "30") == 2
    assert "fps is 60.0 there and cannot become 30.0 in a run" in capsys.readouterr().err
    assert usd(out) == before and report(out)["resumed"] is None and sorted((out / "frames").iterdir()) == pictures
    assert run(path, "--out", out, *arguments) == 0  # the frame rate of the scene file is ignored
    assert len(list((out / "frames").iterdir())) == 2 * len(pictures) - 1


def test_results_of_another_scene_are_not_overwritten(tmp_path, capsys):
    path, out, other = write(tmp_path / "scene.py", GENTLE), tmp_path / "out", tmp_path / "other"
    assert run(path, "--out", out, *SHORT_OUTPUT) == 0
    assert run(write(tmp_path / "beam.py", BEAM.replace('"beam"', '"other"')), "--out", other) == 0
    before = {file: file.read_bytes() for file in other.rglob("*") if file.is_file()}
    assert run(path, "--out", other, "--resume", out / "checkpoint.npz", "--seconds", "0.2") == 3
    assert "is of another scene, frame rate or --error" in capsys.readouterr().err
    assert {file: file.read_bytes() for file in other.rglob("*.png")} == {f: b for f, b in before.items() if f.suffix == ".png"}
    assert usd(other) and (other / "steps.csv").read_bytes() == before[other / "steps.csv"]


def test_a_damaged_checkpoint_is_replaced_by_the_previous_one(single, tmp_path, capsys):
    path, out = write(tmp_path / "scene.py", GENTLE), tmp_path / "out"
    assert run(path, "--out", out, "--checkpoint-every", str(1 / 30)) == 0
    damaged, previous = out / "checkpoint.npz", out / "checkpoint.previous.npz"
    assert read_checkpoint(previous).state["simulation"]["time"] == pytest.approx(3 / 30)
    damaged.write_bytes(damaged.read_bytes()[:-1000])
    assert run(path, "--out", out, "--resume", damaged, "--seconds", "0.2") == 0
    message = f"previous checkpoint instead, {previous}"
    assert message in capsys.readouterr().err and message in report(out)["problems"][0]
    assert report(out)["resumed"]["checkpoint"] == str(previous) and read_checkpoint(previous)
    assert_same_folders(single, out)
