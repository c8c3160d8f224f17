"""Options, timing and child processes of benchmarks.

Times exclude compilation. Alternatives are timed in turn, so that a slow moment of the machine affects all of them.
"""

import argparse
import hashlib
import json
import os
import subprocess
import sys
import time
import warnings
from collections import Counter
from collections.abc import Callable, Iterable, Iterator, Mapping
from contextlib import ExitStack, contextmanager
from pathlib import Path

import taichi as ti

import taisoft
from taisoft.backend.runtime import compile_clock
from taisoft.errors import SimulationError
from taisoft.output.tables import require_matplotlib
from taisoft.simulator import Simulator

from .document import RESULTS, check_out, default_out

HERE = Path(taisoft.__file__).resolve().parents[1]
RESULT = "result: "  # marks a child's results among Taichi's output
REST = "rest"  # time of a call outside its timed parts


# --- options ------------------------------------------------------------------------------------------------------------


def make_parser(name: str, doc: str, **more) -> argparse.ArgumentParser:
    """Parser of `taisoft bench NAME`; the help is the module's docstring."""
    first, _, rest = doc.partition("\n")
    return argparse.ArgumentParser(prog=f"taisoft bench {name}", description=first, epilog=rest.partition("\n\n")[2], **more)


def add_arch(parser: argparse.ArgumentParser) -> None:
    """Add --arch."""
    parser.add_argument("--arch", choices=("cpu", "cuda"), default="cpu", help="where to compute (default cpu)")


def add_named_out(parser: argparse.ArgumentParser) -> None:
    """Add --out [FILE.json]; without a name, `named_out` puts the file into benchmarks/results."""
    text = "write FILE.json and FILE.md; without a name into benchmarks/results, named after the machine"
    parser.add_argument("--out", type=Path, nargs="?", const=RESULTS, metavar="FILE.json", help=text)


def named_out(options: argparse.Namespace, name: str) -> Path | None:
    """The file of --out, None without it. Raises OutputError if it cannot be written."""
    out = default_out(options.arch, name) if options.out == RESULTS else options.out
    check_out(out, ".json")
    return out


def parse_options(
    parser: argparse.ArgumentParser, argv: list[str] | None, drawn: str = "", arch: bool = True
) -> argparse.Namespace:
    """Add --out [FILE.json], --arch unless it is always cpu or there already, and --plot if something is drawn; parse.

    An option `results` may say what results without a name are named after, if not after the benchmark. Raises OutputError if a
    file cannot be written.
    """
    parser.set_defaults(arch=parser.get_default("arch") or "cpu")
    if arch:
        add_arch(parser)
    add_named_out(parser)
    if drawn:
        parser.add_argument("--plot", type=Path, metavar="FILE.png", help=f"draw {drawn}")
    options = parser.parse_args(argv)
    options.out = named_out(options, getattr(options, "results", parser.prog.split()[-1]))
    if drawn and options.plot:
        check_out(options.plot, ".png")
        require_matplotlib()
    return options


def quick_options(name: str, doc: str, argv: list[str] | None, quick: str) -> argparse.Namespace:
    """Parse --quick and --out [FILE.json] of a benchmark on the CPU. quick: help of --quick. Raises OutputError."""
    parser = make_parser(name, doc)
    parser.add_argument("--quick", action="store_true", help=quick)
    return parse_options(parser, argv, arch=False)


def progress(text: str) -> None:
    """Print progress on stderr."""
    print(text, file=sys.stderr, flush=True)


def files_digest(paths: Iterable[Path]) -> str:
    """A digest of the names and contents of files, in the order of their paths."""
    total = hashlib.sha256()
    for path in sorted(paths):
        total.update(path.name.encode() + path.read_bytes())
    return total.hexdigest()


# --- times --------------------------------------------------------------------------------------------------------------


def clock() -> float:
    """The time [s] after all launched kernels have finished."""
    ti.sync()
    return time.perf_counter()


def timed(call: Callable[[], object]) -> tuple[object, float]:
    """The result of a call, and its seconds without compilation."""
    begin, compiled = time.perf_counter(), compile_clock()
    result = call()
    return result, time.perf_counter() - begin - (compile_clock() - compiled)


def repeated(call: Callable[[], object], rounds: int, max_seconds: float = 3.0, min_rounds: int = 2) -> list[float]:
    """Wall seconds of `rounds` calls, or fewer once they take `max_seconds` together. The caller warms up."""
    seconds: list[float] = []
    while len(seconds) < rounds and (len(seconds) < min_rounds or sum(seconds) < max_seconds):
        begin = clock()
        call()
        seconds.append(clock() - begin)
    return seconds


@contextmanager
def patched(owner, name: str, value) -> Iterator[None]:
    """Context in which an attribute of an object or a module has another value."""
    own, before = name in vars(owner), getattr(owner, name)
    setattr(owner, name, value)
    try:
        yield
    finally:
        if own:
            setattr(owner, name, before)
        else:
            delattr(owner, name)


def warm_up(sim: Simulator, steps: int = 3) -> None:
    """Compile the kernels that steps need, in as many as those of a multistep integrator take, then reset to the start."""
    for _ in range(steps):
        sim.step()
    sim.reset()


@contextmanager
def without_warnings() -> Iterator[None]:
    """Context without UserWarnings, for benchmarks that measure what the warnings are about."""
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", UserWarning)
        yield


class Stopwatch:
    """Seconds per part, without those of nested parts, and the number of calls by name."""

    def __init__(self) -> None:
        self.spent: Counter[str] = Counter()
        self.calls: Counter[str] = Counter()
        self._inner: list[float] = []  # per active call: seconds in nested calls

    def timed(self, call: Callable, part: str) -> Callable:
        """A timed version of the call."""

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
        """Context in which calls are timed. places: part, owner and attribute name of each function."""
        with ExitStack() as stack:
            for part, owner, name in places:
                stack.enter_context(patched(owner, name, self.timed(getattr(owner, name), part)))
            yield

    def parts_of(self, call: Callable[[], object]) -> dict[str, float]:
        """Seconds of each part of one call, including REST."""
        self.spent.clear()
        begin = clock()
        call()
        whole = clock() - begin
        return dict(self.spent) | {REST: whole - sum(self.spent.values())}


# --- processes ----------------------------------------------------------------------------------------------------------


def run_python(
    what: str,
    *arguments: str | int | Path,
    folder: Path = HERE,
    cache: Path | None = None,
    environment: Mapping[str, str] = os.environ,
) -> list[str]:
    """The output lines of a Python process with the version in `folder`. Raises SimulationError with its last line on failure."""
    paths = {"PYTHONPATH": os.pathsep.join(filter(None, (str(folder), os.environ.get("PYTHONPATH"))))}
    done = subprocess.run(
        [sys.executable, *map(str, arguments)],
        env=dict(environment) | paths | ({} if cache is None else {"XDG_CACHE_HOME": str(cache)}),
        stdin=subprocess.DEVNULL,
        capture_output=True,
        text=True,
        check=False,
    )
    if done.returncode:
        last = (done.stderr.strip().splitlines() or ["nothing"])[-1]
        raise SimulationError(f"{what} ended with status {done.returncode}: {last}")
    return done.stdout.splitlines()


def print_result(result) -> None:
    """Print a child's result."""
    print(RESULT + json.dumps(result), flush=True)


def parse_result(line: str):
    """The result in a line of a child's output, None in other lines."""
    return json.loads(line.removeprefix(RESULT)) if line.startswith(RESULT) else None
