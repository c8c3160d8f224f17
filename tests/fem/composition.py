"""Scenes for tests of the elements, so that each kernel is compiled for one of them.

Compiling takes more than twice as long for two kinds of tets in a scene: hence one law of each order.
"""

import numpy as np

import taisoft as ts
from tests.dynamics.scenes import SNH, SVK, cube, halved, rubber


def composition(*orders: int) -> ts.Scene:
    """Of the orders given: 1: bodies of 6 and 5 tets with a volume floor, one with numbers by tet; 2: one of 10 with two regions.

    They do not touch, none fills its last lanes, and damping, loads and constraints differ.
    """
    scene, damping = ts.Scene(gravity=(0.3, -9.81, 0.7)), {"mass_damping": 0.4, "stiffness_damping": 3e-3}
    scene.contact_forces = False
    if 2 in orders:
        regions = {"left": rubber(SNH, **damping), 7: rubber(SNH, young=4e4, poisson=0.1, density=1700.0, **damping)}
        beam = scene.add_body(halved(cube(cells=(2, 1, 1))), regions, name="beam", position=(0.5, 0, 0), order=2)
        beam.fix(lambda X: X[:, 0] < -0.49)
        beam.add_traction(lambda X: X[:, 0] > 0.49, (300.0, 2000.0, -500.0))
    if 1 in orders:
        numbers = {"young": np.linspace(4e4, 1e5, 6), "poisson": np.linspace(0, 0.4, 6), "density": np.linspace(5e2, 1e3, 6)}
        material, six = rubber(SVK, volume_floor=0.5, **damping), cube((3, 0, 0), pattern="six")
        block = scene.add_body(six, material, name="block", velocity=(0.5, 0, -0.3), **numbers)
        block.fix([0, 1], axes="x")
        block.add_force([5, 6, 7], (30.0, -10.0, 20.0))
        softer = rubber(SVK, young=7e4, poisson=0.2, density=1500.0, volume_floor=0.3)
        scene.add_body(cube((6, 0, 0)), softer, name="flyer")
    return scene
