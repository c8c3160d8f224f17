"""Material laws in f64, one also with a volume floor: psi, P, dP and the projected dP equal the oracle's and are finite for every
F; Hooke's law holds for small strains; P and dP are derivatives by finite differences; `evaluate_law` refuses invalid arguments.
"""

import numpy as np
import pytest

import taisoft as ts
from taisoft.backend import runtime
from taisoft.fem.laws import LAWS
from taisoft.fem.laws.evaluate import evaluate_differential
from taisoft.scene.laws import SHIPPED
from tests.dynamics.scenes import COR, SNH, SVK
from tests.fem import oracle_laws as oracle
from tests.fem.matrices import MATRICES, stretched

YOUNG, POISSON, FLOOR = 3e5, 0.35, 0.08  # [Pa]; not round, so that mu, lambda and their multiples all differ
FLOORED = (SVK, FLOOR)  # the floor is the same code for every law
CASES = [*((law, 0.0) for law in LAWS), FLOORED]
each_case = pytest.mark.parametrize("law, floor", CASES)


def gap(F) -> np.ndarray:
    """(s1 + s2)/s0: 0 where the rotation of F is not unique; errors of R grow as 1/gap."""
    s = oracle.signed_svd(F)[1]
    return (s[:, 1] + s[:, 2]) / np.where(s[:, 0] > 0, s[:, 0], 1.0)


def smooth(law: str, F) -> np.ndarray:
    """Where a law is differentiable: everywhere except near gap = 0 of the corotational law."""
    return gap(F) > 0.02 if law == COR else np.ones(len(F), dtype=bool)


def moderate() -> np.ndarray:
    """Matrices of small to extreme deformation, of which some are inverted, and 300 with det F from -0.2 to 0.2."""
    rng = np.random.default_rng(3)
    F = np.concatenate([np.eye(3) + size * rng.standard_normal((150, 3, 3)) for size in (0.03, 0.3, 0.8)])
    J, a, b = rng.uniform(-0.2, 0.2, 300), *rng.uniform(0.7, 1.5, (2, 300))
    return np.concatenate([F, stretched(rng, np.stack([a, b, J / (a * b)], axis=1), 300)])


MODERATE = moderate()
DIRECTIONS = np.random.default_rng(2).standard_normal((2, *MODERATE.shape))


def values(law: str, F, floor: float = 0.0):
    return ts.evaluate_law(law, F, YOUNG, POISSON, volume_floor=floor)


def differential(law: str, F, D, projected: bool = False, floor: float = 0.0):
    return evaluate_differential(law, F, D, YOUNG, POISSON, projected, floor)


def test_every_law_is_available_to_scenes():
    assert sorted(LAWS) == sorted(law.name for law in SHIPPED if law.is_classic)


@each_case
def test_rest_is_stress_free_and_small_strains_follow_hooke(law, floor):
    psi, P = values(law, np.eye(3)[None], floor)
    assert psi[0] == 0.0 and np.abs(P).max() < 1e-14 * YOUNG
    mu, lam = oracle.lame(YOUNG, POISSON)
    H = np.random.default_rng(0).standard_normal((20, 3, 3))
    strain = (H + oracle.transposed(H)) / 2
    hooke = 2 * mu * strain + lam * oracle.trace(strain)[:, None, None] * np.eye(3)
    energy = np.sum(strain * hooke, axis=(1, 2)) / 2
    for e in (1e-3, 1e-6, 1e-9):
        psi, P = values(law, np.eye(3) + e * H, floor)
        # Hooke's law is the first-order term; F itself is rounded to 1e-16
        assert np.abs(P / e - hooke).max() < (30 * e + 2e-15 / e) * YOUNG
        assert np.abs(psi / e**2 - energy).max() < (100 * e + 2e-15 / e) * YOUNG


