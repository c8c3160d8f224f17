"""The energy check: runs that create energy are degraded, others are ok:

* with given energies: a rise above a tenth of the energy of the motion counts, work of gravity and loads does not; prescribed
  motion, changes by the user and corrected overlaps restart the check; explicit steps may oscillate about the energy;
* energy is created by steps near `stable_dt` in a strained state, and by linearly implicit steps of St. Venant-Kirchhoff bodies
  under strong compression;
* bodies that fall, bounce, swing, vibrate or are loaded create none, also in explicit bounces with restitution 1.
"""

from types import SimpleNamespace

import numpy as np
import pytest

import taisoft as ts
from taisoft.energy_check import EnergyCheck
from taisoft.records import Energies, RunReport, StepReport
from tests.dynamics.scenes import COR, SNH, SVK, cube, rubber


class StandIn:
    """Simulator and Dynamics of a 1 m cube with 100 J of kinetic energy."""

    def __init__(self, integrator: str = "implicit_euler"):
        self.settings = SimpleNamespace(explicit=integrator in ("symplectic_euler", "velocity_verlet"), integrator=integrator)
        self.scene, self.dt, self.stable_dt, self.time = ts.Scene(), 0.5, 1.0, 0.0
        self.scene.add_body(cube(), rubber(), name="cube")
        self.scene.gravity = (0, 0, 0)
        self.is_driven, self.changes, self.contact = False, 0, SimpleNamespace(contact_offset=0.01)

    def _host(self) -> "StandIn":
        return self

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
        ([step(320.0, 0.0, -200.0)], "ok"),
        ([step(340.0, 0.0, -200.0)], "degraded"),
        ([step(100.0, gravity=20.0)], "degraded"),
        ([step(90.0), None, step(105.0)], "ok"),
        ([step(130.0), None, step(100.0)], "degraded"),
        ([step(np.nan)], "ok"),  # the run has failed
    ],
)
def test_rises_of_energy(steps, status):
    run = check(StandIn(), *steps)
    assert run.status == status and len(run.problems) == (status == "degraded")
    assert all("energy was created: it rose by" in text and "halve dt" in text for text in run.problems)


def test_messages_give_the_rise():
    (text,) = check(StandIn(), step(1000.0), step(400.0)).problems
    assert "rose by 900 J from t = 0 s to 1 s, 9 times the energy of the motion" in text
    assert "rose by 30 J from t = 0 s to 1 s, 30 % of" in check(StandIn(), step(130.0)).problems[0]


@pytest.mark.parametrize(
    "integrator, allowed, too_large",
    [("velocity_verlet", (90.0, 25.0), (105.0, 25.0)), ("symplectic_euler", (90.0, 60.0), (180.0, 60.0))],
)
def test_explicit_steps_may_oscillate_about_the_energy(integrator, allowed, too_large):
    assert check(StandIn(integrator), step(*allowed)).status == "ok"
    assert check(StandIn(integrator), step(*too_large)).status == "degraded"
    assert check(StandIn(), step(*allowed)).status == "degraded"


def test_driven_motion_and_corrected_overlaps_may_add_energy():
    sim = StandIn()
    sim.is_driven = True
    assert check(sim, step(500.0)).status == "ok"
    sim.is_driven, sim.scene.allow_initial_overlap = False, True
    assert check(sim, step(500.0, max_penetration=0.1), step(505.0)).status == "ok"
    assert check(sim, step(500.0, max_penetration=0.1), step(600.0)).status == "degraded"


def test_initial_contacts_may_open_to_their_offset():
    """Which adds energy; later contacts may not."""
    assert check(StandIn(), step(130.0, n_contacts=4)).status == "ok"
    assert check(StandIn(), step(100.0), step(130.0, n_contacts=4)).status == "degraded"


