"""How a run ends under faults of the computer:

* a full or read-only disk, a folder that is moved away, a failing fsync, rename or write: exit status 3, a message with the
  path of each lost output, no truncated file, no success message, and no earlier report;
* a process killed while report and checkpoint are replaced leaves the old or the new ones, and the next run cleans up;
* a jumping clock, another locale, no home, no cache: refused, or without effect;
* too little memory: a message with the needed and the available memory, before the first step;
* a number that becomes NaN during a run is found in the same step, and the last good checkpoint stays.
"""

import json
import os
import re
import resource
import shutil
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest
from pxr import Sdf, Usd

import taisoft as ts
from taisoft import simulator
from taisoft.checkpoint import read_checkpoint
from taisoft.output.folder import OutputFolder
from tests.backend.lanes import opened
from tests.cli.command import BEAM, LED, ROOT, report, run, write
from tests.output.png import decode


def python(code: str, *arguments, **environment) -> subprocess.CompletedProcess:
    """Run code in a child process; None removes a variable from its environment."""
    given = os.environ | {"PYTHONPATH": str(ROOT)} | environment
    given = {name: value for name, value in given.items() if value is not None}
    command = [sys.executable, "-c", code, *map(str, arguments)]
    return subprocess.run(command, env=given, capture_output=True, text=True, timeout=300, check=False)


def error_lines(stderr: str) -> list[str]:
    """The lines of stderr, except for the note on compiling."""
    return [line for line in stderr.splitlines() if not re.match(r"taisoft: (compiling|\d+ kernels so far)", line)]


@pytest.fixture(scope="module")
def shim(tmp_path_factory) -> Path:
    """The library of failing calls."""
    compiler = shutil.which("cc") or shutil.which("gcc")
    if compiler is None or not sys.platform.startswith("linux"):
        pytest.skip("there is no C compiler, or nothing can be preloaded here")
    path = tmp_path_factory.mktemp("shim") / "failing_calls.so"
    if re.search(r"[\s:]", str(path)):
        pytest.skip("the loader preloads nothing from a folder with a blank or a colon in its name")
    subprocess.run([compiler, "-shared", "-fPIC", "-o", path, ROOT / "tests" / "faults" / "failing_calls.c", "-ldl"], check=True)
    return path


# All runs in one process, so that kernels are compiled once: [scene file, failing call, part of the path where it fails], ...
FAILING = """
import contextlib, io, json, os, sys
from taisoft.backend import runtime
from taisoft.cli import main
shown = []
for k, (scene, call, name) in enumerate(json.loads(sys.argv[2])):
    out, err, folder = io.StringIO(), io.StringIO(), f"{sys.argv[1]}/{k}"
    os.environ |= {"FAIL_CALL": call, "FAIL_NAME": name, "LATER": f"{folder}/"}
    with contextlib.redirect_stdout(out), contextlib.redirect_stderr(err):
        status = main(["run", scene, "--headless", "--out", folder, "--overwrite", "--checkpoint-every", "0.03"])
    os.environ["FAIL_NAME"] = ""
    runtime.forget()  # Taichi starts again, and finds its kernels in the cache
    shown.append((status, out.getvalue(), err.getvalue()))
print(json.dumps(shown))
"""
CALLS = [("fsync", "report.json"), ("write", "00001.png|checkpoint.npz"), ("rename", "steps.csv"), ("change", "")]
READ_ONLY = LED.replace("{body}", 't > 0.05 and os.environ.update(FAIL_NAME=os.environ["LATER"])\n    return (0, 0, 0)')


