"""A scene in f32 has the contacts of the same scene in f64: only the samples of distance fields are rounded.

The last file of the folder, since another precision makes Taichi forget all kernels.
"""

import numpy as np
import pytest

from tests.collision.detection_scenes import compare, keys, simulator, zoo


@pytest.mark.long
def test_contacts_in_single_precision(double_precision):
    with simulator(zoo()[0]) as sim:
        expected = sim.detect_contacts()
    double_precision.close()
    with simulator(zoo()[0], "f32") as sim:
        found = sim.detect_contacts()
    compare(expected, found, close=1e-5)
    by_field = np.char.endswith(expected.kind.astype(str), "_field")
    order = [keys(found).index(key) for key in keys(expected)]
    assert np.abs(found.gap[order] - expected.gap)[~by_field].max() < 1e-12
