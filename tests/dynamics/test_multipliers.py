"""Anderson extrapolation of multipliers, against NumPy, on the impulses of 40 contacts:

* without a history the impulses become the multipliers, and the radii of the friction disks follow from them;
* with one or two previous updates the new multipliers are those of least squares, also beside contacts that cannot move;
  linearly dependent changes are ignored, and an extrapolation that is too long is rejected;
* an affine iteration with two slow modes converges after three updates;
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
from taisoft.dynamics.frictional import (
    MAX_EXTRAPOLATION,
    MAX_R_FRICTIONLESS,
    MAX_R_SCALE,
    MIN_R_SCALE,
    extrapolate_multipliers,
    next_scale,
)
from tests.backend.lanes import opened

K = 40


@dataclass(frozen=True, eq=False)
class Work:
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


def test_without_a_history_impulses_become_the_multipliers(rig):
    rng = np.random.default_rng(0)
    restart(rig, rng.standard_normal((K, 3)))
    impulses = np.abs(rng.standard_normal((K, 3)))
    assert np.array_equal(update(rig, impulses, 0), impulses)
    assert np.array_equal(rig.work.radius.to_numpy()[:K], rig.friction * impulses[:, 0])


@pytest.mark.parametrize("max_history", [1, 2])
def test_updates_are_those_of_least_squares(rig, max_history):
    rng = np.random.default_rng(max_history)
    multipliers, impulses = [rng.standard_normal((K, 3))], []
    restart(rig, multipliers[0])
    for n in range(5):
        impulses.append(rng.standard_normal((K, 3)))
        history = min(n, max_history)
        multipliers.append(update(rig, impulses[-1], history))
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


def test_two_slow_modes_converge_after_three_updates(rig):
    step, fixed, x = affine_iteration([0.9, 0.6], 7)
    restart(rig, x)
    for history in range(3):
        x = update(rig, step(x), history)
    assert np.abs(x - fixed).max() < 1e-9


def test_linearly_dependent_changes_are_ignored(rig):
    """With one mode the second change is parallel to the first."""
    step, fixed, x = affine_iteration([0.9], 8)
    restart(rig, x)
    x = update(rig, step(x), 0)
    for history in (1, 2):
        fill_field(rig.work.multiplier, x)  # undo the extrapolation
        last, x = x, step(x)
        updated = update(rig, x, history)
    assert np.abs(updated - fixed).max() < 1e-6 < np.abs(x - last).max()


@pytest.mark.parametrize("steps, accepted", [(2.0 * MAX_EXTRAPOLATION, False), (0.9 * MAX_EXTRAPOLATION, True)])
def test_an_extrapolation_that_is_too_long_is_rejected(rig, steps, accepted):
    """The fixed point of the slow mode lies `steps` changes away."""
    step, fixed, x = affine_iteration([1.0 - 1.0 / steps], 9)
    restart(rig, x)
    x = update(rig, step(x), 0)
    impulses = step(x)
    updated = update(rig, impulses, 1)
    assert np.abs(updated - fixed).max() < 1e-6 if accepted else np.array_equal(updated, impulses)


def test_an_extrapolation_whose_second_term_is_too_long_is_rejected(rig):
    """The slower of two modes makes the coefficient of the change before the last one too large."""
    step, _, x = affine_iteration([1.0 - 0.2 / MAX_EXTRAPOLATION, 0.5], 10)
    restart(rig, x)
    for history in (0, 1):
        x = update(rig, step(x), history)
    impulses = step(x)
    assert np.array_equal(update(rig, impulses, 2), impulses)


@pytest.mark.parametrize(
    "scale, residual, before, n_steps, frictionless, expected",  # the laws hold below a residual of 0.1
    [
        (8.0, 1.3, 1.0, 1, 0, 4.0),  # increased: softer,
        (4.0, 1.3, 1.0, 1, 0, 8.0),  # but not below STEADY
        (8.0, 0.9, 1.0, 1, 0, 16.0),  # hardly decreased after one step: stiffer,
        (MAX_R_SCALE, 0.9, 1.0, 1, 0, MAX_R_SCALE),
        (8.0, 0.9, 1.0, 3, 0, 8.0),  # after some: unchanged,
        (2.0, 0.9, 1.0, 5, 0, 1.0),  # after many: softer
        (MIN_R_SCALE, 0.9, 1.0, 5, 0, MIN_R_SCALE),
        (8.0, 0.7, 1.0, 1, 0, 8.0),  # decreased: unchanged
        (8.0, 1.3, 1.0, 1, 1, 16.0),  # without friction: stiffer while it does not decrease,
        (8.0, 0.9, 1.0, 3, 1, 16.0),  # after some steps, too,
        (8.0, 0.9, 1.0, 5, 1, 4.0),  # but softer after many
        (MAX_R_FRICTIONLESS, 0.9, 1.0, 1, 1, MAX_R_FRICTIONLESS),
        (8.0, 0.09, 0.1, 1, 1, 2.0),  # and softer once the laws hold,
        (2.0, 0.09, 0.1, 1, 1, 1.0),  # down to the first value,
        (8.0, 0.09, 0.1, 1, 0, 16.0),  # which does not concern friction
    ],
)
def test_the_scale_of_r_follows_the_residual_of_the_contact_laws(scale, residual, before, n_steps, frictionless, expected):
    assert next_scale(scale, residual, before, n_steps, frictionless, MAX_R_FRICTIONLESS, 0.1) == expected