def test_failing_calls(beam, tmp_path, shim):
    """The last disk becomes read-only during the run, as when the system remounts it after an error."""
    path = write(tmp_path / "led.py", READ_ONLY.replace("import taisoft", "import os\n\nimport taisoft"))
    for k in range(len(CALLS)):
        (tmp_path / str(k)).mkdir()
        (tmp_path / str(k) / "report.json").write_text("old")
    calls = json.dumps([(str(beam if name else path), call, name) for call, name in CALLS])
    done = python(FAILING, tmp_path, calls, LD_PRELOAD=str(shim))
    assert done.returncode == 0, done.stderr
    *runs, last = json.loads(done.stdout.splitlines()[-1])
    for k, ((call, name), (status, out, err)) in enumerate(zip(CALLS, runs)):
        folder = tmp_path / str(k)
        reason = "No space left on device" if call == "write" else "Input/output error"
        assert status == 3, (call, name, out, err)
        failed, lines = name.split("|"), error_lines(err)
        assert len(lines) == len(failed), err
        for file, line in zip(failed, lines):
            assert re.match(rf"taisoft: cannot write {re.escape(str(folder))}/\S*{file}\S*.*: {reason}", line), err
            assert not list(folder.rglob(file))
        assert not list(folder.rglob("*.part")) and not list(folder.glob("*.lock"))
        assert "status   degraded" in out and not re.search(r"\bok\b", out)
        if name in ("report.json", "steps.csv"):
            assert not (folder / "report.json").exists()  # not even the earlier one
        else:
            assert report(folder)["status"] == "degraded"
        if "checkpoint.npz" not in failed:  # the state is saved, so that the run can continue elsewhere
            read_checkpoint(folder / "checkpoint.npz")
    out, (status, shown, err) = tmp_path / str(len(runs)), last
    assert status == 3 and "status   degraded" in shown, shown + err
    start, usd = f"taisoft: cannot write {out}/", r"\(\d+ bytes of new frames\): Unable to open .+ for write"  # gives no reason
    lines = error_lines(err)
    assert all(line.startswith(start) and re.search(rf"(: Read-only file system| {usd})$", line) for line in lines), lines
    lost = [re.match(r"(?:\w+/)?([\w.]+)", line.removeprefix(start))[1] for line in lines]
    # the thread that writes pictures may meet the disk before or after the state's
    assert sorted({*lost} - {"00002.png"}) == ["00002.npz", "checkpoint.npz", "points_00002.usdc", "steps.csv"]
    assert [path.name for path in sorted((out / "frames").iterdir())] == ["00000.png", "00001.png"]
    assert read_checkpoint(out / "checkpoint.npz").state["simulation"]["time"] == pytest.approx(1 / 30)
    for picture in (out / "frames").glob("*.png"):
        assert decode(picture.read_bytes()).ndim == 3
    for path in (out / "chunks").glob("*.usdc"):
        stage = Usd.Stage.Open(str(path))
        points = stage.GetAttributeAtPath("/World/beam/tets.points")
        assert points.GetTimeSamples()
        assert all(np.isfinite(np.array(points.Get(moment))).all() for moment in points.GetTimeSamples())


def test_full_disk(beam, tmp_path, capsys):
    """A limit on file sizes: earlier files are complete."""
    disk, limits = tmp_path / "disk", resource.getrlimit(resource.RLIMIT_FSIZE)
    disk.mkdir()
    with opened("f32"):  # else Taichi would start, and write the kernels of another precision, within the limit
        try:
            resource.setrlimit(resource.RLIMIT_FSIZE, (20_000, limits[1]))
            status = run(beam, "--out", disk / "out", "--seconds", "0.5")
        finally:
            resource.setrlimit(resource.RLIMIT_FSIZE, limits)
    errors, start = capsys.readouterr().err, f"cannot write {re.escape(str(disk))}/out/"
    assert status == 3 and re.search(rf"taisoft: {start}\S+ \(\d+ bytes.*: .+", errors), errors
    files = [path for path in (disk / "out").rglob("*") if path.is_file()]
    assert not [path for path in files if path.suffix == ".part" or path.stat().st_size == 0]
    lost = set(re.findall(rf"{start}(\w+\.\w+)", errors))
    if "checkpoint.npz" not in lost:
        read_checkpoint(disk / "out" / "checkpoint.npz")
    if not lost & {"report.json", "steps.csv"}:
        assert report(disk / "out")["status"] == "degraded"
    assert not any((disk / "out" / name).exists() for name in lost)


MOVED_AWAY = """out = Path(__file__).parent / "out"
    if t > 0.05 and out.is_dir():
        out.rename(out.with_name("moved"))
        out.write_text("a file")
    return (0, 0, 0)"""


def test_output_folder_moved_away(tmp_path, capsys):
    """During the run, in a way that also stops the superuser, and before it; earlier files stay complete."""
    text = LED.replace("{body}", MOVED_AWAY).replace("import taisoft", "from pathlib import Path\n\nimport taisoft")
    path, out = write(tmp_path / "scene.py", text), tmp_path / "out"
    assert run(path, "--out", out, "--checkpoint-every", "0.03") == 3
    captured = capsys.readouterr()
    assert re.search(rf"taisoft: cannot write {re.escape(str(out))}/\S+.*: Not a directory", captured.err), captured.err
    assert "status   degraded" in captured.out
    kept = sorted(str(file.relative_to(tmp_path / "moved")) for file in (tmp_path / "moved").rglob("*.png"))
    assert kept[:2] == ["frames/00000.png", "frames/00001.png"] and not (tmp_path / "moved" / "report.json").exists()
    assert run(path, "--out", out / "new") == 3
    captured = capsys.readouterr()
    assert "cannot create the folder" in captured.err and "status" not in captured.out


