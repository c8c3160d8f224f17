"""The elastic operator of bodies of both orders, with regions, numbers by tet and a volume floor, in f64 serial kernels:

* energies, volume ratios, the first softened tet, forces and their differential are the oracle's;
* forces are minus the gradient of the energy, their differential is their derivative; a tet inverted at one point is inverted;
* a body at rest has no force, at any position and orientation;
* the assembled stiffness is minus the differential, and its pattern is the node graph (`tests/linear` has its values);
* one lane per block, as on CUDA, gives the same forces.
"""

import numpy as np
import pytest

from taisoft.backend.arrays import FieldArena
from taisoft.fem.laws import LAWS
from taisoft.fem.measure import NO_TET, measure
from taisoft.fem.model import build_model
from taisoft.fem.node_graph import EVERYTHING
from taisoft.fem.state import ELASTIC, FIRST_SOFTENED, GRAVITY, MIN_J, N_INVERTED
from taisoft.fem.terms import elasticity
from taisoft.linear import block_csr
from taisoft.scene.plan import make_plan
from tests.backend.lanes import opened
from tests.collision.rotations import rotation
from tests.dynamics.scenes import block_scene, built
from tests.fem.composition import composition
from tests.fem.oracle import Oracle, tet_materials
from tests.fem.oracle_elements import Elements

SQUEEZE = np.array([[0.6, 0.1, 0.0], [-0.15, 1.2, 0.05], [0.0, 0.1, 0.7]])


@pytest.fixture(scope="module", params=[1, 2])
def rig(request):
    with built(composition(request.param), "f64") as made:
        made.force, made.dx, made.product = made.vectors("force"), made.vectors("dx"), made.vectors("product")
        rng = np.random.default_rng(11)
        # compressed, sheared and noisy, with inverted tets and tets of negative curvature [m]
        made.x = made.oracle.rest @ SQUEEZE.T + {1: 0.35, 2: 0.12}[request.param] * rng.standard_normal(made.oracle.rest.shape)
        made.direction = rng.standard_normal(made.x.shape)
        yield made


def forces(rig, x: np.ndarray) -> np.ndarray:
    rig.model.state.x.from_numpy(x)
    rig.model.state.element_force.fill(np.nan)  # entries that are read but not written give nan
    elasticity.elastic_forces(rig.model)
    elasticity.gather_forces(rig.model, rig.force)
    return rig.force.to_numpy()


def differential(rig, x: np.ndarray, dx: np.ndarray) -> np.ndarray:
    rig.model.state.x.from_numpy(x)
    rig.dx.from_numpy(dx)
    elasticity.force_differential(rig.model, rig.dx, rig.product)
    return rig.product.to_numpy()


def energy(rig, x: np.ndarray) -> float:
    rig.model.state.x.from_numpy(x)
    measure(rig.model)
    return rig.model.state.scalars[ELASTIC]


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
    assert_close(forces(rig, rig.x), rig.oracle.force(rig.x), 1e-14)
    expected = -(rig.oracle.stiffness(rig.x) @ rig.direction.reshape(-1)).reshape(-1, 3)
    assert_close(differential(rig, rig.x, rig.direction), expected, 1e-13)


def test_derivatives_by_finite_differences(rig):
    h, d = 1e-6, rig.direction
    f, df = forces(rig, rig.x), differential(rig, rig.x, d)
    ends = [rig.x + step * d for step in (h, -h)]
    slope = (energy(rig, ends[0]) - energy(rig, ends[1])) / (2 * h)
    assert abs(slope) > 1e3 and -np.sum(f * d) == pytest.approx(slope, rel=1e-7)  # [N]
    assert_close(df, (forces(rig, ends[0]) - forces(rig, ends[1])) / (2 * h), 2e-8)


def test_no_force_at_rest_anywhere(rig):
    far = rig.oracle.rest + [1e4, -2e4, 5e3]  # [m]
    turned = rig.oracle.rest @ rotation((1.0, -2.0, 0.5), 0.7).T
    largest = 1e5  # [Pa] times about 1 m^2: the force of a strain of 1
    for x, rounding in ((rig.oracle.rest, 1e-15), (far, 1e-11), (turned, 1e-15)):
        assert np.abs(forces(rig, x)).max() < 10 * rounding * largest
        assert energy(rig, x) < 10 * rounding * largest and rig.model.state.scalars[N_INVERTED] == 0


@pytest.mark.parametrize("rig", [2], indirect=True)
def test_a_tet_inverted_at_one_point_is_inverted(rig):
    """Moving the middle of an edge along it inverts the element near one end."""
    x, part = rig.oracle.rest.copy(), rig.oracle.parts[0]
    tet = part.nodes[0]
    x[tet[4]] += 0.6 * (x[tet[1]] - x[tet[0]])
    J = np.linalg.det(rig.oracle.gradients(x, part)).reshape(-1, part.points)
    low, count = rig.oracle.volume_ratios(x)
    assert count == (J <= 0).any(axis=1).sum() > 0 and (J <= 0).sum(axis=1).max() == 1
    energy(rig, x)
    assert rig.model.state.scalars[MIN_J] == pytest.approx(low) and rig.model.state.scalars[N_INVERTED] == count


def test_the_assembled_stiffness_is_minus_the_differential_on_the_node_graph(rig):
    matrix = block_csr.build_block_csr(rig.model, rig.arena)
    df = differential(rig, rig.x, rig.direction)
    block_csr.assemble(rig.model, matrix, EVERYTHING, False)
    assert_close(block_csr.to_scipy(rig.model, matrix) @ rig.direction.reshape(-1), -df.reshape(-1), 1e-13)
    edges = {(int(a), int(b)) for part in rig.oracle.parts for tet in part.nodes for a in tet for b in tet if a != b}
    start, column, n = matrix.row_start.to_numpy(), matrix.column.to_numpy(), rig.model.n_nodes
    rows = [list(column[start[i] : start[i + 1]]) for i in range(2 * n)]
    assert {(i % n, int(j)) for i, row in enumerate(rows) for j in row} == edges and 2 * matrix.n_edges == len(edges)
    assert all(row == sorted(set(row)) for row in rows)
    assert all(j < i if i < n else j > i - n for i, row in enumerate(rows) for j in row)


def test_one_lane_gives_the_same_forces():
    scene, arena, oracle = block_scene(), FieldArena(), Oracle(block_scene())
    x = oracle.rest + 0.1 * np.random.default_rng(1).standard_normal(oracle.rest.shape)
    with opened("f64") as runtime:
        runtime.lanes = 1
        model, _ = build_model(scene, runtime, arena, make_plan(scene, True, False).on)
        assert model.n_blocks == 5
        force = arena.vectors("force", model.real, model.n_nodes)
        model.state.x.from_numpy(x)
        elasticity.elastic_forces(model)
        elasticity.gather_forces(model, force)
        assert_close(force.to_numpy(), oracle.force(x), 1e-14)
        arena.release()
