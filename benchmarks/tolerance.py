"""Wished against obtained errors, and what they cost: the scenes of `taisoft bench error`, run to a tolerance.

taisoft bench tolerance [--only NAME ...] [--wish PERCENT ...] [--quick] [--budget SECONDS] [--keep DIR] [--out [FILE.json]]

Each scene runs with tolerances of 10, 1 and 0.1 % (`Simulator(tolerance=)`), and with a grid of fixed settings: all integrators
at 1 to 64 steps a frame, explicit ones at up to 8 times their least, as long as they are not slower than settings that meet all
tolerances. Errors are distances at the frames, over the largest
excursion, to a run in double precision with small steps: 128 a frame, explicit ones 32 times the least, with tolerances of 1e-9,
and 1e-8 of the contact laws. Implicit and explicit steps have a reference each, since quadratic elements have another mass matrix
in explicit steps and impacts another law. A reference's own error is its distance to a run with half as many steps.
References are kept in the user's cache until scenes or code that runs with given steps change.
Seconds are from the call of Simulator to the end of the run, with trials, without compiling: medians of repeated runs, in turns
with the best fixed setting. With frames: where an observer gets them, as in `taisoft run`, so that a trial is not the run. Best:
the fastest fixed setting that meets the tolerance. Exit status: 0, or 1 if a limit is not met.
"""

import math
import statistics
import sys
import time
from collections.abc import Callable
from contextlib import suppress
from dataclasses import asdict, dataclass, replace
from pathlib import Path

import numpy as np

import taisoft as ts
from taisoft.display import percent
from taisoft.dynamics.schemes import EXPLICIT, IMPLICIT, takes_contacts
from taisoft.errors import OutputError
from taisoft.estimation.comparison import distance, largest_excursion
from taisoft.estimation.first_choice import stable_steps
from taisoft.files import cache_folders
from taisoft.machine import machine
from taisoft.many.store import NOT_COMPUTING, Store, code_digest, digest

from .document import Limit, begin, table
from .error import EXACT, EXPLICIT_FPS
from .error_cases import CASES, Case, path_of
from .runner import files_digest, without_warnings
from .suite import LEFT_OUT, chosen, runs_of, suite_options, suite_parser

TOLERANCES = (0.1, 0.01, 0.001)
STEPS = (1, 2, 4, 8, 16, 32, 64)  # of implicit integrators, a frame
FINER = (1, 2, 4, 8)  # steps of explicit integrators over their least
TRUTH = {False: 128, True: 32}  # steps a frame of the reference, explicit ones over their least; key: explicit
REPEATS, SHORT, LONG = 5, 1.0, 10.0  # runs of up to SHORT [s] are repeated; a grid goes no further after one of LONG [s]
ENOUGH, SLOWEST, MEDIAN = 11 / 12, 2.0, 1.3  # of the scenes that meet a tolerance; times over the best fixed setting
QUICK = ("hanging beam", "incline")
HERE = Path(__file__).parent
SOURCES = (HERE / "error_cases.py", HERE / "reference_cases" / "record.py")  # on which stored references depend
NOT_RUNNING = (*NOT_COMPUTING, "estimation")  # folders of taisoft on which they do not


@dataclass
class Fixed:
    """A fixed setting: steps a frame, its true error and seconds."""

    integrator: str
    steps: int
    error: float
    seconds: float


@dataclass
class Row:
    """A scene run to a tolerance. own: the reference's own error; best: the fastest fixed setting, None if none meets it."""

    name: str
    tolerance: float
    integrator: str
    steps: int  # a frame
    status: str
    estimated: float | None
    true: float
    own: float
    seconds: float
    observed: float  # seconds with frames that are observed, so that a trial is not the run
    trials: float  # [s]
    best: Fixed | None

    @property
    def met(self) -> bool:
        """Whether the true error is within the tolerance."""
        return self.true <= self.tolerance

    @property
    def ratio(self) -> float:
        """Seconds over those of the best fixed setting; nan without one."""
        return self.seconds / self.best.seconds if self.best else math.nan


def read_row(data: dict) -> Row:
    """The row of plain data."""
    return Row(**data | {"best": data["best"] and Fixed(**data["best"])})


def stored(request: list, compute: Callable[[], np.ndarray]) -> np.ndarray:
    """The array of a request, plain data, from the user's cache, or what `compute` returns, which is then kept there."""
    key = digest([request, machine(), code_digest(NOT_RUNNING), files_digest(SOURCES)])[:32]
    store = Store()
    with suppress(StopIteration, OutputError):  # no folder can be used
        store = Store(next(cache_folders()) / "tolerance")
    if (found := store.read(key)) is None:
        found = {"array": compute()}
        with suppress(OutputError):  # the folder is full
            store.write(key, found)
    return found["array"]


