"""The benchmark of element orders, on made-up numbers:

* the time to an error is exact for a power law, and a bound if all meshes lie on one side of it;
* ratios are per round, with the default quadrature; an extrapolated reference is the limit of its rows.
"""

import math
from dataclasses import replace

import numpy as np
import pytest

from benchmarks.order import Reach, compare, time_to
from benchmarks.order_cases import CASES, HANGING, LINEAR, QUADRATIC, QUADRATIC_14, Reference
from benchmarks.order_runs import Row, own_reference, set_error

BEAM = CASES[0]
REFERENCE = Reference((-2.0,), 1e-3, "made up")


def row(element=LINEAR, cells=(2, 1, 1), error=0.1, rounds=(1.0,), **more) -> Row:
    """A row with a made-up error and times."""
    found = {"tets": 10, "nodes": 12, "measured": [-1.9], "error": error, "rounds": list(rounds)} | more
    return Row(HANGING, "SNH", element.order, element.degree, element.points, cells, **found)


def test_times_to_an_error():
    """Exact for a power law, never extrapolated; all later errors must be below, too: an error may change its sign."""
    seconds = np.array([0.1, 0.7, 2.0, 30.0])
    reach = time_to(0.02 * seconds**-0.75, seconds, goal=0.01)
    assert reach.bound == "=" and reach.seconds == pytest.approx(2.0 ** (4 / 3))
    assert time_to([0.5, 0.02], [1.0, 9.0], 0.01) == Reach(9.0, ">") and time_to([], [], 0.01) is None
    assert time_to([0.01, 0.002], [1.0, 9.0], 0.01) == Reach(1.0, "<=")
    reach = time_to([0.5, 0.001, 0.04, 0.0025], [1.0, 2.0, 3.0, 6.0], 0.01)
    assert reach.bound == "=" and reach.seconds == pytest.approx(3.0 * 2 ** (math.log(4) / math.log(16)))


def test_ratios_are_per_round_with_the_default_quadrature():
    rows = [
        row(error=0.04, rounds=(4.0, 8.0, 4.0)),
        row(error=0.0025, rounds=(16.0, 32.0, 16.0)),
        row(QUADRATIC, error=0.04, rounds=(0.1, 0.2, 0.1)),
        row(QUADRATIC, error=0.0025, rounds=(0.4, 0.8, 0.4, 0.4)),
        row(QUADRATIC_14, error=0.0025, rounds=(0.001,)),
        row(error=None, rounds=(), failure="no luck"),
    ]
    found = compare(BEAM, rows, REFERENCE)
    assert found.bound == "=" and found.ratio.repeats == 3
    assert (found.ratio.median, found.ratio.spread) == (pytest.approx(40), pytest.approx(0))
    assert [found.reach[order].seconds for order in (1, 2)] == pytest.approx([8.0, 0.2])


def test_own_references_and_errors():
    """The limit of a geometric sequence; the largest error counts."""
    values = [-2.0 + 0.3 * 0.25**k for k in range(4)]
    rows = [row(QUADRATIC, measured=[x]) for x in values] + [row(measured=[7.0]), row(QUADRATIC_14, measured=[8.0])]
    limit = own_reference(replace(BEAM, extrapolated=True), rows)
    assert limit.values == pytest.approx((-2.0,), rel=1e-12) and limit.uncertainty == pytest.approx(0.3 * 0.25**3 / 2)
    assert own_reference(replace(BEAM, extrapolated=False), rows).values == ()
    assert own_reference(replace(BEAM, extrapolated=True), rows[:2]).values == ()
    found = row(measured=[-1.9, 4.4, 99.0], error=None)
    set_error(found, Reference((-2.0, 4.0), 0.0, ""))
    assert found.error == pytest.approx(0.1)
