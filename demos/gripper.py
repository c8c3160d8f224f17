"""A gripper with two soft fingers, closed by tendons, lifts a cube from the ground and holds it.

A rigid palm of 0.16 x 0.02 x 0.05 m follows key frames; two fingers of 0.02 x 0.12 x 0.04 m, of 60 quadratic tets each, are
attached to it exactly. A tendon runs down the inner face of each finger; its tension grows to 5 N within 0.4 s and bends the
finger against a cube of 19 g. Then the palm rises by 0.1 m.

`check` asserts that the cube was lifted, that friction carries its weight, and the joints the fingers and the cube; in statics a
finger must bend as a beam whose tendon pulls beside its middle.
"""

import numpy as np

import taisoft as ts

solver = {"integrator": "implicit_euler", "dt": 1 / 120, "seconds": 1.6, "fps": 30.0, "precision": "f64"}
solver |= {"newton_tolerance": 1e-6}

FRICTION = 0.8
YOUNG = 3e5  # of the fingers [Pa]
PULL, GRIPPED, LIFTED, HEIGHT = 5.0, 0.4, 1.2, 0.1  # [N], [s], [s], [m]
SIZE, DENSITY = 0.04, 300.0  # of the cube [m], [kg/m^3]
FINGER, PALM = (0.02, 0.12, 0.04), (0.16, 0.02, 0.05)  # [m]
KNOTS = np.linspace(-0.5, 0.5, 7) * FINGER[1]  # of a tendon, along its finger [m]
INNER, LOW = 0.03, 0.015  # distance of a finger's inner face from the middle, and height of its tip [m]


def build(friction: float = FRICTION) -> ts.Scene:
    """The open gripper above the cube. friction: of everything."""
    scene = ts.Scene()
    soft = ts.Material(young=YOUNG, poisson=0.3, density=1000.0, mass_damping=5.0, friction=friction)
    light = ts.Material(young=1e6, poisson=0.3, density=DENSITY, friction=friction)
    top = LOW + FINGER[1]
    place = (0.0, top + PALM[1] / 2, 0.0)
    palm = scene.add_rigid_body(ts.box_mesh((4, 1, 1), PALM), name="palm", position=place, friction=friction)
    lift = ts.KeyFrames((0.0, GRIPPED, LIFTED), translations=[(0, 0, 0), (0, 0, 0), (0, HEIGHT, 0)], smooth=True)
    palm.move(lift)
    closing = ts.KeyFrames((0.0, GRIPPED), values=(0.0, PULL), smooth=True)
    for name, side in (("left", -1.0), ("right", 1.0)):
        mesh = ts.box_mesh((1, 6, 2), FINGER)
        place = (side * (INNER + FINGER[0] / 2), LOW + FINGER[1] / 2, 0.0)
        scene.add_body(mesh, soft, name=name, position=place, order=2)
        scene.attach(name, lambda X: X[:, 1] > FINGER[1] / 2 - 1e-9, "palm", name=f"{name} joint")
        inner = -side * FINGER[0] / 2
        line = [(name, (inner, y, 0.0)) for y in KNOTS]
        scene.add_tendon(line, closing, name=f"{name} tendon")
    cube = ts.box_mesh((2, 2, 2), (SIZE, SIZE, SIZE))
    scene.add_body(cube, light, name="cube", position=(0.0, SIZE / 2 + 2e-4, 0.0))
    scene.add_obstacle(ts.HalfSpace((0.0, 0.0, 0.0), (0.0, 1.0, 0.0)), name="ground", friction=friction)
    return scene


def rise(sim: ts.Simulator) -> float:
    """How far the cube was lifted [m]."""
    return float(sim.positions("cube")[:, 1].mean()) - SIZE / 2


def curvature(young: float) -> float:
    """Curvature of a finger in its middle under a small tension of its tendon, over the tension [1/(N m)]."""
    scene, finger = ts.Scene(gravity=(0.0, 0.0, 0.0)), ts.box_mesh((1, 6, 2), FINGER)
    body = scene.add_body(finger, ts.Material(young=young, poisson=0.3), name="finger", order=2)
    body.fix(lambda X: X[:, 1] > FINGER[1] / 2 - 1e-9)
    tension, X = 0.02, body.rest_positions
    scene.add_tendon([("finger", (FINGER[0] / 2, y, 0.0)) for y in KNOTS], tension)
    x, turns = ts.solve_static(scene).positions("finger"), []
    for y in (-FINGER[1] / 6, FINGER[1] / 6):
        on = np.abs(X[:, 1] - y) < 1e-9
        across = ((X[on, 0] - X[on, 0].mean())[:, None] * x[on]).sum(axis=0)
        turns.append(float(np.arctan2(across[1], across[0])))
    return (turns[0] - turns[1]) / (FINGER[1] / 3) / tension


def check(sim: ts.Simulator, result) -> None:
    """The gripper holds the cube, forces balance, and a finger bends as a beam whose tendon pulls beside its middle."""
    found = rise(sim)
    assert 0.0 < found - HEIGHT < 0.01, f"the cube was lifted by {found:.4f} m, not by {HEIGHT} m and what its grip slid up"
    weight = -sim.scene.gravity[1] * np.array([sim.scene.body(name).mass for name in ("cube", "left", "right")])
    held = sim.contact_force("cube")[1]
    assert abs(held / weight[0] - 1.0) < 1e-3, f"friction carries {held:.5f} N of the cube's {weight[0]:.5f} N"
    for name, own in (("left", weight[1]), ("right", weight[2])):
        load, joint = own - sim.contact_force(name)[1], sim.joint_force(f"{name} joint")[:, 1].sum()
        assert abs(joint / load - 1.0) < 1e-3, f"the {name} joint carries {joint:.4f} N, not {load:.4f} N"
    bent = curvature(sim.scene.body("left").young) * YOUNG * FINGER[2] * FINGER[0] ** 3 / 12 / (FINGER[0] / 2)
    assert abs(bent - 1.0) < 4e-3, f"a finger bends {bent:.4f} times as much as the beam"
