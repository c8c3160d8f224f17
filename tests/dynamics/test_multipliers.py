"""Anderson extrapolation of multipliers, against NumPy, on the impulses of 40 contacts:

* without a history the impulses become the multipliers, and the radii of the friction disks follow from them;
* with one or two previous updates the new multipliers are those of least squares, also beside contacts that cannot move;
  of linearly dependent changes only the last counts, and an extrapolation that is too long is rejected;
* the scale of R follows the residual of the contact laws.
"""

from dataclasses import dataclass
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
import taichi as ti

from taisoft.backend.arrays import FieldArena
from taisoft.contact.problem import build_node_problem, fill_field
from taisoft.dynamics.contact_terms import PAST
from taisoft.dynamics.frictional import extrapolate_multipliers, next_scale
from tests.backend.lanes import opened

K = 40


@dataclass(frozen=True, eq=False)
class Work:
    """What the kernel uses of a stage's contacts."""

    multiplier: Any
    radius: Any
    past_impulse: Any
    past_change: Any


@dataclass(frozen=True, eq=False)
class Terms:
    problem: Any
    work: Work


@pytest.fixture(scope="module")
def rig():
    with opened("f64"):
        arena, rng = FieldArena(), np.random.default_rng(5)
        p = build_node_problem(arena, K + 2, 4, True)
        work = Work(
            arena.vectors("multiplier", ti.f64, K + 2),
            arena.field("radius", ti.f64, K + 2),
            arena.vectors("past_impulse", ti.f64, PAST * (K + 2)),
            arena.vectors("past_change", ti.f64, PAST * (K + 2)),
        )
        factor, friction = 10.0 ** rng.uniform(-1, 1, (K, 2)), rng.uniform(0.1, 1.0, K)
        factor[::9] = 0.0  # contacts that cannot move
        for field, values in ((p.factor, factor), (p.friction, friction)):
            fill_field(field, values)
        p.count[0] = K
        yield SimpleNamespace(p=p, work=work, terms=Terms(p, work), factor=factor[:, [0, 1, 1]], friction=friction)
        arena.release()


def update(rig, impulses: np.ndarray, history: int) -> np.ndarray:
    """The new multipliers (K,3) after impulses (K,3); history: number of previous updates to use."""
    fill_field(rig.p.r, impulses)
    extrapolate_multipliers(rig.terms, history)
    return rig.work.multiplier.to_numpy()[:K]


def restart(rig, multipliers: np.ndarray) -> None:
    """Discard the history, and set multipliers (K,3)."""
    rig.work.past_impulse.fill(np.nan)
    rig.work.past_change.fill(np.nan)
    fill_field(rig.work.multiplier, multipliers)


def least_squares(rig, multipliers: list[np.ndarray], impulses: list[np.ndarray]) -> np.ndarray:
    """The next multipliers from all previous ones and the impulses that they gave, by NumPy."""
    weight = np.where(rig.factor > 0.0, 1.0 / np.sqrt(np.where(rig.factor > 0.0, rig.factor, 1.0)), 0.0)
    change = [p - x for x, p in zip(multipliers, impulses)]
    steps = np.stack([(weight * (b - a)).ravel() for a, b in zip(change, change[1:])], axis=1)
    t = np.linalg.lstsq(steps, (weight * change[-1]).ravel(), rcond=None)[0]
    new = impulses[-1] - sum(s * (b - a) for s, a, b in zip(t, impulses, impulses[1:]))
    new[:, 0] = np.maximum(new[:, 0], 0.0)
    return new


@pytest.mark.parametrize("max_history", [1, 2])
def test_updates_are_those_of_least_squares(rig, max_history):
    rng = np.random.default_rng(max_history)
    multipliers, impulses = [rng.standard_normal((K, 3))], []
    restart(rig, multipliers[0])
    for n in range(5):
        impulses.append(rng.standard_normal((K, 3)))
        history = min(n, max_history)
        multipliers.append(update(rig, impulses[-1], history))
        expected = impulses[-1] * (impulses[-1] > (0.0, -np.inf, -np.inf))
        if history:
            expected = least_squares(rig, multipliers[-2 - history : -1], impulses[-1 - history :])
        assert np.allclose(multipliers[-1], expected, rtol=1e-10, atol=1e-10)
        assert (multipliers[-1][:, 0] == 0.0).any()  # some were clipped
        assert np.allclose(rig.work.radius.to_numpy()[:K], rig.friction * multipliers[-1][:, 0], rtol=1e-14)


def affine_iteration(rates: list[float], seed: int):
    """An affine map of multipliers (K,3) with modes of these rates, its fixed point, and a start; normal parts are large."""
    rng = np.random.default_rng(seed)
    modes = np.linalg.qr(rng.standard_normal((3 * K, len(rates))))[0]
    fixed = rng.standard_normal((K, 3)) + (10.0, 0.0, 0.0)

    def step(multipliers: np.ndarray) -> np.ndarray:
        return fixed + (modes @ (rates * (modes.T @ (multipliers - fixed).ravel()))).reshape(K, 3)

    return step, fixed, fixed + (modes @ np.ones(len(rates))).reshape(K, 3)


@pytest.mark.parametrize(
    "rates, history, accepted",
    [([0.9, 0.6], 2, True), ([0.9], 2, True), ([1 - 1 / 90], 1, True), ([1 - 1 / 200], 1, False), ([0.998, 0.5], 2, False)],
)
def test_an_extrapolation_that_is_too_long_is_rejected(rig, rates, history, accepted):
    """The fixed point of a slow mode lies 1 / (1 - rate) changes away; else it is reached. One mode: parallel changes."""
    step, fixed, x = affine_iteration(rates, 9)
    restart(rig, x)
    for n in range(history):
        x = update(rig, step(x), n if len(rates) > 1 else 0)
    impulses = step(x)
    updated = update(rig, impulses, history)
    assert np.abs(updated - fixed).max() < 1e-6 if accepted else np.array_equal(updated, impulses)


@pytest.mark.parametrize(
    "scale, residual, before, n_steps, frictionless, expected",  # the laws hold below a residual of 0.1
    [
        (8.0, 1.3, 1.0, 1, 0, 4.0),  # increased: softer,
        (4.0, 1.3, 1.0, 1, 0, 8.0),  # but not if it is soft already
        (8.0, 0.9, 1.0, 1, 0, 16.0),  # hardly decreased after one step: stiffer,
        (8.0, 0.9, 1.0, 3, 0, 8.0),  # after some: unchanged,
        (2.0, 0.9, 1.0, 5, 0, 1.0),  # after many: softer
        (8.0, 0.7, 1.0, 1, 0, 8.0),  # decreased: unchanged
        (8.0, 1.3, 1.0, 1, 1, 16.0),  # without friction: stiffer while it does not decrease,
        (8.0, 0.9, 1.0, 3, 1, 16.0),  # after some steps, too,
        (8.0, 0.9, 1.0, 5, 1, 4.0),  # but softer after many
        (40.0, 0.9, 1.0, 1, 1, 50.0),  # up to a bound,
        (8.0, 0.09, 0.1, 1, 1, 2.0),  # and softer once the laws hold,
        (2.0, 0.09, 0.1, 1, 1, 1.0),  # down to the first value,
        (8.0, 0.09, 0.1, 1, 0, 16.0),  # which does not concern friction
    ],
)
def test_the_scale_of_r_follows_the_residual_of_the_contact_laws(scale, residual, before, n_steps, frictionless, expected):
    assert next_scale(scale, residual, before, n_steps, frictionless, 50.0, 0.1) == expected
