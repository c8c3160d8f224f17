"""Crossings: does any surface cross another one, or itself, after any step?

taisoft bench crossings [--what GROUP ...] [--only NAME ...] [--count N] [--quick] [--arch cpu|cuda] [--budget SECONDS]
                        [--keep DIR] [--out [FILE.json]]

ipctk judges every state: after each step of an implicit integrator, after each sub-step of an explicit one. Judged are bodies
against each other and against obstacles, and against themselves where self-collision is on.

Groups: demos, each as it is. hard: all variants of the hard cases that need not be refused. heaps: 200 random heaps of 5 to 20
bodies, thrown at each other at up to 5 m/s, half of them in single precision and a fifth with explicit integrators. shots: 20
random ones of each of ten kinds, such as a cube through a wall, that one step may carry far beyond what they meet. jittered: ten
starts each, displaced by up to 0.1 mm at random, of a folded strip, the twisted mat (S1) and the trash compactor (S4).

Shots are also judged by sides, since a body may get through another one without a state that crosses: they have tunnelled where
something is behind a wall that it cannot have passed beside, rings are linked, or a vertex is inside another surface.

Each run has a process of its own. Nothing is judged where nothing can touch. Contacts, inverted: the most contacts, and inverted
tets, in a step. Depth: how far two crossing triangles must move to part, or how deep one is in a half-space, sphere or capsule.
Least: the least distance of every tenth state that does not cross, up to 1 mm. Newton, CG, substeps: sums over the run. --keep
stores finished runs in DIR, and the same command resumes there. Exit status: 1 if any state crosses, a shot tunnels or a run
crashes, else 0.
"""

import argparse
import sys
from collections.abc import Iterable
from functools import partial

from taisoft.machine import require

from .crossing_runs import DEMOS, DISTANCE_EVERY, GROUPS, HARD, HEAPS, JITTERED, NEAR, SHOTS, answer, names_of
from .document import begin, table
from .suite import CRASHED, LEFT_OUT, chosen, runs_of, suite_options, suite_parser

TITLE = "Crossings"
QUICK = {
    DEMOS: ("cube_on_box", "sheet_on_box"),
    HARD: ("S3: two bodies",),
    HEAPS: ("heap 000", "heap 001", "heap 004"),
    SHOTS: ("cube through wall 00", "linked rings 00"),
    JITTERED: ("fold, start 0",),
}
QUICK_STEPS = 20
FILES = ("crossing*.py", "judge.py", "hard_cases/*.py", "../demos/*.py")  # that define the runs
SECONDS = ("seconds", "judge_seconds")
TOTALS = {"Newton": "newton_iterations", "CG": "linear_iterations", "substeps": "substeps"}  # by heading
MOST_PAIRS = 4  # of names in a sentence


def asked(options: argparse.Namespace) -> dict[str, dict]:
    """The requests of the groups' runs by name."""
    return {
        name: {"group": group, "name": name, "arch": options.arch, "steps": QUICK_STEPS if options.quick else None}
        for group in options.what
        for name in (QUICK[group] if options.quick else names_of(group, options.count))
    }


def ran(rows: Iterable[dict]) -> list[dict]:
    """The rows with a record."""
    return [row for row in rows if LEFT_OUT not in row]


def least_text(row: dict) -> str:
    """The least distance [mm]."""
    if row["states"] < DISTANCE_EVERY:
        return ""
    return f"> {1e3 * NEAR:g}" if row["least"] >= NEAR else f"{1e3 * row['least']:.2g}"


def total_of(key: str, row: dict) -> str:
    """A sum over the steps; results stored earlier have none."""
    return str(row.get(key) or "")


COLUMNS = (
    ("<run", "{0[name]}"),
    ("<settings", "{0[settings]}"),
    ("bodies", lambda row: str(len(row["kinds"]) or "")),
    ("contacts", "{0[contacts]}"),
    ("states", "{0[states]}"),
    ("cross", lambda row: str(row["crossing"] or "")),
    ("first", lambda row: str(row["first"]["step"]) if row["first"] else ""),
    ("most", lambda row: str(row["most"] or "")),
    ("tunnelled", lambda row: str(row.get("tunnelled") or "")),
    ("depth [mm]", lambda row: f"{1e3 * row['deepest']:.2g}" if row["crossing"] else ""),
    ("least [mm]", least_text),
    *((title, partial(total_of, key)) for title, key in TOTALS.items()),
    ("not converged", lambda row: str(row["unconverged"] or "")),
    ("inverted", lambda row: str(row["inverted"] or "")),
    ("<status", "{0[status]}"),
    ("s", "{0[seconds]:.0f}"),
)


