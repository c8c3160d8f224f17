"""The works W1 to W4 in taisoft, MuJoCo, PyBullet and Newton: time against error, and stability of stacks.

taisoft bench peers [--only NAME ...] [--program NAME] [--rounds N] [--quick] [--arch cpu|cuda] [--budget SECONDS] [--keep DIR]
                    [--out [FILE.json]]

W1 is a hanging beam (three meshes; the coarse one also with 1e8 and 1e9 Pa), W2 a cube that drops on the ground, W3 three cubes
that fall on each other, W4 a cube that drops on a clamped sheet (benchmarks/works/scenes.py). All programs get the same nodes
and tets. W1 and W2 are compared with the exact path of each program's own law and masses: the largest position error over the
excursion, or the root mean square error of the mass centre's height over the drop of 0.5 m. W3 and W4 must stand for one second:
no body falls, leans, inverts a tet or penetrates by 1 % of an edge (the smallest of the bodies' mean edges), and until something
reaches the last body it falls freely to within 20 % ("free fall" is 1). taisoft evaluates the positions of every program every
10 ms. taisoft uses all cores if that is faster, the others one core. Times exclude building and compilation. A setting that takes
more than 10 s, or more than 20 s to build, is measured in one round. MuJoCo is release 4.0.1 (package mujoco-core) or later:
in 4.0.0 its solver "Newton" factorises sparse Hessians with elliptic cones wrongly, and older releases double the first Lamé
parameter of a flex. MuJoCo's `passive` contact has no friction, all other contact has. Each work is measured in a process of its
own. The exit status is 0 also if limits are not met. A full run takes about 35 minutes on two cores.
"""

import sys

from taisoft.machine import load_average
from taisoft.output.tables import require_matplotlib

from .document import begin, limit_table, load_text
from .programs import mujoco_flex, newton_works, own, pybullet_soft
from .programs.session import problem
from .suite import LEFT_OUT, chosen, runs_of, suite_options, suite_parser
from .works.runs import Row, measure, row_of
from .works.scenes import WORKS
from .works.table import compare_table, comparisons, draw, implicit_table, limits_of, run_table

PROGRAMS = {program.NAME: program for program in (own, mujoco_flex, pybullet_soft, newton_works)}
BY_KEY = {work.key: work for work in WORKS}
QUICK = ("W1 12x3x3", "W2")
ROUNDS = 3


def page(works: list[list[Row]]) -> tuple[list[str], dict]:
    """The parts of the page, the tables of all works, and the numbers of the last ones."""
    parts = []
    for rows in works:
        work = rows[0].work
        parts.append(f"## {work.key}: {work.title}, {work.tets:,} tets\n\nMeasured {rows[0].date}.\n\n{run_table(rows)}")
    compared, limits = comparisons(works), [limit for rows in works for limit in limits_of(rows)]
    parts.append(f"## The fastest of each at equal error\n\n{compare_table(compared)}")
    if any(rows[0].work.stiff for rows in works):
        parts.append(f"## Steps of 10 ms in the stiff beam; PyBullet has none but explicit ones\n\n{implicit_table(works)}")
    if limits:
        parts.append(f"## Limits\n\n{limit_table(limits)}")
    return parts, {"comparisons": compared, "limits": limits}


def answer(request: dict) -> dict:
    """In a child: the rows of a work."""
    programs = [PROGRAMS[name] for name in request["programs"]]
    return {"rows": [row.record() for row in measure(BY_KEY[request["work"]], programs, request["rounds"], request["arch"])]}


def main(argv=None) -> int:
    """Measure and print. Raises OutputError, or SimulationError where the arch is not available."""
    parser = suite_parser("peers", __doc__, f"only {' and '.join(QUICK)}, one round")
    parser.add_argument(
        "--program", choices=list(PROGRAMS)[1:], action="append", help="only taisoft and this program; repeatable"
    )
    parser.add_argument("--rounds", type=int, default=ROUNDS, help="rounds over all settings (default %(default)s)")
    options = suite_options(parser, argv, answer)
    wanted = {name: one for name, one in PROGRAMS.items() if one is own or not options.program or name in options.program}
    left_out = {name: why for name, program in wanted.items() if (why := problem(program))}
    settings = {"programs": [name for name in wanted if name not in left_out], "rounds": 1 if options.quick else options.rounds}
    asked = {key: {"work": key, "arch": options.arch} | settings for key in (QUICK if options.quick else BY_KEY)}
    requests = chosen(parser, options.only, asked)
    if options.out is not None:
        require_matplotlib("--out")
    packages = ("taichi", "mujoco-core", "pybullet", "newton", "warp-lang", "numpy")
    document, numbers = begin("Speed against error, beside other programs", f"arch {options.arch}", packages=packages)
    document.add(__doc__.partition("\n\n")[2].partition("\n\n")[2].strip())
    for name, why in left_out.items():
        document.add(f"{name} is left out: {why}.")
    with runs_of("peers", options, "peers.py", "exact_path.py", "programs/*.py", "works/*.py", "data/works.npz") as runs:
        records = zip(requests, runs.records(requests, lambda found: f"{len(found['rows'])} settings"))
        works = [[row_of(BY_KEY[key], row) for row in found["rows"]] for key, found in records if LEFT_OUT not in found]
    parts, found = page(works)
    drawn = options.out and any(rows[0].work.kind == "path" for rows in works)
    for text in (*parts, f"Load at the end: {load_text(load_average())}", *([f"![]({options.out.stem}.png)"] if drawn else [])):
        document.add(text)
    # the manual ignores quick results
    options.quick |= settings["rounds"] < ROUNDS or len(settings["programs"]) < len(PROGRAMS)
    options.plot = drawn and options.out.with_suffix(".png")
    rows = [row for rows in works for row in rows]
    return runs.finish(
        document, options, numbers | {"left_out": left_out, "runs": rows} | found, draw=lambda path: draw(works, path)
    )


if __name__ == "__main__":
    sys.exit(main())
