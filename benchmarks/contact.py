"""Contact: solvers on the problems of whole scenes, colourings, cost of steps, real meshes, problems of rigid scenes.

taisoft bench contact [--quick] [--arch cpu|cuda] [--out FILE.json]

Scenes are demos, in f32, and real meshes that fall to the ground: assets/bunny.msh, and those of ../shared/meshes where it is.
Figure numbers are those of the report, of which `taisoft bench report` judges claims by these numbers. In each frame of an
explicit run every solver solves the contact problem in turn to a residual of 1e-4, from the impulses of the previous step.
Residuals are computed in NumPy. A solve's time includes its colouring and excludes compilation; loops run on one CPU thread,
those of coloured Gauss-Seidel on plates on all. What steps spend is explained in benchmarks/kinds.py. Numbers are medians with
their range in brackets; spread is the interquartile range over the median. Exit status: 0, or 1 if a limit is not met. --quick
has few scenes and frames, and no limits. A full run takes about eight minutes on two cores.
"""

import sys
from contextlib import closing
from itertools import product

import numpy as np

from taisoft.backend.runtime import compile_clock, open_runtime
from taisoft.machine import load_average, summarise

from . import contact_problems
from .contact_colouring import (
    QUICK_SEEDS,
    QUICK_SIZES,
    SEEDS,
    SIZES,
    colour_all,
    colour_table,
    crossover_table,
    crossover_text,
    measure_crossover,
)
from .contact_colouring import SCENE as COLOURED
from .contact_runs import (
    EXPLICIT,
    GOAL,
    SERIAL,
    Film,
    Profile,
    Run,
    measure_film,
    measure_run,
    measure_steps,
    open_demo,
    open_drop,
    real_meshes,
    to_impulses,
)
from .document import Document, Limit, begin, ms, ranged, table, timed_cells, timed_limit
from .kinds import KINDS
from .runner import make_parser, parse_options

DEMOS = ("cube_on_box", "two_cubes_two_boxes")  # figures 20 and 19
FRAMES, QUICK_FRAMES = 90, 6
STEPS, QUICK_STEPS = 400, 40
SETTLE = 60  # steps after the first impulse until cubes rest on their boxes
RUN_SECONDS, QUICK_RUN_SECONDS = 2.0, 0.4
SHEET = "sheet_and_cube"  # demonstration 3 of the report
STABLE = 0.9  # of the sheet's largest stable step
SHEET_STEPS = {"symplectic_euler": (400, 60), "implicit_euler": (120, 20)}  # of a full and a quick run
GEOMETRIES = ("distance_field", "proximity")  # the first, in explicit steps, is the report's
DROP_SECONDS, QUICK_DROP_SECONDS = 1.0, 0.2
QUICK_PROBLEMS, REPEATS = ("Rover1039", "Rover4396"), 3
CONTACTS = {"cube_on_box": 198, "two_cubes_two_boxes": 286}  # in the report's figures 20 and 19
STEP_SCENE, STEP_LIMIT = "cube_on_box", 2.0  # [ms] an explicit step, f32, to a residual of GOAL
PILE, PILE_LIMIT = "cube_pile", 3.0  # wall seconds per simulated second
SWEEP_LIMIT = 0  # problems of the films that the default CPU solver leaves above GOAL


