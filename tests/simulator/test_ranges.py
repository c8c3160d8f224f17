"""Ranges of consecutive items against loops over them."""

import numpy as np
from hypothesis import given
from hypothesis import strategies as st

from taisoft.ranges import entries_of, expand, owners


@given(st.lists(st.tuples(st.integers(-9, 9), st.integers(0, 4)), max_size=6))
def test_ranges_are_expanded(ranges):
    starts, counts = np.array(ranges, dtype=np.int64).reshape(-1, 2).T
    wanted = [(k, start + i) for k, (start, count) in enumerate(ranges) for i in range(count)]
    owner, item = expand(starts, counts)
    assert list(zip(owner.tolist(), item.tolist())) == wanted and owners(counts).tolist() == owner.tolist()


def test_entries_of_rows():
    start = np.array([0, 2, 2, 5, 6])
    assert entries_of(start, np.array([2, 0])).tolist() == [2, 3, 4, 0, 1]
    assert entries_of(start, np.array([1, 3])).tolist() == [5]
    assert entries_of(start, np.array([], dtype=int)).size == 0
