"""Runs the tests on a tree with one fault at a time, and lists the faults that they do not find.

    python tests/mutants/run.py [--tree DIR] [--results FILE.json] [--only SUBSTR] [--jobs N] [--minutes M] [--check]

`mutants.toml` lists the faults: a file of the package, a text that occurs exactly once in it, and what replaces that text. To add
one, append both to the list of its file: one or two lines that somebody could have written wrong, that still compile, and that
change what a user can see. To renew those that a change of the code has moved (`--check` lists them), copy the new text there; a
fault that cannot be made any more is replaced by a similar one. A renewed fault is another one for the results.

Each job works on a copy of the tree in a temporary folder. It puts a fault in, runs the tests that concern the file with `-x`,
and puts the file right again. A test that fails also without the fault does not count, and is left out from then on. The results
are kept in a file, and an interrupted run goes on from there: name another file for another tree.
* caught: a test fails, or cannot be collected; crashed: the process of the tests ended by a signal;
* timed out: counted as caught only if the tests take less than a third of the limit without the fault;
* survived: all tests pass; not run: pytest refused to run, or the text does not occur once.

Tests of a flat layout (tests/test_*.py) are chosen by what they import and by their names, at most MOST files; of a mirrored one
(tests/PACKAGE/test_*.py) they are those of the package, modules at the top level being tested in tests/simulator. The reference
problems come last.
"""

import argparse
import ast
import functools
import hashlib
import json
import os
import re
import shutil
import signal
import subprocess
import sys
import tempfile
import threading
import time
import tomllib
from contextlib import suppress
from pathlib import Path
from typing import NamedTuple

import pytest

HERE = Path(__file__).resolve()
ROOT = HERE.parents[2]
MOST = 10  # test files of a flat layout, without the reference problems
LEFT_OUT = (".git", ".venv", "out", "__pycache__", "*.egg-info", ".*_cache", ".hypothesis")
CAUGHT, FINAL = ("caught", "crashed"), ("caught", "crashed", "timed out", "survived")  # outcomes; FINAL: need no other run
OPTIONS = ("-x", "-q", "-rfE", "--tb=no", "-p", "no:cacheprovider", "-p", "mutants_plugin")


@pytest.hookimpl(trylast=True)
def pytest_collection_modifyitems(config, items) -> None:
    """Run files in the order of the arguments: a copy of this module is a plugin of the tests."""
    place = {name: k for k, name in enumerate(config.args)}
    items.sort(key=lambda item: place.get(item.nodeid.partition("::")[0], -1))


class Mutant(NamedTuple):
    """A fault: `new` instead of `old` in a file below taisoft/."""

    file: str
    old: str
    new: str

    @property
    def key(self) -> str:
        """Its name in the results."""
        return hashlib.sha256("\n".join(self).encode()).hexdigest()[:12]

    @property
    def package(self) -> str:
        """Its package; "simulator" for modules at the top level."""
        return self.file.partition("/")[0] if "/" in self.file else "simulator"

    def applies(self, tree: Path) -> bool:
        """Whether the text to be replaced occurs exactly once."""
        path = tree / "taisoft" / self.file
        return path.is_file() and path.read_text(encoding="utf-8").count(self.old) == 1


def read_mutants(only: str) -> list[Mutant]:
    """Return the faults in files whose names contain a text."""
    table = tomllib.loads((HERE.parent / "mutants.toml").read_text(encoding="utf-8"))
    pairs = ((file, *pair) for file, texts in table.items() for pair in zip(texts[::2], texts[1::2], strict=True))
    return [Mutant(*one) for one in pairs if only in one[0]]


def module_of(path: Path) -> str:
    """Return the dotted name of a file, given relative to its root."""
    return ".".join(path.with_suffix("").parts).removesuffix(".__init__")


