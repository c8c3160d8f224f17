"""The Pareto front of time against error, and the cheapest setting within a tolerance."""

import math

from hypothesis import given
from hypothesis import strategies as st

from taisoft.study.results import cheapest, front, nearest

few = st.integers(0, 4).map(float)  # points often coincide or share a coordinate
points = st.lists(st.tuples(few, few) | st.tuples(st.floats(1e-9, 1e9), st.floats(1e-12, 10.0)), max_size=20)


def dominates(a, b) -> bool:
    """Whether a is not larger than b in either coordinate, and smaller in one."""
    return a[0] <= b[0] and a[1] <= b[1] and a != b


@given(points)
def test_front_holds_exactly_the_undominated_points(candidates):
    found = front(candidates)
    assert len(found) == len(set(found))
    for k, point in enumerate(candidates):
        assert (k in found) == (not any(dominates(other, point) for other in candidates))
    times, errors = [candidates[k][0] for k in found], [candidates[k][1] for k in found]
    assert times == sorted(times) and errors == sorted(errors, reverse=True)


@given(points, st.floats(0.0, 5.0))
def test_cheapest_is_the_fastest_within_the_tolerance(candidates, tolerance):
    found, accurate = cheapest(candidates, tolerance), [p for p in candidates if p[1] <= tolerance]
    if not accurate:
        assert found is None
    else:
        assert candidates[found] == min(accurate)


@given(points)
def test_nearest_has_the_smallest_error(candidates):
    found = nearest(candidates)
    assert (found is None) == (not candidates)
    if candidates:
        assert candidates[found] == min(candidates, key=lambda p: (p[1], p[0]))


def test_points_with_nan_are_left_out():
    candidates = [(math.nan, 0.0), (1.0, math.nan), (2.0, 0.5)]
    assert front(candidates) == [2] and cheapest(candidates, 1.0) == 2 and front([]) == []
