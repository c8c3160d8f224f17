"""The contact solvers, compared with NumPy (contact_oracle.py):

* impulses of random problems obey Signorini and Coulomb with every method; reference problems have the reference velocities;
* hard problems: "auto" and the augmented Lagrangian reach 1e-8, Gauss-Seidel twice the yardstick's residual;
* over nodes and as a matrix, r-factors, velocities, residuals and sweeps agree to rounding, and with NumPy, in any order of
  colours and on any number of threads; units, frames of the tangents and the order of contacts do not change the solution;
* the best impulses of the history are returned; problems that are not finite do not converge; solutions need no sweep;
* the augmented Lagrangian solves problems with redundant and slightly unsymmetric W, dense or sparse.
"""

import json

import numpy as np
import pytest
import scipy.sparse as sp
from scipy.linalg import block_diag
from scipy.spatial.transform import Rotation

import taisoft as ts
from benchmarks.contact_problems import YARDSTICK
from taisoft.contact import SOLVERS, augmented_lagrangian
from taisoft.contact.api import METHODS
from taisoft.contact.colouring import colour_contacts, colour_greedy, matrix_graph, store
from taisoft.contact.solve import solve
from tests.contact import contact_oracle as oracle
from tests.contact.contact_rig import N_NODES, impulses


@pytest.mark.parametrize("method", METHODS)
def test_solutions_obey_the_contact_laws(method):
    for seed, k, friction in ((0, 1, 0.5), (1, 6, 0.0), (2, 20, 0.3), (3, 40, 1.0)):
        made = oracle.random_contacts(seed, k, N_NODES, friction, prescribed=seed == 2)
        W, b, mu = made.W, made.b, made.friction
        found = ts.solve_contact_problem(W, b, mu, method, tolerance=1e-9, max_iterations=5000)
        assert found.converged and found.residual == pytest.approx(oracle.residual(W, b, mu, found.impulse), rel=1e-3)
        assert found.residual <= 1e-9 and len(found.residual_history) == found.iterations + 1
        broken = oracle.breaks(W, b, mu, found.impulse)
        assert broken["pulls"] == 0.0 and broken["outside its cone"] < 1e-15
        assert max(broken.values()) < 1e-7, broken
        assert np.abs(found.impulse).max() > 0.1  # some contacts are closed


@pytest.mark.parametrize("method", METHODS)
def test_reference_problems(method, shared):
    paths = sorted((shared / "references").glob("fcp_*.json"))
    assert len(paths) >= 9
    for path in paths:
        (W, b, mu), data = oracle.load(path), json.loads(path.read_text(encoding="utf-8"))
        found = ts.solve_contact_problem(W, b, mu, method, tolerance=1e-10, max_iterations=20000)
        assert found.converged and oracle.residual(W, b, mu, found.impulse) <= 1e-8, path.name
        if data["uncertainty"]["v_unique"]:
            v = np.array(data["value"]["v"])
            assert W @ found.impulse + b == pytest.approx(v, abs=1e-6 * max(1.0, np.abs(v).max()))


def test_hard_problems(rig, shared):
    """Both solvers that are to master them do, and Gauss-Seidel is as good as the yardstick, with momentum too."""
    for name, yardsticks in YARDSTICK.items():  # residuals of plain Gauss-Seidel after 10, 100 and 1000 sweeps
        W, b, mu = oracle.load(shared / "contact_problems" / f"{name}.npz")
        for method, limit in (("augmented_lagrangian", 20), ("auto", 130)):
            found = ts.solve_contact_problem(W, b, mu, method, tolerance=1e-8, max_iterations=limit)
            assert found.converged and oracle.residual(W, b, mu, found.impulse) <= 1e-8, name
        p = rig.matrix(W, b, mu)
        for momentum in (False, True):
            for sweeps, yardstick in zip((10, 100, 1000), yardsticks):
                p.r.fill(0.0)
                found = solve(p, "gauss_seidel", 1e-13, sweeps, momentum=momentum)
                assert found.residual <= 2.0 * yardstick, name
                assert oracle.residual(W, b, mu, impulses(p)) == pytest.approx(found.residual, rel=1e-3, abs=1e-14)


