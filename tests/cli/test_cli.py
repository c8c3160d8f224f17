"""The command line, except for runs (see test_cli_run.py):

* bad input: exit status 2, one sentence that names the cause, no traceback, no output file;
* settings: options override --set, --set overrides the scene's solver dict, and contradictions are refused;
* the summary describes an error in a sentence;
* list, info, doctor and bench list what is available, without importing Taichi.
"""

import os
import subprocess
import sys
import tomllib
import webbrowser
from argparse import Namespace

import pytest

import taisoft as ts
from taisoft.cli import main, parse_scalar, scene_file
from taisoft.cli.run import resolve
from taisoft.cli.summary import describe_error
from taisoft.display import percent
from taisoft.errors import SceneError
from taisoft.records import ErrorEstimate
from tests.cli.command import BEAM, ROOT, child, run, write

BAD_SCENES = [
    ("def build(:\n    pass\n", "line 1: SyntaxError"),
    ("import taisoft as ts\n", "no function build()"),
    ("def build():\n    return 3\n", "build() returned int, a Scene is needed"),
    ("def build():\n    a = 1\n    return a / 0\n", "line 3: ZeroDivisionError: division by zero"),
    ("import not_there_at_all\n", "line 1: ModuleNotFoundError"),
    ("raise SystemExit(0)\n", "line 1: SystemExit: 0"),
    (BEAM.replace("young=1e5", "young=-1"), "line 9: material: young must be greater than 0"),
    (BEAM.replace("solver = {", "solver = 3, {"), "solver must be a dict"),
    (BEAM.replace('"dt"', '"dtt"'), "'dtt' (did you mean dt?)"),
    (BEAM.replace("1 / 240", "0.5"), "above the estimated stability limit"),
    (BEAM.replace("0.1", "-0.1"), "seconds must be greater than 0, not -0.1"),
]
BAD_SETTINGS = [
    (["--set", "solver.newton_tolerence=1e-3"], "did you mean newton_tolerance?"),
    (["--set", "solver.contact_solver=augmented_lagrangian"], "does not fit symplectic_euler: use 'auto' or "),
    (["--set", "young=3"], "the scene has no number 'young' (did you mean beam.young?)"),
    (["--set", "beam.young"], "write NAME.NUMBER=VALUE, such as beam.young=2e5, or solver.KEY=VALUE"),
    (["--details", "pair"], "did you mean 'pairs'?"),
    (["--details", "pairs"], "--details pairs: contact forces are not modelled (one body"),
    (["--details", "quantities"], "--details quantities: the run has none"),
    (["--quantity", "reaction beam"], "--quantity reaction beam: write NAME=TEXT"),
    (["--quantity", "q=reaction bean"], "quantity 'q': scene: no body is called 'bean' (did you mean beam?)"),
    (["--set", "gravity=3,1"], "scene: gravity must have shape (3,), not (2,)"),
    (["--set", "solver.dt=1 ms"], "'1 ms' is not a number"),
    (["--seconds", "nan"], "seconds must be finite, not nan"),
    (["--fps", "-30"], "fps must be greater than 0, not -30.0"),
    (["--resume", "c.npz"], "c.npz: no such checkpoint"),
    (["--checkpoint-every", "0"], "--checkpoint-every must be greater than 0 s, not 0"),
    (["--precision", "f64", "--set", "solver.precision=f32"], "disagree"),
]


def test_bad_scene_files_and_settings_are_refused(tmp_path, capsys):
    for text, arguments, message in [(text, [], rule) for text, rule in BAD_SCENES] + [(BEAM, *row) for row in BAD_SETTINGS]:
        assert run(write(tmp_path / "scene.py", text), "--out", tmp_path / "out", *arguments) == 2
        error = capsys.readouterr().err
        assert message in error and error.startswith("taisoft: ") and error.count("\n") == 1
        assert not (tmp_path / "out").exists()
    path = tmp_path / "scene.py"
    for option, *value in (["--vtu"], ["--video"], ["--checkpoint-every", "0.1"], ["--details", "bodies"]):
        assert run(path, option, *value) == 2
        assert f"{option} needs --out" in capsys.readouterr().err


def test_unknown_scenes_and_bad_usage_are_refused(capsys):
    for name, message in (
        ("not_there.toml", "not_there.toml: no such file"),
        ("no_such_demo", "neither a demo nor a .toml or .py file"),
        ("hanging_bem", "did you mean hanging_beam?"),
    ):
        assert run(name) == 2
        assert message in capsys.readouterr().err
    with pytest.raises(SystemExit) as caught:
        main(["run", "a.py", "--arch", "tpu"])
    assert caught.value.code == 2 and "usage: taisoft" in capsys.readouterr().err