def measure(quick: bool, arch: str, document: Document) -> dict:
    """Measure and print everything; results by name."""
    found: dict = {"films": [], "steps": [], "runs": [], "drops": [], "colourings": []}
    demos = DEMOS[: 1 if quick else None]
    for name in demos:
        with open_demo(name, arch, **EXPLICIT) as sim:
            found["films"].append(measure_film(name, sim, QUICK_FRAMES if quick else FRAMES))
            found["steps"].append(measure_steps(name, sim, QUICK_STEPS if quick else STEPS))
    found["steps"] += _sheet_steps(quick, arch)
    document.add(f"## Explicit steps (figs. 19, 20)\n\n{count_table(found['films'])}\n\n{solver_table(found['films'])}")
    document.add(f"## Whole steps (fig. 10)\n\n{step_table(found['steps'])}\n\n{kind_table(found['steps'])}")
    for name in (*demos, *(() if quick else (PILE,))):
        with open_demo(name, arch) as sim:
            found["runs"].append(measure_run(name, sim, QUICK_RUN_SECONDS if quick else RUN_SECONDS))
            if name == PILE:
                found["colourings"] += colour_all(name, sim._dynamics.contact.problem, SEEDS)[0]
    document.add(f"## Implicit steps\n\n{run_table(found['runs'])}")
    for name, path in list(real_meshes().items())[: 1 if quick else None]:
        with open_drop(path, arch) as sim:
            found["drops"].append(measure_run(name, sim, QUICK_DROP_SECONDS if quick else DROP_SECONDS))
    document.add(f"## Real meshes that fall to the ground\n\n{run_table(found['drops'])}")
    for refine in (0,) if quick else (0, 1):
        with open_demo(COLOURED, arch, refine or None, **EXPLICIT) as sim:
            to_impulses(sim)
            for _ in range(SETTLE):
                sim.step()
            name = f"{COLOURED}, refined" if refine else COLOURED
            colourings, touching = colour_all(name, sim._dynamics.contact.problem, QUICK_SEEDS if quick else SEEDS)
            found["colourings"] += colourings
            found.setdefault("touching", touching)
    document.add(f"## Colours (fig. 19)\n\n{colour_table(found['colourings'])}")
    with closing(open_runtime(arch, "f32", "the benchmark of contacts")) as runtime:
        found["crossover"] = measure_crossover(QUICK_SIZES if quick else SIZES, runtime)
    table, text = crossover_table(found["crossover"]), crossover_text(found["crossover"], arch)
    document.add(f"## Serial and coloured Gauss-Seidel\n\n{table}\n\n{text}")
    found["problems"] = _problems(quick, document)
    return found


def _sheet_steps(quick: bool, arch: str) -> list[Profile]:
    """Steps of the sheet, explicit ones near their limit and the demo's own, with each geometry."""
    found = []
    for integrator, geometry in list(product(SHEET_STEPS, GEOMETRIES))[: 1 if quick else None]:
        settings = {"dt": 1e-6, "integrator": integrator} if integrator == EXPLICIT["integrator"] else {}
        with open_demo(SHEET, arch, geometry=geometry, **settings) as sim:
            if settings:
                sim.dt = STABLE * sim.stable_dt
            found.append(measure_steps(SHEET, sim, SHEET_STEPS[integrator][quick]))
    return found


def _problems(quick: bool, document: Document) -> list[contact_problems.Row]:
    names = QUICK_PROBLEMS if quick else tuple(contact_problems.YARDSTICK)
    document.add("## Contact problems of rigid scenes, f64 on the processor")
    if absent := contact_problems.missing(names):
        document.add(f"Left out: {absent}.")
        return []
    rows = contact_problems.measure(names, 1 if quick else REPEATS)
    document.add(f"{contact_problems.row_table(rows)}\n\n{contact_problems.summary(rows)}")
    return rows


# --- tables and limits --------------------------------------------------------------------------------------------------


def count_table(films: list[Film]) -> str:
    """Contacts of each film and of the report."""
    columns = (
        ("<scene", "{.scene}"),
        ("tets", "{.tets}"),
        ("dt [ms]", lambda f: ms(f.dt)),
        ("stable [ms]", lambda f: ms(f.stable_dt)),
        ("frames", lambda f: str(len(f.time))),
        ("contacts", lambda f: ranged(f.contacts)),
        ("before reduction", lambda f: ranged(f.found)),
        ("the report's", lambda f: str(CONTACTS.get(f.scene, "-"))),
        ("fewer by", lambda f: f"{1 - np.median(f.contacts) / CONTACTS[f.scene]:.0%}" if f.scene in CONTACTS else "-"),
    )
    return table(films, columns)


def solver_table(films: list[Film]) -> str:
    """A row per scene and solver: medians over frames, and the worst."""
    rows = [(film, solver, found) for film in films for solver, found in film.outcomes.items()]
    columns = (
        ("<scene", "{[0].scene}"),
        ("<solver", "{[1]}"),
        ("sweeps", lambda row: ranged([o.sweeps for o in row[2]])),
        ("ms", lambda row: timed_cells(o.median for o in row[2])[0]),
        ("spread", lambda row: timed_cells(o.median for o in row[2])[1]),
        ("maximum", lambda row: ms(max(o.median for o in row[2]))),
        ("worst residual", lambda row: f"{max(o.residual for o in row[2]):.1e}"),
        ("not solved", lambda row: f"{row[0].missed(row[1])} of {len(row[2])}"),
    )
    return table(rows, columns)


