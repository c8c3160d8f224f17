"""`solve_contact_problem`: its inputs and errors:

* dense and sparse matrices of any format, lists, and no contacts are accepted; duplicate entries are summed; nothing is changed;
* invalid input is refused;
* contacts between immovable bodies get no impulse;
* the history has the initial residual and that of every iteration; the iteration limit holds; convergence depends on the
  residual alone.
"""

import numpy as np
import pytest
import scipy.sparse as sp

import taisoft as ts
from taisoft.contact.api import METHODS
from tests.contact import contact_oracle as oracle

PROBLEM = oracle.random_contacts(0, 6, 12)
W, B, MU = PROBLEM.W, PROBLEM.b, PROBLEM.friction


def test_formats_of_W():
    before, b, mu = ts.solve_contact_problem(W, B, MU).impulse, B.copy(), MU.copy()
    for form in (np.ndarray.tolist, sp.csr_matrix, sp.coo_matrix, sp.csr_array, sp.bsr_matrix):
        given = form(W)
        found = ts.solve_contact_problem(given, b.tolist(), mu, "gauss_seidel")
        assert found.converged and np.array_equal(found.impulse, before)
        assert found.impulse.dtype == np.float64 and found.impulse.shape == (18,)
        assert np.array_equal(given if form is np.ndarray.tolist else given.toarray(), W) and np.array_equal(mu, MU)
    whole = sp.coo_matrix(W)
    twice = sp.coo_matrix((np.tile(0.5 * whole.data, 2), (np.tile(whole.row, 2), np.tile(whole.col, 2))), shape=W.shape)
    assert ts.solve_contact_problem(twice, B, MU).impulse == pytest.approx(before)


@pytest.mark.parametrize("method", METHODS)
def test_no_contacts(method):
    for nothing in (sp.csr_matrix((0, 0)), []):
        found = ts.solve_contact_problem(nothing, [], [], method)
        assert found.converged and found.impulse.shape == (0,) and found.residual == 0.0
        assert found.iterations == 0 and found.residual_history == [0.0]


def changed(array: np.ndarray, at, value: float) -> np.ndarray:
    copy = np.array(array, dtype=float)
    copy[at] = value
    return copy


REFUSED = [
    ((W[:17, :17], B, MU), {}, "W has shape .17, 17.: it must be .3k, 3k., three rows per contact"),
    ((W * 1j, B, MU), {}, "W must hold real numbers, not complex128"),
    ((changed(W, (4, 7), np.nan), B, MU), {}, r"W\[4, 7\] is nan, not finite"),
    ((sp.csr_matrix(changed(W, (4, 7), np.inf)), B, MU), {}, r"W\[4, 7\] is inf, not finite"),
    ((changed(W, (6, 6), -2.0), B, MU), {}, r"W\[6, 6\] is -2: .* cannot be negative"),
    ((W, B[:-1], MU), {}, r"b must have shape \(18,\), not \(17,\)"),
    ((W, changed(B, 3, np.inf), MU), {}, r"b: entry \[3\] is inf, not finite"),
    ((W, ["a"] * 18, MU), {}, "b must be numbers"),
    ((W, B, MU[:5]), {}, r"mu must have shape \(6,\), not \(5,\)"),
    ((W, B, changed(MU, 2, -0.1)), {}, r"mu\[2\] is -0.1: a coefficient of friction cannot be negative"),
    ((W, B, MU), {"method": "gauss_siedel"}, "method must be one of .* did you mean 'gauss_seidel'"),
    ((W, B, MU), {"tolerance": 0.0}, "tolerance must be greater than 0"),
    ((W, B, MU), {"max_iterations": 0}, "max_iterations must be a whole number of at least 1, not 0"),
    ((W, B, MU), {"max_iterations": 2.5}, "max_iterations must be a whole number"),
]


def test_invalid_input_is_refused():
    for inputs, options, message in REFUSED:
        with pytest.raises(ts.SceneError, match=message):
            ts.solve_contact_problem(*inputs, **options)


@pytest.mark.parametrize("method", METHODS)
def test_immovable_contacts_get_no_impulse(method):
    """A contact between immovable bodies, and one that is immovable along its tangents, beside others."""
    A, b, mu = np.zeros((24, 24)), np.concatenate([[-1.0, 2.0, 0.0], B, [-4.0, 1.0, 0.0]]), np.array([0.5, *MU, 0.5])
    A[3:21, 3:21], A[21, 21] = W, 2.0
    found = ts.solve_contact_problem(A, b, mu, method, 1e-10)
    assert found.converged and not found.impulse[:3].any() and found.impulse[21] == pytest.approx(2.0)
    assert np.hypot(*found.impulse[22:]) <= 0.5 * found.impulse[21] * (1 + 1e-12)
    alone = ts.solve_contact_problem(W, B, MU, method, 1e-10).impulse
    assert W @ found.impulse[3:21] == pytest.approx(W @ alone, abs=1e-8)
    nothing = ts.solve_contact_problem(np.zeros((6, 6)), -np.ones(6), [0.5, 0.5], method)
    assert not nothing.impulse.any() and nothing.residual == 0.0


@pytest.mark.parametrize("method", METHODS)
def test_iteration_limit_and_history(method):
    made = oracle.random_contacts(1, 30, 40)
    many = ts.solve_contact_problem(made.W, made.b, made.friction, method, 1e-8)
    assert many.converged and many.residual_history[0] == 1.0 and many.residual_history[-1] <= 1e-8 < many.residual_history[-2]
    for limit in (1, 3):
        few = ts.solve_contact_problem(made.W, made.b, made.friction, method, 1e-8, limit)
        assert few.iterations == min(limit, many.iterations) and few.converged == (few.residual <= 1e-8)
        assert few.residual_history == many.residual_history[: few.iterations + 1]
        least = pytest.approx(min(few.residual_history[1:]), rel=1e-3)
        assert few.residual == least and oracle.residual(made.W, made.b, made.friction, few.impulse) == least


def test_histories_longer_than_a_launch_stores_are_whole():
    made = oracle.random_contacts(3, 60, 40, friction=4.0, spread=1.5)
    found = ts.solve_contact_problem(made.W, made.b, made.friction, "jacobi", 1e-15, 2500)
    assert found.iterations == 2500 and len(found.residual_history) == 2501 and not found.converged
