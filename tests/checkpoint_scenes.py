"""Scenes for tests of checkpoints, and a run of one that another process can go on with."""

import sys

import numpy as np
from contact_scenes import SIDE, cube

import taisoft as ts

LOW = 0.01  # [m]
CUBES = {"dt": 0.005, "integrator": "implicit_euler", "precision": "f64"}


def cubes() -> ts.Scene:
    """Three cubes of 40 tets that fall on a floor, one of them onto the two others."""
    scene = ts.Scene()
    soft = ts.Material(young=5e4, poisson=0.3, density=1000.0, friction=0.4)
    for name, at in {"left": (0.0, 0.01, 0.0), "right": (0.12, 0.02, 0.01), "top": (0.055, 0.15, 0.005)}.items():
        scene.add_body(cube(2), soft, name=name, position=at)
    scene.add_obstacle(ts.HalfSpace((0, 0, 0), (0, 1, 0)), name="floor", friction=0.5)
    return scene


def press(release: float) -> ts.Scene:
    """A cube on a floor between a plate that is led down on it, let go at `release` [s], and a ball that is moved into it.

    The plate is to start LOW above its place at rest.
    """
    scene = ts.Scene()
    scene.allow_initial_overlap = True
    soft = ts.Material(young=5e4, poisson=0.3, density=1000.0, friction=0.4, restitution=0.2)
    scene.add_body(cube(2), soft, name="cube", position=(0, 2e-4, 0))
    plate = scene.add_body(ts.box_mesh((2, 1, 2), (0.12, 0.03, 0.12)), soft, name="plate", position=(0, SIDE + 0.0155 - LOW, 0))
    plate.move(lambda X: X[:, 1] > 0.0, lambda t: None if t > release else (0.02 * t, LOW - 0.2 * t, 0.0))
    scene.add_obstacle(ts.HalfSpace((0, 0, 0), (0, 1, 0)), name="floor", friction=0.5)
    scene.add_obstacle(
        ts.Sphere((-0.5 * SIDE - 0.0305, 0.05, 0.0), 0.03), name="ball", path=lambda t: (np.array([0.1 * t, 0, 0]), np.eye(3))
    )
    return scene


def follow(sim: ts.Simulator, steps: int) -> list:
    """Steps one by one: time, positions, velocities, report of each."""
    told = []
    for _ in range(steps):
        report = sim.step()
        told.append((sim.time, sim.positions(), sim.velocities(), report))
    return told


def go_on(checkpoint: str, steps: int, result: str) -> None:
    """Load the cubes' checkpoint, step, and write the positions after every step to `result`."""
    with ts.Simulator.load_checkpoint(checkpoint, cubes()) as sim:
        told = follow(sim, steps)
    np.savez(result, time=[t for t, *_ in told], x=[x for _, x, *_ in told], v=[v for _, _, v, _ in told])


if __name__ == "__main__":
    go_on(sys.argv[1], int(sys.argv[2]), sys.argv[3])