def run_table(runs: list[Run]) -> str:
    """A row per implicit run: medians over steps with contacts; problems below."""
    columns = [("<scene", "{.scene}"), ("tets", "{.tets:,}"), ("<steps", "{.settings}")]
    columns.append(("with contacts", lambda r: str(len(r.seconds))))
    counts = (("contacts", "contacts"), ("multipliers", "outer"), ("Newton", "newton"), ("CG", "linear"))
    columns += [(heading, lambda r, name=name: ranged(getattr(r, name))) for heading, name in counts]
    columns += [
        ("ms", lambda r: timed_cells(r.seconds)[0] if r.seconds else "-"),
        ("spread", lambda r: timed_cells(r.seconds)[1] if r.seconds else "-"),
        ("wall s per simulated s", lambda r: f"{r.wall / r.simulated:.3g}" if r.simulated else "-"),
        ("status", "{.status}"),
    ]
    return table(runs, columns, [f"{r.scene}: {text}" for r in runs for text in r.problems])


STEPS_OF = (("<scene", "{.scene}"), ("<steps", "{.integrator}"), ("<geometry", "{.geometry}"))


def step_table(profiles: list[Profile]) -> str:
    """Medians of whole steps."""
    columns = (
        *STEPS_OF,
        ("dt [ms]", lambda p: ms(p.dt)),
        ("steps", lambda p: str(len(p.whole))),
        ("contacts", lambda p: ranged(p.contacts)),
        ("sweeps", lambda p: ranged(p.sweeps)),
        ("worst residual", "{.residual:.1e}"),
        ("step [ms]", lambda p: timed_cells(p.whole)[0]),
        ("spread", lambda p: timed_cells(p.whole)[1]),
    )
    return table(profiles, columns)


def kind_table(profiles: list[Profile]) -> str:
    """What mean steps spend by kind."""
    kinds = [kind for kind in KINDS if any(kind in p.kinds for p in profiles)]
    return table(profiles, (*STEPS_OF, *((f"{kind} [ms]", lambda p, kind=kind: ms(p.kinds.get(kind, 0.0))) for kind in kinds)))


def find_limits(found: dict) -> list[Limit]:
    """Limits on a step, the pile, the solves of the films and the verdicts of problems. found: see `measure`."""
    cost = next((c for c in found["steps"] if c.scene == STEP_SCENE), None)
    t = summarise(cost.whole) if cost else None
    pile = next((r for r in found["runs"] if r.scene == PILE), None)
    wall = pile.wall / pile.simulated if pile and pile.simulated else np.nan
    bad = np.nan if pile is None else float(pile.status != "ok")
    missed = sum(film.missed(SERIAL) for film in found["films"]) if found["films"] else np.nan
    limits = [
        timed_limit(f"{STEP_SCENE}, explicit, f32: a whole step [ms], median of {t.repeats if t else 0}", t, STEP_LIMIT, 1e3),
        Limit(f"{STEP_SCENE}, explicit: the worst residual of these steps", cost.residual if cost else np.nan, GOAL),
        Limit(f"{PILE}, {pile.settings if pile else 'implicit'}, f32: wall s per simulated s", wall, PILE_LIMIT),
        Limit(f"{PILE}: runs that do not end ok", bad, 0),
        Limit(f"films: solves of gauss_seidel above {GOAL:g}, residuals by NumPy", missed, SWEEP_LIMIT),
    ]
    if found["problems"]:
        limits.append(Limit("contact problems: verdicts that fail", sum("FAIL" in row.verdict for row in found["problems"]), 0))
    return limits


def main(argv=None) -> int:
    """Measure and print. Raises OutputError, or SimulationError if the arch is not available."""
    parser = make_parser("contact", __doc__)
    parser.add_argument("--quick", action="store_true", help="one scene, few frames and sizes, no limits")
    options = parse_options(parser, argv)
    document, numbers = begin("Contact", options.arch, "f32")
    compiled = compile_clock()
    found = measure(options.quick, options.arch, document)
    numbers["compile_seconds"] = compile_clock() - compiled
    document.add(f"Compiling in all: {numbers['compile_seconds']:.0f} s; load at the end: {load_average() or 0:.1f}")
    limits = [] if options.quick else find_limits(found)
    return document.finish(options, numbers | found, limits)


if __name__ == "__main__":
    sys.exit(main())