def fps_of(case: Case) -> float:
    """Frames per second."""
    return EXPLICIT_FPS if case.dt is None else 60.0


class Scene:
    """The references of a scene, and its frame. least: explicit steps a frame."""

    def __init__(self, case: Case):
        self.case, self.frame = case, 1.0 / fps_of(case)
        with ts.Simulator(case.build(), dt=1e-9, integrator="velocity_verlet") as sim:
            self.least, self.touches = stable_steps(sim.stable_dt, self.frame), sim.touches
        self._truths: dict[tuple, np.ndarray] = {}

    def path(self, integrator: str, steps: int, **settings) -> np.ndarray:
        """Positions (k,n,3) [m] at the frames."""
        scene, dt = self.case.build(), self.frame / steps
        return path_of(scene, dt, integrator, self.case.seconds, 1.0 / self.frame, **settings)[0]

    def truth(self, explicit: bool, larger: int = 1) -> np.ndarray:
        """Path of the reference, or with steps larger by a factor."""
        integrator = "velocity_verlet" if explicit else "bdf2" if self.touches else "implicit_midpoint"
        settings = {"precision": "f64"} if explicit else {"precision": "f64", "newton_tolerance": EXACT["newton_tolerance"]}
        settings |= {"contact_tolerance": EXACT["contact_tolerance"]} if self.touches else {}
        steps = TRUTH[explicit] * (self.least if explicit else 1) // larger
        if (integrator, steps) not in self._truths:
            request = [self.case.name, integrator, steps, settings]
            self._truths[integrator, steps] = stored(request, lambda: self.path(integrator, steps, **settings))
        return self._truths[integrator, steps]

    def distance(self, path: np.ndarray, explicit: bool) -> float:
        """Error of a path; infinite if it is shorter, that of a run that failed."""
        truth = self.truth(explicit)
        return distance(path, truth, largest_excursion(truth)).max if len(path) == len(truth) else math.inf

    def error(self, integrator: str, steps: int, **settings) -> float:
        """True error of a run with fixed steps."""
        return self.distance(self.path(integrator, steps, **settings), integrator in EXPLICIT)

    def timed(self, *settings: dict) -> tuple[list[float], list[ts.RunReport], ts.Simulator]:
        """Median seconds of set-up and run with each of several settings, in turns, without compiling; their last reports, and
        the closed simulator of the last one. Settings may have `on_frame`."""
        seconds: list[list[float]] = []
        while not seconds or (sum(seconds[0]) < SHORT and len(seconds) < REPEATS):
            found = [self._run(**one) for one in settings]
            seconds.append([one[0] for one in found])
        return [statistics.median(one) for one in zip(*seconds)], [one[1] for one in found], found[-1][2]

    def _run(self, on_frame=None, **settings) -> tuple[float, ts.RunReport, ts.Simulator]:
        """Seconds of set-up and a run, its report, and its closed simulator."""
        scene, start = self.case.build(), time.perf_counter()
        with ts.Simulator(scene, **settings) as sim:
            report = sim.run(self.case.seconds, fps=1.0 / self.frame, on_frame=on_frame)
            return time.perf_counter() - start - sim.compile_seconds, report, sim

    def grid(self) -> list[Fixed]:
        """All fixed settings; an integrator goes no further after a long run, or one slower than what meets all tolerances."""
        found: list[Fixed] = []
        for integrator in (*EXPLICIT, *IMPLICIT):
            explicit = integrator in EXPLICIT
            if self.touches and not takes_contacts(integrator):
                continue
            for steps in [k * self.least for k in FINER] if explicit else STEPS:
                (seconds,), (report,), _ = self.timed(self.fixed(integrator, steps))
                if report.status != "failed":
                    found.append(Fixed(integrator, steps, self.error(integrator, steps), seconds))
                if seconds > min((one.seconds for one in found if one.error <= min(TOLERANCES)), default=LONG):
                    break
        return found

    def fixed(self, integrator: str, steps: int) -> dict:
        """Settings of a run with fixed steps."""
        return {"dt": self.frame / steps, "integrator": integrator}

    def row(self, tolerance: float, grid: list[Fixed]) -> Row:
        """A run to a tolerance."""
        enough = [one for one in grid if one.error <= tolerance]
        best = min(enough, key=lambda one: one.seconds) if enough else None
        alternatives = [{"tolerance": tolerance, "on_frame": lambda *_: None}, {"tolerance": tolerance}]
        fixed = [self.fixed(best.integrator, best.steps)] if best else []
        seconds, reports, sim = self.timed(*fixed, *alternatives)
        integrator, steps, report = sim.settings.integrator, round(self.frame / sim.dt), reports[-1]
        tolerances = {name: getattr(sim.settings, name) for name in ("newton_tolerance", "contact_tolerance")}
        return Row(
            name=self.case.name,
            tolerance=tolerance,
            integrator=integrator,
            steps=steps,
            status=report.status,
            estimated=report.error_estimate.time if report.error_estimate else None,
            true=self.error(integrator, steps, **tolerances) if report.status != "failed" else math.inf,
            own=self.distance(self.truth(integrator in EXPLICIT, 2), integrator in EXPLICIT),
            seconds=seconds[-1],
            observed=seconds[-2],
            trials=report.trial_seconds,
            best=replace(best, seconds=seconds[0]) if best else None,
        )


