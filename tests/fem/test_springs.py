"""Springs, tendons and attachments: forces, energies, stiffness and damping are those of `oracle_springs`, on tets of both
orders; the projected stiffness has no negative part; `stable_dt` agrees with dense algebra (motion: `test_load_paths`).
"""

import numpy as np
import pytest
import scipy.linalg as la
import taichi as ti

import taisoft as ts
from taisoft.backend.runtime import kernel
from taisoft.fem.loads import SceneLoads
from taisoft.fem.measure import measure
from taisoft.fem.springs import spring_table
from taisoft.fem.state import ELASTIC, LOADS
from taisoft.fem.terms import springs
from taisoft.fem.terms.elasticity import prepare_terms
from taisoft.linear import block_csr
from taisoft.stability import spring_stiffness, stable_dt
from tests.dynamics.companion import add_companion
from tests.dynamics.scenes import built, connected_scene, cube, rubber
from tests.fem.composition import added
from tests.fem.oracle import Oracle
from tests.fem.oracle_springs import OracleSprings


@kernel
def spring_forces(m: ti.template(), out: ti.template()):
    """The force of all elements on every node."""
    prepare_terms(m)
    ti.loop_config(serialize=True)
    for i in range(m.n_nodes):
        out[i] = springs.force(m, i)


def kernel_forces(rig, x, v, model=None) -> np.ndarray:
    model = model or rig.model
    model.state.x.from_numpy(x)
    model.state.v.from_numpy(v)
    spring_forces(model, rig.out)
    return rig.out.to_numpy()


@pytest.fixture(scope="module", params=(1, 2))
def rig(request):
    with built(add_companion(connected_scene(request.param, damping=8.0), varied=False), "f64") as made:
        rng = np.random.default_rng(5)
        made.x = made.oracle.rest + 0.02 * rng.standard_normal(made.oracle.rest.shape)
        made.v = rng.standard_normal(made.x.shape)
        made.springs, made.out = OracleSprings(made.scene), made.vectors("spring_forces")
        made.matrix = block_csr.build_block_csr(made.model, made.arena)
        yield made


def test_energies_and_forces_are_those_of_the_definition(rig):
    rig.model.state.x.from_numpy(rig.x)
    measure(rig.model)
    stored, scalars = rig.oracle.energy(rig.x), rig.model.state.scalars
    assert scalars[ELASTIC] + scalars[LOADS] - stored == pytest.approx(rig.springs.energy(rig.x), rel=1e-9, abs=1e-6 * stored)
    table = spring_table(rig.scene)
    amplitudes = SceneLoads(rig.scene, table).amplitudes([0.0])[0]
    assert len(range(*table.elements["line"].indices(99))) == 4  # none between two points of obstacles
    for v in (np.zeros_like(rig.v), rig.v):
        expected = rig.springs.force(rig.x, v)
        size = np.abs(expected).max()
        assert size > 100.0
        for model in (rig.model, rig.parallel):
            assert np.abs(kernel_forces(rig, rig.x, v, model) - expected).max() < 1e-12 * size
        on_first = table.pulls(rig.x, v, amplitudes)
        on_nodes = np.zeros_like(expected)
        np.add.at(on_nodes, table.node, table.weight[:, None] * on_first[table.element])
        assert np.abs(on_nodes - expected).max() < 1e-12 * size


def test_assembled_rows_are_the_derivatives_of_the_forces(rig):
    beta = 0.3
    expected = beta**2 * rig.springs.stiffness(rig.x) + beta * rig.springs.damping(rig.x)
    found, size = added(rig, rig.x, beta), np.abs(expected).max()
    assert np.abs(found - expected).max() < 1e-7 * size and np.abs(found - found.T).max() <= 1e-13 * size
    assert np.linalg.eigvalsh(found)[0] < -1.0  # a spring pushes
    projected = added(rig, rig.x, beta, projected=True)
    assert np.linalg.eigvalsh(0.5 * (projected + projected.T))[0] > -1e-14 * size
    pushed = np.abs(projected - found).max(axis=0) > 1e-4 * size
    assert (pushed <= np.repeat(rig.springs.rows[0] != 0, 3)).all() and pushed.any()  # the spring that pushes


