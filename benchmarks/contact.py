"""Contact: solvers beside each other on the problems of whole scenes, colourings, the cost of steps, problems of rigid scenes.

taisoft bench contact [--quick] [--arch cpu|cuda] [--out FILE.json] [--plot FILE.png]
taisoft bench contact --capture DIR [--baseline FOLDER] [--only SCENE] [--quick]
taisoft bench contact --replay DIR [--baseline FOLDER] [--only SCENE] [--out FILE.json]
taisoft bench contact --drops [--baseline FOLDER] [--only SCENE] [--out FILE.json] [--quick]
taisoft bench contact --free [--baseline FOLDER] [--only CASE] [--out FILE.json] [--quick]

Scenes are demos, in f32; figures named are those of the report. Of each frame of an explicit run the contact problem is taken
where its solve would begin, and solved to a residual of 1e-4 by every solver, in turns, from the impulses of the step before and
from none. The residual told is worked out in NumPy. A solve's time holds its colouring; a solver's loops run on one thread on the
CPU, or, where that is said, on all. A number is a median, its range in brackets; spread is the distance between the quartiles
over the median. Compiling is apart. Exit status: 0, or 1 where a limit is not met. --quick has one scene, few frames, and no
limit.
The whole takes about six minutes on two cores.

--capture runs twelve scenes and keeps the states before every fifth of their implicit steps and before the ten slowest; --replay
solves each of them again, in f32 and f64, to 1e-4, and in halves where that does not converge, and compares with the same step
solved to 1e-8 (errors over the mean surface edge). --baseline: another version's folder, which captures the states, or solves
them beside this one. N: Newton iterations of the first try, which are assemblies of the matrix; launches and ms: of all tries.
Scenes whose meshes are not there are left out. Capturing takes about ten minutes, replaying ten a version.

--drops runs bodies that fall and come to rest, among them four real meshes: Newton and CG iterations a step, steps that did not
converge, and times, beside those of the older version. It takes two minutes, with version 0.1 beside it six.

--free takes steps without contacts, of beams with and without inverted tets, and solves statics, versions in turns; told are the
steps and solves that converge in every version. It takes two minutes, with version 0.1 beside it six.
"""

import argparse
import sys
from pathlib import Path

from taisoft.backend.runtime import compile_clock, open_runtime
from taisoft.timing import load_average

from . import contact_problems
from .contact_captured import GOAL, Solvers
from .contact_colours import QUICK_SEEDS, SEEDS, colour_all, colour_table
from .contact_crossover import QUICK_SIZES, SIZES, crossover_table, crossover_text, measure_crossover
from .contact_drops import DROPS
from .contact_drops_table import drops
from .contact_free_table import NAMES
from .contact_free_table import measure as measure_free
from .contact_plot import Snapshot, draw, take_snapshot
from .contact_replay import capture, replay
from .contact_runs import measure_film, measure_run, measure_step, open_explicit, open_scene, to_impulses
from .contact_states import SCENES
from .contact_table import PILE, PILE_SECONDS, count_table, find_limits, problem_table, run_table, solver_table, step_table
from .document import Document, header
from .elasticity_table import limit_table
from .order import parse_options

DEMOS = ("cube_on_box", "two_cubes_two_boxes")  # figures 20 and 19
FRAMES, QUICK_FRAMES = 90, 6
STEPS, QUICK_STEPS = 400, 40
RUN_SECONDS, QUICK_RUN_SECONDS = 2.0, 0.4
QUICK_PROBLEMS, REPEATS = ("Rover1039", "Rover4396"), 3


def measure(quick: bool, arch: str, document: Document) -> tuple[dict, list[Snapshot]]:
    """Everything, printed as it comes, by name; and what is drawn of the scenes."""
    found: dict = {"films": [], "steps": [], "runs": [], "colourings": []}
    snapshots = [_explicit(name, quick, arch, found) for name in DEMOS[: 1 if quick else None]]
    document.add(f"## Explicit steps (figs. 19, 20)\n\n{count_table(found['films'])}\n\n{solver_table(found['films'])}")
    document.add(f"## The whole explicit step\n\n{step_table(found['steps'])}")
    for name, seconds in [(s.scene, QUICK_RUN_SECONDS if quick else RUN_SECONDS) for s in snapshots]:
        with open_scene(name, arch) as sim:
            found["runs"].append(measure_run(name, sim, seconds))
    if not quick:
        with open_scene(PILE, arch) as sim:
            found["runs"].append(measure_run(PILE, sim, PILE_SECONDS))
            found["colourings"] += colour_all(PILE, sim._dynamics.contact.problem, SEEDS)[0]
    document.add(f"## Implicit steps\n\n{run_table(found['runs'])}")
    document.add(f"## Colours (fig. 19)\n\n{colour_table(found['colourings'])}")
    runtime = open_runtime(arch, "f32", "the benchmark of contacts")
    try:
        found["crossover"] = measure_crossover(QUICK_SIZES if quick else SIZES, runtime)
    finally:
        runtime.close()
    table, text = crossover_table(found["crossover"]), crossover_text(found["crossover"], arch)
    document.add(f"## Serial and coloured Gauss-Seidel\n\n{table}\n\n{text}")
    found["problems"] = _problems(quick, document)
    return found, snapshots


