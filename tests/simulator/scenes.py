"""Scenes that the tests of simulators share, and so their kernels."""

import numpy as np

import taisoft as ts
from taisoft.dynamics.schemes import EXPLICIT
from tests.dynamics.contact_scenes import SIDE, cube
from tests.dynamics.scenes import SNH, SVK, rubber
from tests.dynamics.scenes import cube as box

DT = 0.002  # [s] of a pair
OVERLAP = 0.01  # [m] of cube and floor at rest
PRESS = {"dt": 2e-3, "integrator": "bdf2", "precision": "f64"}
BEFORE, AFTER = 8, 6  # steps before a checkpoint and after it


def pair(second_law: str = SNH, damping: float = 0.0) -> ts.Scene:
    """Two bodies that do not touch: the first is fixed at one end, and damped; the second flies."""
    scene = ts.Scene()
    scene.contact_forces = False
    beam = scene.add_body(box(cells=(2, 1, 1)), rubber(mass_damping=damping), name="beam", position=(1, 2, 0))
    beam.fix(lambda X: X[:, 0] < -0.49)
    spin = np.random.default_rng(4).standard_normal((8, 3))
    scene.add_body(box((4, 0, 0)), rubber(second_law, density=1200.0), name="flyer", velocity=spin)
    return scene


def simulator(integrator: str, **settings) -> ts.Simulator:
    """A simulator of a pair: explicit ones are damped and have two laws."""
    if integrator in EXPLICIT:
        return ts.Simulator(pair(SVK, 0.5), DT, integrator, precision="f64", **settings)
    return ts.Simulator(pair(), DT, integrator, precision="f64", newton_tolerance=1e-12, linear_tolerance=1e-12, **settings)


def press(release: float = 1.0) -> ts.Scene:
    """A cube on a floor that rises and slides; its top is prescribed until `release` [s].

    At rest it lies OVERLAP below the floor, and must start above it.
    """
    scene = ts.Scene()
    scene.allow_initial_overlap = True
    soft = ts.Material(young=5e4, poisson=0.3, density=1000.0, friction=0.4, restitution=0.2)
    body = scene.add_body(cube(2), soft, name="cube", position=(0, 2e-4 - OVERLAP, 0))
    body.move(lambda X: X[:, 1] > 0.99 * SIDE, lambda t: None if t > release else (0.02 * t, OVERLAP - 0.2 * t, 0.0))
    floor = ts.HalfSpace((0, 0, 0), (0, 1, 0))
    scene.add_obstacle(floor, name="floor", friction=0.5, path=lambda t: (np.array([0.3 * t, 0.05 * t, 0]), np.eye(3)))
    return scene


def pressed(release: float = 1.0, **settings) -> ts.Simulator:
    """A simulator of a press at its start."""
    sim = ts.Simulator(press(release), **(PRESS | settings))
    sim.set_state(positions=sim.positions() + (0, OVERLAP, 0))
    return sim


def follow(sim: ts.Simulator, steps: int) -> list:
    """Take steps, and return the time, positions, velocities and report of each."""
    found = []
    for _ in range(steps):
        report = sim.step()
        found.append((sim.time, sim.positions(), sim.velocities(), report))
    return found