def first_text(row: dict) -> str:
    """The first crossing of a run, in a line."""
    one, more = row["first"], len(row["first"]["names"]) > MOST_PAIRS
    names = ", ".join(one["names"][:MOST_PAIRS]) + (", ..." if more else "")
    how = "" if one["converged"] else ", not converged"
    return (
        f"{row['name']} ({row['settings']}): step {one['step']}, t = {one['time']:.4g} s{how}: {names}, {one['count']} in all, "
        f"{1e3 * one['depth']:.2g} mm deep; the deepest of the run {1e3 * row['deepest']:.2g} mm"
    )


def group_text(group: str, rows: list[dict]) -> str:
    """The section of a group: its table, where each run first crosses, what went wrong."""
    found = ran(rows)
    notes = [f"First crossing of {first_text(row)}." for row in found if row["first"]]
    notes += [
        f"{row['name']} ({row['settings']}) has tunnelled in step {row['tunnelled']}." for row in found if row.get("tunnelled")
    ]
    notes += [f"{row['name']}: {row['starts_crossing']} starts cross before any step." for row in found if row["starts_crossing"]]
    notes += [f"{row['name']}: {problem}" for row in found for problem in row["problems"]]
    notes += [f"{row['name']} was not run: {row[LEFT_OUT]}" for row in rows if LEFT_OUT in row]
    made = table(found, COLUMNS, notes) if found else "\n".join(f"* {note}" for note in notes)
    return f"## {group}\n\n{made}\n\n{total_text(group, rows)}"


def total_text(what: str, rows: list[dict]) -> str:
    """How many states were judged, and how many cross."""
    found = ran(rows)
    states, crossing, seconds, judging = (sum(row[key] for row in found) for key in ("states", "crossing", *SECONDS))
    runs = f"{sum(row['crossing'] > 0 for row in found)} of {len(found)} runs"
    tunnelled = sum(bool(row.get("tunnelled")) for row in found)
    runs += f"; **{tunnelled} tunnelled**" if tunnelled else ""
    return f"**{what}: {states} states judged, {crossing} cross**, in {runs}; {seconds:.0f} s, of which {judging:.0f} s judging"


def page(rows: list[dict]) -> list[str]:
    """The parts of the page."""
    groups = {group: [row for row in rows if row["group"] == group] for group in GROUPS}
    return [*(group_text(group, own) for group, own in groups.items() if own), total_text("In all", rows)]


def failed(rows: list[dict]) -> bool:
    """Whether a state crosses, a shot has tunnelled or a run crashed."""
    return any(row.get(key) for row in rows for key in ("crossing", "starts_crossing", "tunnelled", CRASHED))


def summary(row: dict) -> str:
    """How a run ended, in a line."""
    first = f" from step {row['first']['step']} on" if row["first"] else ""
    first += "" if row["tunnelled"] is None else f", tunnelled in step {row['tunnelled']}"
    return f"{row['crossing']} of {row['states']} states cross{first}, {row['status']}, {row['seconds']:.0f} s"


def main(argv=None) -> int:
    """Run, judge and print. Raises OutputError."""
    parser = suite_parser("crossings", __doc__, "a few runs, heaps and folds of 20 steps")
    parser.add_argument("--what", nargs="+", choices=GROUPS, default=list(GROUPS), help="only these groups")
    parser.add_argument(
        "--count", type=int, metavar="N", help="only the first N heaps, N shots of each kind, N starts of each jittered scene"
    )
    options = suite_options(parser, argv, answer)
    require("ipctk", "taisoft bench crossings", "dev")
    requests = chosen(parser, options.only, asked(options))
    document, numbers = begin(TITLE, f"arch {options.arch}", packages=("taichi", "numpy", "ipctk"))
    with runs_of("crossings", options, *FILES) as runs:
        found = zip(requests.items(), runs.records(requests, summary))
        rows = [{"group": one["group"], "name": name} | row for (name, one), row in found]
    for part in (*page(rows), *runs.store.damaged):
        document.add(part)
    selected = {key: getattr(options, key) for key in ("what", "only", "count")}
    return document.finish(options, numbers | selected | {"rows": rows}) or int(failed(rows))


if __name__ == "__main__":
    sys.exit(main())