@each_case
def test_energy_stress_and_differential_equal_the_oracle(law, floor):
    for kind, F in {"moderate": MODERATE, **MATRICES}.items():
        if kind == "huge" and floor:
            continue
        if kind == "huge":
            F = F * 1e-20  # so that fourth powers do not overflow
        D = np.random.default_rng(2).standard_normal(F.shape)
        psi, P = values(law, F, floor)
        dP, projected = differential(law, F, D, floor=floor), differential(law, F, D, True, floor)
        assert all(np.isfinite(found).all() for found in (psi, P, dP, projected)), kind
        size = 1.0 + np.abs(F).max(axis=(1, 2))
        # polynomials in F of degree at most 6 (energy), 5 (stress) and 4 (differential); errors of R grow as 1/gap^2
        assert (np.abs(psi - oracle.psi(law, F, YOUNG, POISSON, floor)) / size**6).max() < 1e-12 * YOUNG, kind
        ok = smooth(law, F)
        if not ok.any():
            continue
        F, D, P, dP, size = F[ok], D[ok], P[ok], dP[ok], size[ok, None, None]
        loss = (1 + 0.05 / gap(F) ** 2)[:, None, None] if law == COR else 1.0
        assert (np.abs(P - oracle.pk1(law, F, YOUNG, POISSON, floor)) / size**5 / loss).max() < 1e-12 * YOUNG, kind
        if law == COR:  # dR is of size |dF|/|F|
            loss = loss**2 * (1 + 1 / np.abs(F).max(axis=(1, 2))[:, None, None])
        scale = 1 / floor if floor else 1.0
        expected = oracle.dpk1(law, F, D, YOUNG, POISSON, floor)
        assert (np.abs(dP - expected) / size**4 / loss).max() < 1e-11 * YOUNG * scale, kind


@each_case
def test_derivatives_by_finite_differences(law, floor):
    ok = gap(MODERATE) > 0.2
    F, (D, other), h = MODERATE[ok], DIRECTIONS[:, ok], 1e-6
    (up, P_up), (down, P_down) = (values(law, F + s * D, floor) for s in (h, -h))
    P, dP = values(law, F, floor)[1], differential(law, F, D, floor=floor)
    assert np.abs(dP).max() > YOUNG and np.abs(P).max() > YOUNG
    # errors: h^2 times the third derivative, which jumps at J = floor and J = 0, and the rounding of psi divided by h
    scale = 1 / floor**2 if floor else 1.0
    assert np.abs(np.sum(P * D, axis=(1, 2)) - (up - down) / (2 * h)).max() < 1e-7 * YOUNG * scale
    assert np.abs(dP - (P_up - P_down) / (2 * h)).max() < 1e-6 * YOUNG * scale
    assert np.abs(np.sum(dP * other - differential(law, F, other, floor=floor) * D, axis=(1, 2))).max() < 1e-10 * YOUNG * scale


@each_case
def test_projected_differential_is_the_clamped_hessian(law, floor):
    for kind in ("moderate", "all alike", "two alike", "inverted", "nearly inverted", "rank 2", "zero"):
        F = MODERATE if kind == "moderate" else MATRICES[kind]
        H = np.stack([differential(law, F, D, True, floor).reshape(-1, 9) for D in oracle.UNIT], axis=-1)
        largest = np.abs(H).max()
        assert np.abs(H - oracle.transposed(H)).max() <= 1e-12 * largest
        assert np.linalg.eigvalsh((H + oracle.transposed(H)) / 2).min() >= -1e-12 * largest
        ok = smooth(law, F)
        assert ok.any() or (law == COR and kind == "zero")  # R is not unique there
        if ok.any():
            expected = oracle.hessian(law, F[ok], YOUNG, POISSON, True, floor)
            plain = oracle.hessian(law, F[ok], YOUNG, POISSON, False, floor)
            assert np.abs(H[ok] - expected).max() <= 1e-11 * np.abs(plain).max()
            assert kind != "moderate" or np.abs(expected - plain).max() > 0.01 * YOUNG  # the projection matters


def test_evaluate_law_takes_any_number_of_matrices():
    psi_12, P_12 = values(SNH, MODERATE[:12])
    for count in (1, 3, 4, 9):
        psi, P = values(SNH, MODERATE[:count])
        assert psi.shape == (count,) and P.shape == (count, 3, 3)
        assert np.array_equal(psi_12[:count], psi) and np.array_equal(P_12[:count], P)
    assert runtime.open_kind() is None


@pytest.mark.parametrize(
    "change, message",
    [
        ({"law": "stable_neo_hooke"}, "law must be one of .* did you mean 'stable_neo_hookean'"),
        ({"F": np.eye(3)}, r"F has shape \(3, 3\): it must be \(k, 3, 3\)"),
        ({"F": np.zeros((0, 3, 3))}, "with k at least 1"),
        ({"F": np.array([np.eye(3), np.full((3, 3), np.nan)])}, r"F\[1\] is not finite"),
        ({"young": -1.0}, "young must be greater than 0"),
    ],
)
def test_invalid_arguments_of_evaluate_law_are_refused(change, message):
    arguments = {"law": COR, "F": np.eye(3)[None], "young": YOUNG, "poisson": POISSON, **change}
    with pytest.raises(ts.SceneError, match=message):
        ts.evaluate_law(**arguments)
