"""Error estimates in a sentence, and what a smaller error would cost.

The error in time falls with dt^p, p the observed order, and the work grows with 1 / dt. The error in space falls with h^2, and
the work grows with h^-4: tets with h^-3, and steps or iterations with 1 / h. The solvers' error stays: what it alone exceeds has
no forecast.
"""

import math

from taisoft.display import LEAST, percent
from taisoft.estimation.order import MESH_ORDER
from taisoft.records import ERROR_KINDS, ErrorEstimate

MESH_WORK = 4  # exponent of the work in 1 / h


def describe_error(estimate: ErrorEstimate, wall_seconds: float) -> list[str]:
    """Sentences on a run of wall_seconds [s] without output: the error, what a smaller one would cost, and the notes."""
    parts = {name: getattr(estimate, name) for name in ERROR_KINDS}
    known = {name: value for name, value in parts.items() if value is not None}
    listed = ", ".join(f"{name} {percent(value)}" for name, value in known.items())
    sentences = []
    if estimate.total is not None:
        on_mesh = "" if "space" in known else " on this mesh"
        sentences.append(f"about {percent(estimate.total)} % of the largest excursion{on_mesh} ({listed})")
        if cost := forecast(estimate, wall_seconds):
            target, seconds = cost
            sentences[0] += f"; {percent(target)} %{on_mesh} would take about {seconds:.{2 if seconds < 100.0 else 3}g} s"
    elif estimate.time_until_then is not None:
        sentences.append(
            f"about {percent(estimate.time_until_then)} % in time until t = {estimate.agree_until:.4g} s, then unknown"
        )
        apart = max(estimate.spread_after.values())
        sentences.append(f"afterwards the mean positions of bodies change by up to {percent(apart)} % with the step")
    elif known:
        sentences.append(f"unknown in time; in percent of the largest excursion {listed}")
    return sentences + estimate.notes


def forecast(estimate: ErrorEstimate, wall_seconds: float) -> tuple[float, float] | None:
    """The next power of ten below the error, and the wall time it would take [s]; None if unknown."""
    total = estimate.total
    if total is None or not LEAST < total < math.inf:
        return None
    target = 10.0 ** (math.ceil(math.log10(total)) - 1)
    left = target - (estimate.solver or 0.0)
    return None if left <= 0.0 else (target, wall_seconds * work_for(estimate, left))


def work_for(estimate: ErrorEstimate, target: float) -> float:
    """Work for an error of time and space, over that of the run: each gets half of it where both are estimated."""
    shares = [(estimate.time, 1.0 / (estimate.order or 1.0)), (estimate.space, MESH_WORK / MESH_ORDER)]
    known = [(error, exponent) for error, exponent in shares if error]
    return math.prod(max(1.0, len(known) * error / target) ** exponent for error, exponent in known)
