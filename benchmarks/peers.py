"""The works W1 to W4, taisoft beside MuJoCo, PyBullet and Newton: time against error, and what stands.

taisoft bench peers [--work KEY] [--program NAME] [--arch cpu|cuda] [--rounds N] [--quick] [--out [FILE.json]]

W1 is a beam that hangs from its end (three meshes; on the coarse one also 1e8 and 1e9 Pa), W2 a cube that drops on the ground, W3
three cubes that fall on each other, W4 a cube that drops on a clamped sheet (benchmarks/works/scenes.py). Everyone gets the
same nodes and tets. W1's and W2's errors are measured from the exact path of a program's own law and masses, at the largest in
position over the excursion, or the root mean square of the mass centre's height over the 0.5 m it drops. W3 and W4 are to
stand for a second: nothing falls or leans, turns inside out, or sinks in by 1 % of an edge (the least of the bodies' mean
ones), and the last body, until something reaches it, falls as freely as a stone, to 20 % of its way ("free fall" is 1), as
measured by taisoft in every program's positions every 10 ms. taisoft runs on as many threads as the machine has cores
where that pays, the others on one core. Times are without building and compiling. A setting that takes more than 10 s, or more
than 20 s to build, is measured in one round. MuJoCo's `passive` contact has no friction, everything else has. What else was
tried has a table of its own (benchmarks/programs/tried.py). Nothing here passes or fails: limits are marked as met or not.
With --work the other works of FILE.json are kept. The whole takes about 35 minutes on two cores.
"""

import argparse
import sys
from collections.abc import Iterable
from pathlib import Path
from types import ModuleType

from taisoft.files import write_bytes
from taisoft.machine import Timing, load_average
from taisoft.output.report import json_text
from taisoft.output.tables import require_matplotlib

from .document import (
    RESULTS,
    Document,
    again_text,
    check_out,
    default_out,
    earlier_numbers,
    header,
    limit_table,
    load_text,
    plain,
)
from .programs import mujoco_flex, newton_works, own, pybullet_soft
from .programs.tried import TRIED, VERSIONS
from .works.runs import Row, measure, row_of
from .works.scenes import WORKS, Work
from .works.table import compare_table, comparisons, draw, implicit_table, limits_of, run_table, tried_table

PROGRAMS = (own, mujoco_flex, pybullet_soft, newton_works)
QUICK = ("W1 12x3x3", "W2")
ROUNDS = 3


def opening(arch: str, programs: list[ModuleType]) -> tuple[str, dict]:
    """What is measured where, and which programs are missing, as text and as data."""
    packages = ("taichi", "mujoco", "pybullet", "newton", "warp-lang", "numpy")
    text, numbers = header("Speed against error, beside other programs", arch, packages=packages)
    text += "\n\n" + __doc__.partition("\n\n")[2].partition("\n\n")[2].strip()
    left_out = {program.NAME: problem for program in programs if (problem := program.problem())}
    text += "".join(f"\n\n{name} is left out: {problem}." for name, problem in left_out.items())
    return text, numbers | {"arch": arch, "left_out": left_out}


def page(text: str, found: list[list[Row]], document: Document) -> dict:
    """Write the tables of all works. Returns their numbers."""
    document.add(text)
    for rows in found:
        work = rows[0].work
        title = f"## {work.key}: {work.title}, {work.tets:,} tets"
        document.add(f"{title}\n\nMeasured {rows[0].date}.\n\n{run_table(rows)}")
    compared = comparisons(found)
    document.add(f"## The fastest of each at equal error\n\n{compare_table(compared)}")
    if any(rows[0].work.stiff for rows in found):
        document.add(f"## Steps of 10 ms in the stiff beam; PyBullet has none but explicit ones\n\n{implicit_table(found)}")
    limits = [limit for rows in found for limit in limits_of(rows)]
    if limits:
        document.add(f"## Limits\n\n{limit_table(limits)}")
    document.add(f"## What else was tried\n\nBy hand, with {VERSIONS}.\n\n{tried_table()}")
    rows = [row.record() for rows in found for row in rows]
    names = "program", "work", "what", "came_out"
    tried = [dict(zip(names, (program, *one))) for program, rows in TRIED.items() for one in rows]
    return {"runs": rows, "comparisons": compared, "limits": [limit.record() for limit in limits]} | {
        "tried": {"versions": VERSIONS, "settings": tried}
    }