def _explicit(name: str, quick: bool, arch: str, found: dict) -> Snapshot:
    """Film, step and colourings of a scene, all with one simulator."""
    with open_explicit(name, arch) as sim:
        solvers = Solvers(threads=not quick)
        found["films"].append(measure_film(name, sim, QUICK_FRAMES if quick else FRAMES, solvers))
        to_impulses(sim)
        colourings, colours = colour_all(name, sim._dynamics.contact.problem, QUICK_SEEDS if quick else SEEDS)
        found["colourings"] += colourings
        snapshot = take_snapshot(name, sim, colours)
        found["steps"].append(measure_step(name, sim, QUICK_STEPS if quick else STEPS))
    return snapshot


def _problems(quick: bool, document: Document) -> list[contact_problems.Row]:
    names = QUICK_PROBLEMS if quick else tuple(contact_problems.YARDSTICK)
    document.add("## Contact problems of rigid scenes, f64 on the processor")
    if absent := contact_problems.missing(names):
        document.add(f"Left out: {absent}.")
        return []
    rows = contact_problems.measure(names, 1 if quick else REPEATS)
    document.add(f"{problem_table(rows)}\n\n{contact_problems.summary(rows)}")
    return rows


def replay_states(options: argparse.Namespace) -> int:
    """Solve captured states again, and compare. Exit status."""
    document, (text, numbers) = Document(), header("Captured steps with contacts", options.arch)
    document.add(text)
    found, limits = replay(options.replay, options.baseline, options.only, document)
    if options.out:
        document.write(options.out, numbers | {"rows": found, "limits": [limit.record() for limit in limits]})
    return 0 if all(limit.met for limit in limits) else 1


def run_whole(options: argparse.Namespace) -> int:
    """Run whole scenes, and compare. Exit status."""
    title, run = ("Bodies that fall in implicit steps", drops) if options.drops else ("Without contacts", measure_free)
    document, (text, numbers) = Document(), header(title, options.arch, "f32")
    document.add(text)
    found, limits = run(options.baseline, options.only, options.quick, document)
    if options.out:
        document.write(options.out, numbers | {"runs": found, "limits": [limit.record() for limit in limits]})
    return 0 if all(limit.met for limit in limits) else 1


def main(argv=None) -> int:
    """Measure and print. Raises OutputError, or SimulationError where the arch cannot be had."""
    first, _, rest = __doc__.partition("\n")
    parser = argparse.ArgumentParser(prog="taisoft bench contact", description=first, epilog=rest.partition("\n\n")[2])
    parser.add_argument("--quick", action="store_true", help="one scene, few frames and sizes, no limit")
    parser.add_argument("--capture", type=Path, metavar="DIR", help="keep states of implicit steps with contacts")
    parser.add_argument("--replay", type=Path, metavar="DIR", help="solve such states again")
    parser.add_argument("--drops", action="store_true", help="run bodies that fall in implicit steps")
    parser.add_argument("--free", action="store_true", help="take steps without contacts, and solve statics")
    parser.add_argument("--baseline", type=Path, metavar="FOLDER", help="another version")
    parser.add_argument("--only", action="append", metavar="SCENE", help="one of those scenes alone; repeatable")
    options = parse_options(parser, argv, "the report's figures 19 and 20")
    known = DROPS if options.drops else NAMES if options.free else SCENES
    if unknown := [name for name in options.only or () if name not in known]:
        parser.error(f"argument --only: '{unknown[0]}' is none of {', '.join(known)}")
    if options.capture:
        for line in capture(options.capture, options.baseline, options.only, options.quick):
            print(line, flush=True)
        return 0
    if options.replay:
        return replay_states(options)
    if options.drops or options.free:
        return run_whole(options)
    document, (text, numbers) = Document(), header("Contact", options.arch, "f32")
    document.add(text)
    compiled = compile_clock()
    found, snapshots = measure(options.quick, options.arch, document)
    numbers |= {"arch": options.arch, "quick": options.quick, "load_at_the_end": load_average()}
    numbers["compile_seconds"] = compile_clock() - compiled
    document.add(f"Compiling in all: {numbers['compile_seconds']:.0f} s; load at the end: {numbers['load_at_the_end'] or 0:.1f}")
    limits = [] if options.quick else find_limits(found, GOAL)
    if limits:
        document.add("## Limits\n\n" + limit_table(limits))
    if options.out:
        numbers |= {name: [x.record() for x in some] for name, some in found.items()}
        numbers["limits"] = [limit.record() for limit in limits]
        document.write(options.out, numbers)
    if options.plot:
        draw(found, snapshots, options.plot)
        print(f"written: {options.plot}")
    return 0 if all(limit.met for limit in limits) else 1


if __name__ == "__main__":
    sys.exit(main())