@functools.cache
def imports_of(path: Path) -> frozenset[str]:
    """Return the dotted names that a file imports, anywhere in it."""
    nodes = list(ast.walk(ast.parse(path.read_text(encoding="utf-8"))))
    found = {one.name for node in nodes if isinstance(node, ast.Import) for one in node.names}
    for node in nodes:
        if isinstance(node, ast.ImportFrom) and node.module:
            found |= {node.module, *(f"{node.module}.{one.name}" for one in node.names)}
    return frozenset(found)


def names_around(path: Path, text: str) -> list[str]:
    """Return the names of the functions and classes of a file that contain a text."""
    source = path.read_text(encoding="utf-8")
    line = source[: source.index(text)].count("\n") + 1
    nodes = [node for node in ast.walk(ast.parse(source)) if isinstance(node, ast.FunctionDef | ast.ClassDef)]
    return [node.name.strip("_") for node in nodes if node.lineno <= line <= node.end_lineno]


def tests_of(tree: Path, mutant: Mutant) -> list[str]:
    """Return the test files that concern a fault, in the order in which they are run."""
    tests, source, module = tree / "tests", tree / "taisoft" / mutant.file, module_of(Path("taisoft") / mutant.file)
    stem, words = module.rpartition(".")[2], [word.rstrip("s") for word in re.findall("[a-z]{3,}", module)[1:]]

    def order(path: Path) -> tuple:
        return f"_{stem}_" not in f"_{path.stem}_", path.stat().st_size

    if any(tests.glob("*/test_*.py")):
        own, last = (tests / mutant.package).rglob("test_*.py"), sorted((tests / "references").rglob("test_*.py"))
        chosen = sorted(own, key=lambda path: (module not in imports_of(path) and order(path)[0], *order(path)))
    else:
        imports = {module_of(path.relative_to(tree)): imports_of(path) for path in (tree / "taisoft").rglob("*.py")}
        near = {name for name, imported in imports.items() if module in imported} - {"taisoft"}
        far = {name for name, imported in imports.items() if near & imported} - {"taisoft"}
        helpers = {path.stem for path in tests.glob("*.py") if module in imports_of(path)}
        calls = re.compile(rf"\b({'|'.join(names_around(source, mutant.old)) or '-'})\(")

        def rank(path: Path) -> tuple:
            own, text, named = imports_of(path), path.read_text(encoding="utf-8"), not order(path)[0]
            groups = module in own, named or own & helpers, calls.search(text), own & near, own & far, True
            texts = path.stem, text
            return [bool(one) for one in groups].index(True), *(-sum(map(one.count, words)) for one in texts), order(path)

        last = [tests / "test_references.py"]
        chosen = sorted(sorted(set(tests.glob("test_*.py")) - set(last), key=rank)[:MOST], key=order)
    return [path.relative_to(tree).as_posix() for path in (*chosen, *last) if path.is_file()]