KILLED = """
import json, os, random, signal, sys, time
from pathlib import Path
import numpy as np
from tests.view.fake_simulator import beam_scene
from taisoft.checkpoint import read_checkpoint, write_checkpoint
from taisoft.output.report import write_report
from taisoft.records import RunReport, StepReport

folder, scene = Path(sys.argv[1]), beam_scene()

class Saved:
    time = 0.0
    def save_checkpoint(self, path, notes):
        write_checkpoint(path, {}, scene, {}, {"n": self.time, "x": np.full(20_000, self.time)}, notes)

def replace(kill, begun):
    sim = Saved()
    for k in range(1_000_000):
        sim.time = 1000.0 * kill + k
        sim.save_checkpoint(folder / "checkpoint.npz", {})
        reports = [StepReport(time=0.01 * j) for j in range(k % 50)]
        write_report(folder, RunReport(steps=k, step_reports=reports), arch="cpu", precision="f32", settings={}, plan=[])
        if k == 0:
            os.write(begun, b".")

dice, seen = random.Random(2), set()
Saved().save_checkpoint(folder / "checkpoint.npz", {})
for kill in range(1, 11):
    started, begun = os.pipe()
    child = os.fork()
    if child == 0:
        replace(kill, begun)
    os.read(started, 1)
    time.sleep(dice.uniform(0.0, 0.05))
    os.kill(child, signal.SIGKILL)
    os.waitpid(child, 0)
    state = read_checkpoint(folder / "checkpoint.npz").state
    assert (state["x"] == state["n"]).all()
    seen.add(state["n"])
    json.loads((folder / "report.json").read_text())
    rows = (folder / "steps.csv").read_text()
    assert rows.endswith("\\n") and len(set(row.count(",") for row in rows.splitlines())) == 1
assert len(seen) == 10  # each child has written
"""


def test_kills_while_files_are_replaced(tmp_path):
    done = python(KILLED, tmp_path)
    assert done.returncode == 0, done.stderr
    OutputFolder(tmp_path, overwrite=True).close()
    assert not list(tmp_path.glob("*.part"))


def german(folder: Path) -> dict[str, str]:
    """Compile a locale with decimal commas in the folder; return its environment variables, or nothing where that fails."""
    command = ["localedef", "-i", "de_DE", "-f", "UTF-8", str(folder / "de_DE.UTF-8")]
    if shutil.which(command[0]) is None or subprocess.run(command, capture_output=True, check=False).returncode:
        return {}
    return {"LOCPATH": str(folder), "LC_ALL": "de_DE.UTF-8", "LANG": "de_DE.UTF-8"}


HOSTILE = """
import locale, os, sys, tempfile, time
locale.setlocale(locale.LC_ALL, "")
moments = time.time(), time.time()
print("point", locale.localeconv()["decimal_point"], "jump", abs(moments[0] - moments[1]))
from taisoft.cli import main
"""


