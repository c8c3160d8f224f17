"""An implicit step with contacts on the GPU path: its launches and host accesses follow from its events alone, and the order in
which a team takes its work changes no more than the rounding of sums."""

import numpy as np
import pytest

import taisoft as ts
from taisoft.backend.counters import FILLS, counting
from taisoft.backend.paths import AS_WRITTEN, Order, gpu_path

DT, STEPS = 5e-3, 14
EVENTS = ("run_team", "update_multipliers")  # linear solves with their steps; updates of multipliers
SEARCHES = (
    "update_surface",
    "search_shapes",
    "place_at_end",
    "set_leg",
)  # searches, renewals of the geometry, and legs of bent paths


def landing(pair: bool) -> ts.Scene:
    """A cube that slides and lands on the ground, and another that falls on it."""
    scene, size = ts.Scene(gravity=(0.0, -9.81, 0.0)), (0.1,) * 3
    rubber = ts.Material(law="stable_neo_hookean", young=1e5, poisson=0.3, density=1000.0)
    mesh = ts.box_mesh((3, 3, 3), size, pattern="six")
    scene.add_body(mesh, rubber, name="cube", position=(0.0, 0.0501, 0.0), velocity=(0.3, -0.2, 0.0))
    if pair:
        scene.add_body(mesh, rubber, name="other", position=(0.02, 0.1505, 0.01), velocity=(0.3, -0.4, 0.0))
    scene.add_obstacle(ts.HalfSpace((0.0, 0.0, 0.0), (0.0, 1.0, 0.0)), name="ground")
    return scene


@pytest.mark.parametrize("pair, integrator", [(False, "implicit_euler"), (True, "bdf2")])
def test_launches_and_accesses_follow_from_the_events_of_a_step(pair, integrator):
    most_events = 0
    with gpu_path(), ts.Simulator(landing(pair), dt=DT, integrator=integrator) as sim:
        sim.step()  # the first one also finds out what crosses
        for _ in range(STEPS):
            with counting() as counts:
                report = sim.step()
            n, launches = report.newton_iterations, counts.launches
            events, searches = (sum(launches[name] for name in names) for names in (EVENTS, SEARCHES))
            accesses = sum(m for kind, m in counts.accesses.items() if kind != FILLS) + counts.returned.total()
            assert launches.total() <= 50 + 9 * n + 6 * events + 45 * searches
            assert accesses <= events + 5 * n + 10 and counts.host_arrays.total() == 0
            most_events = max(most_events, events)
    assert report.converged and report.n_contacts >= 16 and most_events > 15


def test_the_order_of_a_team_changes_only_the_rounding_of_sums():
    found = []
    for order in (AS_WRITTEN, AS_WRITTEN, Order(7, True)):
        with gpu_path(order), ts.Simulator(landing(False), dt=DT, precision="f64") as sim:
            reports = [sim.step() for _ in range(4)]
            found.append((sim.positions(), [report.newton_iterations for report in reports]))
    (x, n), (again, n_again), (y, n_other) = found
    assert np.array_equal(x, again) and n == n_again == n_other
    assert not np.array_equal(x, y) and np.abs(y - x).max() < 1e-10  # [m]: the tolerance of f64 times a step's way
