"""Scenes for tests of checkpoints; as a script, continues a run in another process."""

import sys

import numpy as np

import taisoft as ts
from tests.dynamics.contact_scenes import SIDE, cube

OVERLAP = 0.01  # [m] of plate and cube at rest
CUBES = {"dt": 0.005, "integrator": "implicit_euler", "precision": "f64"}


def cubes() -> ts.Scene:
    """Three cubes of 40 tets that fall, two on a floor and one onto the others."""
    scene = ts.Scene()
    soft = ts.Material(young=5e4, poisson=0.3, density=1000.0, friction=0.4)
    for name, at in {"left": (0.0, 0.01, 0.0), "right": (0.12, 0.02, 0.01), "top": (0.055, 0.15, 0.005)}.items():
        scene.add_body(cube(2), soft, name=name, position=at)
    scene.add_obstacle(ts.HalfSpace((0, 0, 0), (0, 1, 0)), name="floor", friction=0.5)
    return scene


def press(release: float) -> ts.Scene:
    """A cube on a floor, pressed by a plate whose nodes are prescribed until `release` [s], and hit by a moving ball.

    The plate must start OVERLAP above its place at rest.
    """
    scene = ts.Scene()
    scene.allow_initial_overlap = True
    soft = ts.Material(young=5e4, poisson=0.3, density=1000.0, friction=0.4, restitution=0.2)
    scene.add_body(cube(2), soft, name="cube", position=(0, 2e-4, 0))
    plate = scene.add_body(
        ts.box_mesh((2, 1, 2), (0.12, 0.03, 0.12)), soft, name="plate", position=(0, SIDE + 0.0155 - OVERLAP, 0)
    )
    plate.move(lambda X: X[:, 1] > 0.0, lambda t: None if t > release else (0.02 * t, OVERLAP - 0.2 * t, 0.0))
    scene.add_obstacle(ts.HalfSpace((0, 0, 0), (0, 1, 0)), name="floor", friction=0.5)
    scene.add_obstacle(
        ts.Sphere((-0.5 * SIDE - 0.0305, 0.05, 0.0), 0.03), name="ball", path=lambda t: (np.array([0.1 * t, 0, 0]), np.eye(3))
    )
    return scene


def follow(sim: ts.Simulator, steps: int) -> list:
    """Take steps, and return the time, positions, velocities and report of each."""
    found = []
    for _ in range(steps):
        report = sim.step()
        found.append((sim.time, sim.positions(), sim.velocities(), report))
    return found


def resume(checkpoint: str, steps: int, result: str) -> None:
    """Continue from a checkpoint of the cubes, and write times, positions and velocities of all steps to `result`."""
    with ts.Simulator.load_checkpoint(checkpoint, cubes()) as sim:
        found = follow(sim, steps)
    np.savez(result, time=[t for t, *_ in found], x=[x for _, x, *_ in found], v=[v for _, _, v, _ in found])


if __name__ == "__main__":
    resume(sys.argv[1], int(sys.argv[2]), sys.argv[3])
