"""The benchmark of element orders, on made-up numbers:

* the time to an error is exact for a power law, and a bound if all meshes lie on one side of it;
* times are compared with the default quadrature, and only where both are interpolated.
"""

import math
from dataclasses import replace

import numpy as np
import pytest

from benchmarks.order import Reach, Row, compare, time_to
from benchmarks.order_cases import CASES, HANGING, LINEAR, QUADRATIC, QUADRATIC_14, Reference

BEAM = replace(CASES[0], reference=Reference((-2.0,), 1e-3, "made up"))


def row(element=LINEAR, error=0.1, rounds=(1.0,), **more) -> Row:
    """A row with a made-up error and times."""
    return Row(HANGING, "SNH", *element, (2, 1, 1), error=error, rounds=list(rounds), **more)


def test_times_to_an_error():
    """Exact for a power law, never extrapolated; all later errors must be below, too: an error may change its sign."""
    seconds = np.array([0.1, 0.7, 2.0, 30.0])
    reach = time_to(0.02 * seconds**-0.75, seconds, goal=0.01)
    assert reach.bound == "=" and reach.seconds == pytest.approx(2.0 ** (4 / 3))
    assert time_to([0.5, 0.02], [1.0, 9.0], 0.01) == Reach(9.0, ">") and time_to([], [], 0.01) is None
    assert time_to([0.01, 0.002], [1.0, 9.0], 0.01) == Reach(1.0, "<=")
    reach = time_to([0.5, 0.001, 0.04, 0.0025], [1.0, 2.0, 3.0, 6.0], 0.01)
    assert reach.bound == "=" and reach.seconds == pytest.approx(3.0 * 2 ** (math.log(4) / math.log(16)))


def test_times_are_compared_with_the_default_quadrature():
    rows = [
        row(error=0.04, rounds=(4.0, 8.0, 4.0)),
        row(error=0.0025, rounds=(16.0, 32.0, 16.0)),
        row(QUADRATIC, error=0.04, rounds=(0.1, 0.2, 0.1)),
        row(QUADRATIC, error=0.0025, rounds=(0.4, 0.8, 0.4, 0.4)),
        row(QUADRATIC_14, error=0.0025, rounds=(0.001,)),
        row(error=None, rounds=(), failure="no luck"),
    ]
    found = compare(BEAM, rows)
    assert [found.reach[order].seconds for order in (1, 2)] == pytest.approx([8.0, 0.2]) and found.ratio == pytest.approx(40)
    assert compare(BEAM, rows, goal=1e-4).reach == {1: None, 2: None}
    (slow, fast) = compare(BEAM, rows[:1] + rows[2:]).reach.values()
    assert (slow.bound, fast.bound) == (">", "=") and compare(BEAM, rows[:1] + rows[2:]).ratio is None