@pytest.mark.parametrize("prescribed", [False, True])
def test_forms_agree(rig, prescribed):
    made = oracle.random_contacts(5, 30, N_NODES, prescribed=prescribed)
    W, b, mu = made.W, made.b, made.friction
    p, q = rig.nodes(made), rig.matrix(W, b, mu)
    for form in (p, q):
        assert form.factor.to_numpy()[:30][:, [0, 1, 1]] == pytest.approx(oracle.factors(W), rel=1e-12)
        for sweeps in (1, 2, 7):
            form.r.fill(0.0)
            found = solve(form, "gauss_seidel", 0.0, sweeps, momentum=False)
            expected = oracle.gauss_seidel(W, b, mu, sweeps)
            assert impulses(form) == pytest.approx(expected, rel=1e-11, abs=1e-13)
            assert found.residual == pytest.approx(oracle.residual(W, b, mu, expected), rel=1e-9)
            assert found.iterations == sweeps
    w = p.w.to_numpy()
    assert w == pytest.approx(made.inverse_mass * (made.jacobian.T @ impulses(p).ravel()).reshape(-1, 3), abs=1e-13)
    for form in (p, q):
        form.r.fill(0.0)
        solve(form, "gauss_seidel", 0.0, 12)  # with momentum
    relaxation = p.sweep.relaxation.to_numpy()[:30]
    assert relaxation == pytest.approx(q.sweep.relaxation.to_numpy()[:30], rel=1e-12)
    assert (relaxation < 0.999).any() == prescribed  # with one axis prescribed, blocks are no multiples of the identity
    assert impulses(p) == pytest.approx(impulses(q), rel=1e-9, abs=1e-12)


@pytest.mark.parametrize("matrix", [False, True])
def test_coloured_equals_serial_in_the_order_of_the_colours(rig, matrix):
    made = oracle.random_contacts(7, 40, N_NODES, prescribed=True)
    W, b, mu = made.W, made.b, made.friction
    for momentum in (False, True):
        found = []
        for serial in (True, False):
            p = rig.matrix(W, b, mu, serial) if matrix else rig.nodes(made, serial)
            store(p, colour_greedy(matrix_graph(sp.csr_matrix(W)))) if matrix else colour_contacts(p)
            order = p.sweep.order.to_numpy()[:40]
            assert 1 < p.count[1] < 40 and sorted(order) == list(range(40)) and (np.diff(order) < 0).any()
            for method in ("coloured_gauss_seidel", "gauss_seidel"):  # the second in p.sweep.order too
                p.r.fill(0.0)
                solve(p, method, 0.0, 6, momentum=momentum)
                found.append(impulses(p))
        expected = found[0] if momentum else oracle.gauss_seidel(W, b, mu, 6, order)
        assert all(other == pytest.approx(expected, rel=1e-11, abs=1e-13) for other in found)


@pytest.mark.parametrize("method", ["jacobi", "hybrid"])
def test_threads_do_not_matter(rig, method):
    made = oracle.random_contacts(8, 60, N_NODES, prescribed=True)
    for matrix in (False, True):
        found, results = [], []
        for serial in (True, False, False):
            p = rig.matrix(made.W, made.b, made.friction, serial) if matrix else rig.nodes(made, serial)
            results.append(solve(p, method, 1e-6, 1000, history=True))
            found.append(impulses(p))
        assert results[0].converged and results[0].iterations == results[1].iterations
        assert results[1].history == pytest.approx(results[0].history, rel=1e-6)
        assert found[1] == pytest.approx(found[0], rel=1e-6, abs=1e-9)
        assert np.array_equal(found[1], found[2]) and results[1].history == results[2].history  # reruns give the same bits


def test_hybrid_uses_the_new_normal_impulse_for_friction(rig):
    """One contact pressed and pushed sideways: after a sweep from 0 Jacobi has no friction yet, the hybrid all of it."""
    W, b, mu = np.eye(3), np.array([-1.0, 5.0, 0.0]), np.array([0.5])
    for method, tangential in (("jacobi", 0.0), ("hybrid", -0.5)):
        p = rig.matrix(W, b, mu)
        solve(p, method, 0.0, 1, momentum=False)
        assert impulses(p) == pytest.approx(np.array([[1.0, tangential, 0.0]]))


