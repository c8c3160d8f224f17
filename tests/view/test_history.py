"""The history of step reports that plots show, in memory of a fixed size:

* entries cover consecutive runs of steps, of equal length but for the last, and hold the lowest and highest value of each;
* the capacity is never exceeded, and at least half of it is used;
* energies are stored as changes since the start; quantities that are not modelled or not finite are NaN and hide no neighbour.
"""

import math
from types import SimpleNamespace

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from taisoft.records import Energies, StepReport
from taisoft.view.plots import QUANTITIES, History

COLUMN = {name: k for k, name in enumerate(QUANTITIES)}


def started(capacity: int = 8, time: float = 0.0, kinetic: float = 0.0) -> History:
    history = History(capacity)
    history.start(SimpleNamespace(time=time, energies=lambda: Energies(kinetic, 1.0, 2.0)))
    return history


@settings(max_examples=60, deadline=None)
@given(
    st.lists(st.floats(-1e6, 1e6, allow_subnormal=False) | st.just(float("nan")), max_size=200), st.sampled_from([2, 4, 8, 10])
)
def test_entries_hold_the_extremes_of_their_steps(values, capacity):
    history = started(capacity)
    for k, value in enumerate(values):
        history.take(StepReport(time=k + 1.0, kinetic=value, elastic=1.0, gravity=2.0, n_contacts=k), 0.001, False, True)
    kinetic, steps = np.array([0.0, *values]), np.arange(len(values) + 1.0)
    n = len(history.times)
    length = 2 ** math.ceil(math.log2(len(kinetic) / n))
    assert n <= capacity and (length == 1 or 2 * n > capacity)
    for j in range(n):
        covered = slice(j * length, (j + 1) * length)
        finite = kinetic[covered][np.isfinite(kinetic[covered])]
        low, high = history.low[j, 0], history.high[j, 0]
        if len(finite):
            assert (low, high) == (finite.min(), finite.max())
        else:
            assert np.isnan(low) and np.isnan(high)
        assert history.times[j] == steps[covered][-1]
    assert history.times[-1] == len(values)


def test_peaks_are_kept_and_memory_does_not_grow():
    history = started(256)
    memory = history.times.base, history.low.base, history.high.base
    for k in range(20_000):
        report = StepReport(time=5e-3 * (k + 1), n_contacts=7777 if k == 6_234 else 3, elastic=1.0, gravity=2.0)
        history.take(report, 0.001, True, True)
    assert history.high[:, COLUMN["n_contacts"]].max() == 7777 and 128 <= len(history.times) <= 256
    assert (np.diff(history.times) > 0).all() and history.times[-1] == pytest.approx(100.0)
    assert all(a is b for a, b in zip(memory, (history.times.base, history.low.base, history.high.base)))


def test_energies_are_changes_and_unmodelled_quantities_are_nan():
    history = started(kinetic=10.0, time=3.0)
    report = StepReport(
        time=3.1,
        steps=4,
        kinetic=11.0,
        elastic=3.0,
        gravity=-1.0,
        residual=1e-5,
        newton_iterations=2,
        linear_iterations=30,
        contact_residual=float("inf"),
        contact_iterations=8,
        n_contacts=5,
    )
    expected = {"kinetic": 1.0, "elastic": 2.0, "gravity": -3.0, "total": 0.0, "step_time": 5.0}
    implicit = {"newton_residual": 1e-5, "newton_iterations": 2, "linear_iterations": 30}
    contact = {"contact_iterations": 2.0, "n_contacts": 5}
    for explicit, touching in ((False, True), (True, True), (True, False), (False, False)):
        history.take(report, 0.02, explicit, touching)
        modelled = expected | (implicit if not explicit else {}) | (contact if touching else {})
        assert {name: value for name, value in zip(QUANTITIES, history.last) if np.isfinite(value)} == pytest.approx(modelled)
    assert history.begin == 3.0
    history.start(SimpleNamespace(time=0.0, energies=lambda: Energies(0.0, 0.0, 0.0)))
    assert len(history.times) == 1 and history.begin == 0.0
