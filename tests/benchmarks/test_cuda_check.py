"""The GPU check, on a machine without one:

* parts that fail, hang or find nothing leave the results of the others, and the next part starts;
* the time limits hold, and the page names the parts that were not run;
* every table shows the results of its part, failures included; test results are parsed from pytest's output;
* the script continues if a wheel cannot be installed, and passes on arguments and exit status.
"""

import json
import os
import subprocess
import sys
import time

import pytest

from benchmarks import cuda_check
from benchmarks.cuda_check import TABLES, Outcome, Part, check, main, make_parts, parse_test, part_text
from benchmarks.cuda_parts import JOBS, run_job
from benchmarks.runner import RESULT
from tests.cli.command import ROOT

SCRIPT = ROOT / "benchmarks" / "cuda_check.sh"
RERUN = {"scene": "beam", "integrator": "bdf2", "reruns": 3, "spread": 1.5e-6}
FOUND = {
    "tests": [{"test": "test_operator[cuda-f32]", "result": "passed"}, {"test": "test_steps[cuda-bdf2]", "result": "failed"}],
    "works": [
        {
            "work": "W1",
            "tets": 540,
            "setting": "bdf2, 10 ms",
            "arch": "cuda",
            "seconds": 0.5,
            "build_seconds": 2.0,
            "error": 0.011,
            "stands": True,
            "inverted": 0,
            "unconverged": 0,
        },
        {"work": "W3", "tets": 3240, "setting": "bdf2, 10 ms", "arch": "cuda", "failure": "it diverged"},
    ],
    "sweeps": [
        {
            "contacts": 34,
            "colours": 7,
            "serial_ms": 2.0,
            "coloured_ms": 1.0,
            "serial_sweeps": 9,
            "coloured_sweeps": 9,
            "serial_residual": 5e-5,
            "coloured_residual": 5e-5,
        }
    ],
    "sizes": [
        {
            "tets": 1_000_000,
            "integrator": "bdf2",
            "step_ms": 20.0,
            "steps": 3,
            "linear": 60,
            "newton": 6,
            "unconverged": 0,
            "inverted": 0,
            "build_seconds": 30.0,
            "compile_seconds": 4.0,
            "field_bytes": 2**30,
        },
        {"tets": 4_000_000, "integrator": "bdf2", "failure": "not enough memory"},
    ],
    "reruns": [RERUN],
}


def fake(name: str, code: str, seconds: float = 20.0) -> Part:
    """A part that runs a line of Python."""
    return Part(name, f"Part {name}", (sys.executable, "-c", f"import time\n{code}"), seconds)


def test_failing_parts_leave_the_results_of_others(tmp_path):
    found = f"print({(RESULT + json.dumps(RERUN))!r}, flush=True)"
    parts = [
        fake("reruns", f"{found}\nraise ValueError('the kernel broke')"),
        fake("sizes", "time.sleep(600)", 2.0),
        fake("works", "import os; os.kill(os.getpid(), 11)"),
        fake("reruns", found),
    ]
    start = time.monotonic()
    outcomes = check(parts, 62.0, tmp_path, "cpu")
    assert time.monotonic() - start < 60.0  # the sleeper was ended
    assert [outcome.ended for outcome in outcomes] == ["failed", "out of time", "failed", "ok"]
    assert outcomes[0].found == outcomes[3].found == [RERUN] and "the kernel broke" in outcomes[0].tail
    page, numbers = (tmp_path / "cuda-check.md").read_text(), json.loads((tmp_path / "cuda-check.json").read_text())
    assert page.count("1.5e-06") == 2 and page.count("It found nothing.") == 2
    assert "the kernel broke" in page and "status -11" in page
    assert [part["ended"] for part in numbers["parts"]] == [outcome.ended for outcome in outcomes]


def test_parts_without_time_left_are_reported(tmp_path):
    outcomes = check([fake("sizes", "time.sleep(600)", 1.5), fake("reruns", "pass", 0.0)], 1.6, tmp_path, "cpu")
    assert [outcome.ended for outcome in outcomes] == ["out of time"] * 2
    assert "no time was left to start it" in (tmp_path / "cuda-check.md").read_text()


