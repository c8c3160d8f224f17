"""Hard cases: what each must keep to, measured, pass or fail.

taisoft bench hard [--case NAME] [--arch cpu|cuda]

A row is a number that a case must keep to. Seconds include compiling. Exit status: 0 all passed, 1 some failed.
"""

import argparse
import sys
import time
from collections.abc import Callable, Iterable
from functools import partial

from . import hard_contact
from .reference_cases.record import Check, computed

CASES: dict[str, Callable[[str], Iterable[Check]]] = {
    "C1 slope": hard_contact.slope,
    "C2 stack, start 0": partial(hard_contact.stack, seed=0),
    "C2 stack, start 1": partial(hard_contact.stack, seed=1),
    "C3 inner edges": hard_contact.inner_edges,
    "C3 spike in a hole": hard_contact.spike_in_hole,
    "R2 stiffness ratio": hard_contact.stiffness_ratio,
    "T4 stiff cube, corotational": partial(hard_contact.stiff_cube, law=hard_contact.COR),
    "T4 stiff cube, neo-Hookean": partial(hard_contact.stiff_cube, law=hard_contact.SNH),
    "L2 rest": hard_contact.rest,
}
FORMAT = "{:28} {:64} {:>12} {:>9} {:>9} {:5} {:>7}"


def run(name: str, arch: str) -> list[Check]:
    """The checks of a case."""
    return computed(lambda: CASES[name](arch))


def main(argv=None) -> int:
    """Run the cases and print their table."""
    parser = argparse.ArgumentParser(prog="taisoft bench hard", description=__doc__.partition("\n")[0])
    parser.add_argument("--case", metavar="NAME", help=f"only those whose name begins so: {', '.join(CASES)}")
    parser.add_argument("--arch", choices=("cpu", "cuda"), default="cpu", help="where to compute (default cpu)")
    options = parser.parse_args(argv)
    names = [name for name in CASES if name.startswith(options.case or "")]
    if not names:
        parser.error(f"no case begins with {options.case!r}")
    print(FORMAT.format("case", "quantity", "measured", "error", "limit", "", "seconds"))
    failed = 0
    for name in names:
        start = time.perf_counter()
        checks = run(name, options.arch)
        seconds = f"{time.perf_counter() - start:.0f}"
        for check in checks:
            failed += not check.passed
            limit = "-" if check.limit is None else f"{check.limit:.1e}"
            numbers = f"{check.measured:.6g}", f"{check.error:.1e}", limit
            print(FORMAT.format(name, check.quantity, *numbers, check.verdict, seconds))
            seconds = ""
    print("all passed" if not failed else f"{failed} failed")
    return 1 if failed else 0


if __name__ == "__main__":
    sys.exit(main())
