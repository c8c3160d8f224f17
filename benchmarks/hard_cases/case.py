"""Hard cases: their data, the run of a variant, and its verdicts.

A case is data and one function. The function gets a `Session` and a variant's parameters, runs, and returns numbers by quantity;
criteria set limits on them. The catalogue and physics, never a result, determine how a variant must end. A reference is the same
run in f64 with an eighth of the step, sampled at the same times.
"""

import math
import time
import warnings
from collections.abc import Callable
from dataclasses import dataclass, field
from typing import Any

import numpy as np

import taisoft as ts
from taisoft.errors import TaisoftError
from taisoft.output.report import peak_memory
from taisoft.records import RunReport, StepReport

MEASURED, ANALYTIC, PROPOSED = "measured", "analytic", "proposed"  # basis of a limit
# How a variant ends. Refused: an error before a simulator's first step is done. Stopped: an error in a later step.
OK, DEGRADED, REFUSED, STOPPED = WORST = ("ok", "degraded", "refused", "stopped")
FAILED = "failed"  # both, in a RunReport

# Causes of a degraded run.
UNCONVERGED, INVERTED, DROPPED = "unconverged steps", "inverted tets", "dropped contacts"
PENETRATION, INEXACT, OVERLAP, INTERRUPTED = "penetration", "inexact contacts", "overlap at the end", "interruption"
END = "end of the run"  # quantity of a variant's first verdict
DEEPEST = "deepest penetration after any step [m]"

IMPLICIT, EXPLICIT = "implicit_euler", "symplectic_euler"
OLD_NORMALS = (  # cause and next idea of shortfalls
    "contacts act along the normals of the step's start, and brake where these turn within the step; the run says so",
    "the contact geometry of the step's end",
)
FINER = 8  # steps of a reference per step of the run
FRAMES = 20  # approximate maximum of stored frames


@dataclass(frozen=True)
class Must:
    """How a variant must end: OK, DEGRADED, REFUSED or STOPPED, and the reason in one line.

    causes: allowed causes of degradation, due to the setting itself. With OK and causes, an ok end and one degraded only by them
    count. Refused and stopped runs may have no other causes either.
    """

    end: str
    reason: str
    causes: tuple[str, ...] = ()

    @property
    def text(self) -> str:
        """The required end in words."""
        by = f"{DEGRADED} by {' and '.join(self.causes)}"
        return self.end if not self.causes or self.end in (REFUSED, STOPPED) else f"ok, or {by}" if self.end == OK else by

    def met(self, record: dict) -> bool:
        """Whether a record ends as required."""
        status, causes = record["status"], set(record["causes"])
        if not causes <= set(self.causes):
            return False
        if status == DEGRADED:
            return self.end in (OK, DEGRADED) and bool(causes)  # a run degraded without a known cause does not count
        return status == self.end and not (status == OK and causes)


def firm(volume_floor: float) -> str:
    """Why a variant with this volume floor is asked."""
    return f"not of the catalogue: with a material whose volume floor is {volume_floor:g}"


@dataclass(frozen=True)
class Variant:
    """One run of a case. settings: arguments of ts.Simulator; parameters: of the case's function; must: how it must end;
    reference: whether its shape is comparable with that of a reference run."""

    name: str
    settings: dict[str, Any]
    parameters: dict[str, Any]
    must: Must
    reference: bool = True

    def has(self, of: dict[str, Any]) -> bool:
        """Whether every named setting has the given value, or one of them."""
        own = self.settings | self.parameters
        return all(own[key] in (value if isinstance(value, tuple) else (value,)) for key, value in of.items())


def implicit(dt: float, **more) -> dict[str, Any]:
    """Settings of implicit Euler steps."""
    return {"dt": dt, "integrator": IMPLICIT, **more}


def explicit(dt: float, **more) -> dict[str, Any]:
    """Settings of symplectic Euler steps."""
    return {"dt": dt, "integrator": EXPLICIT, **more}


@dataclass(frozen=True)
class Criterion:
    """A limit on a number of a case.

    quantity: name of the number. basis: one of MEASURED, ANALYTIC, PROPOSED. at_least: a lower limit. note: why it is not the
    catalogue's. of: parameters and settings of the variants it applies to, by name; empty for all. cost: a limit on time,
    memory or iterations; a run that misses it is not solved, but not wrong.
    """

    quantity: str
    limit: float
    basis: str
    at_least: bool = False
    note: str = ""
    of: dict[str, Any] = field(default_factory=dict)
    cost: bool = False

    def met(self, value: float) -> bool:
        """Whether a value meets the limit; nan never does."""
        return math.isfinite(value) and (value >= self.limit if self.at_least else value <= self.limit)


