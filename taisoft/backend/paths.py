"""The GPU path: loops, orders of work and data arranged for thousands of threads, instead of for a few that each do much.

It is taken on a GPU, and on the CPU where `gpu_path` asks for it, so that tests and counts of launches need no GPU.
"""

import contextlib
import os
from collections.abc import Iterator
from typing import NamedTuple

from taisoft.backend.arrays import on_cuda

VARIABLE = "TAISOFT_GPU_PATH"  # environment variable: 1 to take the GPU path on the CPU, in tests
FEWER = 64  # what takes so many threads on a GPU takes one on the CPU


class Order(NamedTuple):
    """Order in which one thread takes the entries of a phase of a team, see `team`."""

    virtual: int = 1
    backwards: bool = False


_is_forced = os.environ.get(VARIABLE) == "1"
AS_WRITTEN = Order()
_order = AS_WRITTEN


def on_gpu_path() -> bool:
    """Whether what is made now takes the GPU path."""
    return _is_forced or on_cuda()


def gpu_threads(n: int) -> int:
    """Number of chunks of a loop that has n on a GPU."""
    return n if on_cuda() else n // FEWER


def team_order() -> Order:
    """The order of the teams that are made now."""
    return _order


@contextlib.contextmanager
def gpu_path(order: Order = AS_WRITTEN) -> Iterator[None]:
    """Context in which simulators take the GPU path: made, used and closed in it. order: of their teams on the CPU."""
    global _is_forced, _order
    before, (_is_forced, _order) = (_is_forced, _order), (True, order)
    try:
        yield
    finally:
        _is_forced, _order = before
