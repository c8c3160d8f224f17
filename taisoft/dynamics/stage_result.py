"""What the solve of a stage did, and the sums of several."""

from dataclasses import dataclass, replace


@dataclass(frozen=True)
class StageResult:
    """What a solve did. Without contacts they have converged at 0 iterations."""

    newton_iterations: int
    linear_iterations: int
    residual: float  # relative
    converged: bool  # with the contacts
    at_rounding: bool  # the residual is at the rounding of the forces
    contact_iterations: int = 0  # multipliers
    contact_residual: float = 0.0
    unbalanced: tuple[float, str] = (0.0, "")  # worst relative residual of a piece beside others, and which it is


def relative(r: float, scale: float) -> float:
    """|r| over its scale; |r| itself where there is none."""
    return r / scale if scale > 0.0 else r


def merge(results: list[StageResult]) -> StageResult:
    """The parts of one step: iterations in all, the worst residuals."""
    return StageResult(
        sum(r.newton_iterations for r in results), sum(r.linear_iterations for r in results),
        max(r.residual for r in results), all(r.converged for r in results), all(r.at_rounding for r in results),
        sum(r.contact_iterations for r in results), max(r.contact_residual for r in results),
        max(r.unbalanced for r in results),
    )  # fmt: skip


def count_all(result: StageResult, given_up: list[StageResult]) -> StageResult:
    """The result of a step with the iterations of earlier tries at it."""
    work = merge([result, *given_up])
    return replace(
        result, newton_iterations=work.newton_iterations, linear_iterations=work.linear_iterations,
        contact_iterations=work.contact_iterations,
    )  # fmt: skip
