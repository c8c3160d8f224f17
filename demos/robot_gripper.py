"""A robot's two fingers take up a soft fruit, carry it, and set it down (extra robot).

MuJoCo moves the robot of assets/gripper.xml: a gantry with position servos, and a force sensor in its wrist. The fruit is a ball
of 80 mm, stable neo-Hookean, E = 60 kPa, nu = 0.4, 800 kg/m^3; friction 0.8 with the fingers. z is up.

`check` asserts that the fruit was lifted and stands where it was set down, that the wrist's sensor showed its weight while it was
held, and that forces on the fingers are the sums over their contacts.
"""

from pathlib import Path

import numpy as np

import taisoft as ts

solver = {"integrator": "implicit_euler", "dt": 1 / 100, "seconds": 4.0, "fps": 25.0}

ROBOT = Path(__file__).resolve().parents[1] / "assets" / "gripper.xml"
RADIUS, DENSITY, G = 0.04, 800.0, 9.81  # [m], [kg/m^3], [m/s^2]
DOWN, UP, CARRY = -0.16, -0.06, 0.2  # of the lift, and of the gantry [m]
HELD = 2.4  # when the fruit hangs still [s]
BELOW = 0.4 + 2 * 0.2  # mass of palm and fingers, which hang on the wrist, too [kg]


def path(*frames: tuple[float, float]) -> ts.KeyFrames:
    """A control along time, smoothly through (time [s], value)."""
    times, values = zip(*frames)
    return ts.KeyFrames(times, values=values, smooth=True)


def build() -> ts.Scene:
    """The fruit on the ground, below the open gripper."""
    scene = ts.Scene(up="z")
    flesh = ts.Material(young=6e4, poisson=0.4, density=DENSITY, friction=0.8, stiffness_damping=2e-3)
    scene.add_body(ts.ball_mesh(RADIUS, 6), flesh, name="fruit", position=(0.0, 0.0, RADIUS + 1e-4))
    scene.add_ground(friction=0.8)
    fingers = path((0.5, 0.0), (1.0, 0.02), (3.0, 0.02), (3.4, 0.0))
    control = {
        "lift": path((0.0, 0.0), (0.5, DOWN), (1.0, DOWN), (1.5, UP), (2.4, UP), (2.9, DOWN), (3.5, DOWN), (4.0, 0.0)),
        "travel": path((1.5, 0.0), (2.3, CARRY)),
        "left": fingers,
        "right": fingers,
    }
    scene.add_robot(ts.Robot.load(ROBOT), name="gripper", friction=0.8, control=control)
    return scene


def check(sim: ts.Simulator, result) -> None:
    """The fruit stands where it was set down; it was lifted, and the wrist felt its weight; forces are those of the contacts."""
    rest = sim.positions("fruit").mean(axis=0)
    assert abs(rest[0] - CARRY) < 0.01 and 0.9 * RADIUS < rest[2] < RADIUS, f"the fruit ends at {rest} m"
    sim.reset()
    sim.run(HELD, fps=None)
    robot, weight = sim.robot, G * sim.scene.body("fruit").mass
    height = sim.positions("fruit").mean(axis=0)[2]
    assert abs(height - rest[2] - (UP - DOWN)) < 0.005, f"the fruit hangs at {height:.4f} m"
    felt = robot.sensor["wrist"][2] - G * BELOW
    assert abs(felt / weight - 1.0) < 0.01, f"the wrist feels {felt:.4f} N of the fruit's {weight:.4f} N"  # 1e-4 measured
    contacts = sim.contacts()
    for finger in ("left finger", "right finger"):
        own = np.array(contacts.body_b) == f"gripper/{finger}"
        summed, force = -contacts.impulse[own].sum(axis=0) / sim.dt, robot.link_wrench(finger).force
        assert np.abs(force - summed).max() < 1e-6 * np.abs(summed).max(), f"the {finger} gets {force}, its contacts {summed} N"
