"""What a hard case is: variants of one setting, the function that runs it and measures, and the numbers that it must keep to.

A case is data beside one function. The function gets a `Session` (`session.py`) and a variant's parameters, runs, and returns
numbers by their quantity; the criteria say which of them have a limit, and of which variants. Each variant says how it must
end, and why: by the catalogue and by physics, never by what came out.
"""

import math
from collections.abc import Callable
from dataclasses import asdict, dataclass, field
from typing import Any

MEASURED, ANALYTIC, PROPOSED = "measured", "analytic", "proposed"  # what a limit rests on
# How a variant ends. Refused: an error before a simulator's first step is done. Stopped: an error in a later step.
OK, DEGRADED, REFUSED, STOPPED = "ok", "degraded", "refused", "stopped"
FAILED = "failed"  # what a RunReport calls both

# What degrades a run.
UNCONVERGED, INVERTED, DROPPED = "unconverged steps", "inverted tets", "dropped contacts"
PENETRATION, OVERLAP, INTERRUPTED = "penetration", "overlap at the end", "interruption"
END = "end of the run"  # the quantity of a variant's first verdict


@dataclass(frozen=True)
class Must:
    """How a variant must end: OK, DEGRADED, REFUSED or STOPPED. reason: why, in one line.

    causes: what may degrade the run, because the setting itself brings it about. With OK and causes, both an ok end and one
    that only they degrade count. Nothing else may have gone wrong in a run that is refused or stopped either.
    """

    end: str
    reason: str
    causes: tuple[str, ...] = ()

    @property
    def text(self) -> str:
        """As words."""
        by = f"{DEGRADED} by {' and '.join(self.causes)}"
        return self.end if not self.causes or self.end in (REFUSED, STOPPED) else f"ok, or {by}" if self.end == OK else by

    def met(self, record: dict) -> bool:
        """Whether a record ends so."""
        status, causes = record["status"], set(record["causes"])
        if not causes <= set(self.causes):
            return False
        if status == DEGRADED:
            return self.end in (OK, DEGRADED) and bool(causes)  # a run that cannot say what degraded it is not excused
        return status == self.end and not (status == OK and causes)


@dataclass(frozen=True)
class Criterion:
    """A number that a case must keep to.

    quantity: by which the case's function tells it. basis: one of MEASURED, ANALYTIC, PROPOSED. at_least: a lower limit.
    asked: the limit that the catalogue proposes, where another, an honest baseline, replaces it. note: what that is and why.
    of: the parameters and settings of the variants that it is asked of, by name; empty for all. cost: a limit on time, memory
    or iterations; a run that misses it is not solved, but its answer is not wrong.
    """

    quantity: str
    limit: float
    basis: str
    at_least: bool = False
    asked: float | None = None
    note: str = ""
    of: dict[str, Any] = field(default_factory=dict)
    cost: bool = False

    def met(self, value: float) -> bool:
        """Whether a value keeps the limit; one that is not a number never does."""
        return math.isfinite(value) and (value >= self.limit if self.at_least else value <= self.limit)


@dataclass(frozen=True)
class Variant:
    """One run of a case. settings: arguments of ts.Simulator; parameters: of the case's function.

    must: how it must end. reference: whether its shape can be held against that of a run in f64 with an eighth of the step.
    """

    name: str
    settings: dict[str, Any]
    parameters: dict[str, Any]
    must: Must
    reference: bool = True


@dataclass(frozen=True)
class Shortfall:
    """Why variants of a case are not solved, and what to try next. of: which variants, as in Criterion."""

    cause: str
    next_idea: str
    of: dict[str, Any] = field(default_factory=dict)


@dataclass(frozen=True)
class Case:
    """A hard case. size [m]: what errors are divided by. shortfalls: of variants that are not solved."""

    id: str
    name: str
    run: Callable[..., dict[str, float]]  # (session, **parameters) -> numbers by quantity
    variants: tuple[Variant, ...]
    criteria: tuple[Criterion, ...]
    size: float
    shortfalls: tuple[Shortfall, ...] = ()
    quick: tuple[str, ...] = ()  # variants that are cheap and solved

    def criteria_of(self, variant: Variant) -> list[Criterion]:
        """What is asked of one variant."""
        return [c for c in self.criteria if _concerns(c.of, variant)]

    def shortfalls_of(self, variant: Variant) -> list[Shortfall]:
        """Why one variant is not solved."""
        return [s for s in self.shortfalls if _concerns(s.of, variant)]


@dataclass(frozen=True)
class Verdict:
    """A quantity of a run beside its limit. value and limit: numbers, or texts where the end of the run is judged."""

    quantity: str
    value: float | str | None
    limit: float | str | None = None
    at_least: bool = False
    basis: str = ""
    asked: float | None = None
    passed: bool | None = None  # None where there is no limit
    cost: bool = False

    def record(self) -> dict:
        """As plain data."""
        return asdict(self)


def judge(case: Case, variant: Variant, record: dict) -> list[Verdict]:
    """What a record says of a variant's criteria: its end first, then what has a limit, then what is only told."""
    causes = " and ".join(record["causes"]) if record["status"] == DEGRADED else ""
    ended = f"{record['status']} by {causes}" if causes else record["status"]
    verdicts = [Verdict(END, ended, variant.must.text, passed=variant.must.met(record))]
    numbers = record["numbers"]
    criteria = case.criteria_of(variant)
    for c in criteria:
        value = numbers.get(c.quantity)  # null for what is not finite, absent in a run that could not be made
        met = value is not None and c.met(value)
        verdicts.append(Verdict(c.quantity, value, c.limit, c.at_least, c.basis, c.asked, met, c.cost))
    judged = {c.quantity for c in criteria}
    return verdicts + [Verdict(name, value) for name, value in numbers.items() if name not in judged]


def _concerns(of: dict[str, Any], variant: Variant) -> bool:
    """Whether a variant has one of the values asked for under every name."""
    own = variant.settings | variant.parameters
    return all(own[key] in (value if isinstance(value, tuple) else (value,)) for key, value in of.items())