@pytest.mark.parametrize("method", METHODS)
def test_units_frames_and_order_do_not_matter(method):
    """Masses times 2^20, velocities times 2^-10: impulses times 2^10. Tangents rotated about the normals, contacts permuted: the
    same velocities in space."""
    made, mu = oracle.random_contacts(10, 20, N_NODES), np.linspace(0.1, 0.9, 20)
    W, b, rng = made.W, made.b, np.random.default_rng(0)
    one = ts.solve_contact_problem(W, b, mu, method, 1e-10, 5000)
    other = ts.solve_contact_problem(W * 2.0**-20, b * 2.0**-10, mu, method, 1e-10, 5000)
    assert other.iterations == one.iterations and other.impulse * 2.0**-10 == pytest.approx(one.impulse, rel=1e-6, abs=1e-9)
    order, turns = rng.permutation(20), Rotation.from_euler("x", rng.uniform(0, 6, (20, 1))).as_matrix()
    T = block_diag(*turns) @ np.kron(np.eye(20)[order], np.eye(3))
    other = ts.solve_contact_problem(T @ W @ T.T, T @ b, mu[order], method, 1e-10, 5000)
    assert one.converged and other.converged
    assert T.T @ (T @ W @ T.T @ other.impulse + T @ b) == pytest.approx(W @ one.impulse + b, abs=1e-7)


@pytest.mark.parametrize("method", SOLVERS)
def test_the_best_impulses_are_returned(rig, method):
    """With large friction and scattered normals no method converges, and residuals oscillate; NaN does not converge either."""
    made = oracle.random_contacts(17, 60, N_NODES, friction=4.0, spread=1.5)
    p = rig.nodes(made)
    colour_contacts(p)
    found = solve(p, method, 1e-14, 400, every=1, history=True)
    residual = oracle.residual(made.W, made.b, made.friction, impulses(p))
    assert not found.converged and max(np.diff(found.history)) > 0.0
    assert found.residual == min(found.history[1:]) and residual == pytest.approx(found.residual, rel=1e-6)
    assert p.w.to_numpy() == pytest.approx(made.inverse_mass * (made.jacobian.T @ impulses(p).ravel()).reshape(-1, 3), abs=1e-9)
    made.b[4] = np.nan
    p = rig.nodes(made)
    colour_contacts(p)
    found = solve(p, method, 1e-6, 20)
    assert not found.converged and found.iterations == 20


def test_a_solution_needs_no_sweep(rig):
    made = oracle.random_contacts(16, 30, N_NODES)
    p = rig.nodes(made)
    solve(p, "gauss_seidel", 1e-9, 2000)
    before = impulses(p)
    assert solve(p, "jacobi", 1e-8, 100).iterations == 0 and np.array_equal(impulses(p), before)
    made.b[0::3] = np.abs(made.b[0::3]) + 0.1  # all contacts separate
    p = rig.nodes(made)
    found = solve(p, "gauss_seidel", 1e-8, 50)
    assert found.converged and found.iterations == 0 and found.residual == 0.0 and not impulses(p).any()


def test_factors_of_the_augmented_lagrangian_are_those_of_the_stiffest_direction():
    W = sp.diags([2.0, 4.0, 8.0, 0.5, 5.0, 1.0, 0.0, 0.0, 0.0])
    assert augmented_lagrangian.find_factors(W) == pytest.approx(np.array([[1 / 2, 1 / 8], [2, 1 / 5], [0, 0]]))


@pytest.mark.parametrize("k", [15, 40])  # islands of 90 rows are solved as dense matrices, larger ones as sparse ones
@pytest.mark.parametrize("skew", [0.0, 1e-3])
def test_augmented_lagrangian_of_a_singular_matrix(k, skew):
    """Every contact twice, so that half of W's eigenvalues are 0, and W slightly unsymmetric."""
    made = oracle.random_contacts(18, k, N_NODES)
    double = np.kron(np.ones((2, 1)), np.eye(3 * k))
    uneven = made.W * (1.0 + skew * np.random.default_rng(0).uniform(-1, 1, (3 * k, 3 * k)))
    W, b, mu = double @ uneven @ double.T, double @ made.b, np.tile(made.friction, 2)
    found = ts.solve_contact_problem(sp.csr_matrix(W), b, mu, "augmented_lagrangian", 1e-10, 30)
    assert found.converged and oracle.residual(W, b, mu, found.impulse) <= 1.01e-10
