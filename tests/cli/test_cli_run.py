"""`taisoft run`, from its first step on:

* runs: exit status 0, and a report with every resolved setting; 1 if the run failed;
* output that cannot be written: exit status 3, and the results are still reported;
* signals: the first one saves and exits with 130 or 143; one before the run, or a second one, exits immediately;
* README: its scene runs from the command line and from Python;
* without a display there is no window.
"""

import csv
import re
import signal

import numpy as np
import pytest

from taisoft.checkpoint import read_checkpoint
from taisoft.cli import main, recording
from taisoft.errors import OutputError
from taisoft.view import pictures
from tests.cli.command import BEAM, LED, ROOT, SHORT_OUTPUT, child, report, run, write


def test_a_run_writes_and_prints_its_results(beam, tmp_path, capsys):
    out = tmp_path / "out"
    numbers = ("--set", "beam.young=9e4", "--set", "gravity=[0, -9, 0]")
    assert run(beam, "--out", out, "--set", "solver.dt=0.004", *numbers) == 0
    record = report(out)
    assert record["status"] == "ok" and record["sim_seconds"] == pytest.approx(0.1)
    lowered = "dt lowered from 0.004 s to 0.0037037 s"
    assert [problem for problem in record["problems"] if problem.startswith(f"note: {lowered}, so that 9 steps make a frame")]
    assert record["dt_requested"] == 0.004 and record["dt"] == pytest.approx(1 / 270)
    expected = {"integrator": "symplectic_euler", "fps": 30, "seconds": 0.1, "allow_unstable": False}
    expected |= {"set": {"beam.young": 9e4, "gravity": [0, -9, 0]}}
    assert expected.items() <= record["settings"].items()
    assert record["settings"]["dt"] == pytest.approx(1 / 270) and record["plan"]  # the dt in use, not the requested one
    assert sorted(path.name for path in (out / "frames").iterdir()) == [f"{i:05d}.png" for i in range(4)]
    assert len((out / "steps.csv").read_text().splitlines()) == 4 and (out / "scene.usdc").stat().st_size > 0
    shown = capsys.readouterr().out
    assert shown.count("dt lowered") == 1
    for word in ("fixed_nodes", f"\n\nstatus   ok; {lowered}\n", "min J", "kinetic", "report.json", "(4 pictures"):
        assert word in shown
    assert len(shown.splitlines()) < 40  # one screen
    before = (out / "report.json").read_bytes()
    assert run(beam, "--out", out) == 3
    assert "already holds results" in capsys.readouterr().err
    assert (out / "report.json").read_bytes() == before
    assert run(beam, "--out", out, "--overwrite", *SHORT_OUTPUT) == 0
    assert (out / "report.json").read_bytes() != before
    assert not (out / "scene.usdc").exists()  # it was of the earlier run


def test_without_out_nothing_is_written(tmp_path, monkeypatch, capsys):
    """The scene imports its neighbour, and the plan is short unless verbose."""
    write(tmp_path / "beam_parts_of_this_test.py", BEAM)
    path = write(tmp_path / "scene.py", "from beam_parts_of_this_test import build, solver\n")
    (tmp_path / "empty").mkdir()
    monkeypatch.chdir(tmp_path / "empty")
    assert run(path, "--seconds", "0.01") == 0
    short = capsys.readouterr().out
    assert "\nleft out" not in short and "plan     law:stable_neo_hookean, " in short and "used by" not in short
    assert run(path, "--seconds", "0.01", "--verbose") == 0
    assert re.search(r"law:stable_neo_hookean +used by beam\n", full := capsys.readouterr().out) and "\nleft out law:" in full
    assert not list((tmp_path / "empty").iterdir())


def test_a_failed_run_is_reported_and_keeps_its_last_good_state(tmp_path, capsys):
    path = write(tmp_path / "led.py", LED.replace("{body}", "return (0, -t, 0) if t < 0.05 else (0, float('nan'), 0)"))
    out = tmp_path / "out"
    assert run(path, "--out", out, *SHORT_OUTPUT) == 1
    record = report(out)
    assert record["status"] == "failed" and 0.0 < record["sim_seconds"] < 0.1
    assert record["problems"] and record["problems"][0] in capsys.readouterr().out.replace("\n         ", " ")
    simulation = read_checkpoint(out / "checkpoint.npz").state["simulation"]
    assert 0.0 < simulation["time"] < 0.05 and np.isfinite(simulation["x"]).all()