def row_table(rows: list[Row]) -> str:
    """A row per scene and tolerance."""

    def best(row: Row) -> str:
        return f"{row.best.integrator} {row.best.steps}" if row.best else "none"

    columns = (
        ("<scene", lambda r: r.name),
        ("wished [%]", lambda r: f"{100.0 * r.tolerance:.3g}"),
        ("<integrator", lambda r: r.integrator),
        ("steps a frame", lambda r: f"{r.steps:,}"),
        ("estimated [%]", lambda r: "unknown" if r.estimated is None else percent(r.estimated)),
        ("true [%]", lambda r: percent(r.true)),
        ("own error [%]", lambda r: percent(r.own)),
        ("<met", lambda r: "yes" if r.met else "no, but reported" if r.status != "ok" else "no"),
        ("seconds", lambda r: f"{r.seconds:.3g}"),
        ("with frames", lambda r: f"{r.observed:.3g}"),
        ("of trials", lambda r: f"{r.trials:.2g}"),
        ("<best fixed", best),
        ("seconds over best", lambda r: "-" if math.isnan(r.ratio) else f"{r.ratio:.2f}"),
    )
    return table(rows, columns)


def find_limits(rows: list[Row]) -> list[Limit]:
    """How many scenes meet each tolerance, and times over the best fixed setting where there is one."""
    found = []
    for tolerance in sorted({row.tolerance for row in rows}, reverse=True):
        chosen = [row.met for row in rows if row.tolerance == tolerance]
        name = f"{100.0 * tolerance:.3g} %: fraction of scenes that meet it"
        found.append(Limit(name, sum(chosen) / len(chosen), ENOUGH, at_least=True))
    ratios = [row.ratio for row in rows if not math.isnan(row.ratio)] or [math.nan]
    found.append(Limit("seconds over the best fixed setting, median", statistics.median(ratios), MEDIAN))
    return [*found, Limit("seconds over the best fixed setting, largest", max(ratios), SLOWEST)]


def answer(request: dict) -> dict:
    """In a child: the rows of a scene, and its grid."""
    with without_warnings():
        scene = Scene(next(case for case in CASES if case.name == request["name"]))
        grid = scene.grid()
        rows = [asdict(scene.row(wish, grid)) for wish in request["wishes"]]
    return {"rows": rows, "grid": [asdict(one) for one in grid]}


def main(argv: list[str] | None = None) -> int:
    """Measure and print. Raises OutputError if a file cannot be written."""
    parser = suite_parser("tolerance", __doc__, f"only {' and '.join(QUICK)}")
    known = {f"{100.0 * one:g}": one for one in TOLERANCES}
    parser.add_argument(
        "--wish", nargs="+", choices=known, default=list(known), metavar="PERCENT", help=f"only these: {', '.join(known)}"
    )
    options = suite_options(parser, argv, answer, arch=False)
    wishes = [known[text] for text in options.wish]
    names = QUICK if options.quick else [case.name for case in CASES]
    requests = chosen(parser, options.only, {name: {"name": name, "wishes": wishes} for name in names})
    document, numbers = begin("Runs to a tolerance", "cpu", "f32")
    with runs_of("tolerance", options, "error_cases.py", "tolerance.py", "reference_cases/record.py") as runs:
        records = runs.records(requests, lambda one: f"{len(one['grid'])} fixed settings")
        found = {name: one for name, one in zip(requests, records) if LEFT_OUT not in one}
    rows = [read_row(row) for one in found.values() for row in one["rows"]]
    grids = {name: one["grid"] for name, one in found.items()}
    document.add(row_table(rows))
    return runs.finish(document, options, numbers | {"precision": "f32", "rows": rows, "grids": grids}, find_limits(rows))


if __name__ == "__main__":
    sys.exit(main())