def test_the_page_is_written_after_every_part(tmp_path, monkeypatch):
    pages = []
    plain = cuda_check.write_page

    def write_page(*arguments):
        plain(*arguments)
        pages.append((tmp_path / "cuda-check.md").read_text())

    monkeypatch.setattr(cuda_check, "write_page", write_page)
    check([fake("reruns", "pass"), fake("sizes", "pass")], 60.0, tmp_path, "cpu")
    assert "Not yet run: sizes." in pages[0] and "Not yet run" not in pages[1]


def test_time_limits_are_within_the_budget():
    assert sum(part.seconds for part in make_parts("cuda", False)) <= cuda_check.BUDGET < 480.0


@pytest.mark.parametrize("name", TABLES)
def test_tables(name):
    text = part_text(Outcome(Part(name, "Title", (), 0.0), "ok", 3.2, FOUND[name]))
    shown = {"tests": "failed", "works": "it diverged", "sweeps": "34", "sizes": "not enough memory", "reruns": "1.5e-06"}
    assert shown[name] in text and "Ended: ok, 3 s." in text


def test_lines_of_pytest_are_parsed():
    line = "tests/backend/test_arch.py::test_operator[cuda-f32] PASSED                  [ 10%]"
    assert parse_test(line) == {"test": "test_operator[cuda-f32]", "result": "passed"}
    line = "[gw3] [ 40%] PASSED tests/backend/test_arch.py::test_steps_with_contacts[cuda-bdf2 auto] "
    assert parse_test(line) == {"test": "test_steps_with_contacts[cuda-bdf2 auto]", "result": "passed"}
    assert parse_test("tests/backend/test_arch.py::test_a[cuda-b c] FAILED") == {"test": "test_a[cuda-b c]", "result": "failed"}
    assert parse_test("collected 15 items") is None and parse_test("FAILED tests/test_arch.py::test_a - AssertionError") is None


def test_every_part_has_a_job_and_a_table():
    assert {part.name for part in make_parts("cuda", False)} == {"tests", *JOBS} == set(TABLES)


def test_a_job_prints_what_it_finds(capsys):
    run_job("reruns", "cpu", True)
    (line,) = [line for line in capsys.readouterr().out.splitlines() if line.startswith(RESULT)]
    assert json.loads(line.removeprefix(RESULT))["spread"] == 0.0  # reruns on the CPU give the same bits


def test_exit_status_after_a_failing_part(tmp_path, monkeypatch):
    monkeypatch.setattr(cuda_check, "make_parts", lambda arch, quick: [fake("reruns", "raise SystemExit(3)")])
    assert main(["--arch", "cpu", "--out", str(tmp_path)]) == 1


def test_the_script_continues_after_a_failed_install(tmp_path):
    python, wheels, out = tmp_path / "python", tmp_path / "wheels", tmp_path / "out"
    lines = ["#!/bin/sh", f'echo "$@" >> "{tmp_path}/called"', '[ "$2" = pip ] && exit 1', "exit 7"]
    python.write_text("\n".join(lines) + "\n")
    python.chmod(0o755)
    wheels.mkdir()
    (wheels / "broken-1.0-py3-none-any.whl").write_bytes(b"no wheel")
    environment = os.environ | {"PYTHON": str(python)}
    done = subprocess.run([SCRIPT, wheels, out, "--quick"], env=environment, capture_output=True, text=True, check=False)
    assert done.returncode == 7, done.stderr
    pip, bench = (tmp_path / "called").read_text().splitlines()
    assert "install" in pip and "--no-index" in pip
    assert bench == f"-m taisoft bench cuda_check --out {out} --quick"
    assert "broken-1.0" in (out / "not-installed.txt").read_text()
    assert subprocess.run([SCRIPT], env=environment, capture_output=True, check=False).returncode == 2
