"""A robot's compliant arm sinks under a soft block by weight over stiffness (extra robot).

The arm of assets/arm.urdf turns about one joint, which a servo of 250 N m/rad holds; MuJoCo moves it. The block of 0.1 m on
3 x 3 x 3 cells, stable neo-Hookean, E = 0.1 MPa, nu = 0.3, 1000 kg/m^3, is set down on the tray at the arm's end. z is up.

`check` asserts that the joint turns by the torque of both weights over its stiffness, and that the tray feels the block's weight.
"""

from pathlib import Path

import numpy as np

import taisoft as ts

solver = {"integrator": "implicit_euler", "dt": 1 / 100, "seconds": 2.0, "fps": 25.0}

ROBOT = Path(__file__).resolve().parents[1] / "assets" / "arm.urdf"
STIFFNESS, DAMPING = 250.0, 12.0  # of the servo [N m/rad], [N m s/rad]
ARM, CENTRE = 1.2, 0.25  # its mass [kg], and how far its centre is from the joint [m]
HEIGHT, TRAY, SIDE, G = 0.2, 0.42, 0.1, 9.81  # of the joint, place of the tray, side of the block [m]


def build() -> ts.Scene:
    """The level arm, and the block just above its tray."""
    scene = ts.Scene(up="z")
    foam = ts.Material(young=1e5, poisson=0.3, density=1000.0, friction=0.8)
    place = (TRAY, 0.0, HEIGHT + 0.01 + SIDE / 2 + 1e-4)
    scene.add_body(ts.box_mesh((3, 3, 3), (SIDE, SIDE, SIDE)), foam, name="block", position=place)
    scene.add_robot(ts.Robot.load(ROBOT, servo=(STIFFNESS, DAMPING)), name="arm", friction=0.8, iterations=20)
    return scene


def check(sim: ts.Simulator, result) -> None:
    """The arm sinks by weight over stiffness; the tray feels the block."""
    weight, robot = G * sim.scene.body("block").mass, sim.robot
    angle, held = robot.joint["elbow"], -sim.contact_force("arm/forearm/1")[2]
    assert abs(held / weight - 1.0) < 1e-3, f"the tray bears {held:.4f} N, not {weight:.4f} N"
    torque = weight * sim.positions("block")[:, 0].mean() + ARM * G * CENTRE * np.cos(angle)
    # 5e-6 measured
    assert abs(STIFFNESS * angle / torque - 1.0) < 1e-3, f"the joint turns by {angle:.5f}, not by {torque / STIFFNESS:.5f}"
    assert abs(robot.joint_velocity["elbow"]) < 1e-3, "the arm still moves"
