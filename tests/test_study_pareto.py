"""The front of speed against error and the cheapest setting, as pure functions:

* no point of the front is dominated, every other one is, and it runs from the fastest to the most exact;
* the cheapest within a tolerance is within it, and nothing within it is faster; without one there is none;
* what is not a number is on no front.
"""

import math

from hypothesis import given
from hypothesis import strategies as st

from taisoft.study.results import cheapest, front, nearest

few = st.integers(0, 4).map(float)  # few values, so that points coincide and share coordinates
points = st.lists(st.tuples(few, few) | st.tuples(st.floats(1e-9, 1e9), st.floats(1e-12, 10.0)), max_size=20)


def dominates(a, b) -> bool:
    """Whether a is at most as large as b in both and smaller in one."""
    return a[0] <= b[0] and a[1] <= b[1] and a != b


@given(points)
def test_the_front_is_what_nothing_dominates(some):
    found = front(some)
    assert len(found) == len(set(found))
    for k, point in enumerate(some):
        assert (k in found) == (not any(dominates(other, point) for other in some))
    times, errors = [some[k][0] for k in found], [some[k][1] for k in found]
    assert times == sorted(times) and errors == sorted(errors, reverse=True)


@given(points, st.floats(0.0, 5.0))
def test_the_cheapest_within_a_tolerance(some, tolerance):
    found, good = cheapest(some, tolerance), [p for p in some if p[1] <= tolerance]
    if not good:
        assert found is None
    else:
        assert some[found] == min(good)


@given(points)
def test_the_nearest_has_the_least_error(some):
    found = nearest(some)
    assert (found is None) == (not some)
    if some:
        assert some[found] == min(some, key=lambda p: (p[1], p[0]))


def test_what_is_no_number_is_left_out():
    some = [(math.nan, 0.0), (1.0, math.nan), (2.0, 0.5)]
    assert front(some) == [2] and cheapest(some, 1.0) == 2 and front([]) == []