@pytest.mark.parametrize("part", [0.0, 0.003, 0.0099, 0.0101])
def test_short_elements_have_smooth_forces(part):
    """part: of its length at rest that each has. Forces and stiffness are differences of energy and forces; none at length 0."""
    scene, step = ts.Scene(), 1e-6
    scene.add_body(cube(), rubber(), name="a")
    scene.add_spring(("a", 0), ("a", 1), 100.0, rest_length=1.0)
    scene.add_spring(("a", 6), ("a", 7), 50.0, rest_length=0.0)
    scene.add_tendon([("a", 2), ("a", 3)], 40.0)
    scene.add_tendon([("a", 4), ("a", 5), ("a", 7)], length=0.2, stiffness=30.0)
    with built(add_companion(scene, varied=False), "f64") as rig:
        x, zero, table = rig.oracle.rest.copy(), np.zeros_like(rig.oracle.rest), spring_table(scene)
        x[1:8:2] = x[0:8:2] + part * (x[1:8:2] - x[0:8:2])
        rig.out, rig.matrix = rig.vectors("spring_forces"), block_csr.build_block_csr(rig.model, rig.arena)
        amplitudes, rng = SceneLoads(scene, table).amplitudes([0.0])[0], np.random.default_rng(0)

        def energy(x):
            rig.model.state.x.from_numpy(x)
            measure(rig.model)
            return rig.model.state.scalars[ELASTIC] + rig.model.state.scalars[LOADS] - rig.oracle.energy(x)

        force = kernel_forces(rig, x, zero)
        assert part > 0.0 or not force[:4].any()
        on_nodes = np.zeros_like(force)
        np.add.at(on_nodes, table.node, table.weight[:, None] * table.pulls(x, zero, amplitudes)[table.element])
        assert np.abs(on_nodes - force).max() < 1e-12 * np.abs(force).max()
        y, matrix = rng.standard_normal(x.shape), added(rig, x, 1.0)
        assert (energy(x - step * y) - energy(x + step * y)) / (2 * step) == pytest.approx((force * y).sum(), rel=1e-5, abs=1e-3)
        change = (kernel_forces(rig, x - step * y, zero) - kernel_forces(rig, x + step * y, zero)).reshape(-1) / (2 * step)
        assert np.abs(matrix @ y.reshape(-1) - change).max() < 1e-3 * np.abs(change).max()
        rows = np.kron(table.rows.toarray(), np.eye(3))
        own = rows.T @ table.stiffness_matrix(table.vectors(x, amplitudes), amplitudes) @ rows
        assert np.abs((own - matrix)[:24, :24]).max() < 1e-12 * np.abs(matrix).max()  # the companion is damped


@pytest.mark.parametrize("stiffness, tension, order", [(1.0, 1.0, 1), (3e5, 1.0, 1), (1.0, 1e6, 1), (3e4, 1.0, 2)])
def test_stable_dt_is_a_lower_bound_of_the_limit(stiffness, tension, order):
    scene = connected_scene(order)
    scene.remove(*scene.tendons)
    scene.add_tendon([("a", 5), ("b", (0.7, 0.0, 0.1))], tension)
    scene.add_spring(("a", 7), ("b", (0.9, 0.2, -0.1)), stiffness, name="strong")
    oracle = Oracle(scene)
    K = oracle.stiffness(oracle.rest) + OracleSprings(scene).stiffness(oracle.rest)
    limit = 2 / np.sqrt(la.eigh(0.5 * (K + K.T), np.kron(oracle.inertia(explicit=True), np.eye(3)), eigvals_only=True)[-1])
    found = stable_dt(scene, verlet=False)
    assert 0.7 * limit < found < 1.0001 * limit
    assert stable_dt(scene, verlet=True) == found
    scene.add_spring(("a", 7), ("b", (0.9, 0.2, -0.1)), stiffness, damping=1e5)  # which acts by the last velocities
    assert stable_dt(scene, verlet=False) < 0.8 * found


def test_linear_vibration_includes_elastic_tendons():
    scene = connected_scene(2)
    rest = np.concatenate([body.rest_positions + body.position for body in scene.bodies])
    expected = OracleSprings(scene).stiffness(rest)
    assert np.abs(spring_stiffness(scene, spring_table(scene)).toarray() - expected).max() < 1e-9 * np.abs(expected).max()
