"""The elastic operator of four bodies, two linear and two quadratic, whose tets do not fill the last lanes.

In f64 serial kernels, with two laws and the finer quadrature, also with laws and numbers that differ between the tets of a body,
among them a volume floor;
in f32 parallel kernels, with one law and the coarser quadrature.

* energies, volume ratios, forces and their differential are the oracle's;
* forces are minus the gradient of the energy; a tet inverted at a single quadrature point counts as inverted;
* a body at rest has no force, at any position and orientation;
* the assembled stiffness is that of the oracle, of the matrix-free differential and of finite differences of the forces;
  it is symmetric, translations are in its null space, and its pattern is the node graph;
* the projected stiffness is the oracle's and has no negative eigenvalue; the system adds mass and damping;
* parallel kernels give the same bits in every run.
"""

import numpy as np
import pytest

from taisoft.fem.measure import measure
from taisoft.fem.node_graph import EVERYTHING
from taisoft.fem.state import ELASTIC, GRAVITY, MIN_J, N_INVERTED
from taisoft.fem.terms import elasticity
from taisoft.linear import block_csr
from tests.dynamics.scenes import SNH, SVK, built, mixed_scene

SQUEEZE = np.array([[0.6, 0.1, 0.0], [-0.15, 1.2, 0.05], [0.0, 0.1, 0.7]])


@pytest.fixture(scope="module", params=["f64", "f32", "by tet"])
def rig(request):
    # compiling an assembly takes seconds per law and quadrature; the laws have tests of their own
    by_tet = request.param == "by tet"
    double = request.param == "f64" or by_tet
    laws, degree = ((SNH, SVK, SNH, SVK), 4) if double else ((SNH,) * 4, 2)
    damping = {"mass_damping": 0.4, "stiffness_damping": 3e-3}
    scene = mixed_scene(laws, **damping, order="both", degrees=(degree, degree), by_tet=by_tet, volume_floor=0.5 * by_tet)
    with built(scene, "f64" if double else "f32") as made:
        made.model = made.model if double else made.parallel
        made.force, made.dx, made.product = made.vectors("force"), made.vectors("dx"), made.vectors("product")
        made.matrix = block_csr.build_block_csr(made.model, made.arena)
        made.damper = block_csr.sibling(made.matrix, made.model, made.arena, "damper")
        yield made


@pytest.fixture
def squeezed(rig):
    """A compressed, sheared and noisy state with an inverted tet and tets of negative curvature; returns x."""
    rng = np.random.default_rng(11)
    x = rig.oracle.rest @ SQUEEZE.T + 0.12 * rng.standard_normal(rig.oracle.rest.shape)  # [m]
    rig.model.state.x.from_numpy(x)
    rig.model.state.v.from_numpy(rng.standard_normal(x.shape).astype(rig.machine.np_real))
    return x


def elastic_force(rig, x) -> np.ndarray:
    """Elastic forces at x, as float64."""
    rig.model.state.x.from_numpy(x)
    elasticity.elastic_forces(rig.model)
    elasticity.gather_forces(rig.model, rig.force)
    return rig.force.to_numpy().astype(np.float64)


def assert_close(rig, value, expected, roundings: float) -> None:
    """Check equality up to that many roundings of the largest expected number."""
    assert np.abs(expected).max() > 0.0
    assert np.abs(value - expected).max() < roundings * rig.eps * np.abs(expected).max()


def test_the_squeezed_state_is_inverted_and_indefinite(rig, squeezed):
    assert 1 <= rig.oracle.volume_ratios(squeezed)[1] < 26  # tets
    assert np.linalg.eigvalsh(rig.oracle.stiffness(squeezed)).min() < -1e3  # N/m


def test_energies_and_volume_ratios(rig, squeezed):
    v = rig.model.state.v.to_numpy().astype(np.float64)
    of_mass = rig.oracle.kinetic(v, explicit=False), rig.oracle.weight(squeezed, explicit=False)
    expected = (rig.oracle.energy(squeezed), *rig.oracle.volume_ratios(squeezed), *of_mass)
    rig.model.state.scalars.fill(-1.0)
    measure(rig.model)
    # sums are in f64, but the rest shape, masses and gravity are stored in the model's precision
    assert rig.model.state.scalars.to_numpy()[: GRAVITY + 1] == pytest.approx(expected, rel=10 * rig.eps, abs=10 * rig.eps)


