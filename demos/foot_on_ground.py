"""A soft sole under a rigid foot is loaded, rolls from heel to toe on the ground, and pushes off.

The foot carries 60 N, which grow within 0.2 s; its rotation and its position along x are prescribed, its height is free. The sole
is a layer of 20 mm on 16 x 2 x 6 cells (960 tets), stable neo-Hookean, E = 0.3 MPa, nu = 0.4, 1100 kg/m^3, attached to the foot
exactly; friction 0.7. Its underside is an arc, so it rolls by x = RADIUS * angle. Then the foot is pushed back by 1 mm, which
friction resists.

`check` asserts that the ground bears load and weight, that friction balances what drives the foot and stays within Coulomb's cone
at each contact, and how deep the sole is pressed: as in double precision with a quarter of the step.
"""

import numpy as np

import taisoft as ts

solver = {"integrator": "implicit_euler", "dt": 1 / 120, "seconds": 1.2, "fps": 30.0}

LOAD, FRICTION = 60.0, 0.7  # [N]
LENGTH, WIDTH, THICKNESS = 0.24, 0.08, 0.02  # of the sole [m]
FOOT, SHANK = 0.03, 0.12  # height of the foot and of the shank above it [m]
RADIUS = 0.3  # of the arc below the sole [m]
ANGLE = np.radians(14.0)  # of the foot at the start (toe up) and at the end (heel up)
LOADED, ROLLED, PUSHED = 0.2, 0.8, 1.0  # [s]
PUSH = 0.001  # [m]
HEIGHT = -3.00788e-3  # how the foot's centre has moved up at the end [m]
CELLS = (16, 2, 6)  # of the sole
G = 9.81  # [m/s^2]


def shaped(mesh: ts.TetMesh, top: float) -> ts.TetMesh:
    """A foot's outline and underside for a box whose underside is at y = 0 and whose flat top is at y = top; turned toe up."""
    x, y, z = mesh.vertices.T
    s = x / LENGTH  # from -1/2 at the heel to 1/2 at the toe
    width = 0.72 + 0.5 * s - 1.6 * s**4 + 0.35 * np.exp(-((s - 0.22) ** 2) / 0.02)
    arc = RADIUS - np.sqrt(RADIUS**2 - x**2)
    flat = np.clip((y - THICKNESS) / FOOT, 0.0, 1.0) if top > THICKNESS else 0.0
    y = y + arc * (1.0 - flat) - RADIUS
    c, sn = np.cos(ANGLE), np.sin(ANGLE)
    return ts.TetMesh(np.stack([c * x - sn * y, sn * x + c * y + RADIUS, width * z], axis=1), mesh.tets)


def foot() -> ts.TetMesh:
    """A foot with a shank, above the sole."""
    layers, above = 2, 4
    height = FOOT * (layers + above) / layers
    block = ts.box_mesh((16, layers + above, 6), (LENGTH, height, WIDTH), center=(0.0, THICKNESS + height / 2, 0.0))
    x, y, z = block.vertices[block.tets].mean(axis=1).T
    shank = (np.abs(x + 0.06) < 0.0301) & (np.abs(z) < WIDTH / 6)
    vertices, tets = np.unique(block.tets[(y < THICKNESS + FOOT) | shank], return_inverse=True)
    return shaped(ts.TetMesh(block.vertices[vertices], tets.reshape(-1, 4)), THICKNESS + FOOT)


def build() -> ts.Scene:
    """The foot, toe up, a hair above the ground."""
    scene = ts.Scene(gravity=(0.0, -G, 0.0))
    place = (-RADIUS * ANGLE, 2e-4, 0.0)
    ankle = scene.add_rigid_body(foot(), density=300.0, name="foot", position=place, friction=FRICTION)
    rubber = ts.Material(young=3e5, poisson=0.4, density=1100.0, friction=FRICTION, mass_damping=10.0)
    flat = ts.box_mesh(CELLS, (LENGTH, THICKNESS, WIDTH), center=(0.0, THICKNESS / 2, 0.0))
    scene.add_body(shaped(flat, THICKNESS), rubber, name="sole", position=place)
    scene.attach("sole", lambda X: flat.vertices[:, 1] > THICKNESS - 1e-9, "foot", name="joint")
    scene.add_obstacle(ts.HalfSpace((0.0, 0.0, 0.0), (0.0, 1.0, 0.0)), name="ground", friction=FRICTION)

    rolled = 2 * RADIUS * ANGLE
    shifts = [(0, 0, 0), (0, 0, 0), (rolled, 0, 0), (rolled - PUSH, 0, 0)]
    turns = [(0, 0, 0), (0, 0, 0), (0, 0, -2 * ANGLE), (0, 0, -2 * ANGLE)]
    path = ts.KeyFrames((0.0, LOADED, ROLLED, PUSHED), shifts, turns, pivot=(place[0], place[1] + RADIUS, 0.0), smooth=True)
    ankle.move(path, axes="xz")
    ankle.add_force(None, ts.KeyFrames((0.0, LOADED), [(0, 0, 0), (0, -LOAD, 0)], smooth=True))
    return scene


def check(sim: ts.Simulator, result) -> None:
    """Load, friction, cone, no slip, depth."""
    weight = G * sum(sim.scene.body(name).mass for name in ("foot", "sole"))
    force, drive = sim.contact_force("sole"), sim.reactions("foot").sum(axis=0)
    assert abs(force[1] / (LOAD + weight) - 1.0) < 1e-3, f"the ground bears {force[1]:.3f} N, not {LOAD + weight:.3f} N"
    assert abs(force[0] + drive[0]) < 2e-3 * LOAD, f"friction is {force[0]:.3f} N, the foot is driven with {drive[0]:.3f} N"
    assert 0.2 < force[0] / force[1] < 0.9 * FRICTION, f"friction is {force[0] / force[1]:.3f} of the normal force"

    contacts = sim.contacts()
    normal = (contacts.impulse * contacts.normal).sum(axis=1)
    tangential = np.linalg.norm(contacts.impulse - normal[:, None] * contacts.normal, axis=1)
    assert normal.min() >= 0.0, "a contact pulls"
    assert (tangential <= (FRICTION + 1e-3) * normal + 1e-6 * normal.sum()).all(), "friction is outside Coulomb's cone"
    assert abs(normal.sum() / sim.dt / force[1] - 1.0) < 1e-6, "the normal forces do not add up to the contact force"

    # 5e-7 m measured; 1e-5 m for a hundredth of stiffness
    height = sim.pose("foot").translation[1]
    assert abs(height - HEIGHT) < 4e-6, f"the foot ends {1e3 * height:.4f} mm above its start, not {1e3 * HEIGHT:.4f} mm"
    assert max(report.max_penetration for report in result.step_reports) < 1e-4
