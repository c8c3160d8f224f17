"""Nested values and their arrays come back through JSON and the flat dict, whatever their keys."""

import json

import numpy as np
from hypothesis import given
from hypothesis import strategies as st
from hypothesis.extra import numpy as hnp

from taisoft.nested import join_arrays, part_arrays

# where a kernel has run, the processor flushes subnormal numbers to zero
floats = st.floats(allow_nan=False, allow_subnormal=False)
leaves = st.none() | st.booleans() | st.integers() | floats | st.text() | hnp.arrays(float, st.integers(0, 3))
keys = st.text(max_size=3) | st.sampled_from(["x", "#0", "0", "a/b", "body 'a': young"])
values = st.recursive(leaves, lambda inner: st.lists(inner, max_size=3) | st.dictionaries(keys, inner, max_size=4), max_leaves=8)


def same(a, b) -> bool:
    if isinstance(a, dict):
        return isinstance(b, dict) and list(a) == list(b) and all(same(a[key], b[key]) for key in a)
    if isinstance(a, list):
        return isinstance(b, list) and len(a) == len(b) and all(map(same, a, b))
    return type(a) is type(b) and np.array_equal(a, b, equal_nan=isinstance(a, np.ndarray))


@given(values)
def test_random_values_come_back(value):
    arrays = {}
    text = json.dumps(part_arrays(value, arrays))
    assert same(join_arrays(json.loads(text), arrays), value)
