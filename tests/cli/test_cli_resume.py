"""`taisoft run --resume` and the checkpoints of a run:

* a resumed run gives the same files as a single run: pictures, tables, VTK and USD bytewise, and the last state;
* so does a run that was interrupted, or killed after writing checkpoints;
* settings that cannot change within a run, a run that is already over, and another scene: status 2, and no file changes.
"""

import os
import re
from pathlib import Path

import numpy as np
import pytest

from taisoft.checkpoint import read_checkpoint
from tests.cli.command import BEAM, LED, SHORT_OUTPUT, child, report, run, write

SPRING = '    scene.add_spring(("beam", 0), ("beam", 3), 10.0)\n    return scene\n'
LED_BY_SPRING = LED.replace("    return scene\n", SPRING)
GENTLE = LED_BY_SPRING.replace("{body}", "return (0, -t, 0)")
ALL = ("--vtu", "--seconds", "0.2", "--details", "bodies")


def usd(folder: Path) -> str:
    """scene.usdc as text."""
    from pxr import Sdf

    return Sdf.Layer.OpenAsAnonymous(str(folder / "scene.usdc")).ExportToString()


def assert_same_folders(a: Path, b: Path, rows: int = 0) -> None:
    """Compare the results of two runs, except for reports; of steps.csv only rows from `rows` on."""
    names = [sorted(str(path.relative_to(folder)) for path in folder.rglob("*")) for folder in (a, b)]
    assert names[0] == names[1] and {"frames/00006.png", "vtu/00006.vtu", "frames.csv"} <= set(names[0])
    assert not {"chunks", "scene.usdc.part"} & set(names[0])
    for name in names[0]:
        if name.startswith(("frames", "vtu/", "states/", "scene.pvd")) and (a / name).is_file():
            assert (a / name).read_bytes() == (b / name).read_bytes(), name
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
    assert run(write(folder / "scene.py", GENTLE), "--out", folder / "out", *ALL) == 0
    return folder / "out"


@pytest.fixture(scope="module")
def begun(tmp_path_factory) -> tuple[Path, Path]:
    """A scene file, and the folder of its run of 0.1 s at 60 frames per second without pictures and USD."""
    folder = tmp_path_factory.mktemp("begun")
    path = write(folder / "scene.py", GENTLE)
    assert run(path, "--out", folder / "out", "--fps", "60", *SHORT_OUTPUT) == 0
    return path, folder / "out"


def test_two_parts_equal_one_run(single, tmp_path, capsys):
    path, out = write(tmp_path / "scene.py", GENTLE), tmp_path / "out"
    assert run(path, "--out", out, "--vtu", "--details", "bodies") == 0
    assert run(path, "--out", out, "--resume", out / "checkpoint.npz", *ALL) == 0
    assert_same_folders(single, out)
    record = report(out)
    assert record["resumed"] == {"checkpoint": str(out / "checkpoint.npz"), "time": pytest.approx(0.1), "frame": 3}
    assert record["sim_seconds"] == pytest.approx(0.1) and record["steps"] == 24
    assert report(single)["resumed"] is None
    shown = capsys.readouterr()
    assert f"resumed  from {out / 'checkpoint.npz'}, t = 0.1 s" in shown.out and "taisoft draw" not in shown.err
    other = ("--seconds", "0.24", "--size", "32x18", "--no-usd")
    assert run(path, "--out", out, "--resume", out / "checkpoint.npz", *other) == 0
    rule = f"pictures differ in size or look from those before frame 6: `taisoft draw {out}` draws all of them alike"
    assert rule in capsys.readouterr().err


def test_two_parts_draw_the_pictures_of_one_run(tmp_path):
    """The scales of colours and impulses depend on earlier pictures: the beam lands before the first part ends."""
    ground = "    scene.add_obstacle(ts.HalfSpace((0, -1.05, 0), (0, 1, 0)))\n"
    text = BEAM.replace("symplectic_euler", "implicit_euler").replace("1 / 240", "1 / 60")
    path = write(tmp_path / "scene.py", text.replace("    body.fix(lambda X: X[:, 0] < -1.99)\n", ground))
    out, single, arguments = tmp_path / "out", tmp_path / "single", ("--no-usd", "--layers", "contacts", "--colour", "speed")
    assert run(path, "--out", out, "--seconds", "0.2", *arguments) == 0
    assert run(path, "--out", out, "--resume", out / "checkpoint.npz", "--seconds", "0.4", *arguments) == 0
    assert run(path, "--out", single, "--seconds", "0.4", *arguments) == 0
    pictures = [{path.name: path.read_bytes() for path in (folder / "frames").iterdir()} for folder in (out, single)]
    assert pictures[0] == pictures[1] and len(pictures[0]) == 13


