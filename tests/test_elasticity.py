"""The elastic operator of four bodies, none of whose tets fill the last lanes: two laws in f64, one in f32.

* energies, volume ratios, forces and their differential are the oracle's, in the serial and in the parallel kernels;
* a body at rest has no force, wherever it stands and however it is turned;
* the assembled stiffness is the oracle's, the matrix-free differential's and that of finite differences of the forces;
  it is symmetric, translations are its null space, and its pattern is the node graph;
* the projected one is the oracle's and has no negative eigenvalue; with inertia and damping it makes the system;
* parallel kernels give the same numbers in every run.
"""

import numpy as np
import pytest
from scenes import SNH, SVK, built, mixed_scene

from taisoft import elasticity
from taisoft.linear import block_csr

SQUEEZE = np.array([[0.6, 0.1, 0.0], [-0.15, 1.2, 0.05], [0.0, 0.1, 0.7]])


@pytest.fixture(scope="module", params=["f64", "f32"])
def rig(request):
    # compiling an assembly takes seconds a law; the laws have tests of their own
    laws = (SNH, SVK, SNH, SVK) if request.param == "f64" else (SNH,) * 4
    with built(mixed_scene(laws, mass_damping=0.4, stiffness_damping=3e-3), request.param) as made:
        made.heavy = (made.model,) if request.param == "f64" else (made.model, made.parallel)
        made.force, made.way, made.product = made.vectors("force"), made.vectors("way"), made.vectors("product")
        made.matrix = block_csr.build_block_csr(made.model, made.arena, made.model.real)
        made.damper = block_csr.sibling(made.matrix, made.model, made.arena, made.model.real, "damper")
        made.shift = made.arena.field("shift", made.model.real, made.model.n_nodes)
        yield made


@pytest.fixture
def squeezed(rig):
    """A compressed, sheared and noisy state with an inverted tet and tets of negative curvature; returns x."""
    rng = np.random.default_rng(11)
    x = rig.oracle.rest @ SQUEEZE.T + 0.12 * rng.standard_normal(rig.oracle.rest.shape)
    rig.model.x.from_numpy(x)
    rig.model.v.from_numpy(rng.standard_normal(x.shape).astype(rig.machine.np_real))
    return x


def close(rig, value, expected, roundings: float) -> None:
    """Equal up to so many roundings of the largest expected number."""
    assert np.abs(expected).max() > 0.0
    assert np.abs(value - expected).max() < roundings * rig.eps * np.abs(expected).max()


def test_the_squeezed_state_is_a_hard_one(rig, squeezed):
    J = np.concatenate([np.linalg.det(rig.oracle.gradients(squeezed, part)) for part in rig.oracle.parts])
    assert (J <= 0).sum() in range(1, 6)
    assert np.linalg.eigvalsh(rig.oracle.stiffness(squeezed)).min() < -1e3  # N/m


def test_energies_and_volume_ratios(rig, squeezed):
    J = np.concatenate([np.linalg.det(rig.oracle.gradients(squeezed, part)) for part in rig.oracle.parts])
    v = rig.model.v.to_numpy().astype(np.float64)
    gravity = -np.sum(rig.oracle.mass * squeezed * rig.oracle.gravity)
    expected = (rig.oracle.energy(squeezed), J.min(), (J <= 0).sum(), np.sum(rig.oracle.mass * v**2) / 2, gravity)
    for model in (rig.model, rig.parallel):
        model.scalars.fill(-1.0)
        elasticity.measure(model)
        # sums are in f64, but the rest shape, masses and gravity are stored in the model's precision
        assert model.scalars.to_numpy()[:5] == pytest.approx(expected, rel=10 * rig.eps, abs=10 * rig.eps)


def test_forces(rig, squeezed):
    expected = rig.oracle.force(squeezed)
    for model in (rig.model, rig.parallel):
        model.corner.fill(np.nan)  # what is read must have been written
        elasticity.elastic_forces(model)
        elasticity.gather_forces(model, rig.force)
        close(rig, rig.force.to_numpy(), expected, 30)


@pytest.mark.parametrize("where", ["here", "far", "turned"])
def test_no_force_at_rest(rig, where):
    x = rig.oracle.rest
    if where == "far":
        x = x + [1e4, -2e4, 5e3]  # [m]: positions and their differences are f64 in either precision
    if where == "turned":
        Q = np.linalg.qr(np.random.default_rng(2).standard_normal((3, 3)))[0]
        x = x @ (Q * np.linalg.det(Q)).T
    rig.model.x.from_numpy(x)
    elasticity.elastic_forces(rig.model)
    elasticity.gather_forces(rig.model, rig.force)
    largest = max(m.young for *_, m in rig.oracle.parts)  # times about 1 m^2: the force of a strain of 1
    rounding = rig.eps + (1e-11 if where == "far" else 0.0)
    assert np.abs(rig.force.to_numpy()).max() < 10 * rounding * largest


def test_force_differential(rig, squeezed):
    way = np.random.default_rng(5).standard_normal(squeezed.shape).astype(rig.machine.np_real)
    expected = -(rig.oracle.stiffness(squeezed) @ way.astype(np.float64).reshape(-1)).reshape(-1, 3)
    rig.way.from_numpy(way)
    for model in rig.heavy:
        elasticity.force_differential(model, rig.way, rig.product)
        close(rig, rig.product.to_numpy(), expected, 100)