class Job:
    """A copy of a tree in which tests are run. tried: by test, whether it passes without a fault, shared by all jobs."""

    def __init__(self, folder: Path, tree: Path, seconds: float, tried: dict[str, bool]):
        self.tree, self._seconds, self._tried, self._output = folder / "copy", seconds, tried, folder / "output.txt"
        self._process, self._n_written = None, 0
        shutil.copytree(tree, self.tree, symlinks=True, ignore=shutil.ignore_patterns(*LEFT_OUT))
        for shared in [one for one in (tree.parent / "shared", ROOT.parent / "shared") if one.is_dir()][:1]:
            (folder / "shared").symlink_to(shared)
        shutil.copy(HERE, folder / "mutants_plugin.py")
        kernels = Path(os.environ.get("XDG_CACHE_HOME") or "~/.cache").expanduser() / "taisoft" / "kernels"
        self._cache = folder / "cache" / "taisoft"  # of its own but for the kernels: a fault could spoil what else it holds
        for one in (kernels, self._cache):
            one.mkdir(parents=True, exist_ok=True)
        (self._cache / "kernels").symlink_to(kernels)
        own = {"PYTHONPATH": f"{self.tree}{os.pathsep}{folder}", "XDG_CACHE_HOME": str(folder / "cache")}
        self._environment = os.environ | own | {"OPENBLAS_NUM_THREADS": "1", "COLUMNS": "1000"}

    def judge(self, mutant: Mutant) -> dict:
        """Return what the tests say of a fault."""
        if not mutant.applies(self.tree):
            return {"outcome": "not run", "test": "the text does not occur once"}
        files = tests_of(self.tree, mutant)
        while True:
            broken = [name for name, passes in list(self._tried.items()) if not passes]
            arguments = [*(name for name in files if name not in broken), *(f"--deselect={name}" for name in broken)]
            code, failed, seconds = self._run_with(mutant, arguments)
            found = {"outcome": "survived", "test": failed[0] if failed else "", "seconds": round(seconds, 1)}
            if code is None:
                return found | {"outcome": "timed out", "counts": self._pytest(arguments, self._seconds / 3)[0] is not None}
            if code < 0:  # counts only if the tests do not end so without the fault, and for a fault of their own
                is_own = code != -signal.SIGKILL and (self._pytest(arguments, self._seconds)[0] or 0) >= 0
                return found | {"outcome": "crashed" if is_own else "not run", "test": f"signal {-code}"}
            if code != 0 and (code > 2 or not failed):
                return found | {"outcome": "not run", "test": f"pytest ended with {code}"}
            if code == 0 or self._passes(failed[0]):
                return found | ({"outcome": "caught"} if code else {})

    def _passes(self, name: str) -> bool:
        """Return whether a test passes, or a file can be collected, without a fault."""
        if name not in self._tried:
            self._tried[name] = self._pytest([name] if "::" in name else [name, "--collect-only"], self._seconds)[0] == 0
        return self._tried[name]

    def _run_with(self, mutant: Mutant, arguments: list[str]) -> tuple[int | None, list[str], float]:
        """Run pytest with a fault in the tree. Every version of the file has a time of its own, by which Python compiles it."""
        path, self._n_written = self.tree / "taisoft" / mutant.file, self._n_written + 1
        right, times = path.read_text(encoding="utf-8"), (path.stat().st_atime, path.stat().st_mtime)
        try:
            path.write_text(right.replace(mutant.old, mutant.new), encoding="utf-8")
            os.utime(path, (times[0], times[1] + 10 * self._n_written))
            return self._pytest(arguments, self._seconds)
        finally:
            path.write_text(right, encoding="utf-8")
            os.utime(path, times)
            for one in self._cache.iterdir():
                if not one.is_symlink():
                    shutil.rmtree(one, ignore_errors=True)

    def _pytest(self, arguments: list[str], limit: float) -> tuple[int | None, list[str], float]:
        """Run pytest; return its exit status, None after the time limit [s], the tests that failed, and the time [s]."""
        begin, command = time.perf_counter(), [sys.executable, "-m", "pytest", *OPTIONS, *arguments]
        with open(self._output, "wb") as output:
            streams = {"stdin": subprocess.DEVNULL, "stdout": output, "stderr": subprocess.STDOUT}
            self._process = subprocess.Popen(command, cwd=self.tree, env=self._environment, start_new_session=True, **streams)
            try:
                code = self._process.wait(limit)
            except subprocess.TimeoutExpired:
                code = None
            self.kill()
        lines = self._output.read_text(encoding="utf-8", errors="replace").splitlines()
        failed = [line.split(" ", 1)[1].split(" - ")[0].strip() for line in lines if line.startswith(("FAILED ", "ERROR "))]
        return code, failed, time.perf_counter() - begin

    def kill(self) -> None:
        """End the tests that run, with the processes that they started."""
        if self._process is not None:
            with suppress(ProcessLookupError):
                os.killpg(self._process.pid, signal.SIGKILL)
            self._process.wait()


