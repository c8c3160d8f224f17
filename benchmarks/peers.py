"""The works W1 to W4 in taisoft, MuJoCo, PyBullet and Newton: time against error, and stability of stacks.

taisoft bench peers [--work KEY] [--program NAME] [--arch cpu|cuda] [--rounds N] [--quick] [--out [FILE.json]]

W1 is a hanging beam (three meshes; the coarse one also with 1e8 and 1e9 Pa), W2 a cube that drops on the ground, W3 three cubes
that fall on each other, W4 a cube that drops on a clamped sheet (benchmarks/works/scenes.py). All programs get the same nodes
and tets. W1 and W2 are compared with the exact path of each program's own law and masses: the largest position error over the
excursion, or the root mean square error of the mass centre's height over the drop of 0.5 m. W3 and W4 must stand for one second:
no body falls, leans, inverts a tet or penetrates by 1 % of an edge (the smallest of the bodies' mean edges), and until something
reaches the last body it falls freely to within 20 % ("free fall" is 1). taisoft evaluates the positions of every program every
10 ms. taisoft uses all cores if that is faster, the others one core. Times exclude building and compilation. A setting that takes
more than 10 s, or more than 20 s to build, is measured in one round. MuJoCo is release 4.0.1 (package mujoco-core) or later:
in 4.0.0 its solver "Newton" factorises sparse Hessians with elliptic cones wrongly, and older releases double the first Lamé
parameter of a flex. MuJoCo's `passive` contact has no friction, all other contact has. A second
table lists other settings that were tried (benchmarks/programs/tried.py). The exit status is 0 also if limits are not met. With
--work the other works in FILE.json are kept. A full run takes about 35 minutes on two cores.
"""

import sys
from collections.abc import Iterable
from types import ModuleType

from taisoft.files import write_bytes
from taisoft.machine import Timing, load_average
from taisoft.output.tables import require_matplotlib

from .document import Document, again_text, compact_text, earlier_numbers, header, limit_table, load_text, plain
from .programs import mujoco_flex, newton_works, own, pybullet_soft
from .programs.tried import TRIED, VERSIONS
from .runner import add_arch, add_named_out, make_parser, named_out
from .works.runs import Row, measure, row_of
from .works.scenes import WORKS, Work
from .works.table import compare_table, comparisons, draw, implicit_table, limits_of, run_table, tried_table

PROGRAMS = (own, mujoco_flex, pybullet_soft, newton_works)
QUICK = ("W1 12x3x3", "W2")
ROUNDS = 3


def opening(arch: str, programs: list[ModuleType]) -> tuple[str, dict]:
    """Header with the missing programs, as text and as data."""
    packages = ("taichi", "mujoco-core", "pybullet", "newton", "warp-lang", "numpy")
    text, numbers = header("Speed against error, beside other programs", arch, packages=packages)
    text += "\n\n" + __doc__.partition("\n\n")[2].partition("\n\n")[2].strip()
    left_out = {program.NAME: problem for program in programs if (problem := program.problem())}
    text += "".join(f"\n\n{name} is left out: {problem}." for name, problem in left_out.items())
    return text, numbers | {"arch": arch, "left_out": left_out}


def page(text: str, found: list[list[Row]], document: Document) -> dict:
    """Add the tables of all works. Returns their numbers."""
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
    """Rows by key of the works that are not measured now, from an earlier run on the same machine."""
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
    """Measure and print. Returns the numbers and the rows of each work. earlier: numbers of a run whose other works are kept."""
    text, numbers = opening(arch, programs)
    here = [program for program in programs if program.NAME not in numbers["left_out"]]
    rows = kept_rows(earlier, works, numbers)
    for work in works:
        rows[work.key] = measure(work, here, rounds, arch)
    found = [rows[work.key] for work in WORKS if work.key in rows]
    numbers |= {"quick": rounds < ROUNDS or len(here) < len(PROGRAMS)}  # the manual ignores quick results
    numbers |= page(text, found, document)
    document.add(again_text(earlier, times_of(rows[work.key] for work in works), numbers))
    document.add(f"Load at the end: {load_text(load_average())}")
    return numbers | {"times": plain(times_of(found))}, found


def times_of(works: Iterable[list[Row]]) -> dict[str, Timing]:
    """Timings of all rows, by name."""
    return {f"{row.work.key}: {row}": row.timing for rows in works for row in rows if row.timing is not None}


def main(argv=None) -> int:
    """Measure and print. Raises OutputError, or SimulationError where the arch is not available."""
    parser = make_parser("peers", __doc__)
    parser.add_argument("--work", metavar="KEY", help=f"only works with this prefix: {', '.join(work.key for work in WORKS)}")
    names = [program.NAME for program in PROGRAMS]
    parser.add_argument("--program", choices=names[1:], action="append", help="only taisoft and this program; repeatable")
    add_arch(parser)
    parser.add_argument("--rounds", type=int, default=ROUNDS, help="rounds over all settings (default %(default)s)")
    parser.add_argument("--quick", action="store_true", help=f"only {' and '.join(QUICK)}, one round")
    add_named_out(parser, "FILE.json, FILE.md and FILE.png")
    options = parser.parse_args(argv)
    works = [work for work in WORKS if work.key.startswith(options.work or "") and (not options.quick or work.key in QUICK)]
    if not works:
        parser.error(f"no work begins with {options.work!r}")
    out = named_out(options, "peers")
    if out is not None:
        require_matplotlib("--out")
    programs = [one for one in PROGRAMS if one is own or not options.program or one.NAME in options.program]
    document = Document()
    rounds = 1 if options.quick else options.rounds
    numbers, found = run(works, programs, options.arch, rounds, document, earlier_numbers(out))
    if out is not None:
        write_bytes(out, compact_text(numbers).encode())
        picture = f"\n![]({out.stem}.png)\n" if any(rows[0].work.kind == "path" for rows in found) else ""
        write_bytes(out.with_suffix(".md"), f"{document.text()}{picture}".encode())
        draw(found, out.with_suffix(".png"))
        print(f"written: {out}, {out.with_suffix('.md').name} and, where a path is known, {out.with_suffix('.png').name}")
    return 0


if __name__ == "__main__":
    sys.exit(main())