def test_assembled_stiffness(rig, squeezed):
    way = np.random.default_rng(6).standard_normal(squeezed.shape).astype(rig.machine.np_real)
    rig.way.from_numpy(way)
    elasticity.force_differential(rig.model, rig.way, rig.product)
    free = rig.product.to_numpy()
    exactly = rig.oracle.stiffness(squeezed)
    for model in rig.heavy:
        rig.matrix.value.fill(np.nan)
        rig.matrix.diagonal.fill(np.nan)
        block_csr.assemble(model, rig.matrix, False)
        K = block_csr.to_scipy(model, rig.matrix).toarray()
        close(rig, K, exactly, 100)
        close(rig, K, K.T, 20)
        block_csr.multiply(model, rig.matrix, rig.way, rig.product)
        close(rig, rig.product.to_numpy(), -free, 100)
        close(rig, rig.product.to_numpy().reshape(-1), K @ way.astype(np.float64).reshape(-1), 30)
        for axis in np.eye(3):
            assert np.abs(K @ np.tile(axis, rig.model.n_nodes)).max() < 30 * rig.eps * np.abs(K).max()


def test_stiffness_by_finite_differences_of_the_forces(rig, squeezed):
    """Of the package's own forces: h^2 of the third derivative of the energy, and the rounding of the forces over h."""
    block_csr.assemble(rig.model, rig.matrix, False)
    K = block_csr.to_scipy(rig.model, rig.matrix)
    way, h = np.random.default_rng(7).standard_normal(squeezed.shape), {"f64": 1e-6, "f32": 1e-3}[rig.machine.precision]
    forces = []
    for step in (h, -h):
        rig.model.x.from_numpy(squeezed + step * way)
        elasticity.elastic_forces(rig.model)
        elasticity.gather_forces(rig.model, rig.force)
        forces.append(rig.force.to_numpy().astype(np.float64))
    change = (forces[0] - forces[1]).reshape(-1) / (2 * h)
    assert np.abs(K @ way.reshape(-1) + change).max() < (1e-8 + 30 * rig.eps / h) * np.abs(change).max()


def test_pattern_is_the_node_graph(rig):
    """Rows of ascending columns without the diagonal, one for each edge of a tet; both halves find their blocks."""
    edges = set()
    for tets, *_ in rig.oracle.parts:
        for tet in tets:
            edges |= {(int(a), int(b)) for a in tet for b in tet if a != b}
    start, column = rig.matrix.row_start.to_numpy(), rig.matrix.column.to_numpy()
    rows = [list(column[start[i] : start[i + 1]]) for i in range(rig.model.n_nodes)]
    assert {(i, int(j)) for i, row in enumerate(rows) for j in row} == edges
    assert all(row == sorted(set(row)) for row in rows) and 2 * rig.matrix.n_edges == len(edges)


@pytest.mark.parametrize("rig", ["f32"], indirect=True)  # each law's own projection is tested in f64 with the laws
def test_projected_stiffness(rig, squeezed):
    expected = rig.oracle.stiffness(squeezed, projected=True)
    assert np.abs(expected - rig.oracle.stiffness(squeezed)).max() > 1e4  # [N/m] there is something to project
    block_csr.assemble(rig.model, rig.matrix, True)
    K = block_csr.to_scipy(rig.model, rig.matrix).toarray()
    close(rig, K, expected, 100)
    assert np.linalg.eigvalsh((K + K.T) / 2).min() > -20 * rig.eps * np.abs(K).max()


def test_system(rig):
    """diag(shift) + k K + c b K_d with each row's own stiffness damping b, which is 0 in two of the bodies."""
    k, c, rng = 0.04, 0.3, np.random.default_rng(9)
    fields = (rig.matrix.value, rig.matrix.diagonal, rig.damper.value, rig.damper.diagonal)
    numbers = [rng.standard_normal(field.shape).astype(rig.machine.np_real) for field in fields]
    shift = rng.uniform(1, 2, rig.model.n_nodes).astype(rig.machine.np_real)
    damping = np.repeat(rig.oracle.stiffness_damping, 3)[:, None]
    assert {float(b) for b in np.unique(damping)} == {0.0, 3e-3}
    rig.shift.from_numpy(shift)
    for model in (rig.model, rig.parallel):
        for field, values in zip(fields, numbers):
            field.from_numpy(values)
        K, K_d = (block_csr.to_scipy(model, A).toarray() for A in (rig.matrix, rig.damper))
        block_csr.to_system(model, rig.matrix, rig.damper, rig.shift, k, c)
        expected = np.diag(np.repeat(shift.astype(np.float64), 3)) + k * K + c * damping * K_d
        close(rig, block_csr.to_scipy(model, rig.matrix).toarray(), expected, 10)


def test_parallel_kernels_are_reproducible(rig, squeezed):
    def numbers():
        block_csr.assemble(rig.heavy[-1], rig.matrix, False)
        elasticity.elastic_forces(rig.parallel)
        elasticity.gather_forces(rig.parallel, rig.force)
        elasticity.measure(rig.parallel)
        fields = (rig.matrix.value, rig.matrix.diagonal, rig.force, rig.parallel.scalars)
        return [field.to_numpy() for field in fields]

    first = numbers()
    for _ in range(10):
        assert all(np.array_equal(a, b) for a, b in zip(first, numbers()))
