"""The GPU check, on a machine without one:

* parts that fail, hang or find nothing leave the results of the others, within the time limits; the page names what was not run;
* test results are parsed from pytest's output.
"""

import json

from benchmarks import cuda_check
from benchmarks.cuda_check import Part, main, parse_test
from benchmarks.runner import RESULT

RERUN = {"scene": "beam", "integrator": "bdf2", "reruns": 3, "spread": 1.5e-6}


def fake(name: str, code: str, seconds: float = 20.0) -> Part:
    """A part that runs a line of Python."""
    return Part(name, f"Part {name}", ("-S", "-c", f"import time\n{code}"), seconds)


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
        fake("sizes", "time.sleep(600)", 0.5),
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
    for line, found in (
        ("tests/backend/test_arch.py::test_a[cuda-b c] PASSED                  [ 10%]", "passed"),
        ("[gw3] [ 40%] PASSED tests/backend/test_arch.py::test_a[cuda-b c] ", "passed"),
        ("tests/backend/test_arch.py::test_a[cuda-b c] FAILED", "failed"),
    ):
        assert parse_test(line) == {"test": "test_a[cuda-b c]", "result": found}
    assert parse_test("collected 15 items") is None and parse_test("FAILED tests/test_arch.py::test_a - AssertionError") is None
