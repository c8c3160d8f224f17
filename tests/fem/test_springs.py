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


def test_an_element_without_length_does_not_pull_unless_its_rest_length_is_0():
    scene = ts.Scene()
    scene.add_body(cube(), rubber(), name="a")
    for k, numbers in enumerate(({"rest_length": 0.5, "damping": 3.0}, {"rest_length": 0.0})):
        scene.add_spring(("a", 2 * k), ("a", 2 * k + 1), 100.0, **numbers)
    with built(add_companion(scene, varied=False), "f64") as rig:
        x = rig.oracle.rest.copy()
        x[1:8:2] = x[0:8:2]
        rig.out, rig.matrix = rig.vectors("spring_forces"), block_csr.build_block_csr(rig.model, rig.arena)
        assert not kernel_forces(rig, x, np.zeros_like(x)).any()
        found = added(rig, x, 1.0, projected=True)
        assert np.isfinite(found).all() and found[6, 6] == pytest.approx(100.0)


@pytest.mark.parametrize("stiffness, tension, order", [(1.0, 1.0, 1), (3e5, 1.0, 1), (1.0, 1e6, 1), (3e4, 1.0, 2)])
def test_stable_dt_is_a_lower_bound_of_the_limit(stiffness, tension, order):
    scene = connected_scene(order)
    scene.tendons.clear()
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
