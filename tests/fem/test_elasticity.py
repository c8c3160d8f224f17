"""The elastic operator of bodies of both orders, with regions, numbers by tet and a volume floor, in f64: energies, volumes,
the first softened tet, forces and their differential are the oracle's; a body at rest has no force at any place and orientation.
"""

import numpy as np
import pytest

from taisoft.fem.laws import LAWS
from taisoft.fem.measure import NO_TET, measure
from taisoft.fem.state import FIRST_SOFTENED, GRAVITY, N_INVERTED
from tests.collision.rotations import rotation
from tests.dynamics.scenes import built
from tests.fem.composition import composition, differential, energy, forces
from tests.fem.oracle import tet_materials
from tests.fem.oracle_elements import Elements

SQUEEZE = np.array([[0.6, 0.1, 0.0], [-0.15, 1.2, 0.05], [0.0, 0.1, 0.7]])


@pytest.fixture(scope="module", params=[1, 2])
def rig(request):
    with built(composition(request.param), "f64") as made:
        rng = np.random.default_rng(11)
        # compressed, sheared and noisy, with inverted tets and tets of negative curvature [m]
        made.x = made.oracle.rest @ SQUEEZE.T + {1: 0.35, 2: 0.12}[request.param] * rng.standard_normal(made.oracle.rest.shape)
        made.direction = rng.standard_normal(made.x.shape)
        yield made


def assert_close(value, expected, relative: float) -> None:
    """Check equality up to a fraction of the largest expected number."""
    size = np.abs(expected).max()
    assert size > 0.0 and np.abs(value - expected).max() < relative * size


def first_softened(rig, x: np.ndarray) -> int:
    """Index, by blocks and lanes, of the first tet with a stretch below that where its law softens."""
    found = [NO_TET]
    for k, body in enumerate(rig.scene.bodies):
        whole = Elements(body.mesh, body.order).part(body.quadrature_degree, None, rig.oracle.starts[k])
        stretches = np.linalg.svd(rig.oracle.gradients(x, whole), compute_uv=False)[:, -1].reshape(-1, whole.points).min(axis=1)
        for tet, (stretch, material) in enumerate(zip(stretches, tet_materials(body))):
            if stretch < LAWS[material.law].SOFTENS_BELOW:
                found.append(int(rig.layout.lane_of_tet[rig.layout.tet_start[k] + tet]))
    return min(found)


def test_energies_volume_ratios_and_the_first_softened_tet(rig):
    rng, softened = np.random.default_rng(3), set()
    m, rest = rig.model, rig.oracle.rest
    noise = rng.standard_normal(rest.shape)
    for x in (rest + 0.02 * noise, rest * [1.0, 0.75, 1.0] + 0.03 * noise, rest * [1.0, 0.7, 1.0] + 0.2 * noise, rig.x):
        v = rng.standard_normal(x.shape)
        m.state.x.from_numpy(x)
        m.state.v.from_numpy(v)
        m.state.scalars.fill(-1.0)
        measure(m)
        of_mass = rig.oracle.kinetic(v, explicit=False), rig.oracle.weight(x, explicit=False)
        expected = (rig.oracle.energy(x), *rig.oracle.volume_ratios(x), *of_mass)
        assert m.state.scalars.to_numpy()[: GRAVITY + 1] == pytest.approx(expected, rel=1e-12)
        assert m.state.scalars[FIRST_SOFTENED] == first_softened(rig, x)
        softened.add(first_softened(rig, x))
    assert NO_TET in softened and len(softened) > (rig.scene.bodies[0].order == 1)


def test_forces_and_their_differential_are_the_oracles(rig):
    assert 1 <= rig.oracle.volume_ratios(rig.x)[1] < 10  # inverted tets
    assert_close(forces(rig, rig.x), rig.oracle.force(rig.x), 3e-14)
    expected = -(rig.oracle.stiffness(rig.x) @ rig.direction.reshape(-1)).reshape(-1, 3)
    assert_close(differential(rig, rig.x, rig.direction), expected, 1e-13)


def test_no_force_at_rest_anywhere(rig):
    far = rig.oracle.rest + [1e4, -2e4, 5e3]  # [m]
    turned = rig.oracle.rest @ rotation((1.0, -2.0, 0.5), 0.7).T
    largest = 1e5  # [Pa] times about 1 m^2: the force of a strain of 1
    for x, rounding in ((rig.oracle.rest, 1e-15), (far, 1e-11), (turned, 1e-15)):
        assert np.abs(forces(rig, x)).max() < 10 * rounding * largest
        assert energy(rig, x) < 10 * rounding * largest and rig.model.state.scalars[N_INVERTED] == 0