@dataclass(frozen=True)
class Shortfall:
    """Why variants of a case are not solved, and the next idea. of: the variants, as in Criterion."""

    cause: str
    next_idea: str
    of: dict[str, Any] = field(default_factory=dict)


@dataclass
class Case:
    """A hard case. size [m]: the unit of errors. quick: cheap solved variants."""

    id: str
    name: str
    run: Callable[..., dict[str, float]]  # (session, **parameters) -> numbers by quantity
    variants: list[Variant] = field(default_factory=list)
    criteria: list[Criterion] = field(default_factory=list)
    shortfalls: list[Shortfall] = field(default_factory=list)
    size: float = 1.0
    quick: tuple[str, ...] = ()

    def add_variant(self, name: str, settings: dict[str, Any], must: Must, reference: bool = True, **parameters) -> None:
        """Add a run, see Variant."""
        self.variants.append(Variant(name, settings, parameters, must, reference))

    def add_limit(self, quantity: str, limit: float, basis: str, at_least=False, note="", cost=False, **of) -> None:
        """Add a criterion, see Criterion."""
        self.criteria.append(Criterion(quantity, limit, basis, at_least, note, of, cost))

    def add_shortfall(self, cause: str, next_idea: str, **of) -> None:
        """Explain variants that are not solved, see Shortfall."""
        self.shortfalls.append(Shortfall(cause, next_idea, of))

    def criteria_of(self, variant: Variant) -> list[Criterion]:
        """Criteria of one variant."""
        return [c for c in self.criteria if variant.has(c.of)]

    def shortfalls_of(self, variant: Variant) -> list[Shortfall]:
        """Shortfalls of one variant."""
        return [s for s in self.shortfalls if variant.has(s.of)]


@dataclass(frozen=True)
class Verdict:
    """A quantity of a run and its limit: numbers, or texts for the end of the run."""

    quantity: str
    value: float | str | None
    limit: float | str | None = None
    at_least: bool = False
    basis: str = ""
    passed: bool | None = None  # None without a limit
    cost: bool = False


def judge(case: Case, variant: Variant, record: dict) -> list[Verdict]:
    """Verdicts on a record: its end, then quantities with limits, then those without."""
    causes = " and ".join(record["causes"]) if record["status"] == DEGRADED else ""
    ended = f"{record['status']} by {causes}" if causes else record["status"]
    verdicts = [Verdict(END, ended, variant.must.text, passed=variant.must.met(record))]
    numbers = record["numbers"]
    criteria = case.criteria_of(variant)
    for c in criteria:
        value = numbers.get(c.quantity)  # null if not finite, absent in a failed run
        met = value is not None and c.met(value)
        verdicts.append(Verdict(c.quantity, value, c.limit, c.at_least, c.basis, met, c.cost))
    judged = {c.quantity for c in criteria}
    return verdicts + [Verdict(name, value) for name, value in numbers.items() if name not in judged]