def kept_rows(earlier: dict | None, works: list[Work], numbers: dict) -> dict[str, list[Row]]:
    """By key the rows that an earlier run on the same machine has of the works that are not measured now."""
    if earlier is None or any(earlier.get(name) != numbers[name] for name in ("processor", "cores", "arch")):
        return {}
    rows: dict[str, list[Row]] = {}
    anew = {work.key for work in works}
    left = {work.key: work for work in WORKS if work.key not in anew}
    for one in earlier["runs"]:
        if one["work"] in left:
            rows.setdefault(one["work"], []).append(row_of(left[one["work"]], one, earlier["date"]))
    return rows


def run(
    works: list[Work], programs: list[ModuleType], arch: str, rounds: int, document: Document, earlier: dict | None = None
) -> tuple[dict, list[list[Row]]]:
    """Everything, printed. Returns the numbers, and the rows of each work. earlier: numbers of an earlier run, whose other works
    are kept."""
    text, numbers = opening(arch, programs)
    here = [program for program in programs if program.NAME not in numbers["left_out"]]
    rows = kept_rows(earlier, works, numbers)
    for work in works:
        rows[work.key] = measure(work, here, rounds, arch)
    found = [rows[work.key] for work in WORKS if work.key in rows]
    numbers |= {"quick": rounds < ROUNDS or len(here) < len(PROGRAMS)}  # not for the manual
    numbers |= page(text, found, document)
    document.add(again_text(earlier, times_of(rows[work.key] for work in works), numbers))
    document.add(f"Load at the end: {load_text(load_average())}")
    return numbers | {"times": plain(times_of(found))}, found


def times_of(works: Iterable[list[Row]]) -> dict[str, Timing]:
    """By name, of all rows that have one."""
    return {f"{row.work.key}: {row}": row.timing for rows in works for row in rows if row.timing is not None}


def main(argv=None) -> int:
    """Measure and print. Raises OutputError, or SimulationError where the arch is not available."""
    first, _, rest = __doc__.partition("\n")
    parser = argparse.ArgumentParser(prog="taisoft bench peers", description=first, epilog=rest.partition("\n\n")[2])
    parser.add_argument("--work", metavar="KEY", help=f"only those that begin so: {', '.join(work.key for work in WORKS)}")
    names = [program.NAME for program in PROGRAMS]
    parser.add_argument("--program", choices=names[1:], action="append", help="only this one beside taisoft; may be repeated")
    parser.add_argument("--arch", choices=("cpu", "cuda"), default="cpu", help="where taisoft computes (default cpu)")
    parser.add_argument("--rounds", type=int, default=ROUNDS, help="rounds over all settings (default %(default)s)")
    parser.add_argument("--quick", action="store_true", help=f"only {' and '.join(QUICK)}, one round")
    parser.add_argument(
        "--out",
        type=Path,
        nargs="?",
        const=RESULTS,
        metavar="FILE.json",
        help="write FILE.json, FILE.md and FILE.png; without a name into benchmarks/results, named after the machine",
    )
    options = parser.parse_args(argv)
    works = [work for work in WORKS if work.key.startswith(options.work or "") and (not options.quick or work.key in QUICK)]
    if not works:
        parser.error(f"no work begins with {options.work!r}")
    out = options.out
    if out is not None:
        out = default_out(options.arch, "peers") if out == RESULTS else out
        check_out(out, ".json")
        require_matplotlib("--out")
    programs = [one for one in PROGRAMS if one is own or not options.program or one.NAME in options.program]
    document = Document()
    rounds = 1 if options.quick else options.rounds
    numbers, found = run(works, programs, options.arch, rounds, document, earlier_numbers(out))
    if out is not None:
        write_bytes(out, json_text(numbers).encode())
        picture = f"\n![]({out.stem}.png)\n" if any(rows[0].work.kind == "path" for rows in found) else ""
        write_bytes(out.with_suffix(".md"), f"{document.text()}{picture}".encode())
        draw(found, out.with_suffix(".png"))
        print(f"written: {out}, {out.with_suffix('.md').name} and, where a path is known, {out.with_suffix('.png').name}")
    return 0


if __name__ == "__main__":
    sys.exit(main())
