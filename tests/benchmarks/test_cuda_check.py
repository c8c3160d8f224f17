"""The GPU check, on a machine without one:

* parts that fail, hang or find nothing leave the results of the others, and the next part starts;
* the time limits hold, and the page names the parts that were not run;
* test results are parsed from pytest's output;
* the script continues if a wheel cannot be installed, and passes on arguments and exit status.
"""

import json
import os
import subprocess
import sys

from benchmarks import cuda_check
from benchmarks.cuda_check import Part, main, parse_test
from benchmarks.runner import RESULT
from tests.cli.command import ROOT

SCRIPT = ROOT / "benchmarks" / "cuda_check.sh"
RERUN = {"scene": "beam", "integrator": "bdf2", "reruns": 3, "spread": 1.5e-6}


def fake(name: str, code: str, seconds: float = 20.0) -> Part:
    """A part that runs a line of Python."""
    return Part(name, f"Part {name}", (sys.executable, "-c", f"import time\n{code}"), seconds)


def test_failing_parts_leave_the_results_of_others(tmp_path, monkeypatch):
    """The page is written after every part; a part for which no time is left is reported."""
    pages, write_page = [], cuda_check.write_page

    def written(*arguments):
        write_page(*arguments)
        pages.append((tmp_path / "cuda-check.md").read_text())

    monkeypatch.setattr(cuda_check, "write_page", written)
    found = f"print({(RESULT + json.dumps(RERUN))!r}, flush=True)"
    parts = [
        fake("reruns", f"{found}\nraise ValueError('the kernel broke')"),
        fake("works", "import os; os.kill(os.getpid(), 11)"),
        fake("reruns", found),
        fake("sizes", "time.sleep(600)", 1.0),
        fake("sizes", "pass", 0.0),
    ]
    monkeypatch.setattr(cuda_check, "make_parts", lambda arch, quick: parts)
    assert main(["--arch", "cpu", "--budget", "4", "--out", str(tmp_path)]) == 1
    numbers = json.loads((tmp_path / "cuda-check.json").read_text())["parts"]
    assert [part["ended"] for part in numbers] == ["failed", "failed", "ok", "out of time", "out of time"]
    assert numbers[0]["found"] == numbers[2]["found"] == [RERUN] and "the kernel broke" in numbers[0]["tail"]
    assert "Not yet run: works, reruns, sizes, sizes." in pages[0] and "Not yet run" not in pages[4]
    assert pages[4].count("1.5e-06") == 2 and pages[4].count("It found nothing.") == 3 and "status -11" in pages[4]
    assert "no time was left to start it" in pages[4]


def test_lines_of_pytest_are_parsed():
    line = "tests/backend/test_arch.py::test_operator[cuda-f32] PASSED                  [ 10%]"
    assert parse_test(line) == {"test": "test_operator[cuda-f32]", "result": "passed"}
    line = "[gw3] [ 40%] PASSED tests/backend/test_arch.py::test_steps_with_contacts[cuda-bdf2 auto] "
    assert parse_test(line) == {"test": "test_steps_with_contacts[cuda-bdf2 auto]", "result": "passed"}
    assert parse_test("tests/backend/test_arch.py::test_a[cuda-b c] FAILED") == {"test": "test_a[cuda-b c]", "result": "failed"}
    assert parse_test("collected 15 items") is None and parse_test("FAILED tests/test_arch.py::test_a - AssertionError") is None


def test_the_script_continues_after_a_failed_install(tmp_path):
    python, wheels, out = tmp_path / "python", tmp_path / "wheels", tmp_path / "out"
    python.write_text(f'#!/bin/sh\necho "$@" >> "{tmp_path}/called"\n[ "$2" = pip ] && exit 1\nexit 7\n')
    python.chmod(0o755)
    wheels.mkdir()
    (wheels / "broken-1.0-py3-none-any.whl").write_bytes(b"no wheel")
    environment = os.environ | {"PYTHON": str(python)}
    assert subprocess.run([SCRIPT, wheels, out, "--quick"], env=environment, capture_output=True, check=False).returncode == 7
    pip, bench = (tmp_path / "called").read_text().splitlines()
    assert "--no-index" in pip and bench == f"-m taisoft bench cuda_check --out {out} --quick"
    assert "broken-1.0" in (out / "not-installed.txt").read_text()
