"""The only place that starts Taichi: arch, precision, flags, kernels and their launch counts.

Taichi's state belongs to the process, so one (arch, precision) is open at a time. `cfg_optimization=False` works round a
miscompilation of Taichi 1.7.4 (`A = f(A)` on a local matrix), and also compiles faster; `fast_math=False` keeps NaN
comparisons and the order of sums (no speed lost).
"""

import contextlib
import functools
import io
import os
import time
from collections import Counter
from collections.abc import Callable, Iterator

import numpy as np
import taichi as ti
from taichi.lang import impl

from taisoft import compile_message, tracing  # noqa: F401  tracing before anything is decorated
from taisoft.errors import SimulationError
from taisoft.files import cache_folders
from taisoft.lane_pool import LanePool
from taisoft.launching import Kernels
from taisoft.memory import address_space, format_bytes
from taisoft.timing import usable_cores

PRECISIONS = {"f32": ti.f32, "f64": ti.f64}
ARCHS = {"cpu": ti.cpu, "cuda": ti.cuda}
POOL = 2**30  # bytes of address space that Taichi asks for at a time on the CPU
CACHE = 2**30  # bytes of kernels on disk, above which Taichi removes the oldest; its own limit holds but some 450

launches: Counter[str] = Counter()  # kernel name -> launches so far in this process
_open: list["Runtime"] = []  # simulators that hold the runtime now
_kind: tuple[str, str] | None = None  # (arch, precision) that Taichi was initialised with
_program = None  # Taichi's own state, of that initialisation
_clock = {"compile": 0.0, "kernels": 0}
_known: list[Kernels] = []
_pool: LanePool | None = None


class Runtime:
    """A claim on the process's Taichi runtime; `close` gives it back.

    arch: "cpu" | "cuda"; precision: "f32" | "f64"; real: the Taichi type of everything but positions; lanes: elements
    handled side by side (SIMD lanes on the CPU, 1 on CUDA, where threads take that part).
    """

    def __init__(self, arch: str, precision: str):
        self.arch, self.precision = arch, precision
        self.real = PRECISIONS[precision]
        self.np_real = np.float32 if precision == "f32" else np.float64
        self.eps = float(np.finfo(self.np_real).eps)
        self.lanes = 4 if arch == "cpu" else 1
        self.owner = ""
        self._program = _program

    def check(self) -> None:
        """Raises SimulationError where Taichi was initialised anew since, by whomever: all fields and kernels are gone."""
        check_program(self._program)

    def close(self) -> None:
        """Release the claim; Taichi itself stays up until another kind is asked for."""
        if self in _open:
            _open.remove(self)


def check_program(program) -> None:
    """Raises SimulationError unless Taichi's state is this one: with another one, old fields and kernels end the process."""
    if impl.get_runtime().prog is not program:
        raise SimulationError(
            "Taichi was initialised anew in this process, by ti.init or ti.reset, which frees all memory of open simulators: "
            "close this one and make a new one"
        )


def open_runtime(arch: str, precision: str, owner: str = "a simulator") -> Runtime:
    """Claim Taichi with this arch and precision, initialising it where needed.

    Raises SimulationError when the names are unknown, another kind is in use, or the arch cannot be had. What held Taichi before
    another initialisation in this process (a user's own ti.init) holds nothing any more.
    """
    global _kind
    if arch not in ARCHS:
        raise SimulationError(f"arch '{arch}' is unknown: it must be one of {', '.join(ARCHS)}")
    if precision not in PRECISIONS:
        raise SimulationError(f"precision '{precision}' is unknown: it must be one of {', '.join(PRECISIONS)}")
    if impl.get_runtime().prog is not _program:
        _open.clear()
        _kind = None
    kind = (arch, precision)
    if _open and _kind != kind:
        raise SimulationError(
            f"{_open[0].owner} is open with arch '{_kind[0]}' and precision '{_kind[1]}', and one process holds one kind at "
            f"a time: close it before asking for '{arch}' and '{precision}'"
        )
    if _kind != kind:
        _kind = None  # a failed initialisation leaves no kind
        _initialise(arch, precision)
        _kind = kind
    runtime = Runtime(arch, precision)
    runtime.owner = owner
    _open.append(runtime)
    return runtime


def _cache_folder() -> str:
    """A folder for compiled kernels that can be written: Taichi ends the process where its own cannot."""
    for folder in cache_folders():
        path = folder / "kernels"
        try:
            path.mkdir(parents=True, exist_ok=True)
        except OSError:
            continue
        if os.access(path, os.W_OK):
            return str(path)
    raise SimulationError("no folder for compiled kernels can be written: set XDG_CACHE_HOME to one that can")


