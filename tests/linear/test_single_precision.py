"""Solvers in f32: conjugate gradients alone and with multigrid reach what rounding allows."""

from taisoft.linear import pcg
from taisoft.linear.hierarchy import build_hierarchy
from tests.linear.boxes import assembled, error, held_box


def test_solutions_in_single_precision():
    with assembled(held_box(), shift=100.0, precision="f32") as made:
        m, A, w = made.model, made.A, made.work
        hierarchy = build_hierarchy(m, A, made.x, made.free)
        for solve, most in (
            (lambda tolerance: pcg.solve(m, A, w, tolerance, 1000), 200),
            (lambda tolerance: hierarchy.solve(m, A, w, tolerance, 200), 40),
        ):
            result = solve(1e-6)
            assert result.converged and not result.negative and 4 < result.iterations < most and error(made) < 1e-3
