"""A robot's lever under a constant torque pushes a rubber cube over the ground (extra robot).

MuJoCo moves the lever of assets/pusher.xml, 0.4 m long, which hangs from a hinge under a motor's constant 2 N m; its weight is
compensated, and its round end touches the cube without friction. The cube of 0.1 m on 3 x 3 x 3 cells, stable neo-Hookean,
E = 3 MPa, nu = 0.3, 500 kg/m^3, slides with friction 0.4. z is up.

`check` compares the cube's path with that of a rigid block: I a'' = T - F l cos(a), m (l sin(a))'' = F - mu m g.
"""

from pathlib import Path

import numpy as np
from scipy.integrate import solve_ivp

import taisoft as ts

solver = {"integrator": "implicit_euler", "dt": 1 / 500, "seconds": 0.3, "fps": 50.0}

ROBOT = Path(__file__).resolve().parents[1] / "assets" / "pusher.xml"
TORQUE, LENGTH, END = 2.0, 0.4, 0.02  # [N m], of the lever and radius of its end [m]
SIDE, FRICTION, G = 0.1, 0.4, 9.81  # of the cube [m], with the ground, [m/s^2]


def build() -> ts.Scene:
    """The lever upright, and the cube at its end."""
    scene = ts.Scene(up="z")
    rubber = ts.Material(young=3e6, poisson=0.3, density=500.0, friction=FRICTION)
    place = (END + SIDE / 2 + 1e-4, 0.0, SIDE / 2)
    scene.add_body(ts.box_mesh((3, 3, 3), (SIDE, SIDE, SIDE)), rubber, name="cube", position=place)
    scene.add_ground(friction=FRICTION, height=-1e-4)
    place = (0.0, 0.0, 0.4 * SIDE + LENGTH - 0.5)
    lever, control = ts.Robot.load(ROBOT), {"motor": lambda t: TORQUE}
    robot = scene.add_robot(lever, name="pusher", position=place, iterations=10, control=control)
    scene.set_contact("cube", next(iter(robot.shapes)), friction=0.0)
    return scene


def rigid_path(t: np.ndarray, mass: float, inertia: float) -> np.ndarray:
    """How far a rigid block was pushed at times t [s] [m]."""

    def rates(_, state):
        a, w = state
        along = LENGTH * np.cos(a)
        force = FRICTION * mass * G - mass * LENGTH * np.sin(a) * w**2
        return w, (TORQUE - force * along) / (inertia + mass * along**2)

    return LENGTH * np.sin(solve_ivp(rates, (0.0, t[-1]), (0.0, 0.0), t_eval=t, rtol=1e-9).y[0])


def check(sim: ts.Simulator, result) -> None:
    """The cube moves as a rigid block does, and the ground resists by friction."""
    mass, inertia = sim.scene.body("cube").mass, float(sim.robot.model.dof_M0[0])
    sim.reset()
    times, path, start = [], [], sim.positions("cube")[:, 0].mean()

    def on_frame(sim, index, report) -> None:
        times.append(sim.time)
        path.append(sim.positions("cube")[:, 0].mean() - start)

    sim.run(solver["seconds"], on_frame, fps=solver["fps"])
    exact = rigid_path(np.array(times), mass, inertia)
    off = np.abs(np.array(path) - exact).max() / exact[-1]
    assert off < 0.01, f"the cube's path is off by {off:.2%}"  # 0.6 % measured
    slid = sim.contact_force("cube", "ground")
    assert abs(slid[0] / slid[2] + FRICTION) < 1e-3, f"friction is {slid[0] / slid[2]:.4f} of the normal force"