def run_all(mutants: list[Mutant], tree: Path, file: Path, n_jobs: int, seconds: float) -> dict[str, dict]:
    """Judge the faults that have no result yet, write each result, and return all."""
    kept = json.loads(file.read_text(encoding="utf-8")) if file.is_file() else {"results": {}, "tried": {}}
    waiting = [one for one in reversed(mutants) if kept["results"].get(one.key, {}).get("outcome") not in FINAL]
    lock, ended, jobs = threading.Lock(), threading.Event(), []

    def work(job: Job) -> None:
        with suppress(IndexError):  # nothing waits any more
            while not ended.is_set():
                mutant = waiting.pop()
                found = job.judge(mutant)
                if ended.is_set():
                    return
                print(f"{found['outcome']:<10} {found.get('seconds', 0.0):7.1f} s  {mutant.file}: {found['test']}", flush=True)
                with lock:
                    kept["results"][mutant.key] = mutant._asdict() | found
                    part = file.with_suffix(".part")
                    part.write_text(json.dumps(kept | {"tried": dict(kept["tried"])}, indent=1), encoding="utf-8")
                    part.replace(file)

    with tempfile.TemporaryDirectory(prefix="mutants-") as folder:
        for k in range(min(n_jobs, len(waiting))):
            (place := Path(folder) / f"{k}").mkdir()
            jobs.append(Job(place, tree, seconds, kept["tried"]))
        threads = [threading.Thread(target=work, args=(job,)) for job in jobs]
        try:
            for thread in threads:
                thread.start()
            for thread in threads:
                thread.join()
        finally:  # Ctrl-C, too
            ended.set()
            for job, thread in zip(jobs, threads):
                job.kill()
                thread.join()
    return kept["results"]


def print_table(mutants: list[Mutant], results: dict[str, dict]) -> None:
    """Print the numbers of faults by package, and those that no test found."""
    found = [(one, results.get(one.key, {"outcome": "not run", "test": ""})) for one in mutants]
    found = [(one, result, "by time" if result.get("counts") else result["outcome"]) for one, result in found]
    print(f"\n{'package':<12}{'faults':>8}{'caught':>8}{'by time':>9}{'survived':>10}{'other':>8}")
    for name in (*sorted({one.package for one in mutants}), "all"):
        own = [how for one, _, how in found if name in (one.package, "all")]
        n = [sum(how in CAUGHT for how in own), own.count("by time"), own.count("survived")]
        print(f"{name:<12}{len(own):>8}{n[0]:>8}{n[1]:>9}{n[2]:>10}{len(own) - sum(n):>8}")
    for one, result, how in found:
        if how not in (*CAUGHT, "by time"):
            print(f"\n{how}: {one.file} {result['test']}\n- {one.old}\n+ {one.new}")


def main() -> int:
    """Run the command; see above."""
    parser = argparse.ArgumentParser(description=__doc__.partition("\n")[0], allow_abbrev=False)
    parser.add_argument("--tree", type=Path, default=ROOT, help="a checkout of taisoft (default: this one)")
    parser.add_argument("--results", type=Path, default=Path("out/mutants.json"), help="where results are kept")
    parser.add_argument("--only", default="", metavar="SUBSTR", help="faults in files whose names contain this")
    parser.add_argument("--jobs", type=int, default=1, metavar="N", help="faults at a time (default 1)")
    parser.add_argument("--minutes", type=float, default=15.0, metavar="M", help="limit of a run of the tests (default 15)")
    parser.add_argument("--check", action="store_true", help="only list faults whose text does not occur once")
    arguments = parser.parse_args()
    mutants, tree = read_mutants(arguments.only), arguments.tree.resolve()
    if arguments.check:
        outdated = [f"{one.file}: {one.old}" for one in mutants if not one.applies(tree)]
        print("\n".join([f"{len(mutants)} faults, {len(outdated)} to be renewed", *outdated]))
        return int(bool(outdated))
    signal.signal(signal.SIGTERM, lambda *_: sys.exit(128 + signal.SIGTERM))
    arguments.results.parent.mkdir(parents=True, exist_ok=True)
    print_table(mutants, run_all(mutants, tree, arguments.results, arguments.jobs, 60.0 * arguments.minutes))
    return 0


if __name__ == "__main__":
    sys.exit(main())
