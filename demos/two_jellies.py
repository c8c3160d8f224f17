"""Two jellies collide head-on and fly apart wobbling; for `taisoft run two_jellies --error`.

Each is a fluted disc of 80 mm height on 6 x 8 x 8 cells (1,920 tets), stable neo-Hookean, E = 20 kPa, nu = 0.4, 1000 kg/m^3. They
fly at 0.6 m/s, without gravity and damping; the lime one is half as dense.

`check` asserts that momentum is kept, that no energy appears, and that restitution and wobbling share the energy as with a
quarter of the step.
"""

import numpy as np

import taisoft as ts

solver = {"integrator": "velocity_verlet", "dt": 1 / 3840, "contact_tolerance": 1e-3, "seconds": 0.15, "fps": 60.0}

YOUNG, DENSITY, LIME = 2e4, 1000.0, 0.5  # [Pa], [kg/m^3], density of the lime jelly over that of the other
SPEED, HEIGHT = 0.6, 0.08  # of each [m/s], [m]
RESTITUTION = 0.76871  # speed of separation over that of approach
ENERGY = 0.55266  # elastic, in the frame with the most of it, over the kinetic one at the start


def jelly(side: float) -> ts.TetMesh:
    """A jelly as it leaves its mould, with eight flutes, narrower at its top, which is at x = side * HEIGHT / 2."""
    block = ts.box_mesh((6, 8, 8), (1.0, 2.0, 2.0))
    x, y, z = block.vertices.T
    disc_y, disc_z = y * np.sqrt(1 - z**2 / 2), z * np.sqrt(1 - y**2 / 2)  # of the square to the disc
    radius = 0.7 - 0.25 * (x + 0.5) ** 1.5
    flutes = 1.0 + 0.06 * np.hypot(disc_y, disc_z) ** 2 * np.cos(8 * np.arctan2(disc_z, disc_y))
    vertices = HEIGHT * np.column_stack([side * x, radius * flutes * disc_y, side * radius * flutes * disc_z])
    return ts.TetMesh(vertices, block.tets)


def build() -> ts.Scene:
    """The jellies top to top."""
    scene = ts.Scene(gravity=(0.0, 0.0, 0.0))
    for name, side, density in (("strawberry", 1.0, DENSITY), ("lime", -1.0, LIME * DENSITY)):
        jello = ts.Material(young=YOUNG, poisson=0.4, density=density, friction=0.0)
        place, velocity = (-side * 0.7 * HEIGHT, 0.0, 0.0), (side * SPEED, 0.0, 0.0)
        scene.add_body(jelly(side), jello, name=name, position=place, velocity=velocity)
    return scene


def speeds(sim: ts.Simulator) -> dict[str, float]:
    """Speeds of the jellies' centres of mass along x [m/s]."""
    return {body.name: sim.momentum(body.name)[0] / body.mass for body in sim.scene.bodies}


def check(sim: ts.Simulator, result) -> None:
    """Momentum, restitution, energy."""
    masses = {body.name: body.mass for body in sim.scene.bodies}
    start = SPEED * (masses["strawberry"] - masses["lime"])
    kept = sim.momentum() - (start, 0.0, 0.0)
    assert np.abs(kept).max() < 1e-4 * start, f"the momentum changes by {kept} N s of {start:.4f} N s"

    after = speeds(sim)
    restitution = (after["lime"] - after["strawberry"]) / (2 * SPEED)
    # 2.8e-4 measured
    assert abs(restitution / RESTITUTION - 1.0) < 1e-3, f"the restitution is {restitution:.5f}, not {RESTITUTION}"
    energies = np.array([report.kinetic + report.elastic for report in result.step_reports])
    first = 0.5 * SPEED**2 * sum(masses.values())
    assert energies.max() < (1 + 1e-4) * first, f"the energy rises to {energies.max() / first:.5f} of that at the start"
    largest = max(report.elastic for report in result.step_reports) / first
    # 8e-4 measured; 1e-2 for a hundredth of stiffness
    assert abs(largest / ENERGY - 1.0) < 3e-3, f"at most {largest:.5f} of the energy is elastic, not {ENERGY}"
    assert not sim.intersecting_triangles(), "the jellies cross"
