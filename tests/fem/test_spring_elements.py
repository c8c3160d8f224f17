"""Springs, tendons and attachments in random states, against `oracle_springs`, in both precisions and element orders:

* forces with damping, energies, stiffness and damping matrices; the projected stiffness has no negative part;
* forces turn with the state, have no resultant, and do not depend on the order of the bodies.
"""

from itertools import product

import numpy as np
import pytest

from taisoft.fem.loads import SceneLoads
from taisoft.fem.measure import measure
from taisoft.fem.node_graph import EVERYTHING
from taisoft.fem.springs import spring_table
from taisoft.fem.state import ELASTIC, LOADS
from taisoft.linear import block_csr
from tests.collision.rotations import rotation
from tests.dynamics.scenes import built, connected_scene
from tests.fem.oracle_springs import OracleSprings
from tests.fem.spring_rig import assembled, kernel_forces


@pytest.fixture(scope="module", params=product((1, 2), ("f32", "f64")), ids=lambda p: f"order {p[0]} {p[1]}")
def rig(request):
    order, precision = request.param
    with built(connected_scene(order, damping=8.0), precision) as made:
        rng = np.random.default_rng(5)
        made.x = made.oracle.rest + 0.02 * rng.standard_normal(made.oracle.rest.shape)
        made.v = rng.standard_normal(made.x.shape).astype(np.float32).astype(np.float64)
        made.springs, made.out = OracleSprings(made.scene), made.vectors("spring_forces")
        made.matrix = block_csr.build_block_csr(made.model, made.arena)
        yield made


def test_forces_are_those_of_the_definition(rig):
    for v in (np.zeros_like(rig.v), rig.v):
        expected = rig.springs.force(rig.x, v)
        size = np.abs(expected).max()
        assert size > 100.0
        for model in (rig.model, rig.parallel):
            assert np.abs(kernel_forces(rig, rig.x, v, model) - expected).max() < (4 * rig.eps + 1e-12) * size
        amplitudes = SceneLoads(rig.scene).amplitudes([0.0])[0]
        table = spring_table(rig.scene)
        on_first = table.pulls(rig.x, v, amplitudes)
        on_nodes = np.zeros_like(expected)
        np.add.at(on_nodes, table.node, table.weight[:, None] * on_first[table.element])
        assert np.abs(on_nodes - expected).max() < 1e-12 * size


def test_forces_are_minus_the_gradient_of_the_energy(rig):
    def energy(x) -> float:
        rig.model.state.x.from_numpy(x)
        measure(rig.model)
        stored = rig.oracle.energy(x)
        scalars = rig.model.state.scalars
        assert scalars[ELASTIC] + scalars[LOADS] - stored == pytest.approx(rig.springs.energy(x), rel=1e-9, abs=1e-6 * stored)
        return rig.springs.energy(x)

    f, h = rig.springs.force(rig.x), 1e-6
    for i, j in ((0, 0), (3, 1), (6, 2), (10, 0), (len(rig.x) - 1, 1)):
        step = np.zeros_like(rig.x)
        step[i, j] = h
        assert -(energy(rig.x + step) - energy(rig.x - step)) / (2 * h) == pytest.approx(f[i, j], rel=1e-6, abs=1e-5)


def test_assembled_rows_are_the_derivatives_of_the_forces(rig):
    beta = 0.3
    expected = beta**2 * rig.springs.stiffness(rig.x) + beta * rig.springs.damping(rig.x)
    found = assembled(rig, rig.x, beta, projected=False)
    assert np.abs(found - expected).max() < max(20 * rig.eps, 1e-7) * np.abs(expected).max()
    assert np.abs(found - found.T).max() <= 4 * rig.eps * np.abs(expected).max()
    assert np.linalg.eigvalsh(assembled(rig, rig.x, beta, False))[0] < -1.0  # a spring pushes
    projected = assembled(rig, rig.x, beta, projected=True)
    assert np.linalg.eigvalsh(0.5 * (projected + projected.T))[0] > -20 * rig.eps * np.abs(expected).max()
    pushed = np.abs(projected - found).max(axis=0) > 1e-4 * np.abs(expected).max()
    only = connected_scene(rig.scene.bodies[0].order)
    del only.springs[1:], only.tendons[:], only.attachments[:]
    assert (pushed <= np.repeat(np.any([row != 0 for row, *_ in OracleSprings(only).all], axis=0), 3)).all() and pushed.any()


def test_to_system_adds_them_to_elasticity(rig):
    m, A, beta = rig.model, rig.matrix, 0.01
    m.state.x.from_numpy(rig.x)
    block_csr.assemble(m, A, EVERYTHING, False)
    block_csr.to_system(m, A, A, EVERYTHING, 0, 1.0, beta)
    found = block_csr.to_scipy(m, A).toarray()
    K = rig.oracle.stiffness(rig.x) + rig.springs.stiffness(rig.x)
    expected = np.kron(rig.oracle.mass, np.eye(3)) + beta**2 * K + beta * rig.springs.damping(rig.x)
    assert np.abs(found - expected).max() < max(100 * rig.eps, 1e-7) * np.abs(expected).max()


def test_rotations_and_translations_rotate_the_forces(rig):
    scene = connected_scene(rig.scene.bodies[0].order, damping=8.0, anchored=False)
    free, R = OracleSprings(scene), rotation((1.0, -2.0, 0.5), 0.7)
    table, amplitudes = spring_table(scene), SceneLoads(scene).amplitudes([0.0])[0]
    f = table.pulls(rig.x, rig.v, amplitudes)
    moved = table.pulls(rig.x @ R.T + (0.3, -0.2, 0.1), rig.v @ R.T, amplitudes)
    assert np.abs(moved - f @ R.T).max() < 1e-11 * np.abs(f).max()
    on_nodes = free.force(rig.x)
    assert np.abs(on_nodes.sum(axis=0)).max() < 1e-9 and np.abs(np.cross(rig.x, on_nodes).sum(axis=0)).max() < 1e-9
    assert np.abs(on_nodes).max() > 100.0


def test_the_order_of_bodies_does_not_matter(rig):
    scene = rig.scene
    turned = scene.snapshot()
    turned.bodies.reverse()
    n = turned.bodies[0].n_nodes
    x, v = (np.concatenate([a[-n:], a[:-n]]) for a in (rig.x, rig.v))
    amplitudes = SceneLoads(scene).amplitudes([0.0])[0]
    tables = spring_table(scene), spring_table(turned)
    assert tables[0].elements == tables[1].elements
    pulls = tables[0].pulls(rig.x, rig.v, amplitudes), tables[1].pulls(x, v, amplitudes)
    assert np.abs(pulls[0] - pulls[1]).max() < 1e-12 * np.abs(pulls[0]).max()
