"""Explicit steps search seldom while surfaces are far apart:

* states and reports are the same bits as with a search in every step, also where bodies turn off their straight paths, after
  questions in flight, and after a jump to another state.
"""

import numpy as np
import pytest

import taisoft as ts
from taisoft.collision.detector import Detection
from taisoft.dynamics import search_ahead
from taisoft.dynamics.schemes import EXPLICIT
from taisoft.dynamics.search_ahead import SearchAhead
from tests.dynamics.contact_scenes import cube, ground, material

STEPS, FALL = 300, 0.1  # of the lower cube [m]


def scene() -> ts.Scene:
    """A cube falls on the ground, and another one on it."""
    made = ts.Scene(gravity=(0.0, -9.81, 0.0))
    made.add_body(cube(2), material(mass_damping=0.0), name="lower", position=(0.0, FALL, 0.0))
    made.add_body(cube(1), material(mass_damping=0.0), name="upper", position=(0.01, FALL + 0.3, 0.0), velocity=(0, -1.0, 0))
    made.add_obstacle(ground(), name="ground")
    return made


def fly(sim, asks: bool = False) -> list:
    """States and reports of a fall with a gust of wind; asks: whether questions are asked in flight."""
    found = []
    sim.reset()
    sim.set_gravity((0.0, -9.81, 0.0))
    for k in range(STEPS):
        if k in (40, 45):
            sim.set_gravity((60.0 if k == 40 else 0.0, -9.81, 0.0))
        if asks and k == 50:
            assert len(sim.detect_contacts()) == len(sim.contacts()) == 0
        report = sim.step()
        found += [sim.positions("lower"), sim.velocities("upper"), [report.n_contacts, report.max_penetration, report.kinetic]]
    return found


@pytest.mark.parametrize("integrator", EXPLICIT)
def test_results_are_those_of_a_search_in_every_step(integrator, monkeypatch):
    searches, find = [], Detection.find

    def count(self, *args, **kwargs):
        searches.append(1)
        return find(self, *args, **kwargs)

    monkeypatch.setattr(Detection, "find", count)
    monkeypatch.setattr(search_ahead, "MOST", 1)  # no contacts are kept, as searches ahead may find some earlier
    with ts.Simulator(scene(), 1e-3, integrator, precision="f64") as sim:
        seldom, n_seldom = fly(sim), len(searches)
        asked = fly(sim, asks=True)
        searches.clear()
        monkeypatch.setattr(SearchAhead, "is_far", lambda *_: False)
        every = fly(sim)
    assert n_seldom < len(searches) - 100
    assert max(rows[0] for rows in every[2::3]) > 0  # they do touch
    for one, other, always in zip(seldom, asked, every):
        assert np.array_equal(one, always) and np.array_equal(other, always)
