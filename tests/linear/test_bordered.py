"""Bordered systems: multipliers of the active set."""

import numpy as np

from taisoft.linear.bordered import solve_active


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
