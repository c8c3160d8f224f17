"""A clamped beam of a stiff layer and a soft one is bent by a force that grows within a second.

2.4 x 0.1 x 0.1 m, 240 quadratic tets in two regions: 4 GPa and 2500 kg/m^3 below, 1 GPa and 1000 kg/m^3 above, nu = 0, stable
neo-Hookean. The force on its end follows key frames, from 0 to 400 N; mass damping brings the beam to rest.

`check` compares the end's deflection at rest with Timoshenko's beam: the layers bend about the neutral axis of both.
"""

import numpy as np

import taisoft as ts

solver = {"integrator": "implicit_euler", "dt": 1 / 60, "seconds": 3.0, "fps": 30.0}

LENGTH, HEIGHT, WIDTH = 2.4, 0.1, 0.1  # [m]
YOUNG = {"stiff": 4e9, "soft": 1e9}  # [Pa], from below
FORCE = 400.0  # [N]


def build() -> ts.Scene:
    """The beam; it starts straight and at rest."""
    scene = ts.Scene(gravity=(0.0, 0.0, 0.0))
    box = ts.box_mesh(cells=(24, 2, 1), size=(LENGTH, HEIGHT, WIDTH), center=(LENGTH / 2, 0.0, 0.0))
    above = box.vertices[box.tets].mean(axis=1)[:, 1] > 0.0
    mesh = ts.TetMesh(box.vertices, box.tets, regions=above.astype(int), region_names={0: "stiff", 1: "soft"})
    shared = {"poisson": 0.0, "mass_damping": 20.0}
    stiff = ts.Material(young=YOUNG["stiff"], density=2500.0, **shared)
    soft = ts.Material(young=YOUNG["soft"], density=1000.0, **shared)
    beam = scene.add_body(mesh, {"stiff": stiff, "soft": soft}, name="beam", order=2)
    beam.fix(lambda X: X[:, 0] < 1e-9)
    growing = ts.KeyFrames(times=(0.0, 1.0), translations=[(0.0, 0.0, 0.0), (0.0, -FORCE, 0.0)], smooth=True)
    beam.add_force(lambda X: X[:, 0] > LENGTH - 1e-9, growing)
    return scene


def deflection() -> float:
    """Deflection of the end [m] by beam theory, of bending and of shear."""
    E, y, h = np.array(list(YOUNG.values())), np.array([-HEIGHT / 4, HEIGHT / 4]), HEIGHT / 2
    neutral = (E @ y) / E.sum()
    bending = float((E * WIDTH * h * (h**2 / 12 + (y - neutral) ** 2)).sum())
    shear = 5 / 6 * E.mean() / 2 * WIDTH * HEIGHT
    return FORCE * LENGTH**3 / (3 * bending) + FORCE * LENGTH / shear


def check(sim: ts.Simulator, result) -> None:
    """The end hangs as deep as theory says, and nothing moves any more."""
    X = sim.scene.body("beam").rest_positions
    found = -sim.positions("beam")[X[:, 0] > LENGTH - 1e-9, 1].mean()
    ratio = found / deflection()
    assert abs(ratio - 1.0) < 5e-3, f"the end hangs {found:.5f} m deep, {ratio:.4f} times the theory's {deflection():.5f} m"
    speed = np.linalg.norm(sim.velocities("beam"), axis=1).max()
    assert speed < 1e-4, f"it still moves, at {speed:.2e} m/s"