def test_a_run_interrupted_between_frames_continues(tmp_path):
    """Implicit runs can stop after any step: step 28 of 48 lies in the middle of frame 4."""
    raising = "import signal\n    if 27.8 < 240 * t < 28.2 and not hasattr(path, 'pressed'):\n        path.pressed = True\n"
    raising += "        signal.raise_signal(2)\n    return (0, -t, 0)"
    implicit = ("--set", "solver.integrator=implicit_euler", "--seconds", "0.2", "--no-frames")
    path, out, single = tmp_path / "scene.py", tmp_path / "out", tmp_path / "single"
    write(path, LED_BY_SPRING.replace("{body}", raising))
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
    """Killed in frame 6, with checkpoints at frames 2 and 4, before a chunk of USD is full; half written files are removed."""
    dying = "import os; t > 0.17 and os._exit(9)\n    return (0, -t, 0)"
    path, out = write(tmp_path / "scene.py", LED_BY_SPRING.replace("{body}", dying)), tmp_path / "out"
    process = child("run", path, "--headless", "--out", out, "--checkpoint-every", str(2 / 30), *ALL)
    process.communicate(timeout=120)
    assert process.returncode == 9 and not (out / "scene.usdc").exists()
    assert {f"{k:05d}.png" for k in range(5)} <= {path.name for path in (out / "frames").iterdir()}, "those of the checkpoint"
    assert read_checkpoint(out / "checkpoint.npz").state["simulation"]["time"] == pytest.approx(4 / 30)
    listed = re.findall(r'file="(\S+)"', (out / "scene.pvd").read_text())
    assert listed == sorted(f"vtu/{file.name}" for file in (out / "vtu").iterdir()) and len(listed) >= 5
    (out / f"vtu/00005.vtu.{os.getpid()}-0.part").write_bytes(b"half")
    write(path, GENTLE)
    assert run(path, "--out", out, "--resume", out / "checkpoint.npz", *ALL) == 0
    assert_same_folders(single, out, rows=5)  # the killed run wrote no rows


def test_a_run_continues_in_another_folder_with_another_dt(begun, tmp_path):
    """At the frame rate of the earlier run, not that of the scene file."""
    (path, out), other = begun, tmp_path / "other"
    before = (out / "report.json").read_bytes()
    arguments = ("--resume", out / "checkpoint.npz", "--set", "solver.dt=0.002", "--seconds", "0.15", "--no-usd")
    assert run(path, "--out", other, *arguments) == 0
    assert report(other)["settings"]["dt"] == pytest.approx(1 / 540) and (out / "report.json").read_bytes() == before
    assert sorted(picture.name for picture in (other / "frames").iterdir()) == [f"{k:05d}.png" for k in range(6, 10)]


def test_settings_that_cannot_change_are_refused(begun, capsys):
    path, out = begun
    before = {file.name: file.read_bytes() for file in out.rglob("*.*")}
    capsys.readouterr()
    for arguments, message in (
        (["--precision", "f64"], "precision is f32 there and cannot become f64 in a run"),
        (["--set", "solver.integrator=bdf2"], "integrator is symplectic_euler there and cannot become bdf2"),
        (["--set", "solver.dt=0.5"], "above the estimated stability limit"),
        (["--fps", "30"], "fps is 60.0 there and cannot become 30.0 in a run"),
        (["--seconds", "0.1"], "it is already at t = 0.1 s, and the run ends at 0.1 s"),
    ):
        assert run(path, "--out", out, "--resume", out / "checkpoint.npz", "--seconds", "0.2", *arguments) == 2
        error = capsys.readouterr().err
        assert message in error and error.startswith("taisoft: ") and error.count("\n") == 1
        assert {file.name: file.read_bytes() for file in out.rglob("*.*")} == before


def test_other_scenes_and_numbers_are_refused(begun, tmp_path, capsys):
    """Other numbers would be ignored, since a resumed run keeps its own."""
    _, out = begun
    arguments = ("--out", tmp_path / "new", "--resume", out / "checkpoint.npz", "--seconds", "0.15")
    for text, message in (
        (BEAM, "is a checkpoint of another scene, which differs in body 'beam': constraints"),
        (GENTLE.replace("young=1e5", "young=2e5"), "beam.young is 200000.0 in this scene and was 100000.0 at the start"),
    ):
        capsys.readouterr()
        assert run(write(tmp_path / "other.py", text), *arguments) == 2
        assert message in capsys.readouterr().err and not (tmp_path / "new").exists()
    assert run(begun[0], *arguments, "--set", "beam.young=2e5") == 2
    assert "beam.young is 200000.0 in this scene and was 100000.0 at the start" in capsys.readouterr().err
