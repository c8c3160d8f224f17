"""Rigid bodies: a free top against Euler's equations, a cube on slopes, its weight on a soft mat, a stack of ten.

top:      dw/dt = I^-1 (I w x w), dR/dt = R [w]x, of a box of 1 x 0.6 x 0.3 m that spins about its middle axis, perturbed by 1 %,
          integrated to 1e-11 over ten turns, in which it flips,
slope:    at 26.565 degrees, of slope 1/2, a cube sticks at a friction of 0.51, and slides by g (sin a - mu cos a) at 0.49,
mat:      the contact force of a cube at rest on a mat is its weight,
stack:    ten cubes stand, and stay rigid.
"""

from functools import partial

import numpy as np
from scipy.integrate import solve_ivp

import taisoft as ts

from .record import GRAVITY, Case, near, small

BOX, SPIN, TURNS = (1.0, 0.6, 0.3), 2.0 * np.pi * np.array([0.01, 1.0, 0.0]), 10  # [m], [rad/s], one turn a second
SLOPE = np.arctan(0.5)
RIGID = 1e-4  # largest strain
STEP = 0.01  # [s] of cubes


def _free_top(inertia: np.ndarray):
    """w in the body and R, flat (12,), as a function of time. inertia: (3,) principal moments."""

    def rate(_, y):
        w, R = y[:3], y[3:].reshape(3, 3)
        turn = np.array([[0.0, -w[2], w[1]], [w[2], 0.0, -w[0]], [-w[1], w[0], 0.0]])
        return np.concatenate([np.cross(inertia * w, w) / inertia, (R @ turn).ravel()])

    start = np.concatenate([SPIN, np.eye(3).ravel()])
    return solve_ivp(rate, (0.0, TURNS), start, rtol=1e-11, atol=1e-12, dense_output=True).sol


def top(per_turn: int, _reference: dict, arch: str):
    """Rotation and spin over ten turns, by the implicit midpoint rule."""
    made = ts.Scene(gravity=(0.0, 0.0, 0.0))
    body = made.add_rigid_body(ts.box_mesh((1, 1, 1), BOX), density=500.0, name="top", angular_velocity=SPIN)
    exact, inertia = _free_top(np.diag(body.inertia)), body.inertia
    turned = spun = strain = drift = 0.0
    with ts.Simulator(made, dt=1.0 / per_turn, integrator="implicit_midpoint", precision="f64", arch=arch) as sim:
        for _ in range(20 * TURNS):
            sim.run(1.0 / 20.0, fps=None)
            y, R, w = exact(sim.time), sim.pose("top").rotation, sim.twist("top").angular_velocity
            expected = y[3:].reshape(3, 3)
            turned = max(turned, float(np.abs(R - expected).max()))
            spun = max(spun, float(np.linalg.norm(w - expected @ y[:3])))
            drift = max(drift, float(np.linalg.norm(R @ inertia @ R.T @ w - inertia @ SPIN)))
            strain = max(strain, sim.rigid_strain("top"))
    yield small("rotation, largest entry of the difference", turned, 0.005)
    yield small("angular velocity, over the spin", spun / np.linalg.norm(SPIN), 0.005)
    yield small("angular momentum, over its start", drift / np.linalg.norm(inertia @ SPIN), RIGID)
    yield small("strain", strain, RIGID)


def _cube(made: ts.Scene, name: str, height: float, **numbers) -> None:
    made.add_rigid_body(ts.box_mesh((2, 2, 2), (1.0, 1.0, 1.0)), name=name, position=(0.0, height, 0.0), **numbers)


def _ground(made: ts.Scene, **numbers) -> None:
    made.add_obstacle(ts.HalfSpace((0.0, 0.0, 0.0), (0.0, 1.0, 0.0)), name="ground", **numbers)


def slope(friction: float, _reference: dict, arch: str):
    """Acceleration along the slope after the cube has settled, by gravity turned."""
    made = ts.Scene(gravity=(GRAVITY * np.sin(SLOPE), -GRAVITY * np.cos(SLOPE), 0.0))
    _cube(made, "cube", 0.5)
    _ground(made)
    made.set_contact("cube", "ground", friction=10.0)
    with ts.Simulator(made, dt=STEP, integrator="implicit_euler", precision="f64", arch=arch) as sim:
        sim.run(0.5, fps=None)
        sim.set_contact("cube", "ground", friction=friction)
        start = sim.pose("cube").translation
        sim.run(0.1, fps=None)
        before = sim.twist("cube").velocity[0]
        sim.run(0.5, fps=None)
        gain = (sim.twist("cube").velocity[0] - before) / 0.5
        slip = np.linalg.norm((sim.pose("cube").translation - start)[[0, 2]])
        if friction < 0.5:
            yield near("acceleration [m/s^2]", gain, GRAVITY * (np.sin(SLOPE) - friction * np.cos(SLOPE)), 0.005)
        else:
            yield small("slip in 0.6 s [m]", slip, 1e-5)
        yield small("strain", sim.rigid_strain("cube"), RIGID)


def mat(_reference: dict, arch: str):
    """Contact force between a cube and a soft mat under it, at rest."""
    made = ts.Scene(gravity=(0.0, -GRAVITY, 0.0))
    soft = ts.Material(young=2e5, density=500.0, mass_damping=10.0)
    made.add_body(ts.box_mesh((6, 2, 6), (2.0, 0.4, 2.0)), soft, name="mat", position=(0.0, 0.2, 0.0), order=2)
    _cube(made, "cube", 0.901, density=200.0)
    _ground(made)
    with ts.Simulator(made, dt=STEP, integrator="implicit_euler", precision="f64", arch=arch) as sim:
        sim.run(1.5, fps=None)
        weight = sim.scene.body("cube").mass * GRAVITY
        yield near("force on the cube [N]", sim.contact_force("cube")[1], weight, 0.01)
        yield small("torque on the cube, over weight times side", np.linalg.norm(sim.contact_torque("cube")) / weight, 1e-3)
        yield small("strain", sim.rigid_strain("cube"), RIGID)


def stack(_reference: dict, arch: str):
    """Ten unit cubes on each other after a second."""
    made = ts.Scene(gravity=(0.0, -GRAVITY, 0.0))
    for k in range(10):
        _cube(made, f"cube{k}", 0.5 + k)
    _ground(made)
    with ts.Simulator(made, dt=STEP, integrator="implicit_euler", precision="f64", arch=arch) as sim:
        sim.run(1.0, fps=None)
        poses = [sim.pose(f"cube{k}") for k in range(10)]
        offset = 2e-3 * 0.5  # of the mean surface edge, at most, that each contact keeps
        yield small("sideways [m]", max(float(np.abs(one.translation[[0, 2]]).max()) for one in poses), offset)
        yield small("turned, largest entry of R - 1", max(float(np.abs(one.rotation - np.eye(3)).max()) for one in poses), 1e-3)
        yield near("height of the highest [m]", 9.5 + poses[-1].translation[1], 9.5, 2e-3)
        yield small("strain", max(sim.rigid_strain(f"cube{k}") for k in range(10)), RIGID)


CASES = (
    Case("rigid_top", "", "800 steps a turn", partial(top, 800), closed_form=True),
    Case("rigid_slope", "", "sticks", partial(slope, 0.51), closed_form=True),
    Case("rigid_slope", "", "slides", partial(slope, 0.49), closed_form=True),
    Case("rigid_mat", "", "", mat, closed_form=True),
    Case("rigid_stack", "", "", stack, closed_form=True),
)