def strained(law: str, integrator: str, stretch: float, dt: float | None, steps: int) -> RunReport:
    scene = ts.Scene(gravity=(0, 0, 0))
    scene.add_body(ts.box_mesh((4, 2, 2), (2, 1, 1)), ts.Material(law=law, young=1e6, poisson=0.3, density=1000.0), name="box")
    with ts.Simulator(scene, 1e-4, integrator, precision="f64") as sim:
        sim.dt = dt or 0.9 * sim.stable_dt
        x = sim.positions()
        x[:, 0] *= stretch
        sim.set_state(positions=x)
        return sim.run(steps * sim.dt, fps=None)


@pytest.mark.filterwarnings("ignore:step")
@pytest.mark.parametrize(
    "law, integrator, stretch, dt, steps",
    [(COR, "symplectic_euler", 0.95, None, 200), (SVK, "linearly_implicit_euler", 0.6, 0.08, 3)],
)
def test_unstable_steps_create_energy(law, integrator, stretch, dt, steps):
    run = strained(law, integrator, stretch, dt, steps)
    assert run.status == "degraded" and "energy was created" in run.problems[-1]


@pytest.mark.parametrize("integrator", ["symplectic_euler", "velocity_verlet", "implicit_midpoint", "bdf2", "implicit_euler"])
def test_swinging_and_vibrating_bodies_create_no_energy(integrator):
    """A beam that falls about its fixed end under a traction, and a vibrating block that flies far away."""
    scene = ts.Scene()
    scene.contact_forces = False
    beam = scene.add_body(cube(cells=(3, 1, 1), size=(2, 0.5, 0.5)), rubber(SNH), name="beam")
    beam.fix(lambda x: x[:, 0] < -0.99)
    beam.add_traction(lambda x: x[:, 0] > 0.99, (300.0, 900.0, -2000.0))
    velocity = np.random.default_rng(0).standard_normal((8, 3))
    scene.add_body(cube(), rubber(COR), name="block", position=(1e5, -1e5, 0), velocity=velocity)
    with ts.Simulator(scene, 2e-3, integrator) as sim:
        if sim.settings.explicit:
            sim.dt = 0.9 * sim.stable_dt
        run = sim.run(1.5)
    assert run.status == "ok", run.problems


@pytest.mark.parametrize(
    "integrator, restitution", [("symplectic_euler", 1.0), ("symplectic_euler", 0.5), ("velocity_verlet", 1.0), ("bdf2", 1.0)]
)
def test_bounces_create_no_energy(integrator, restitution):
    """Explicit steps at 0.7 of `stable_dt` once created 50 times the energy of the fall."""
    scene, side = ts.Scene(), 0.1
    material = ts.Material(law=SNH, young=1e6, poisson=0.3, density=1000.0, friction=0.0)
    scene.add_body(ts.box_mesh((2, 2, 2), (side,) * 3), material, name="cube", position=(0, side, 0))
    scene.add_obstacle(ts.HalfSpace((0, 0, 0), (0, 1, 0)), name="ground", friction=0.0, restitution=restitution)
    with ts.Simulator(scene, 1e-4 if integrator[0] in "sv" else 5e-3, integrator, precision="f64") as sim:
        if sim.settings.explicit:
            sim.dt = 0.7 * sim.stable_dt
        start = sim.energies()
        run = sim.run(1.5)
        weight = start.gravity / side  # of the centre's height
    assert run.status == "ok", run.problems
    energy = np.array([r.kinetic + r.elastic + r.gravity for r in run.step_reports]) - weight * side / 2
    assert energy[-1] < 1.3 * weight * side / 2


def test_a_body_squeezed_by_the_contact_offset_is_ok():
    """It touches a plane on either side."""
    scene = ts.Scene(gravity=(0, 0, 0))
    scene.add_body(cube(size=(1, 1, 1)), rubber(), name="cube")
    for k, y in enumerate((-0.5, 0.5)):
        scene.add_obstacle(ts.HalfSpace((0, y, 0), (0, -np.sign(y), 0)), name=f"plane{k}")
    with ts.Simulator(scene, 0.01) as sim:
        run = sim.run(0.5)
    assert run.status == "ok", run.problems
