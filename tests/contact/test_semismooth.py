"""The semismooth Newton method for contact problems with a dense W:

* from a start near them it finds impulses that stick, slip and open as the laws of Signorini and Coulomb demand, also where
  contacts are redundant, so that W is singular;
* its derivative is that of the projection onto the laws, and its limit of iterations holds;
* where the first shift cycles another takes over;
* it gives up where there is no solution, and on what is not finite; then the augmented Lagrangian takes over.
"""

import numpy as np
import pytest

from taisoft.contact import semismooth
from taisoft.contact.augmented_lagrangian import find_factors, find_residual, prox, residual_at
from taisoft.contact.matrix_contacts import MatrixContacts
from tests.contact import contact_oracle as oracle

TOLERANCE = 1e-10


def solved(W, b, friction, start, most: int = 30) -> tuple[np.ndarray, int] | None:
    def holds(r: np.ndarray) -> bool:
        return find_residual(W, b, friction, r) <= TOLERANCE

    return semismooth.solve(W, b, friction, start, find_factors(W), holds, 4 * TOLERANCE, most)


@pytest.mark.parametrize(
    "b, friction, r",
    [
        pytest.param((-1.0, 0.1, -0.05), 0.5, (0.5, -0.1, 0.05), id="sticks"),
        pytest.param((-1.0, 3.0, 4.0), 0.5, (0.5, -0.15, -0.2), id="slips"),
        pytest.param((-1.0, 3.0, 4.0), 0.0, (0.5, 0.0, 0.0), id="slips without friction"),
        pytest.param((1.0, 3.0, 4.0), 0.5, (0.0, 0.0, 0.0), id="opens"),
    ],
)
def test_one_contact(b, friction, r):
    """Of a mass, whose impulses are known; from a start in another state."""
    W = np.diag([2.0, 1.0, 1.0])
    for start in ((0.6, 0.0, 0.0), (0.1, 0.05, 0.0), (0.6, -0.2, -0.2)):
        found = solved(W, np.array(b), np.array([friction]), np.array([start]))
        assert found is not None and np.abs(found[0] - r).max() < 1e-10


OPEN, STICK, SLIP = range(3)


def random_problem(seed: int, k: int = 12, redundant: int = 0, friction: float = 0.6) -> tuple:
    """W, b, friction and impulses that solve the problem, a third of which open, stick and slip.

    redundant: contacts, the last ones, at the places of the first ones.
    """
    rng, own = np.random.default_rng(seed), k - redundant
    state, at = rng.permutation(own) % 3, np.concatenate([np.arange(own), np.arange(redundant)])
    J = rng.standard_normal((own, 3, 3 * own + 5))[at].reshape(3 * k, -1) / np.sqrt(3 * own)
    angle, normal = rng.uniform(0, 2 * np.pi, own), rng.uniform(0.5, 1.5, k)
    e = np.stack([np.cos(angle), np.sin(angle)], axis=1)
    u = np.zeros((own, 3))
    u[state == OPEN] = rng.standard_normal((np.sum(state == OPEN), 3))
    u[state == OPEN, 0] = rng.uniform(0.5, 1.5, np.sum(state == OPEN))
    u[state == SLIP, 1:] = -e[state == SLIP] * rng.uniform(0.5, 1.5, (np.sum(state == SLIP), 1))
    state, e, u = state[at], e[at], u[at]
    share = np.where(state == SLIP, 1.0, 0.4 * rng.uniform(0, 1, k))
    r = np.column_stack([normal, (friction * normal * share)[:, None] * e]) * (state != OPEN)[:, None]
    if friction == 0.0:
        u[state == STICK, 1:] = rng.standard_normal((np.sum(state == STICK), 2))
    W = J @ J.T
    return W, u.reshape(-1) - W @ r.reshape(-1), np.full(k, friction), r


@pytest.mark.parametrize("redundant", [0, 4])
@pytest.mark.parametrize("friction", [0.0, 0.6])
@pytest.mark.parametrize("seed", range(4))
def test_random_problems(seed, friction, redundant):
    """Redundant contacts have any impulses with the same sum: the laws hold, and velocities are the known ones."""
    W, b, mu, r = random_problem(seed, redundant=redundant, friction=friction)
    assert np.linalg.matrix_rank(W) == len(W) - 3 * redundant and oracle.residual(W, b, mu, r) < 1e-13
    start = prox(r + 0.02 * np.random.default_rng(seed).standard_normal(r.shape), mu)
    given = start.copy()
    found, n = solved(W, b, mu, start)
    assert n <= 12 and np.array_equal(start, given)
    assert (found[:, 0] >= 0.0).all(), "a disk of negative radius gives no number"
    assert oracle.residual(W, b, mu, found) <= 1.01 * TOLERANCE
    assert max(oracle.breaks(W, b, mu, found).values()) < 1e-9
    assert np.abs(W @ (found - r).reshape(-1)).max() < 1e-8
    if not redundant:
        assert np.abs(found - r).max() < 1e-8


