"""The energy check: runs that create energy are degraded; work of gravity and loads, prescribed motion, changes by the user and
corrected overlaps do not count, and explicit steps may oscillate about the energy.
"""

import pytest

from taisoft.dynamics.schemes import EXPLICIT
from taisoft.energy_check import EnergyCheck
from taisoft.records import Energies, RunReport, StepReport
from tests.dynamics.scenes import cube, rubber
from tests.simulator.scenes import simulator
from tests.simulator.test_running import StandIn as Counter


class StandIn(Counter):
    """Simulator and Dynamics of a 1 m cube with 100 J of kinetic energy."""

    def __init__(self, integrator: str = "implicit_euler"):
        super().__init__(integrator in EXPLICIT, dt=0.5)
        self.settings.integrator = integrator
        self.scene.add_body(cube(), rubber(), name="cube")
        self.scene.gravity = (0, 0, 0)

    def energies(self) -> Energies:
        return Energies(100.0, 0.0, 0.0)


def check(sim: StandIn, *reports: StepReport | None) -> RunReport:
    """The report of a run of steps with these energies; None: the user changes the state."""
    energy, run = EnergyCheck(sim), RunReport()
    for report in reports:
        if report is None:
            sim.changes += 1
            continue
        energy.before_step()
        energy.after_step(report)
    energy.add_problem(run)
    return run


def step(kinetic: float, elastic: float = 0.0, gravity: float = 0.0, loads: float = 0.0, **fields) -> StepReport:
    return StepReport(time=1.0, kinetic=kinetic, elastic=elastic, gravity=gravity, loads=loads, **fields)


@pytest.mark.parametrize(
    "steps, status",
    [
        ([step(109.0)], "ok"),
        ([step(60.0, 60.0)], "degraded"),
        ([step(10.0), step(100.0), step(120.0), step(5.0)], "degraded"),
        ([step(300.0, 0.0, -200.0)], "ok"),
        ([step(300.0, 0.0, 0.0, -200.0)], "ok"),
        ([step(340.0, 0.0, -200.0)], "degraded"),
        ([step(100.0, gravity=20.0)], "degraded"),
        ([step(90.0), None, step(105.0)], "ok"),
    ],
)
def test_rises_of_energy(steps, status):
    run = check(StandIn(), *steps)
    assert run.status == status and len(run.problems) == (status == "degraded")
    assert all("energy was created: it rose by" in text and "halve dt" in text for text in run.problems)
    (text,) = check(StandIn(), step(1000.0), step(400.0)).problems
    assert "rose by 900 J from t = 0 s to 1 s, 9 times the energy of the motion" in text


@pytest.mark.parametrize(
    "integrator, allowed, too_large",
    [("velocity_verlet", (90.0, 25.0), (92.0, 25.0)), ("symplectic_euler", (90.0, 60.0), (180.0, 60.0))],
)
def test_explicit_steps_may_oscillate_about_the_energy(integrator, allowed, too_large):
    assert check(StandIn(integrator), step(*allowed)).status == "ok"
    assert check(StandIn(integrator), step(*too_large)).status == "degraded"
    assert check(StandIn(), step(*allowed)).status == "degraded"


def test_driven_motion_corrected_overlaps_and_initial_contacts_may_add_energy():
    """Bodies that touch at the start may part to the contact offset; later contacts add nothing."""
    sim = StandIn()
    sim.is_driven = True
    assert check(sim, step(500.0)).status == "ok"
    sim.is_driven, sim.scene.allow_initial_overlap = False, True
    assert check(sim, step(500.0, max_penetration=0.1), step(505.0)).status == "ok"
    assert check(sim, step(500.0, max_penetration=0.1), step(600.0)).status == "degraded"
    assert check(StandIn(), step(130.0, n_contacts=4)).status == "ok"
    assert check(StandIn(), step(100.0), step(130.0, n_contacts=4)).status == "degraded"


@pytest.mark.parametrize("stretch, status", [(1.0, "ok"), (1.4, "degraded")])
def test_real_runs(stretch, status):
    """A beam that falls about its fixed end and a body in flight create no energy; a strained one in large steps does."""
    with simulator("velocity_verlet") as sim:
        sim.dt = 0.9 * sim.stable_dt
        sim.set_gravity((0.0, -9.81 * (stretch == 1.0), 0.0))
        x, first = sim.positions(), len(sim.positions("beam"))
        x[first:, 0] = 4.0 + stretch * (x[first:, 0] - 4.0)
        sim.set_state(positions=x, velocities=sim.velocities() * (stretch == 1.0))
        run = sim.run(200 * sim.dt, fps=None)
    assert run.status == status and ("energy was created" in " ".join(run.problems)) == (status == "degraded")
