"""`Simulator.warm_up`: what later steps need is compiled before, and nothing else changes.

* after it, steps in which bodies meet, slide, rebound and pass each other's paths launch no kernel for the first time;
* a run is the same bit by bit, whether it was warmed up at its start, while bodies touch, or not at all.
"""

from contextlib import contextmanager

import numpy as np
import pytest

import taisoft as ts
from taisoft.backend.compiled import Compiled
from taisoft.backend.launching import Kernels
from tests.dynamics.contact_scenes import SIDE, cube

SOFT = {"young": 5e4, "poisson": 0.3, "density": 1000.0}
GROUND = ts.HalfSpace((0, 0, 0), (0, 1, 0))


def falling(restitution: float = 0.0, rigid: bool = False) -> ts.Scene:
    """Two soft cubes that fall beside a ball on each other and on the ground; with `rigid`, the upper one is rigid."""
    scene = ts.Scene()
    soft = ts.Material(**SOFT, friction=0.4, restitution=restitution)
    scene.add_body(cube(2), soft, name="low", position=(0, 0.02 * SIDE, 0), velocity=(0.2, 0, 0))
    place = {"position": (0.3 * SIDE, 1.05 * SIDE, 0), "velocity": (-1.0, -1.5, 0.3)}
    if rigid:
        scene.add_rigid_body(cube(1), density=1000.0, name="high", **place)
    else:
        scene.add_body(cube(1), soft, name="high", **place)
    scene.add_obstacle(GROUND, name="ground", friction=0.3)
    scene.add_obstacle(ts.Sphere((1.4 * SIDE, 0.4 * SIDE, 0), 0.5 * SIDE), name="ball")
    return scene


def pair() -> ts.Scene:
    """Two soft cubes that collide in the air, without obstacles."""
    scene = ts.Scene(gravity=(0, 0, 0))
    for k, name in enumerate(("left", "right")):
        scene.add_body(cube(1), ts.Material(**SOFT), name=name, position=(1.02 * k * SIDE, 0, 0), velocity=(0.5 - k, 0, 0))
    return scene


def plain() -> ts.Scene:
    """A soft cube that falls on the ground."""
    scene = ts.Scene()
    scene.add_body(cube(2), ts.Material(**SOFT), position=(0, 0.02 * SIDE, 0), velocity=(0, -1, 0))
    scene.add_obstacle(GROUND)
    return scene


CASES = [
    pytest.param(falling(0.5, rigid=True), "implicit_euler", 5e-3, 12, id="restitution and rigid bodies"),
    pytest.param(falling(), "bdf2", 5e-3, 12, id="bdf2"),
    pytest.param(pair(), "symplectic_euler", 5e-4, 60, id="explicit pair"),
    pytest.param(plain(), "velocity_verlet", 5e-4, 60, id="explicit ground"),
]


@contextmanager
def launches():
    """Collect the versions of kernels that are launched."""
    found, plain = set(), Compiled.launch

    def launch(self, *arguments):
        found.add(self)
        return plain(self, *arguments)

    Compiled.launch = launch
    Kernels.watch(True)
    try:
        yield found
    finally:
        Kernels.watch(False)
        Compiled.launch = plain


@pytest.mark.parametrize("scene, integrator, dt, steps", CASES)
def test_no_later_step_launches_another_kernel(scene, integrator, dt, steps):
    with ts.Simulator(scene, dt, integrator) as sim, launches() as found:
        sim.warm_up()
        known, n_contacts = set(found), 0
        for _ in range(steps):
            n_contacts = max(n_contacts, sim.step().n_contacts)
        assert n_contacts > 0 and sorted(one.path for one in found - known) == []


@pytest.mark.parametrize("scene, integrator, dt, steps", CASES)
def test_a_run_stays_the_same(scene, integrator, dt, steps):
    """Time, motion, contacts and reports, also of the steps right after it."""

    def run(warm: tuple) -> list:
        found = []
        for k in range(steps):
            if k in warm:
                sim.warm_up()
            report, contacts = sim.step(), sim.contacts()
            found.append((sim.time, sim.positions(), sim.velocities(), contacts.impulse, contacts.point, vars(report)))
        return found

    with ts.Simulator(scene, dt, integrator) as sim:
        expected = run(())
        for warm in ((0,), (steps // 2, steps - 2)):
            sim.reset()
            for one, other in zip(run(warm), expected):
                assert all(np.array_equal(a, b) for a, b in zip(one[:-1], other[:-1])) and one[-1] == other[-1]


def test_it_changes_nothing_that_can_be_read():
    with ts.Simulator(falling(), 5e-3, "bdf2") as sim:
        for _ in range(8):
            sim.step()
        before = sim.time, sim.step_count, sim.positions(), sim.contacts().impulse, sim.contact_force("low", "ground")
        sim.warm_up()
        after = sim.time, sim.step_count, sim.positions(), sim.contacts().impulse, sim.contact_force("low", "ground")
        assert len(before[3]) > 0 and all(np.array_equal(a, b) for a, b in zip(before, after))


def test_a_step_that_fails_leaves_the_state():
    with ts.Simulator(falling(), 5e-3, "bdf2") as sim:
        sim.set_state(velocities=np.full_like(sim.velocities(), 1e30))
        x = sim.positions()
        with pytest.raises(ts.SimulationError, match="step 1"):
            sim.warm_up()
        assert sim.step_count == 0 and np.array_equal(sim.positions(), x)
