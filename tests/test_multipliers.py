"""Renewals of multipliers, judged by NumPy, on the impulses of 40 contacts:

* without a past the impulses are taken, and disks open as far as they say;
* with one or two renewals known the new multipliers are those of least squares, also beside contacts that nothing can move;
  a change that says nothing new is left out, and an extrapolation that goes too far is not taken;
* an affine iteration with two slow modes ends after three renewals;
* R follows the laws' residual.
"""

from dataclasses import dataclass
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
import taichi as ti
from scenes import opened

from taisoft.backend.arrays import FieldArena
from taisoft.contact.problem import build_node_problem, fill_field
from taisoft.dynamics.contact_terms import PAST
from taisoft.dynamics.frictional import MAX_EXTRAPOLATION, MAX_R_SCALE, MIN_R_SCALE, extrapolate_multipliers, next_scale

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
        factor[::9] = 0.0  # nothing can move these
        for field, values in ((p.factor, factor), (p.friction, friction)):
            fill_field(field, values)
        p.count[0] = K
        yield SimpleNamespace(p=p, work=work, terms=Terms(p, work), factor=factor[:, [0, 1, 1]], friction=friction)
        arena.release()


def renew(rig, impulses: np.ndarray, known: int) -> np.ndarray:
    """The multipliers (K,3) after impulses (K,3)."""
    fill_field(rig.p.r, impulses)
    extrapolate_multipliers(rig.terms, known)
    return rig.work.multiplier.to_numpy()[:K]


def begin(rig, multipliers: np.ndarray) -> None:
    """A past that says nothing, and multipliers (K,3)."""
    rig.work.past_impulse.fill(np.nan)
    rig.work.past_change.fill(np.nan)
    fill_field(rig.work.multiplier, multipliers)


def least_squares(rig, multipliers: list[np.ndarray], impulses: list[np.ndarray]) -> np.ndarray:
    """The next multipliers from those so far and what they led to, by NumPy."""
    weight = np.where(rig.factor > 0.0, 1.0 / np.sqrt(np.where(rig.factor > 0.0, rig.factor, 1.0)), 0.0)
    change = [p - x for x, p in zip(multipliers, impulses)]
    steps = np.stack([(weight * (b - a)).ravel() for a, b in zip(change, change[1:])], axis=1)
    t = np.linalg.lstsq(steps, (weight * change[-1]).ravel(), rcond=None)[0]
    new = impulses[-1] - sum(s * (b - a) for s, a, b in zip(t, impulses, impulses[1:]))
    new[:, 0] = np.maximum(new[:, 0], 0.0)
    return new


def test_without_a_past_impulses_are_taken(rig):
    rng = np.random.default_rng(0)
    begin(rig, rng.standard_normal((K, 3)))
    impulses = np.abs(rng.standard_normal((K, 3)))
    assert np.array_equal(renew(rig, impulses, 0), impulses)
    assert np.array_equal(rig.work.radius.to_numpy()[:K], rig.friction * impulses[:, 0])


@pytest.mark.parametrize("known", [1, 2])
def test_renewals_are_those_of_least_squares(rig, known):
    rng = np.random.default_rng(known)
    multipliers, impulses = [rng.standard_normal((K, 3))], []
    begin(rig, multipliers[0])
    for n in range(5):
        impulses.append(rng.standard_normal((K, 3)))
        at_hand = min(n, known)
        multipliers.append(renew(rig, impulses[-1], at_hand))
        if at_hand:
            wanted = least_squares(rig, multipliers[-2 - at_hand : -1], impulses[-1 - at_hand :])
            assert np.allclose(multipliers[-1], wanted, rtol=1e-10, atol=1e-10)
            assert (multipliers[-1][:, 0] == 0.0).any()  # some were clipped
            assert np.allclose(rig.work.radius.to_numpy()[:K], rig.friction * multipliers[-1][:, 0], rtol=1e-14)


def slow(rig, rates: list[float], seed: int):
    """lambda -> p, affine, with so many modes at these rates and its fixed point (K,3), of normal parts well above 0."""
    rng = np.random.default_rng(seed)
    modes = np.linalg.qr(rng.standard_normal((3 * K, len(rates))))[0]
    fixed = rng.standard_normal((K, 3)) + (10.0, 0.0, 0.0)

    def step(multipliers: np.ndarray) -> np.ndarray:
        return fixed + (modes @ (rates * (modes.T @ (multipliers - fixed).ravel()))).reshape(K, 3)

    return step, fixed, fixed + (modes @ np.ones(len(rates))).reshape(K, 3)


def test_two_slow_modes_are_gone_after_three_renewals(rig):
    step, fixed, x = slow(rig, [0.9, 0.6], 7)
    begin(rig, x)
    for known in range(3):
        x = renew(rig, step(x), known)
    assert np.abs(x - fixed).max() < 1e-9


def test_a_change_that_says_nothing_new_is_left_out(rig):
    """One mode alone: the second change is parallel to the first."""
    step, fixed, x = slow(rig, [0.9], 8)
    begin(rig, x)
    x = renew(rig, step(x), 0)
    for known in (1, 2):
        fill_field(rig.work.multiplier, x)  # as if it had not been extrapolated
        last, x = x, step(x)
        renewed = renew(rig, x, known)
    assert np.abs(renewed - fixed).max() < 1e-6 < np.abs(x - last).max()


@pytest.mark.parametrize("steps, taken", [(2.0 * MAX_EXTRAPOLATION, False), (0.9 * MAX_EXTRAPOLATION, True)])
def test_an_extrapolation_that_goes_too_far_is_not_taken(rig, steps, taken):
    """A mode so slow that its end lies so many steps away."""
    step, fixed, x = slow(rig, [1.0 - 1.0 / steps], 9)
    begin(rig, x)
    x = renew(rig, step(x), 0)
    impulses = step(x)
    renewed = renew(rig, impulses, 1)
    assert np.abs(renewed - fixed).max() < 1e-6 if taken else np.array_equal(renewed, impulses)


def test_neither_is_one_whose_second_part_does(rig):
    """Two modes, the slower one so slow that the change before the last one takes it too far."""
    step, _, x = slow(rig, [1.0 - 0.2 / MAX_EXTRAPOLATION, 0.5], 10)
    begin(rig, x)
    for known in (0, 1):
        x = renew(rig, step(x), known)
    impulses = step(x)
    assert np.array_equal(renew(rig, impulses, 2), impulses)


@pytest.mark.parametrize(
    "scale, law, before, taken, wanted",
    [
        (8.0, 1.3, 1.0, 1, 4.0),  # risen: softer,
        (4.0, 1.3, 1.0, 1, 8.0),  # but not below STEADY
        (8.0, 0.9, 1.0, 1, 16.0),  # hardly fallen after one step: stiffer,
        (MAX_R_SCALE, 0.9, 1.0, 1, MAX_R_SCALE),
        (8.0, 0.9, 1.0, 3, 8.0),  # after some: as it is,
        (2.0, 0.9, 1.0, 5, 1.0),  # after many: softer
        (MIN_R_SCALE, 0.9, 1.0, 5, MIN_R_SCALE),
        (8.0, 0.7, 1.0, 1, 8.0),  # fallen: as it is
    ],
)
def test_r_follows_the_laws(scale, law, before, taken, wanted):
    assert next_scale(scale, law, before, taken) == wanted
