"""Counts of what costs a GPU most beside arithmetic: launches, their arguments, and accesses of its memory by the host.

    with counting() as counts:
        sim.step()
    print(counts.table())

`device_only` refuses such accesses instead. Both work on the CPU too, where the host shares the memory with kernels. While they
are open, watching methods stand in the place of those of `Array` and `Compiled`; otherwise they cost nothing. They may be nested,
and close in reverse order. They do not see allocation, waiting (`ti.sync`), or what is done with an array's `host` later.
`intercepted` hands every launch to a function, which may time it.
"""

import contextlib
import functools
from collections import Counter
from collections.abc import Callable, Iterator
from dataclasses import dataclass, field
from typing import Any

from taisoft.backend.arrays import Array
from taisoft.backend.compiled import Compiled, Signature
from taisoft.backend.launching import Kernels
from taisoft.errors import SimulationError

FILLS = "fills"  # by the device
ACCESSES = {  # attribute of Array: kind of access
    "__getitem__": "reads",
    "__setitem__": "writes",
    "to_numpy": "downloads",
    "from_numpy": "uploads",
    "host": "direct accesses",
    "fill": FILLS,
}


@dataclass
class Counts:
    """What happened while a context of `counting` was open. All but `accesses` by the name of the kernel."""

    launches: Counter[str] = field(default_factory=Counter)  #: also those that failed
    arrays: Counter[str] = field(default_factory=Counter)  #: `Array`s handed to launches
    host_arrays: Counter[str] = field(default_factory=Counter)  #: NumPy arrays handed to them; a GPU copies these there and back
    returned: Counter[str] = field(default_factory=Counter)  #: values that launches returned to the host
    compiled: Counter[str] = field(default_factory=Counter)  #: kernels traced, and compiled or loaded from disk
    accesses: Counter[str] = field(default_factory=Counter)  #: of arrays by the host, by kind: a value of ACCESSES

    def totals(self, steps: int = 1) -> dict[str, float]:
        """Numbers of everything counted, divided by a number of steps."""
        found = {"launches": self.launches.total(), "array arguments": self.arrays.total()}
        found |= {"host arrays": self.host_arrays.total(), "returned values": self.returned.total()}
        found |= {kind: self.accesses[kind] for kind in ACCESSES.values()} | {"kernels compiled": self.compiled.total()}
        return {what: number / steps for what, number in found.items()}

    def table(self, most: int = 10) -> str:
        """The totals, and below them the kernels launched most often: a line each."""
        lines = [f"{number:>8,.0f} {what}" for what, number in self.totals().items()]
        for name, launches in self.launches.most_common(most):
            handed = f"{self.arrays[name]:,} arrays, {self.host_arrays[name]:,} host arrays, {self.returned[name]:,} returned"
            lines.append(f"{launches:>8,} {name}: {handed}")
        return "\n".join(lines)


@contextlib.contextmanager
def counting() -> Iterator[Counts]:
    """Context that counts; its record may also be read before the end."""
    counts = Counts()

    def launched(signature: Signature) -> None:
        kernel, arrays, host_arrays, returned = signature
        counts.launches[kernel] += 1
        counts.arrays[kernel] += arrays
        counts.host_arrays[kernel] += host_arrays
        counts.returned[kernel] += returned

    def compiled(signature: Signature) -> None:
        counts.compiled[signature.kernel] += 1

    def accessed(kind: str, _array: Array) -> None:
        counts.accesses[kind] += 1

    with _watched(launched, compiled, accessed):
        yield counts


@contextlib.contextmanager
def device_only() -> Iterator[None]:
    """Context that raises SimulationError instead of letting the host access the device's memory.

    Refused are reads, writes, copies and the `host` of arrays, and kernels that return values or take NumPy arrays. Only the
    first access is: later ones undo an unfinished step. If something catches the error, it is raised again at the end.
    """
    refused: list[SimulationError] = []

    def refuse(what: str) -> None:
        if not refused:
            refused.append(SimulationError(f"{what} where only the device may work"))
            raise refused[0]

    def launched(signature: Signature) -> None:
        if signature.returned:
            refuse(f"the kernel '{signature.kernel}' returns a value to the host")
        if signature.host_arrays:
            refuse(f"the kernel '{signature.kernel}' takes a NumPy array")

    def accessed(kind: str, array: Array) -> None:
        if kind != FILLS:
            name = f"the array '{array.name}'" if array.name else "an array"
            refuse(f"the host accesses {name} ({kind})")

    with _watched(launched, lambda signature: None, accessed):
        yield
    if refused:
        raise refused[0]


@contextlib.contextmanager
def intercepted(run: Callable[[str, Callable[[], Any]], Any]) -> Iterator[None]:
    """Context in which run(path, launch) stands for each launch: it calls launch() and returns its result.

    path: module and name of the kernel. A first launch with new records is prepared, and its kernel compiled, before `run`.
    """
    plain, was_watched = Compiled.launch, Kernels.watched

    def launch(self, bound, arguments):
        return run(self.path, functools.partial(plain, self, bound, arguments))

    try:
        Compiled.launch = launch
        Kernels.watch(True)
        yield
    finally:
        Kernels.watch(was_watched)
        Compiled.launch = plain


@contextlib.contextmanager
def _watched(launched: Callable, compiled: Callable, accessed: Callable) -> Iterator[None]:
    """Context that calls launched(signature) and accessed(kind, array) before these happen, compiled(signature) afterwards."""
    plain = {(owner, name): vars(owner)[name] for owner, name in ((Compiled, "launch"), (Compiled, "__init__"))}
    plain |= {(Array, name): vars(Array)[name] for name in ACCESSES}

    def launch(self, bound, arguments):
        launched(self.signature)
        return plain[Compiled, "launch"](self, bound, arguments)

    def compile_(self, *arguments):
        plain[Compiled, "__init__"](self, *arguments)
        compiled(self.signature)

    watching = {(Compiled, "launch"): launch, (Compiled, "__init__"): compile_}
    watching |= {(Array, name): _watching(plain[Array, name], kind, accessed) for name, kind in ACCESSES.items()}
    was_watched = Kernels.watched
    try:
        for (owner, name), attribute in watching.items():
            setattr(owner, name, attribute)
        Kernels.watch(True)
        yield
    finally:
        Kernels.watch(was_watched)
        for (owner, name), attribute in plain.items():
            setattr(owner, name, attribute)


def _watching(plain: Any, kind: str, accessed: Callable) -> Any:
    """The method or property of an array that calls accessed(kind, array) first."""

    def access(array, *arguments):
        accessed(kind, array)
        return plain(array, *arguments) if callable(plain) else plain.__get__(array)

    return access if callable(plain) else property(access)