def test_notes_and_warnings_are_printed_and_reported(tmp_path, capsys):
    """Warnings once as they come; in the summary problems first, of which an ok run has none."""
    path, out = (
        write(tmp_path / "stiff.py", BEAM.replace("young=1e5)", 'young=1e5, poisson=0.495), dilatation="local"')),
        tmp_path / "out",
    )
    short = ("--set", "solver.dt=0.004", "--set", "solver.fps=none", "--seconds", "0.001")
    assert run(path, "--out", out, *SHORT_OUTPUT, *short) == 0
    shown, error = capsys.readouterr()
    assert error.count("taisoft: warning: body 'beam': poisson = 0.495") == 1
    assert report(out)["problems"][0].startswith("warning: body 'beam': poisson = 0.495")
    assert "\nwarning  body 'beam': poisson = 0.495" in shown and "\nnote     0.001 s are less than half a step" in shown
    assert "problem" not in shown and shown.index("\nwarning") < shown.index("\nnote")


def test_a_run_with_companions_says_what_they_cost(beam, tmp_path, capsys):
    """It also prints and writes quantities with their errors."""
    out, heading = tmp_path / "out", "quantity the tip [m]"
    tip = ("--quantity", "the tip=displacement.y beam 2 0 0", "--details", "quantities")
    assert run(beam, "--seconds", "0.05", "--error-mesh", "refined", *tip, "--out", out, *SHORT_OUTPUT) == 0
    shown, found = capsys.readouterr().out, report(out)["quantities"]["the tip"]
    assert re.search(r"\nquantity the tip = -0.01\d+ m, errors: time .*, space .*, solver 0\n", shown)
    assert -0.02 < found["value"] < -0.01 and 0.0 < found["space"] < 0.01 and found["solver"] == 0.0
    *_, last = csv.DictReader((out / "steps.csv").read_text().splitlines())
    assert float(last[heading]) == found["value"]
    assert "\nerror    companions follow the run, the one on the refined mesh for some 10 to 40 times its work" in shown
    assert re.search(r"; plus \d+\.\d\d s of companions for the error and ", shown)


def test_a_picture_that_cannot_be_written_ends_the_run(beam, tmp_path, monkeypatch, capsys):
    class FullDisk(pictures.FrameWriter):
        def frame(self, sim, index):
            if index == 2:
                raise OutputError("cannot write frames/00002.png (9 bytes): No space left on device")
            super().frame(sim, index)

    monkeypatch.setattr(pictures, "FrameWriter", FullDisk)
    out = tmp_path / "out"
    assert run(beam, "--out", out) == 3
    assert "taisoft: cannot write frames/00002.png" in capsys.readouterr().err
    record = report(out)
    assert record["status"] == "degraded" and not record["interrupted"]
    assert record["sim_seconds"] == pytest.approx(2 / 30)
    assert any("frames/00002.png" in problem for problem in record["problems"])
    assert (out / "scene.usdc").exists() and len(list((out / "frames").iterdir())) == 2


def refuse(file: str):
    """A function that raises because the disk is full."""

    def raise_error(*_, **__):
        raise OutputError(f"cannot write {file}: No space left on device")

    return raise_error


def test_a_report_or_a_video_that_cannot_be_written(beam, tmp_path, monkeypatch, capsys):
    """An earlier report is removed; the report of a run, written before its video, is updated."""
    out = tmp_path / "out"
    assert run(beam, "--out", out, *SHORT_OUTPUT) == 0 and report(out)["status"] == "ok"
    capsys.readouterr()
    with monkeypatch.context() as full:
        full.setattr(recording, "write_report", refuse("report.json"))
        assert run(beam, "--out", out, "--overwrite", *SHORT_OUTPUT) == 3
        assert_degraded(capsys.readouterr(), "cannot write report.json")
        assert not (out / "report.json").exists() and not (out / "steps.csv").exists()
    monkeypatch.setattr(recording, "write_video", refuse("video.mp4"))
    monkeypatch.setattr(recording, "find_ffmpeg", lambda: "ffmpeg")
    assert run(beam, "--out", out, "--overwrite", "--video", "--no-usd", "--seconds", "0.03") == 3
    assert_degraded(capsys.readouterr(), "cannot write video.mp4")
    assert report(out)["status"] == "degraded" and "cannot write video.mp4" in report(out)["problems"][-1]


