"""A body far away with everything that decides which kernels a scene needs: scenes that have it share their kernels."""

import numpy as np

import taisoft as ts
from taisoft.dynamics.schemes import EXPLICIT
from tests.dynamics.scenes import rubber

FAR = np.array([60.0, 30.0, 0.0])  # and above the ground
LOOSE = {"newton_tolerance": 1e-5, "linear_tolerance": 1e-3}  # of `simulator`
TET = ts.TetMesh(np.array([(0, 0, 0), (1, 0, 0), (0, 1, 0), (0, 0, 1.0)]), np.array([(0, 1, 2, 3)]))


def add_companion(scene: ts.Scene, attached: bool = False, varied: bool = True) -> ts.Scene:
    """Add the body "companion", whose nodes are fixed, and the obstacle "carrier", which is said to move but rests.

    All its loads are 0: a dead load, a pressure, and the pulls of a damped spring with an end on an obstacle that moves, of a
    tendon under no tension, and of a slack elastic tendon. attached: also the rigid body "rider" and the body "passenger", which
    is attached to it exactly. varied: whether the dead load follows a path, which changes explicit steps alone.
    """
    body = scene.add_body(TET, rubber(mass_damping=1e-9), name="companion", position=FAR)
    body.fix([0, 1, 2, 3])
    body.add_force([0], (lambda t: (0.0, 0.0, 0.0)) if varied else (0.0, 0.0, 0.0))
    body.add_pressure([0], 0.0)
    still = ts.KeyFrames((0.0,), [(0.0, 0.0, 0.0)])
    scene.add_obstacle(ts.Sphere(FAR + (0, 9, 0), 1.0), name="carrier", path=still)
    scene.add_spring(("companion", 0), ("carrier", FAR + (0, 9, 0)), 0.0, damping=1.0, name="companion's spring")
    scene.add_tendon([("companion", 0), ("companion", 1)], 0.0, name="companion's tendon")
    scene.add_tendon([("companion", 0), ("companion", 1)], length=2.0, stiffness=1.0, name="companion's slack tendon")
    if attached:
        scene.add_rigid_body(TET, name="rider", position=FAR + (0, 20, 0)).fix()
        scene.add_body(TET, rubber(), name="passenger", position=FAR + (0, 20, 0))
        scene.attach("passenger", [0, 1, 2, 3], "rider", name="companion's attachment")
    return scene


def simulator(scene: ts.Scene, integrator: str, dt: float, **settings) -> ts.Simulator:
    """A simulator in f64, with tight tolerances of implicit steps unless others are given."""
    tight = {} if integrator in EXPLICIT else {"newton_tolerance": 1e-12, "linear_tolerance": 1e-12}
    return ts.Simulator(scene, dt=dt, integrator=integrator, precision="f64", **(tight | settings))


def opened(scene: ts.Scene, integrator: str, dt: float, **settings) -> ts.Simulator:
    """A simulator of the scene with an attached companion; of loose tolerances where bodies can touch."""
    loose = {} if integrator in EXPLICIT or not scene.pushes(False) else LOOSE
    return simulator(add_companion(scene, attached=True), integrator, dt, **(loose | settings))
