"""Two equal cubes, one flush on the other: rounding must not remove contacts at the corners.

Noise far below and far above the search's tolerances moves vertices slightly outside or inside the sides of the other cube.
The contact points must span the whole face in every case.
"""

import numpy as np
import pytest
from scipy.spatial import ConvexHull

import taisoft as ts
from tests.dynamics.scenes import rubber


@pytest.fixture(scope="module")
def sim():
    scene = ts.Scene()
    scene.contact_forces = False
    for name in ("below", "above"):
        scene.add_body(ts.box_mesh((1, 1, 1), (1, 1, 1)), rubber(), name=name, collision="proximity")
    with ts.Simulator(scene, dt=1e-3, integrator="symplectic_euler", precision="f64", allow_unstable=True) as sim:
        yield sim


@pytest.mark.parametrize("noise", [0.0, 1e-14, 1e-12, 1e-10, 1e-9, 1e-8, 1e-7, 1e-6, 1e-5, 1e-4])
@pytest.mark.parametrize("gap", [0.005, -0.001, -0.01])
def test_contacts_span_the_whole_face(sim, noise, gap):
    rng, rest = np.random.default_rng(3), sim.scene.body("below").rest_positions
    for _ in range(8):
        for name, lift in (("below", 0.0), ("above", 1.0 + gap)):
            sim.set_state(positions=rest + (0, lift, 0) + noise * rng.standard_normal(rest.shape), body=name)
        c = sim.detect_contacts()
        assert (np.abs(c.normal[:, 1]) > 0.99).all() and (np.abs(c.gap - gap) < 10 * noise + 1e-9).all()
        assert ConvexHull(c.point[:, [0, 2]]).volume > 0.98