def assert_degraded(captured, *errors):
    """Check for a degraded status in the summary, and a line on stderr for each output that failed."""
    assert "status   degraded" in captured.out and not re.search(r"\bok\b", captured.out)
    lines = captured.err.splitlines()
    assert len(lines) == len(errors) and all(line.startswith(f"taisoft: {error}") for line, error in zip(lines, errors)), lines


def test_without_display_there_is_no_window(tmp_path, monkeypatch, capsys):
    """And a layer of fixed nodes says why it shows nothing."""
    path = write(tmp_path / "led.py", LED.replace("{body}", "return 0, 0, 0").replace("body.fix(lambda X: X[:, 0] < -1.99)", ""))
    monkeypatch.delenv("DISPLAY", raising=False)
    monkeypatch.delenv("WAYLAND_DISPLAY", raising=False)
    show = ("--seconds", "0.01", "--layers", "fixed_nodes", "--no-usd", "--out", str(tmp_path / "led"))
    assert main(["run", str(path), *show]) == 0
    captured = capsys.readouterr()
    assert "taisoft: running without a window: there is no display" in captured.err and "status   ok" in captured.out
    assert "--layers fixed_nodes: no node is fixed; nodes that follow a path have no balls" in captured.err


def test_the_example_of_the_readme_runs(tmp_path, capsys):
    scene, script = re.findall(r"```python\n(.*?)```", (ROOT / "README.md").read_text(), re.DOTALL)
    path = write(tmp_path / "script.py", scene + script.replace("seconds=2.0", "seconds=0.1"))
    exec(compile(path.read_text(), path, "exec"), {"__name__": "__main__"})
    assert re.search(r"^ok \[-2\. ", capsys.readouterr().out, re.MULTILINE)
    assert run(write(tmp_path / "my_scene.py", scene), "--seconds", "0.1") == 0


@pytest.mark.parametrize("number", [signal.SIGINT, signal.SIGTERM])
def test_first_signal_saves_the_results(tmp_path, number, capfd):
    raising = f"import signal; signal.raise_signal({int(number)}) if 0.05 < t < 0.0542 else None\n    return (0, 0, 0)"
    path = write(tmp_path / "led.py", LED.replace("{body}", raising))
    before = signal.getsignal(number)
    assert run(path, "--out", tmp_path / "out", "--no-frames") == 128 + number
    assert signal.getsignal(number) is before
    record = report(tmp_path / "out")
    assert record["interrupted"] and record["status"] == "degraded" and 0.0 < record["sim_seconds"] < 0.1
    assert (tmp_path / "out" / "scene.usdc").exists()
    captured = capfd.readouterr()
    assert "ended early by a signal" in captured.out and "a second signal exits immediately" in captured.err


def test_signal_before_the_run_writes_nothing(tmp_path, capsys):
    text = BEAM.replace("    scene = ts.Scene()", "    import signal; signal.raise_signal(15)\n    scene = ts.Scene()")
    assert run(write(tmp_path / "scene.py", text), "--out", tmp_path / "out") == 143
    assert "nothing was written" in capsys.readouterr().err
    assert not (tmp_path / "out").exists()


def test_second_signal_exits_immediately(tmp_path):
    """The scene hangs inside a step after the first signal, so that only the second one can end the process."""
    hanging = "import signal, time; t > 0.05 and (signal.raise_signal(2), time.sleep(60))\n    return (0, 0, 0)"
    path = write(tmp_path / "led.py", LED.replace("{body}", hanging))
    process = child("run", path, "--headless", "--out", tmp_path / "out", *SHORT_OUTPUT)
    try:
        for line in process.stderr:
            if "a second signal exits immediately" in line:
                break
        process.send_signal(signal.SIGTERM)
        process.communicate(timeout=50)  # of the 60 s that it would hang
    finally:
        process.kill()
    assert process.returncode == 143
    assert not (tmp_path / "out" / "report.json").exists()