class Session:
    """A running variant. finer: 1, or FINER for its reference; reports: of all steps so far; path: points (n,3) [m] at the start,
    at FRAMES times and at the end."""

    def __init__(self, case: Case, variant: Variant, arch: str, finer: int = 1):
        self.case, self.variant, self.arch, self.finer = case, variant, arch, finer
        self.status = OK
        self.causes: set[str] = set()  # causes of degradation
        self.problems: list[str] = []
        self.warned: list[warnings.WarningMessage] = []
        self.steps = 0
        self.seconds = 0.0  # wall time of steps without compilation
        self.step_seconds: list[float] = []  # per step, for each advance
        self.reports: list[StepReport] = []
        self.path: list[np.ndarray] = []

    def simulator(self, scene: ts.Scene, **changes) -> ts.Simulator:
        """A simulator of the scene with the variant's settings and changes; with finer steps for a reference."""
        settings = self.variant.settings | changes
        settings["dt"] = settings["dt"] / self.finer
        if self.finer > 1:
            settings["precision"] = "f64"
        return ts.Simulator(scene, arch=self.arch, **settings)

    def run_steps(
        self, sim: ts.Simulator, steps: int, observe: Callable | None = None, every: int = 1, follow: bool = True
    ) -> RunReport:
        """Run `steps` steps of the variant's dt; call observe(sim, number, report) first and after each `every` steps.

        follow: keep some states for comparison with the reference. The result reports a failed run.
        """
        dt, total = sim.dt * self.finer, steps // every
        kept = max(1, total // FRAMES)

        def frame(sim, number, report):
            if observe is not None:
                observe(sim, number, report)
            if follow and (number % kept == 0 or number == total):
                self.path.append(sim.positions())

        def step(report, seconds):
            self.seconds += seconds
            self.step_seconds.append(seconds / report.steps)

        result = sim.run(steps * dt, frame, fps=1.0 / (every * dt), on_step=step)
        self.steps += result.steps
        self.reports += result.step_reports
        self.causes |= causes_of(sim, result)
        failed = STOPPED if sim.step_count else REFUSED  # the simulator's first step is done, or not
        self._end(failed if result.status == FAILED else result.status, result.problems)
        return result

    def watch(self, sim: ts.Simulator, steps: int, *read: Callable, every: int = 1, follow: bool = True) -> list[list]:
        """`run_steps`, returning the values of each of `read`: first and after each `every` steps."""
        found = [[] for _ in read]

        def observe(*_):
            for values, get in zip(found, read):
                values.append(get())

        self.run_steps(sim, steps, observe, every, follow)
        return found

    def refuse(self, sentence: str) -> None:
        """Record a refusal by a simulator."""
        self._end(REFUSED, [sentence])

    def _end(self, status: str, problems: list[str]) -> None:
        """Record how a run ended; the worst end counts."""
        self.status = max(self.status, status, key=WORST.index)
        self.problems += problems

    @property
    def warnings(self) -> list[str]:
        """All warnings so far."""
        return [str(one.message) for one in self.warned if issubclass(one.category, UserWarning)]

    @property
    def unconverged(self) -> int:
        """Number of unconverged steps."""
        return sum(not report.converged for report in self.reports)

    def largest(self, name: str) -> float:
        """The maximum of a number over all StepReports so far."""
        return max((getattr(report, name) for report in self.reports), default=0)

    def total(self, name: str) -> int:
        """The sum of a number over all StepReports so far."""
        return sum(getattr(report, name) for report in self.reports)

    def record(self) -> dict:
        """Run the variant. Returns its end, numbers, cost and path as plain data."""
        start = time.perf_counter()
        with warnings.catch_warnings(record=True) as self.warned:
            warnings.simplefilter("always", UserWarning)
            try:
                numbers = self.case.run(self, **self.variant.parameters)
            except TaisoftError as error:
                numbers = {}
                self.refuse(str(error))
        return {
            "status": self.status,
            "causes": sorted(self.causes),
            "problems": list(dict.fromkeys(self.problems)),
            "warnings": list(dict.fromkeys(self.warnings)),
            "numbers": {name: float(value) for name, value in numbers.items()},
            "steps": self.steps,
            "seconds": self.seconds,
            "total_seconds": time.perf_counter() - start,
            "step_seconds": float(np.median(self.step_seconds)) if self.step_seconds else None,
            **{f"{what}_iterations": self.total(f"{what}_iterations") for what in ("newton", "linear", "contact")},
            "substeps": self.total("substeps"),
            "most_newton_iterations": max((r.newton_iterations for r in self.reports if r.converged), default=0),
            "inverted": self.largest("n_inverted"),
            "unconverged": self.unconverged,
            "peak_memory_bytes": peak_memory(),
            "points": np.concatenate(self.path) if self.path else np.empty((0, 3)),
        }


def causes_of(sim: ts.Simulator, result: RunReport) -> set[str]:
    """Causes of a degraded run."""
    steps = result.step_reports
    found = {
        UNCONVERGED: any(not step.converged for step in steps),
        INVERTED: any(step.n_inverted for step in steps),
        DROPPED: any(step.dropped_contacts for step in steps),
        PENETRATION: any(step.deep for step in steps),
        INEXACT: any(step.contact_error for step in steps),
        INTERRUPTED: result.interrupted,
        OVERLAP: result.status == DEGRADED
        and sim.touches
        and any(found.depth > sim.contact_limit(found.name_a, found.name_b) for found in sim.overlaps()),
    }
    return {cause for cause, so in found.items() if so}


def refusal(make: Callable[[], ts.Simulator]) -> str:
    """The message with which a simulator refuses to be built, or empty."""
    try:
        make().close()
    except TaisoftError as error:
        return str(error)
    return ""