def _initialise(arch: str, precision: str) -> None:
    global _program, _pool
    clock = time.perf_counter()
    try:
        os.getcwd()
    except FileNotFoundError:
        raise SimulationError("the working folder no longer exists: change to one that does") from None
    folder = _cache_folder()
    room = address_space()
    if arch == "cpu" and room is not None and room < POOL:
        needed = f"{format_bytes(POOL)} are needed at once, available: {format_bytes(room)}"
        raise SimulationError(f"not enough memory to start Taichi: {needed}")
    try:
        with contextlib.redirect_stdout(io.StringIO()):  # its greeting
            ti.init(
                arch=ARCHS[arch], default_fp=PRECISIONS[precision], default_ip=ti.i32, cfg_optimization=False,
                fast_math=False, offline_cache=True, offline_cache_file_path=folder, log_level=ti.ERROR, random_seed=0,
                offline_cache_max_size_of_files=CACHE,
                cpu_max_num_threads=len(usable_cores()),  # Taichi would count the cores that it may not use, too
            )  # fmt: skip
    except RuntimeError as error:
        raise SimulationError(f"Taichi does not start: {(str(error).splitlines() or ['no reason given'])[0]}") from None
    _program = impl.get_runtime().prog
    for known in _known:  # they hold the Taichi that was
        known.forget()
    _pool = LanePool(PRECISIONS[precision]) if arch == "cpu" else None
    _clock["compile"] += time.perf_counter() - clock
    obtained = "cuda" if ti.cfg.arch == ti.cuda else "cpu"
    if obtained != arch:
        raise SimulationError(f"arch '{arch}' is not to be had on this machine (Taichi fell back to '{obtained}')")


def lane_pool() -> LanePool | None:
    """Of the Taichi that is up now; None on CUDA, where threads take the part of lanes."""
    return _pool


def threads() -> int:
    """Number of threads of Taichi's parallel loops on the CPU."""
    return ti.cfg.cpu_max_num_threads


def open_kind() -> tuple[str, str] | None:
    """(arch, precision) in use by an open simulator, or None."""
    return _kind if _open else None


def kernel(function: Callable | None = None, *, cse: bool = True) -> Callable:
    """`ti.kernel` whose launches are counted by name, and whose first launch per set of templates counts as compile time.

    cse: whether Taichi eliminates common subexpressions, in time that grows with the square of the code. What is unrolled over
    the nodes of an element runs up to 2.5 times as fast for that. Long code with many branches, as a search for contacts, runs
    no faster, and compiles in 0.6 of the time without it.
    """
    if function is None:
        return functools.partial(kernel, cse=cse)
    kernels = Kernels(function)
    _known.append(kernels)

    @functools.wraps(function)
    def launch(*arguments):
        check_program(_program)
        launches[function.__name__] += 1
        ready = kernels.find(arguments)
        if ready is not None:
            return ready[0].launch(ready[1], arguments)
        start, compiler, before = time.perf_counter(), _compiler_clock(), kernels.n_compiled
        with _eliminating(cse):
            compiled, context, _ = kernels.prepare(arguments)
            result = compiled.launch(context, arguments)  # which loads the code where it is new
        if kernels.n_compiled > before:
            ti.sync()
            seconds = time.perf_counter() - start
            _clock["compile"] += seconds
            _clock["kernels"] += kernels.n_compiled - before
            compile_message.show(_compiler_clock() - compiler, seconds, _clock["kernels"])
        return result

    return launch


def _compiler_clock() -> float:
    """Seconds that Taichi's compiler has taken so far, those in which it loads kernels from disk included."""
    return _program.get_total_compilation_time() if _program is not None else 0.0


@contextlib.contextmanager
def _eliminating(cse: bool) -> Iterator[None]:
    """Kernels compiled inside go through that pass, or not: at level 0 Taichi leaves it out, and no other that is on."""
    runtime = impl.get_runtime()
    if cse or runtime.prog is None:
        yield
        return
    config = runtime.prog.config()
    level, config.opt_level = config.opt_level, 0
    try:
        yield
    finally:
        config.opt_level = level


def n_compiled() -> int:
    """How many kernels have been compiled so far in this process, each structure counted."""
    return _clock["kernels"]


def compile_clock() -> float:
    """Seconds spent so far on starting Taichi and in first launches (tracing, compiling, and that first run)."""
    return _clock["compile"]
