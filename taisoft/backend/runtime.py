"""Taichi's runtime: initialisation, arch, precision, flags, kernels and their compile time. No other module calls `ti.init`.

Taichi's state belongs to the process, so only one (arch, precision) is open at a time. `cfg_optimization=False` works around
a miscompilation in Taichi 1.7.4 (`A = f(A)` on a local matrix), and also compiles faster. `fast_math=False` preserves NaN
comparisons and the order of sums, at no loss of speed. On CUDA the compiler still rounds a b + c once, takes 0 a + c for c even
if a is not finite, and divides f32 numbers with an error of up to two units in the last place.
"""

import contextlib
import ctypes
import functools
import io
import os
import sys
import time
from collections.abc import Callable, Iterator
from pathlib import Path

import numpy as np
import taichi as ti

from taisoft import compile_message
from taisoft.backend import tracing  # noqa: F401  tracing: before any function is decorated
from taisoft.backend.arrays import on_cuda
from taisoft.backend.launching import Kernels
from taisoft.backend.paths import on_gpu_path
from taisoft.backend.private import impl
from taisoft.errors import SimulationError
from taisoft.files import cache_folders
from taisoft.machine import address_space, format_bytes, thread_count, usable_cores

PRECISIONS = {"f32": ti.f32, "f64": ti.f64}
ARCHS = {"cpu": ti.cpu, "cuda": ti.cuda}
CPU_LANES = 4  # elements that one thread processes together
CPU_POOL_BYTES = 2**30  # address space that Taichi reserves at a time on the CPU
LOCK_SECONDS = 60.0  # after which the lock of the kernel cache, which is held for less than a second, is that of a killed process
KERNEL_CACHE_BYTES = 2**30  # of kernels on disk, above which Taichi removes the oldest; its default holds only about 450

_open: list["Runtime"] = []  # current claims on the runtime
_kind: tuple[str, str] | None = None  # (arch, precision) that Taichi was initialised with
_program = None  # Taichi's program object of that initialisation
_inherited: list = []  # programs of processes that this one was forked from, and whether they are on CUDA
_functions: list = []  # made by `compiled_function`
_totals = {"compile": 0.0, "kernels": 0}


class Runtime:
    """A claim on the process's Taichi runtime; `close` releases it.

    arch: "cpu" | "cuda"; precision: "f32" | "f64"; real: the Taichi type of everything but positions; lanes: number of
    elements processed together (SIMD lanes on the CPU; 1 on CUDA, where threads run in parallel instead). on_cpu: whether it does
    not take the GPU path (`paths`). owner: in messages.
    """

    def __init__(self, arch: str, precision: str, owner: str):
        self.arch, self.precision, self.owner = arch, precision, owner
        self.real = PRECISIONS[precision]
        self.np_real = np.float32 if precision == "f32" else np.float64
        self.eps = float(np.finfo(self.np_real).eps)
        self.on_cpu = not on_gpu_path()
        self.lanes = CPU_LANES if self.on_cpu else 1
        self._program = _program

    def check(self) -> None:
        """Raise SimulationError if Taichi has been re-initialised since, by anyone: all fields and kernels are then gone."""
        check_program(self._program)

    def close(self) -> None:
        """Release the claim; Taichi itself keeps running until another (arch, precision) is requested."""
        if self in _open:
            _open.remove(self)


def check_program(program) -> None:
    """Raise SimulationError unless this is Taichi's current program: under another, old fields and kernels end the process."""
    if impl.get_runtime().prog is not program:
        raise SimulationError(
            "Taichi was re-initialised in this process by ti.init or ti.reset, which frees the memory of all open simulators: "
            "close this one and create a new one"
        )


def open_runtime(arch: str, precision: str, owner: str = "a simulator") -> Runtime:
    """Claim Taichi with this arch and precision, initialising it if needed.

    Raises SimulationError if a name is unknown, another (arch, precision) is in use, or the arch is not available. Claims made
    before a foreign initialisation in this process (a user's own ti.init) are dropped.
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
            f"{_open[0].owner} is open with arch '{_kind[0]}' and precision '{_kind[1]}', and a process can use only one such "
            f"pair at a time: close it before requesting '{arch}' and '{precision}'"
        )
    if _kind != kind:
        _kind = None  # stays None if the initialisation fails
        _initialise(arch, precision)
        _kind = kind
    _open.append(Runtime(arch, precision, owner))
    return _open[-1]


def cache_folder() -> str:
    """A writable folder for compiled kernels; Taichi would end the process if its own were not writable."""
    for folder in cache_folders():
        path = folder / "kernels"
        try:
            path.mkdir(parents=True, exist_ok=True)
        except OSError:
            continue
        if os.access(path, os.W_OK):
            return str(path)
    raise SimulationError("no folder for compiled kernels is writable: set XDG_CACHE_HOME to a writable one")


def remove_stale_lock(folder: Path) -> None:
    """Remove the lock of a kernel cache if the process that held it was killed: Taichi would keep no kernels any more."""
    lock, taken = folder / "ticache.lock", folder / f"ticache.{os.getpid()}.stale"
    with contextlib.suppress(OSError):  # there is none, or another process removes it
        if time.time() - lock.stat().st_mtime > LOCK_SECONDS:
            lock.rename(taken)
            if time.time() - taken.stat().st_mtime > LOCK_SECONDS:
                taken.unlink()
            else:  # another process has taken a new one meanwhile
                taken.rename(lock)


def _leave_to_parent() -> None:
    """In a forked process, give up Taichi's program: its threads have stayed in the parent, and loops would wait for them."""
    global _kind, _program
    if _program is not None and impl.get_runtime().prog is _program:
        _inherited.append((_program, on_cuda()))
        ctypes.pythonapi.Py_IncRef(ctypes.py_object(_program))  # it is never freed: that would wait, too
        impl.get_runtime().prog = _program = _kind = None
        _open.clear()