def test_forces(rig, squeezed):
    rig.model.state.element_force.fill(np.nan)  # entries that are read but not written give nan
    assert_close(rig, elastic_force(rig, squeezed), rig.oracle.force(squeezed), 30)


@pytest.mark.parametrize("where", ["here", "far", "turned"])
def test_no_force_at_rest(rig, where):
    x = rig.oracle.rest
    if where == "far":
        x = x + [1e4, -2e4, 5e3]  # [m]: positions and their differences are f64 in either precision
    if where == "turned":
        Q = np.linalg.qr(np.random.default_rng(2).standard_normal((3, 3)))[0]
        x = x @ (Q * np.linalg.det(Q)).T
    force = elastic_force(rig, x)
    measure(rig.model)
    largest = max(part.material.young for part in rig.oracle.parts)  # times about 1 m^2: the force of a strain of 1
    rounding = rig.eps + (1e-11 if where == "far" else 0.0)
    assert np.abs(force).max() < 10 * rounding * largest
    scalars = rig.model.state.scalars
    assert scalars[ELASTIC] < 10 * rounding * largest and scalars[N_INVERTED] == 0  # [J], inverted tets


def test_forces_are_minus_the_gradient_of_the_energy(rig, squeezed):
    """By finite differences of taisoft's own energy, which is summed in f64."""
    direction, h, energies = np.random.default_rng(4).standard_normal(squeezed.shape), 1e-5, []
    elastic_force(rig, squeezed)
    for step in (h, -h):
        rig.model.state.x.from_numpy(squeezed + step * direction)
        measure(rig.model)
        energies.append(rig.model.state.scalars[ELASTIC])
    slope = (energies[0] - energies[1]) / (2 * h)
    assert abs(slope) > 1e4  # [N]
    assert -np.sum(elastic_force(rig, squeezed) * direction) == pytest.approx(slope, rel=1e-7 + 30 * rig.eps)


def test_a_tet_inverted_at_one_point_is_inverted(rig):
    """Moving the middle of an edge along it inverts the element near one end."""
    x, part = rig.oracle.rest.copy(), rig.oracle.parts[0]
    tet = part.nodes[0]
    x[tet[4]] += 0.6 * (x[tet[1]] - x[tet[0]])
    J = np.linalg.det(rig.oracle.gradients(x, part)).reshape(-1, part.points)
    low, count = rig.oracle.volume_ratios(x)
    assert count == (J <= 0).any(axis=1).sum() > 0 and (J <= 0).sum(axis=1).max() == 1
    rig.model.state.x.from_numpy(x)
    measure(rig.model)
    assert rig.model.state.scalars[MIN_J] == pytest.approx(low, abs=10 * rig.eps) and rig.model.state.scalars[N_INVERTED] == count


def test_force_differential(rig, squeezed):
    dx = np.random.default_rng(5).standard_normal(squeezed.shape).astype(rig.machine.np_real)
    expected = -(rig.oracle.stiffness(squeezed) @ dx.astype(np.float64).reshape(-1)).reshape(-1, 3)
    rig.dx.from_numpy(dx)
    elasticity.force_differential(rig.model, rig.dx, rig.product)
    assert_close(rig, rig.product.to_numpy(), expected, 100)


def test_assembled_stiffness(rig, squeezed):
    dx = np.random.default_rng(6).standard_normal(squeezed.shape).astype(rig.machine.np_real)
    rig.dx.from_numpy(dx)
    elasticity.force_differential(rig.model, rig.dx, rig.product)
    free = rig.product.to_numpy()
    rig.matrix.value.fill(np.nan)
    rig.matrix.diagonal.fill(np.nan)
    block_csr.assemble(rig.model, rig.matrix, EVERYTHING, False)
    K = block_csr.to_scipy(rig.model, rig.matrix).toarray()
    assert_close(rig, K, rig.oracle.stiffness(squeezed), 100)
    assert_close(rig, K, K.T, 20)
    block_csr.multiply(rig.model, rig.matrix, rig.dx, rig.product)
    assert_close(rig, rig.product.to_numpy(), -free, 100)
    assert_close(rig, rig.product.to_numpy().reshape(-1), K @ dx.astype(np.float64).reshape(-1), 30)
    for axis in np.eye(3):
        assert np.abs(K @ np.tile(axis, rig.model.n_nodes)).max() < 30 * rig.eps * np.abs(K).max()


