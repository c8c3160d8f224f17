"""Tables of `contact.py`, and what is wanted beside what was measured."""

import math
from collections.abc import Sequence

import numpy as np

from taisoft.output.tables import markdown, percent, spread_of
from taisoft.timing import summarise

from .contact_problems import HEADINGS, Row
from .contact_runs import COLD, PARTS, REST, WARM, Film, Run, StepCost
from .elasticity_table import Limit

CONTACTS = {"cube_on_box": 198, "two_cubes_two_boxes": 286}  # of the report's figures 20 and 19
STEP_SCENE, STEP_LIMIT = "cube_on_box", 2.0  # [ms] an explicit step, f32, to a residual of GOAL
PILE, PILE_SECONDS, PILE_LIMIT = "cube_pile", 2.0, 3.0  # simulated; wall seconds per simulated second
SWEEP_LIMIT = 0  # problems of the films that the default solver of the CPU leaves above GOAL


def ranged(values: Sequence[float]) -> str:
    """Median, least and most."""
    return f"{np.median(values):g} ({min(values):g} to {max(values):g})" if len(values) else "-"


def _ms(seconds: float) -> str:
    return f"{1e3 * seconds:.3g}"


def count_table(films: list[Film]) -> str:
    """Contacts of each film beside those of the report."""
    lines = []
    for f in films:
        reported = CONTACTS.get(f.scene)
        fewer = "-" if reported is None else f"{1 - np.median(f.contacts) / reported:.0%}"
        step = f"{1e3 * f.dt:.3g}", f"{1e3 * f.stable_dt:.3g}"
        counts = ranged(f.contacts), ranged(f.found), str(reported or "-"), fewer
        lines.append((f.scene, f"{f.tets}", *step, f"{len(f.time)}", *counts))
    headings = ("scene", "tets", "dt [ms]", "stable [ms]", "frames", "contacts", "before reduction", "the report's", "fewer by")
    return markdown(headings, lines, left=(0,))


def solver_table(films: list[Film]) -> str:
    """A row a scene and solver: medians over frames, and the worst."""
    lines = []
    for f in films:
        for name in f.solvers:
            warm, cold = f.of(name), f.of(name, COLD)
            t = summarise(o.median for o in warm)
            sweeps = ranged([o.sweeps for o in warm]), ranged([o.sweeps for o in cold])
            times = _ms(t.median), percent(spread_of(t)), _ms(t.maximum), _ms(np.median([o.median for o in cold]))
            residual = max(o.residual for o in warm + cold)
            lines.append((f.scene, name, *sweeps, *times, f"{residual:.1e}", f"{f.missed([name])} of {2 * len(warm)}"))
    headings = ("scene", "solver", f"sweeps {WARM}", COLD, f"ms {WARM}", "spread", "most", COLD, "worst residual", "not solved")
    return markdown(headings, lines, left=(0, 1))


def run_table(runs: list[Run]) -> str:
    """A row an implicit run: medians over steps with contacts; problems below."""
    lines = []
    for r in runs:
        t = summarise(r.seconds) if r.seconds else None
        times = ("-", "-") if t is None else (_ms(t.median), percent(spread_of(t)))
        counts = (ranged(x) for x in (r.contacts, r.outer, r.newton, r.linear))
        wall = f"{r.wall / r.simulated:.3g}" if r.simulated else "-"
        lines.append((r.scene, r.settings, f"{len(r.seconds)}", *counts, *times, wall, r.status))
    headings = (
        "scene",
        "steps",
        "with contacts",
        "contacts",
        "multipliers",
        "Newton",
        "CG",
        "ms",
        "spread",
        "wall s per simulated s",
        "status",
    )
    notes = [f"* {r.scene}: {text}" for r in runs for text in r.problems]
    return markdown(headings, lines, left=(0, 1)) + ("\n\n" + "\n".join(notes) if notes else "")


def step_table(costs: list[StepCost]) -> str:
    """Whole explicit steps and their parts, medians."""
    lines = []
    for c in costs:
        t = summarise(c.whole)
        parts = (_ms(np.median(c.parts[part])) for part in (*PARTS, REST))
        counts = f"{len(c.whole)}", ranged(c.contacts), ranged(c.sweeps), f"{c.residual:.1e}"
        lines.append((c.scene, c.solver, *counts, _ms(t.median), percent(spread_of(t)), *parts))
    headings = (
        "scene",
        "solver",
        "steps",
        "contacts",
        "sweeps",
        "worst residual",
        "step [ms]",
        "spread",
        *(f"{part} [ms]" for part in (*PARTS, REST)),
    )
    return markdown(headings, lines, left=(0, 1))


def problem_table(rows: list[Row]) -> str:
    """A row a problem and solver of `contact_problems`."""
    return markdown(HEADINGS, [row.cells for row in rows], left=(0, 2, 9))


def find_limits(found: dict, goal: float) -> list[Limit]:
    """What is wanted of a step, of the pile, of the films' solves and of the problems' verdicts. found: see `contact.measure`."""
    limits = []
    cost = next((c for c in found["steps"] if c.scene == STEP_SCENE), None)
    t = summarise(cost.whole) if cost else None
    what = f"{STEP_SCENE}, explicit, f32: a whole step [ms], median of {t.repeats if t else 0}"
    limits.append(Limit(what, 1e3 * t.median if t else math.nan, STEP_LIMIT, spread_of(t) if t else None))
    residual = cost.residual if cost else math.nan
    limits.append(Limit(f"{STEP_SCENE}, explicit: the worst residual of these steps", residual, goal))
    pile = next((r for r in found["runs"] if r.scene == PILE), None)
    wall = pile.wall / pile.simulated if pile and pile.simulated else math.nan
    limits.append(Limit(f"{PILE}, {pile.settings if pile else 'implicit'}, f32: wall s per simulated s", wall, PILE_LIMIT))
    bad = math.nan if pile is None else float(pile.status != "ok")
    limits.append(Limit(f"{PILE}: runs that do not end ok", bad, 0))
    missed = sum(f.missed(f.solvers[:1]) for f in found["films"]) if found["films"] else math.nan
    limits.append(Limit(f"films: solves of gauss_seidel above {goal:g}, judged in NumPy", missed, SWEEP_LIMIT))
    if found["problems"]:
        failed = sum("FAIL" in row.verdict for row in found["problems"])
        limits.append(Limit("contact problems: verdicts that fail", failed, 0))
    return limits