def test_scalars_keep_their_type():
    given = [("0.01", 0.01), ("1", 1), ("true", True), ("bdf2", "bdf2"), ('"bdf2"', "bdf2"), ("none", None), ("1e-3", 1e-3)]
    for text, value in given:
        parsed = parse_scalar(text, "solver.x=" + text)
        assert parsed == value and type(parsed) is type(value)
    for text in ("", "[1]", "{a = 1}", "1\nb = 2", "2020-01-01", "a-b"):
        with pytest.raises(SceneError):
            parse_scalar(text, "solver.x=" + text)


def test_options_override_set_and_set_overrides_the_scene():
    given = {"arch": None, "precision": "f64", "tolerance": None, "seconds": 2.0, "fps": None}
    arguments = Namespace(**given, assignments=["solver.dt=0.5", "solver.fps=none"], quantity=["a = reaction b"])
    own = {"a": "reaction c", "b": "reaction d"}
    resolved = resolve({"dt": 0.1, "precision": "f32", "seconds": 1.0, "fps": 30, "quantities": own}, arguments, ts.Simulator)
    assert resolved.simulator == {"dt": 0.5, "precision": "f64"}
    expected = {"dt": 0.5, "arch": "cpu", "precision": "f64", "newton_tolerance": None, "seconds": 2.0, "fps": None}
    assert expected.items() <= resolved.as_dict().items() and (resolved.seconds, resolved.fps) == (2.0, None)
    assert resolved.quantities == {"a": "reaction b", "b": "reaction d"}


@pytest.mark.parametrize("kind", ["wheel", "checkout"])
def test_list_shows_first_lines_and_runs_nothing(tmp_path, monkeypatch, capsys, kind):
    package = tmp_path / "taisoft"
    folder = (package if kind == "wheel" else tmp_path) / "demos"
    folder.mkdir(parents=True)
    package.mkdir(exist_ok=True)
    write(folder / "one.py", '"""The first.\n\nMore."""\nraise RuntimeError\n')
    write(folder / "two.py", "raise RuntimeError\n")
    write(folder / "_helper.py", "raise RuntimeError\n")
    monkeypatch.setattr(scene_file, "PACKAGE", package)
    assert main(["list"]) == 0
    assert capsys.readouterr().out.splitlines() == ["one  The first.", "two"]
    assert scene_file.find_scene("one") == folder / "one.py"


@pytest.mark.parametrize("kind", ["wheel", "checkout"])
def test_docs_opens_the_manual_or_tells_where_its_pages_are(tmp_path, monkeypatch, capsys, kind):
    opened, package = [], tmp_path / "taisoft"
    package.mkdir()
    monkeypatch.setattr(scene_file, "PACKAGE", package)
    monkeypatch.setattr(webbrowser, "open", opened.append)
    assert main(["docs"]) == 2
    assert "the manual was not built with this installation: `make docs` builds it" in capsys.readouterr().err
    folder = (package if kind == "wheel" else tmp_path) / "out" / "docs"
    (folder / "tutorials").mkdir(parents=True)
    index, drop = (write(folder / f"{name}.html", "") for name in ("index", "tutorials/drop"))
    for given in (["docs"], ["docs", "drop"], ["docs", "--path", "index"]):
        assert main(given) == 0
    assert capsys.readouterr().out.split() == [str(index), str(drop), str(index)] and opened == [index.as_uri(), drop.as_uri()]
    assert main(["docs", "tutorials/dorp"]) == 2 and "did you mean tutorials/drop?" in capsys.readouterr().err


@pytest.mark.filterwarnings("ignore:.*nearly flat")
def test_info_shows_counts_measures_and_problems(tmp_path, capsys):
    path = tmp_path / "part.msh"
    counts, extents = "12 vertices, 10 tets, 20 surface triangles, 1 piece", "x 2 (-1 to 1), y 1 (-0.5 to 0.5), z 1 (-0.5 to 0.5)"
    for cells, size, parts in (
        ((2, 1, 1), (2, 1, 1), (counts, extents, "volume     2\n", "metres", "mean ratio 0.8", "problems   none")),
        ((1, 1, 1), (100, 50, 50), ("probably millimetres",)),
        ((1, 1, 1), (1, 1, 1e-3), ("problems   5 tets are nearly flat or needles",)),
    ):
        ts.write_mesh(path, ts.box_mesh(cells, size))
        assert main(["info", str(path)]) == 0
        shown = capsys.readouterr().out
        assert [part for part in parts if part not in shown] == []
    path.write_bytes(b"\x00\x01random")
    assert main(["info", str(path)]) == 2
    error = capsys.readouterr().err
    assert "part.msh" in error and error.count("\n") == 1


