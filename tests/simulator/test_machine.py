"""Statistics of repeated timings, and the description of machine and package versions."""

import numpy as np
import pytest

from taisoft.machine import machine, summarise, versions


def test_statistics_of_repeated_timings_and_versions():
    t = summarise([4.0, 1.0, 2.0, 3.0, 5.0])
    assert (t.median, t.minimum, t.maximum, t.repeats) == (3.0, 1.0, 5.0, 5)
    assert t.spread == pytest.approx(2 / 3)
    with pytest.raises(ValueError, match="at least one repeat"):
        summarise([])
    assert machine()["processor"] and machine()["cores"] >= 1
    found = versions("numpy", "no-such-package")
    assert found["numpy"] == np.__version__ and found["no-such-package"] is None
