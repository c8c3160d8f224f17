"""How benchmarks run: their options, times of calls and of their parts, and processes of this and of older versions.

A time holds no compiling; what runs beside each other takes turns, so that a slow moment of the machine falls on all.
"""

import argparse
import json
import os
import subprocess
import sys
import time
import warnings
from collections import Counter
from collections.abc import Callable, Iterable, Iterator
from contextlib import ExitStack, contextmanager
from dataclasses import dataclass
from pathlib import Path

import taichi as ti

import taisoft
from taisoft.backend.runtime import compile_clock
from taisoft.errors import SimulationError
from taisoft.output.files import make_folder
from taisoft.output.tables import require_matplotlib

from .document import check_out

HERE = Path(taisoft.__file__).resolve().parents[1]
RESULT = "result: "  # before what a child found, among what Taichi prints
REST = "rest"  # of a call: what no part of it took


# --- options ------------------------------------------------------------------------------------------------------------


def make_parser(name: str, doc: str, **more) -> argparse.ArgumentParser:
    """The parser of `taisoft bench NAME`, with the module's docstring as help."""
    first, _, rest = doc.partition("\n")
    return argparse.ArgumentParser(prog=f"taisoft bench {name}", description=first, epilog=rest.partition("\n\n")[2], **more)


def add_arch(parser: argparse.ArgumentParser) -> None:
    """--arch."""
    parser.add_argument("--arch", choices=("cpu", "cuda"), default="cpu", help="where to compute (default cpu)")


def parse_options(parser: argparse.ArgumentParser, argv: list[str] | None, drawn: str = "") -> argparse.Namespace:
    """--arch, --out and, where something is drawn, --plot, beside the parser's own options; the files can be written."""
    add_arch(parser)
    parser.add_argument("--out", type=Path, metavar="FILE.json", help="write FILE.json and FILE.md too")
    if drawn:
        parser.add_argument("--plot", type=Path, metavar="FILE.png", help=f"draw {drawn}")
    options = parser.parse_args(argv)
    check_out(options.out, ".json")
    if drawn and options.plot:
        check_out(options.plot, ".png")
        require_matplotlib()
    return options


def progress(text: str) -> None:
    """Say on stderr what is being measured."""
    print(text, file=sys.stderr, flush=True)


# --- times --------------------------------------------------------------------------------------------------------------


def clock() -> float:
    """Now [s], when the machine has done all that it was given."""
    ti.sync()
    return time.perf_counter()


def timed(call: Callable[[], object]) -> tuple[object, float]:
    """What a call returns, and its seconds without compiling."""
    begin, compiled = time.perf_counter(), compile_clock()
    result = call()
    return result, time.perf_counter() - begin - (compile_clock() - compiled)


def repeated(call: Callable[[], object], rounds: int, enough: float = 3.0, least: int = 2) -> list[float]:
    """Wall seconds of `rounds` calls, fewer if they take more than `enough` seconds together. Warm-up is left to the caller."""
    seconds: list[float] = []
    while len(seconds) < rounds and (len(seconds) < least or sum(seconds) < enough):
        begin = clock()
        call()
        seconds.append(clock() - begin)
    return seconds


@contextmanager
def patched(owner, name: str, value) -> Iterator[None]:
    """An attribute of an object or a module has this value meanwhile."""
    own, before = name in vars(owner), getattr(owner, name)
    setattr(owner, name, value)
    try:
        yield
    finally:
        if own:
            setattr(owner, name, before)
        else:
            delattr(owner, name)


@contextmanager
def unwarned() -> Iterator[None]:
    """Without warnings to users, where what they warn of is what is measured."""
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", UserWarning)
        yield


class Stopwatch:
    """Seconds by part, each call's own: what a call spends in another part counts there; and calls by name."""

    def __init__(self) -> None:
        self.spent: Counter[str] = Counter()
        self.calls: Counter[str] = Counter()
        self._inner: list[float] = []  # of the calls under way: seconds spent in calls inside

    def timed(self, call: Callable, part: str) -> Callable:
        """The call, timed."""

        def run(*arguments, **named):
            self.calls[getattr(call, "__name__", part)] += 1
            begin = clock()
            self._inner.append(0.0)
            try:
                return call(*arguments, **named)
            finally:
                whole = clock() - begin
                self.spent[part] += whole - self._inner.pop()
                if self._inner:
                    self._inner[-1] += whole

        return run

    @contextmanager
    def on(self, places: Iterable[tuple[str, object, str]]) -> Iterator[None]:
        """Times calls meanwhile. places: part, and the owner and the name under which what is called is looked up."""
        with ExitStack() as stack:
            for part, owner, name in places:
                stack.enter_context(patched(owner, name, self.timed(getattr(owner, name), part)))
            yield

    def parts_of(self, call: Callable[[], object]) -> dict[str, float]:
        """Seconds of each part of one call, REST among them."""
        self.spent.clear()
        begin = clock()
        call()
        whole = clock() - begin
        return dict(self.spent) | {REST: whole - sum(self.spent.values())}


# --- processes ----------------------------------------------------------------------------------------------------------


def run_python(what: str, *arguments: str | int | Path, folder: Path = HERE, cache: Path | None = None) -> list[str]:
    """The lines that a process of the version in `folder` prints. Raises SimulationError with its last line where it fails."""
    paths = {"PYTHONPATH": os.pathsep.join(filter(None, (str(folder), os.environ.get("PYTHONPATH"))))}
    done = subprocess.run(
        [sys.executable, *map(str, arguments)],
        env=os.environ | paths | ({} if cache is None else {"XDG_CACHE_HOME": str(cache)}),
        stdin=subprocess.DEVNULL,
        capture_output=True,
        text=True,
        check=False,
    )
    if done.returncode:
        last = (done.stderr.strip().splitlines() or ["nothing"])[-1]
        raise SimulationError(f"{what} ended with status {done.returncode}: {last}")
    return done.stdout.splitlines()


def say(found) -> None:
    """In a child: print a result."""
    print(RESULT + json.dumps(found), flush=True)


def parse_result(line: str):
    """What a line of a child's output found, None for any other line."""
    return json.loads(line.removeprefix(RESULT)) if line.startswith(RESULT) else None


@dataclass(frozen=True)
class Version:
    """A version of taisoft by its folder. cache: where its compiled kernels are kept; None: where they always are."""

    folder: Path
    cache: Path | None = None

    def run(self, program: Path, *task: str | int | Path) -> list[str]:
        """The lines that a program prints for a task. Raises SimulationError where it fails."""
        what = f"{self.folder}: task {' '.join(map(str, task))}"
        return run_python(what, program, *task, folder=self.folder, cache=self.cache)

    def files(self) -> set[Path]:
        """What lies in the cache."""
        return {path for path in self.cache.rglob("*.tic*") if path.is_file()}


def version_in(folder: Path) -> Version:
    """The version in a folder; another one than this keeps a cache of kernels there."""
    folder = folder.resolve()
    return Version(folder, None if folder == HERE else make_folder(folder / ".cache"))


def versions_beside(baseline: Path | None) -> dict[str, Version]:
    """This version and, where a folder is given, an older one."""
    return {"this": version_in(HERE)} | ({} if baseline is None else {"older": version_in(baseline)})