def test_the_derivative_is_that_of_the_projection():
    """By central differences, where it is smooth: pressing and not, sticking and slipping, with friction and without."""
    rng, friction, h = np.random.default_rng(3), np.repeat([0.0, 0.3, 1.0], 40), 1e-6
    z = rng.standard_normal((len(friction), 3))
    z[::3, 1:] *= 0.1
    away = np.minimum(np.abs(z[:, 0]), np.abs(np.hypot(z[:, 1], z[:, 2]) - friction * np.maximum(z[:, 0], 0.0))) > 1e-3
    z, friction = z[away], friction[away]
    D, size = semismooth.derivative(z, friction), np.hypot(z[:, 1], z[:, 2])
    presses, sticks = z[:, 0] > 0.0, size < friction * z[:, 0]
    assert min(np.sum(~presses), np.sum(presses & sticks), np.sum(presses & ~sticks)) > 5
    for axis in range(3):
        step = h * np.eye(3)[axis]
        expected = (prox(z + step, friction) - prox(z - step, friction)) / (2 * h)
        assert np.abs(D[:, :, axis] - expected).max() < 1e-8
    assert np.isfinite(semismooth.derivative(np.zeros((2, 3)), np.array([0.0, 0.5]))).all()


def test_a_solution_needs_no_iterations_and_too_few_give_none():
    W, b, mu, r = random_problem(5)
    assert solved(W, b, mu, r, most=0)[1] == 0
    start = prox(r + 0.5 * np.random.default_rng(5).standard_normal(r.shape), mu)
    n = solved(W, b, mu, start)[1]
    too_few = (n - 1) // len(semismooth.SHIFTS)
    assert too_few > 0 and solved(W, b, mu, start, most=n)[1] == n and solved(W, b, mu, start, most=too_few) is None


@pytest.mark.parametrize("k, friction, seed", [(4, 0.8, 20), (4, 0.8, 26), (8, 0.3, 12), (8, 0.3, 24)])
def test_where_the_first_shift_cycles_another_takes_over(monkeypatch, k, friction, seed):
    """Contacts of one rigid body, from impulses of 0; earlier than after all iterations."""
    rng, mu = np.random.default_rng(seed), np.full(k, friction)
    J = rng.standard_normal((3 * k, 6))
    problem = J @ J.T + 1e-3 * np.eye(3 * k), J @ rng.standard_normal(6), mu
    found, n = solved(*problem, np.zeros((k, 3)), most=20)
    assert max(oracle.breaks(*problem, found).values()) < 1e-8
    monkeypatch.setattr(semismooth, "MAX_RISING", 99)
    assert n < solved(*problem, np.zeros((k, 3)), most=20)[1]
    monkeypatch.setattr(semismooth, "SHIFTS", semismooth.SHIFTS[:1])
    assert solved(*problem, np.zeros((k, 3)), most=20) is None


def test_it_gives_up_where_it_cannot_solve():
    """Two contacts that squeeze what cannot yield have no solution; nor has what is not finite."""
    pinch = np.kron([[1.0, -1.0], [-1.0, 1.0]], np.eye(3))
    mu, start = np.array([0.3, 0.3]), np.array([[1.0, 0, 0], [1.0, 0, 0]])
    assert solved(pinch, np.array([-1.0, 0, 0, -1.0, 0, 0]), mu, start) is None
    assert solved(np.eye(6), np.full(6, np.nan), mu, start) is None
    assert solved(np.full((6, 6), np.nan), np.zeros(6), mu, start) is None


def test_where_it_fails_the_augmented_lagrangian_takes_over(monkeypatch):
    """To both bounds: that with the factors of W, and that with others."""
    W, b, mu, r = random_problem(7)
    monkeypatch.setattr(semismooth, "solve", lambda *_: None)
    factor, limit = 100.0 * find_factors(W), 1e-6
    found, result = MatrixContacts(True).solve(W, b, mu, prox(0.5 * r, mu), "gauss_seidel", 1e-3, 10, factor=factor, limit=limit)
    assert result.converged and np.abs(found - r).max() < 1e-4
    assert residual_at((W @ found.reshape(-1) + b).reshape(-1, 3), mu, factor, found) <= limit