def test_stiffness_by_finite_differences_of_the_forces(rig, squeezed):
    """Of taisoft's own forces: errors are h^2 times the third derivative of the energy, and rounding of the forces over h."""
    block_csr.assemble(rig.model, rig.matrix, EVERYTHING, False)
    K = block_csr.to_scipy(rig.model, rig.matrix)
    direction, h = np.random.default_rng(7).standard_normal(squeezed.shape), {"f64": 1e-6, "f32": 1e-3}[rig.machine.precision]
    forces = [elastic_force(rig, squeezed + step * direction) for step in (h, -h)]
    change = (forces[0] - forces[1]).reshape(-1) / (2 * h)
    assert np.abs(K @ direction.reshape(-1) + change).max() < (1e-8 + 30 * rig.eps / h) * np.abs(change).max()


def test_pattern_is_the_node_graph(rig):
    """Half-rows left and right of the diagonal with ascending columns, a block for each pair of a tet's nodes."""
    edges = set()
    for tets, *_ in rig.oracle.parts:
        for tet in tets:
            edges |= {(int(a), int(b)) for a in tet for b in tet if a != b}
    start, column = rig.matrix.row_start.to_numpy(), rig.matrix.column.to_numpy()
    n = rig.model.n_nodes
    rows = [list(column[start[i] : start[i + 1]]) for i in range(2 * n)]
    assert {(i % n, int(j)) for i, row in enumerate(rows) for j in row} == edges
    assert all(row == sorted(set(row)) for row in rows) and 2 * rig.matrix.n_edges == len(edges)
    assert all(j < i if i < n else j > i - n for i, row in enumerate(rows) for j in row)


@pytest.mark.parametrize("rig", ["f32"], indirect=True)  # each law's own projection is tested in f64 with the laws
def test_projected_stiffness(rig, squeezed):
    expected = rig.oracle.stiffness(squeezed, projected=True)
    assert np.abs(expected - rig.oracle.stiffness(squeezed)).max() > 1e4  # [N/m] so that projection matters
    block_csr.assemble(rig.model, rig.matrix, EVERYTHING, True)
    K = block_csr.to_scipy(rig.model, rig.matrix).toarray()
    assert_close(rig, K, expected, 100)
    assert np.linalg.eigvalsh((K + K.T) / 2).min() > -20 * rig.eps * np.abs(K).max()


def test_system(rig):
    """(c + beta a) M + beta^2 K + beta b K_d with each row's damping rates a and b, 0 in two bodies."""
    c, beta, rng = 0.7, 30.0, np.random.default_rng(9)
    fields = (rig.matrix.value, rig.matrix.diagonal, rig.damper.value, rig.damper.diagonal)
    numbers = [block_csr.packed(rng.standard_normal((*field.shape, 3, 3))).astype(rig.machine.np_real) for field in fields]
    a, b = (np.repeat(rates, 3)[:, None] for rates in (rig.oracle.mass_damping, rig.oracle.stiffness_damping))
    assert set(a.flat) == {0.0, 0.4} and set(b.flat) == {0.0, 3e-3}
    M = np.kron(rig.oracle.mass, np.eye(3))
    for field, values in zip(fields, numbers):
        field.from_numpy(values)
    K, K_d = (block_csr.to_scipy(rig.model, A).toarray() for A in (rig.matrix, rig.damper))
    block_csr.to_system(rig.model, rig.matrix, rig.damper, EVERYTHING, 0, c, beta)
    expected = (c + beta * a) * M + beta**2 * K + beta * b * K_d
    assert_close(rig, block_csr.to_scipy(rig.model, rig.matrix).toarray(), expected, 10)


@pytest.mark.parametrize("rig", ["f32"], indirect=True)
def test_parallel_kernels_are_reproducible(rig, squeezed):
    assert not rig.model.serial

    def numbers():
        block_csr.assemble(rig.model, rig.matrix, EVERYTHING, False)
        elasticity.elastic_forces(rig.model)
        elasticity.gather_forces(rig.model, rig.force)
        measure(rig.model)
        fields = (rig.matrix.value, rig.matrix.diagonal, rig.force, rig.model.state.scalars)
        return [field.to_numpy() for field in fields]

    first = numbers()
    for _ in range(10):
        assert all(np.array_equal(a, b) for a, b in zip(first, numbers()))
