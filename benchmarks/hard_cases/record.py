"""What a hard case is: variants of one setting, the function that runs it and measures, and the numbers that it must keep to.

A case is data beside one function. The function gets a `Session` (`session.py`) and a variant's parameters, runs, and returns
numbers by their quantity; the criteria say which of them have a limit, and of which variants.
"""

import math
from collections.abc import Callable
from dataclasses import asdict, dataclass, field
from typing import Any

MEASURED, ANALYTIC, PROPOSED = "measured", "analytic", "proposed"  # what a limit rests on
OK, DEGRADED, FAILED = "ok", "degraded", "failed"  # how a run ends


@dataclass(frozen=True)
class Criterion:
    """A number that a case must keep to.

    quantity: by which the case's function tells it. basis: one of MEASURED, ANALYTIC, PROPOSED. at_least: a lower limit.
    asked: the limit that the catalogue proposes, where another, an honest baseline, replaces it. note: what that is and why.
    of: the parameters and settings of the variants that it is asked of, by name; empty for all.
    """

    quantity: str
    limit: float
    basis: str
    at_least: bool = False
    asked: float | None = None
    note: str = ""
    of: dict[str, Any] = field(default_factory=dict)

    def met(self, value: float) -> bool:
        """Whether a value keeps the limit; one that is not a number never does."""
        return math.isfinite(value) and (value >= self.limit if self.at_least else value <= self.limit)


@dataclass(frozen=True)
class Variant:
    """One run of a case. settings: arguments of ts.Simulator; parameters: of the case's function.

    ends: how it may end. reference: whether its shape can be held against that of a run in f64 with an eighth of the step.
    """

    name: str
    settings: dict[str, Any]
    parameters: dict[str, Any] = field(default_factory=dict)
    ends: tuple[str, ...] = (OK,)
    reference: bool = True


@dataclass(frozen=True)
class Case:
    """A hard case. size [m]: what errors are divided by. shortfall: of limits that are not met, the cause and the next idea."""

    id: str
    name: str
    run: Callable[..., dict[str, float]]  # (session, **parameters) -> numbers by quantity
    variants: tuple[Variant, ...]
    criteria: tuple[Criterion, ...]
    size: float
    shortfall: str = ""
    quick: tuple[str, ...] = ()  # variants that are cheap and meet their limits

    def criteria_of(self, variant: Variant) -> list[Criterion]:
        """What is asked of one variant."""
        own = variant.settings | variant.parameters
        return [c for c in self.criteria if all(own[key] in _several(value) for key, value in c.of.items())]


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

    def record(self) -> dict:
        """As plain data."""
        return asdict(self)


def judge(case: Case, variant: Variant, record: dict) -> list[Verdict]:
    """What a record says of a variant's criteria: its end first, then what has a limit, then what is only told."""
    ends, status = " or ".join(variant.ends), record["status"]
    verdicts = [Verdict("end of the run", status, ends, passed=status in variant.ends)]
    numbers = record["numbers"]
    criteria = case.criteria_of(variant)
    for c in criteria:
        value = numbers.get(c.quantity)  # null for what is not finite, absent in a run that could not be made
        met = value is not None and c.met(value)
        verdicts.append(Verdict(c.quantity, value, c.limit, c.at_least, c.basis, c.asked, met))
    judged = {c.quantity for c in criteria}
    return verdicts + [Verdict(name, value) for name, value in numbers.items() if name not in judged]


def _several(value) -> tuple:
    return value if isinstance(value, tuple) else (value,)
