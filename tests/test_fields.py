"""Fields of a simulator:

* they are counted in bytes, named once, released together, and too large ones refused before they are made;
* those of a group, and of groups within it, hold their data when the outermost has ended, in one tree.
"""

import numpy as np
import pytest
import taichi as ti
from lanes import opened

from taisoft.errors import SimulationError
from taisoft.fields import FieldArena


def test_fields():
    with opened("f64"):
        arena = FieldArena()
        x = arena.field("x", ti.f64, (3, 2), np.arange(6.0).reshape(3, 2))
        v = arena.vectors("v", ti.f32, 5)
        arena.field("count", ti.i32, ())
        assert arena.bytes == {"x": 48, "v": 60, "count": 4}
        assert np.array_equal(x.to_numpy(), np.arange(6.0).reshape(3, 2)) and not v.to_numpy().any()
        with pytest.raises(ValueError, match="'x' is allocated twice"):
            arena.field("x", ti.f64, 1)
        with pytest.raises(SimulationError, match=r"field 'huge' needs 3000000000 entries, more than 2\^31 - 1"):
            arena.vectors("huge", ti.f32, 10**9)
        assert set(arena.bytes) == {"x", "v", "count"}
        arena.release()
        assert not arena.bytes
        arena.field("x", ti.f64, 2)  # the name is free again
        arena.release()


@pytest.mark.parametrize("precision", ["f32", "f64"])
def test_groups(precision):
    with opened(precision) as machine:
        arena, ones = FieldArena(), np.ones((6, 3))
        with arena.group():
            count = arena.field("count", ti.i32, 2, np.array([1, -2]))
            with arena.group():
                x = arena.vectors("x", machine.real, 6, ones.astype(machine.np_real))
            zero = arena.field("zero", ti.f64, 3)
        assert len(arena._trees) == 1
        assert np.array_equal(count.to_numpy(), [1, -2]) and np.array_equal(x.to_numpy(), ones) and not zero.to_numpy().any()
        arena.release()
