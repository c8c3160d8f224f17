"""Results of stages and steps, and merging of several."""

import math
from dataclasses import dataclass, field, replace


@dataclass(frozen=True)
class StageResult:
    """Result of solving an implicit stage. Without contacts, contacts count as converged after 0 iterations."""

    newton_iterations: float
    linear_iterations: int
    residual: float  # relative
    converged: bool  # including the contacts
    at_rounding: bool  # the residual is at the level of the forces' rounding
    contact_iterations: int = 0  # multipliers
    contact_residual: float = 0.0
    unbalanced: tuple[float, str] = (0.0, "")  # largest relative residual of a piece, and its name, if unbalanced
    multigrid_solves: int = 0
    imbalance: str = ""  # what is out of balance, in words, if it has not converged
    free: bool = True  # whether nothing passes through anything on the way, and all is finite
    correction: float = 0.0  # displacement by the last Newton iteration and by holding back, if time was out [m]


@dataclass
class StepResult:
    """What a stepper reports of a step, or of a batch of explicit steps: totals, and extremes over the batch.

    The fields mean those of `StepReport`; `min_volume_ratio` and `n_inverted` leave out the final state.
    """

    steps: int = 1
    substeps: int = 1
    newton_iterations: int = 0
    linear_iterations: int = 0
    multigrid_solves: int = 0
    contact_iterations: int = 0
    residual: float = 0.0
    contact_residual: float = 0.0
    min_volume_ratio: float = math.inf
    n_inverted: int = 0
    converged: bool = True
    on_budget: int = 0
    last_correction: float = 0.0
    problems: list[str] = field(default_factory=list)


def relative(r: float, scale: float) -> float:
    """Return |r| over its scale, or |r| if the scale is 0."""
    return r / scale if scale > 0.0 else r


def merge(results: list[StageResult]) -> StageResult:
    """Merge the substeps of a step: total iterations, largest residuals."""
    if len(results) == 1:
        return results[0]
    return StageResult(
        sum(r.newton_iterations for r in results),
        sum(r.linear_iterations for r in results),
        max(r.residual for r in results),
        all(r.converged for r in results),
        all(r.at_rounding for r in results),
        sum(r.contact_iterations for r in results),
        max(r.contact_residual for r in results),
        max(r.unbalanced for r in results),
        sum(r.multigrid_solves for r in results),
        max(results, key=lambda r: (not r.converged, r.residual)).imbalance,
        correction=sum(r.correction for r in results),
    )


def count_all(result: StageResult, discarded: list[StageResult]) -> StageResult:
    """Return the result of a step plus the iterations of discarded attempts."""
    if not discarded:
        return result
    total = merge([result, *discarded])
    return replace(
        result,
        newton_iterations=total.newton_iterations,
        linear_iterations=total.linear_iterations,
        multigrid_solves=total.multigrid_solves,
        contact_iterations=total.contact_iterations,
    )
