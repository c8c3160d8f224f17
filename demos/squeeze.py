"""A soft ball is squeezed flat between two plates and let go.

A ball of 0.2 m radius (some 1,200 tets), stable neo-Hookean, E = 0.1 MPa, nu = 0.4, 1000 kg/m^3, without gravity; the plates
close to 0.55 of its diameter within 1 s, hold, and open again.
"""

import numpy as np

import taisoft as ts

solver = {"integrator": "implicit_euler", "dt": 1 / 100, "seconds": 3.0, "fps": 50.0}

RADIUS = 0.2  # [m]
PLATE = (0.24, 0.01, 0.24)  # [m] half the plate's sides
GAP = 1.002 * RADIUS  # [m] between the middle and each plate at the start
CLOSED, OPENING, OPEN = 1.0, 1.5, 2.0  # [s]: end of the closing, start and end of the opening
SHARE = 0.45  # of the gap that is closed
ENERGY = 216.20  # [J] squeezed: in double precision with a quarter of the dt; 1e-4 less measured here


def build() -> ts.Scene:
    """The ball between the open plates."""
    scene = ts.Scene(gravity=(0.0, 0.0, 0.0))
    rubber = ts.Material(young=1e5, poisson=0.4, density=1000.0, friction=0.5, mass_damping=5.0)
    scene.add_body(ts.ball_mesh(RADIUS, 8), rubber, name="ball")
    for name, side in (("upper", 1.0), ("lower", -1.0)):
        plate = ts.Box((0.0, side * (GAP + PLATE[1]), 0.0), PLATE)
        way = [(0.0, 0.0, 0.0), (0.0, -side * SHARE * GAP, 0.0), (0.0, -side * SHARE * GAP, 0.0), (0.0, 0.0, 0.0)]
        path = ts.KeyFrames([0.0, CLOSED, OPENING, OPEN], way, smooth=True)
        scene.add_obstacle(plate, name=name, friction=0.5, path=path)
    return scene


def check(sim: ts.Simulator, result) -> None:
    """Squeezed, the ball holds the energy that its shape has; let go, it is what it was."""
    held = next(report for report in result.step_reports if abs(report.time - 0.5 * (CLOSED + OPENING)) < 1e-9)
    assert held.kinetic < 1e-5, f"the squeezed ball moves: {held.kinetic:.3g} J"
    assert abs(held.elastic / ENERGY - 1.0) < 0.004, f"the squeezed ball stores {held.elastic:.2f} J, not {ENERGY} J"
    last = result.step_reports[-1]
    assert last.elastic + last.kinetic < 1e-6, f"{last.elastic + last.kinetic:.3g} J are left in the ball"
    body = sim.scene.body("ball")
    off = np.abs(sim.positions("ball") - body.rest_positions).max()
    assert off < 1e-3 * RADIUS, f"the ball is {off:.2e} m off its shape and place"
    deepest = max(report.max_penetration for report in result.step_reports)
    assert deepest < 1e-3 * RADIUS, f"a plate was {deepest:.2e} m in the ball"
