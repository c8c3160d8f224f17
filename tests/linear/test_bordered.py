"""Parts of bordered systems, on the host: multipliers of the active set, and inverses of diagonal blocks."""

import numpy as np

from taisoft.linear import block_csr
from taisoft.linear.bordered import block_inverse, solve_active


def test_one_sided_multipliers_are_complementary():
    rng, k, active = np.random.default_rng(1), 5, 0
    one_sided = np.arange(k) > 0
    for _ in range(30):
        half = rng.standard_normal((k, k))
        N, (start, missing, values, shift) = half @ half.T + 0.1 * np.eye(k), rng.standard_normal((4, k))
        penalty = 0.01 * rng.random(k)
        s, found = solve_active(N, start, missing, values, shift, penalty, one_sided)
        reached, on = start + N @ s, ~one_sided | (found > 0.0)
        assert np.abs(found - on * (values + shift + s - penalty * reached)).max() < 1e-10
        assert np.abs((values + shift + s - penalty * reached)[~on]).max(initial=0.0) < 1e-10
        assert np.abs(reached - missing)[on].max() < 1e-10 and (reached >= missing - 1e-10)[~on].all()
        active += on.sum()
    assert 60 < active < 140
    assert solve_active(np.zeros((1, 1)), *np.ones((5, 1)), np.array([False])) is None


def test_inverses_of_diagonal_blocks():
    rng, free = np.random.default_rng(2), np.ones((4, 3))
    A = rng.standard_normal((4, 3, 3))
    A = A + A.swapaxes(1, 2)  # indefinite
    free[1, 2], free[3] = 0.0, 0.0
    found = block_inverse(block_csr.packed(A), free)
    values, vectors = np.linalg.eigh(A[0])
    assert np.abs(found[0] - (vectors / np.abs(values)) @ vectors.T).max() < 1e-12
    assert np.abs(np.linalg.inv(found[1, :2, :2] @ found[1, :2, :2]) - A[1, :2, :2] @ A[1, :2, :2]).max() < 1e-10
    assert not found[3].any() and not found[1, 2].any() and not found[1, :, 2].any()
    assert block_inverse(np.full((1, 12), np.inf), np.ones((1, 3))) is None