def test_doctor_lists_what_is_installed_and_missing(monkeypatch, capsys):
    from taisoft.cli import doctor

    monkeypatch.delenv("DISPLAY", raising=False)
    monkeypatch.delenv("WAYLAND_DISPLAY", raising=False)
    declared = tomllib.loads((ROOT / "pyproject.toml").read_text())["project"]["optional-dependencies"]
    for package, extra in doctor.OPTIONAL.items():
        assert any(requirement.startswith(package) for requirement in declared[extra])
    assert set(declared) - set(doctor.OPTIONAL.values()) == {"docs", "dev"}
    monkeypatch.setattr(doctor, "OPTIONAL", {"surely-not-installed": "mesh"})
    monkeypatch.setattr(doctor, "KERNEL", "no-kernel")
    assert main(["doctor"]) == 0
    shown = capsys.readouterr().out
    for part in ("taichi 1.7.4", "arch cpu   yes", "arch cuda", "vulkan", "display    no"):
        assert part in shown
    assert "surely-not-installed missing: pip install 'taisoft[mesh]'" in shown
    assert "no-kernel missing: pip install jupyterlab nbconvert" in shown


def test_a_shell_completes_demos_and_scene_files(tmp_path, monkeypatch, capsys):
    monkeypatch.setitem(sys.modules, "argcomplete", None)
    assert main(["completion", "bash"]) == 2
    assert capsys.readouterr().err == "taisoft: completion needs argcomplete: pip install 'taisoft[completion]'\n"
    monkeypatch.undo()
    pytest.importorskip("argcomplete")
    for shell in ("bash", "zsh", "fish"):
        assert main(["completion", shell]) == 0
        assert "_ARGCOMPLETE" in capsys.readouterr().out
    monkeypatch.chdir(tmp_path)
    for name in ("hand.toml", "hand.txt"):
        write(tmp_path / name, "")
    found = scene_file.fitting_scenes("hand")
    assert {"hanging_beam", "hand.toml"} <= set(found) and "hand.txt" not in found


def test_bench_passes_its_arguments_on(tmp_path, monkeypatch, capsys):
    folder = tmp_path / "benchmarks"
    folder.mkdir()
    write(folder / "part.py", "FIVE = 5\n")
    text = '"""Counts."""\nfrom .part import FIVE\n\n\ndef main(argv):\n    print(argv)\n    return FIVE\n'
    write(folder / "counting.py", text)
    monkeypatch.setattr(scene_file, "PACKAGE", tmp_path)
    assert main(["bench", "counting", "--arch", "cpu", "x"]) == 5
    assert capsys.readouterr().out == "['--arch', 'cpu', 'x']\n"
    assert main(["bench"]) == 0
    assert capsys.readouterr().out.splitlines()[1:] == ["counting  Counts."]
    assert main(["bench", "countin"]) == 2
    assert "did you mean counting?" in capsys.readouterr().err


def test_a_closed_pipe_gives_no_traceback():
    process = child("list")
    process.stdout.close()
    error = process.stderr.read()
    assert process.wait(timeout=60) == 3
    assert "Traceback" not in error and "Exception ignored" not in error


def test_the_command_imports_no_taichi_and_needs_a_working_folder(beam, tmp_path):
    code = (
        "import os, sys, taisoft.cli.study\nfrom taisoft.cli import main\nmain(['list'])\nassert 'taichi' not in sys.modules\n"
        "os.rmdir(os.getcwd())\nsys.exit(main(sys.argv[1:]))"
    )
    (tmp_path / "gone").mkdir()
    command = [sys.executable, "-c", code, "run", beam, "--headless", "--out", tmp_path / "out"]
    environment = os.environ | {"PYTHONPATH": str(ROOT)}
    done = subprocess.run(command, cwd=tmp_path / "gone", env=environment, capture_output=True, text=True)
    assert done.returncode == 2 and not (tmp_path / "out").exists()
    assert done.stderr == "taisoft: the working folder cannot be used (No such file or directory): change to another one\n"


def test_errors_are_described():
    (sentence,) = describe_error(ErrorEstimate(time=0.02, space=0.02, solver=0.0, order=2.0))
    assert sentence == "about 4 % of the largest excursion (time 2, space 2, solver 0)"
    (sentence,) = describe_error(ErrorEstimate(time=0.04, solver=0.0, order=2.0))
    assert sentence == "about 4 % of the largest excursion on this mesh (time 4, solver 0)"
    (sentence,) = describe_error(ErrorEstimate(space=0.1, solver=0.001))
    assert sentence == "unknown in time; in percent of the largest excursion space 10, solver 0.1"
    assert [percent(value) for value in (0.0, 1e-9, 0.01234, 2.0)] == ["0", "< 0.0001", "1.2", "200"]
    parted = ErrorEstimate(time_until_then=0.03, agree_until=1.25, spread_after={"a": 0.1, "b": 0.2}, notes=["a note"])
    until, after = (
        "about 3 % in time until t = 1.25 s, then unknown",
        "afterwards the mean positions of bodies change by up to 20 %",
    )
    assert describe_error(parted) == [until, f"{after} with the step", "a note"]