if hasattr(os, "register_at_fork"):
    os.register_at_fork(after_in_child=_leave_to_parent)


def _initialise(arch: str, precision: str) -> None:
    global _program
    clock = time.perf_counter()
    for program, is_on_cuda in _inherited:
        if is_on_cuda:
            raise SimulationError("this process was forked from one that uses a GPU: start it by the method 'spawn' instead")
        program.finalize()  # Taichi counts programs, and allows one; a second call does nothing
    try:
        os.getcwd()
    except FileNotFoundError:
        raise SimulationError("the working folder no longer exists: change to one that does") from None
    folder = cache_folder()
    remove_stale_lock(Path(folder))
    available, threads_wanted = address_space(), thread_count(len(usable_cores()))
    if arch == "cpu" and available is not None and available < CPU_POOL_BYTES:
        shortage = f"{format_bytes(CPU_POOL_BYTES)} are needed at once, available: {format_bytes(available)}"
        raise SimulationError(f"not enough memory to start Taichi: {shortage}")
    try:
        with contextlib.redirect_stdout(io.StringIO()):  # drop Taichi's banner
            ti.init(
                arch=ARCHS[arch],
                default_fp=PRECISIONS[precision],
                default_ip=ti.i32,
                cfg_optimization=False,
                fast_math=False,
                offline_cache=True,
                offline_cache_file_path=folder,
                log_level=ti.ERROR,
                random_seed=0,
                offline_cache_max_size_of_files=KERNEL_CACHE_BYTES,
                cpu_max_num_threads=threads_wanted,  # Taichi's default also counts cores this process may not use
            )
    except RuntimeError as error:
        raise SimulationError(f"Taichi does not start: {(str(error).splitlines() or ['no reason given'])[0]}") from None
    _program = impl.get_runtime().prog
    if (forked := sys.modules.get("multiprocessing.util")) and sys.modules[
        "multiprocessing.process"
    ].parent_process() is not None:
        forked.Finalize(None, end, exitpriority=0)  # such a process skips what Python does at its end, and its kernels with it
    for kernels in Kernels.every:  # they refer to the previous program
        kernels.forget()
    for function in _functions:
        function.compiled, function.taichi_functions = None, {}
    _totals["compile"] += time.perf_counter() - clock
    actual = "cuda" if on_cuda() else "cpu"
    if actual != arch:
        raise SimulationError(f"arch '{arch}' is not available on this machine (Taichi fell back to '{actual}')")


def forget() -> None:
    """Let the next claim initialise Taichi anew, even for the same arch and precision: kernels compiled so far are then gone.

    Raises SimulationError if something is open.
    """
    global _kind
    if _open:
        raise SimulationError(f"{_open[0].owner} is open: close it first")
    _kind = None


def end() -> None:
    """Store compiled kernels on disk, which Taichi does when it ends; everything in its memory is then gone."""
    ti.reset()


def threads() -> int:
    """Number of threads of Taichi's parallel loops on the CPU."""
    return ti.cfg.cpu_max_num_threads


def open_kind() -> tuple[str, str] | None:
    """(arch, precision) in use by an open simulator, or None."""
    return _kind if _open else None


def kernel(function: Callable | None = None, *, cse: bool = True) -> Callable:
    """`ti.kernel` that counts the first launch per set of templates as compile time; launches are counted by `counters`.

    cse: whether Taichi eliminates common subexpressions, which takes time quadratic in the size of the code. Code unrolled over
    the nodes of an element runs up to 2.5 times as fast with it. Long branching code, such as contact detection, runs no
    faster with it, and compiles in 0.6 of the time without it.
    """
    if function is None:
        return functools.partial(kernel, cse=cse)
    kernels = Kernels(function)

    def launch(*arguments):
        check_program(_program)
        ready = kernels.find(arguments)
        if ready is not None:
            return ready.compiled.launch((ready.context, ready.write), arguments)
        start, compiler, before = time.perf_counter(), _compiler_clock(), kernels.n_compiled
        with _common_subexpressions(cse):
            ready = kernels.prepare(arguments)
            result = ready.compiled.launch((ready.context, ready.write), arguments)  # loads the code at the first launch
        if kernels.n_compiled > before:
            ti.sync()
            seconds = time.perf_counter() - start
            _totals["compile"] += seconds
            _totals["kernels"] += kernels.n_compiled - before
            compile_message.show(_compiler_clock() - compiler, seconds, _totals["kernels"])
        return result

    return kernels.launcher(launch)


def compiled_function(number: int) -> Callable:
    """`ti.real_func`: a function that is compiled once and called. number: its own, part of the disk cache's keys."""

    def decorate(function: Callable) -> Callable:
        made = ti.real_func(function)
        made.func.func_id = number  # these and `compiled`, `taichi_functions` are private to Taichi, see `private`
        _functions.append(made.func)
        return made

    return decorate


def _compiler_clock() -> float:
    """Seconds spent so far in Taichi's compiler, including loading kernels from disk."""
    return _program.get_total_compilation_time() if _program is not None else 0.0


@contextlib.contextmanager
def _common_subexpressions(cse: bool) -> Iterator[None]:
    """Compile kernels inside with or without that pass: opt_level 0 skips it and no other enabled pass."""
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
    """Number of kernels compiled so far in this process, each structure counted separately."""
    return _totals["kernels"]


def compile_clock() -> float:
    """Seconds spent so far on starting Taichi and in first launches (tracing, compiling and that run)."""
    return _totals["compile"]
