"""Functions of benchmarks that are called in new processes, which have memory, threads, kernels and a display of their own."""

from collections.abc import Callable
from importlib import import_module

from .document import plain
from .runner import parse_result, print_result, run_python

PROGRAM = "from taisoft.cli.scene_file import load_shipped; load_shipped('benchmarks', 'children').answer({!r}, {!r}, {!r})"


def in_child(what: str, function: Callable, *arguments, **how):
    """What a function of a benchmark returns in a new process, as plain data.

    arguments: plain data; how: see `run_python`. Raises SimulationError with the child's last line if it fails.
    """
    module = function.__module__.partition(".")[2]  # inside the package of benchmarks, whatever its name
    lines = run_python(what, "-c", PROGRAM.format(module, function.__name__, arguments), **how)
    return [found for line in lines if (found := parse_result(line)) is not None][-1]


def answer(module: str, name: str, arguments: tuple) -> None:
    """In the child: print what the function returns."""
    print_result(plain(getattr(import_module(f".{module}", __package__), name)(*arguments)))