def test_hostile_environment(tmp_path, shim):
    """A clock that jumps by days, a locale with decimal commas, no home folder, and caches that cannot be written."""
    ts.write_mesh(tmp_path / "beam.msh", ts.box_mesh((4, 1, 1), (4.5, 1.25, 1)))
    assert "-2.25" in (tmp_path / "beam.msh").read_text()  # decimal points in text
    path = write(tmp_path / "beam.py", BEAM.replace("ts.box_mesh((4, 1, 1), (4, 2, 2))", 'ts.read_mesh(__file__[:-2] + "msh")'))
    assert run(path, "--out", tmp_path / "plain", "--no-frames") == 0
    (tmp_path / "file").write_text("no folder")
    commas = german(tmp_path)
    cache = {"HOME": None, "XDG_CACHE_HOME": str(tmp_path / "file" / "cache")}
    environment = commas | cache | {"LD_PRELOAD": str(shim), "JUMP": "100000"}
    arguments = ("run", path, "--headless", "--no-frames", "--out", tmp_path / "hostile")
    done = python(HOSTILE + "sys.exit(main(sys.argv[1:]))", *arguments, **environment)
    assert done.returncode == 0 and "status   ok" in done.stdout, done.stderr
    point, jump = re.match(r"point (.) jump (\S+)\n", done.stdout).groups()
    assert float(jump) > 1e4 and point == ("," if commas else ".")
    plain, hostile = ({f.relative_to(out): f for f in out.rglob("*.*")} for out in (tmp_path / "plain", tmp_path / "hostile"))
    assert set(plain) == set(hostile) and len(plain) == 4 + 5  # with the states of four frames
    for name in plain:
        if name.suffix == ".csv" or name.parts[0] == "states":
            assert plain[name].read_bytes() == hostile[name].read_bytes(), name
    stages = [Sdf.Layer.OpenAsAnonymous(str(files[Path("scene.usdc")])).ExportToString() for files in (plain, hostile)]
    assert stages[0] == stages[1] and "vonMisesStress" in stages[0]
    found = report(tmp_path / "hostile")
    assert 0.0 <= found["wall_seconds"] < 1e4 and 0.0 <= found["compile_seconds"] < 1e4  # the jump is longer
    no_cache = HOSTILE + "tempfile.tempdir = os.devnull; sys.exit(main(sys.argv[1:]))"
    done = python(no_cache, *arguments, "--overwrite", **environment)
    assert done.returncode == 2 and "no folder for compiled kernels is writable: set XDG_CACHE_HOME" in done.stderr
    if not commas:
        pytest.skip("passed without decimal commas: no such locale can be compiled here")


LIMITED_MEMORY = """
import resource, sys
import taisoft.cli.run
from pathlib import Path
used = int(Path("/proc/self/statm").read_text().split()[0]) * resource.getpagesize()
resource.setrlimit(resource.RLIMIT_AS, (used + int(sys.argv[1]),) * 2)
sys.exit(taisoft.cli.main(["run", sys.argv[2], "--headless", "--out", sys.argv[3]]))
"""
LARGE_BUFFERS = """    scene.add_obstacle(ts.HalfSpace((0, -2, 0), (0, 1, 0)))
    scene.collision = ts.CollisionSettings(initial_capacity=100_000_000)
    return scene
"""


@pytest.mark.skipif(not sys.platform.startswith("linux"), reason="memory in use is read from /proc")
def test_too_little_memory(tmp_path):
    path = write(tmp_path / "scene.py", BEAM.replace("    return scene\n", LARGE_BUFFERS))
    done = python(LIMITED_MEMORY, 4 * 10**9, path, tmp_path / "out")
    assert done.returncode == 2, done.stdout + done.stderr
    needed = r"taisoft: .+/scene\.py: not enough memory for the array '.*: (\d+) bytes .* are needed.*, available: (\d+) bytes"
    found = re.match(needed, done.stderr)
    assert found and int(found[1]) > int(found[2]) and done.stderr.count("\n") == 1, done.stderr
    assert not (tmp_path / "out").exists()


def test_nan_during_a_run(tmp_path, monkeypatch):
    """A velocity becomes NaN after step 2; step 3 finds it, before contact detection does."""
    scene = ts.Scene()
    scene.add_body(ts.box_mesh((2, 1, 1), (2, 1, 1)), ts.Material(young=1e5), name="part")
    scene.add_obstacle(ts.HalfSpace((0, -0.55, 0), (0, 1, 0)))
    path, shown = tmp_path / "checkpoint.npz", []

    class FaultyDynamics(simulator.Dynamics):
        def advance(self, n):
            if self.state.step_count == 2:
                x, v = self.state.state()
                v[5] = np.nan
                self.state.set_state(x, v)
            return super().advance(n)

    def observe(sim, index, report):
        sim.save_checkpoint(path)
        shown.append(sim.positions())

    monkeypatch.setattr(simulator, "Dynamics", FaultyDynamics)
    with ts.Simulator(scene, 0.001, "symplectic_euler") as sim:
        result = sim.run(0.01, observe, fps=None)
        assert result.status == "failed" and result.steps == 2 and len(shown) == 3
        assert re.search(r"^step 3: body 'part', node 5: position, velocity or force is no longer finite", result.problems[-1])
        assert np.array_equal(sim.positions(), shown[-1])
        with pytest.raises(ts.SimulationError, match="written of a state that is not finite: body 'part', node 5"):
            sim.save_checkpoint(path)
    simulation = read_checkpoint(path).state["simulation"]
    assert simulation["step_count"] == 2 and np.array_equal(simulation["x"], shown[-1]) and np.isfinite(simulation["v"]).all()
