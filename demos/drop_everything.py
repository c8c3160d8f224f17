"""A box, a ball, a ring, a plank and a bunny fall on each other, beside a sphere and a step.

Soft rubber (some 4,800 tets), stable neo-Hookean, E = 0.6 MPa, nu = 0.35, 1000 kg/m^3, friction 0.5. They hit each other at up to
5 m/s, with sharp edges too.
"""

from pathlib import Path

import numpy as np

import taisoft as ts

solver = {"integrator": "implicit_euler", "contact_tolerance": 1e-3, "dt": 1 / 200, "seconds": 2.0, "fps": 50.0}

STRUCK, STORED = 0.3, 67.69  # [s], [J]: elastic energy while the ball is in the box. It is that of this dt: a quarter has 58.4 J
MESH = Path(__file__).resolve().parents[1] / "assets" / "bunny.msh"


def ring(radius: float, thickness: float, around: int, across: int) -> ts.TetMesh:
    """A ring of square section: a bar bent round and closed [m]."""
    bar = ts.box_mesh((around, across, across), (1.0, thickness, thickness), pattern="six")
    angle, y, r = 2 * np.pi * bar.vertices[:, 0], bar.vertices[:, 2], radius + bar.vertices[:, 1]
    bent = np.column_stack([r * np.cos(angle), y, r * np.sin(angle)])
    layer = (across + 1) ** 2
    tets = np.where(bar.tets >= around * layer, bar.tets - around * layer, bar.tets)  # the last layer is the first
    return ts.TetMesh(bent[: around * layer], tets)


def build() -> ts.Scene:
    """Everything in the air, one above the other."""
    scene = ts.Scene(gravity=(0.0, -9.81, 0.0))
    rubber = ts.Material(young=6e5, poisson=0.35, density=1000.0, friction=0.5)
    bunny = ts.read_mesh(MESH)
    scene.add_body(ts.box_mesh((4, 4, 4), (0.3, 0.3, 0.3)), rubber, name="box", position=(0.0, 0.3, 0.0))
    scene.add_body(ts.ball_mesh(0.2, 6), rubber, name="ball", position=(0.12, 0.8, 0.05))
    scene.add_body(ring(0.25, 0.12, 20, 2), rubber, name="ring", position=(0.0, 1.15, 0.0))
    scene.add_body(ts.box_mesh((8, 1, 2), (0.8, 0.08, 0.16)), rubber, name="plank", position=(0.05, 1.4, 0.0))
    scene.add_body(ts.TetMesh(0.6 * bunny.vertices, bunny.tets), rubber, name="bunny", position=(0.0, 1.6, 0.0))
    scene.add_obstacle(ts.HalfSpace((0.0, 0.0, 0.0), (0.0, 1.0, 0.0)), name="ground", friction=0.5)
    scene.add_obstacle(ts.Sphere((-0.5, 0.1, 0.1), 0.25), name="stone", friction=0.5)
    scene.add_obstacle(ts.Box((0.6, 0.08, 0.0), (0.15, 0.08, 0.4)), name="step", friction=0.5)
    return scene


def check(sim: ts.Simulator, result) -> None:
    """Energy is only lost, the first blow stores what it must, and at the end nothing is inside anything."""
    energy = np.array([report.elastic + report.kinetic + report.gravity for report in result.step_reports])
    assert np.diff(energy).max() < 1e-6 * energy[0], f"a step gained {np.diff(energy).max():.3g} J"
    struck = next(report for report in result.step_reports if abs(report.time - STRUCK) < 1e-9)
    assert abs(struck.elastic / STORED - 1.0) < 0.003, f"the first blow stored {struck.elastic:.2f} J, not {STORED} J"
    left = result.step_reports[-1].kinetic / (energy[0] - energy[-1])
    assert left < 0.15, f"{left:.0%} of the energy lost is still motion"
    for body in sim.scene.bodies:
        lowest = sim.positions(body.name)[:, 1].min()
        assert lowest > -1e-3, f"the {body.name} is {-lowest:.2e} m below the ground"
    found = sim.deepest_overlap()
    assert found is None or found.depth < 1e-3, f"{found}"
