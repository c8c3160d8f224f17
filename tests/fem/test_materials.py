"""Material laws, against NumPy and against themselves:

* every law is available to scenes;
* energy and stress vanish at rest, and Hooke's law holds for small strains down to 1e-9;
* psi(QF) = psi(F) = psi(FQ), P(QF) = Q P(F), P(FQ) = P(F) Q;
* psi, P, dP and the projected dP equal the oracle's, in f64 and f32, also for inverted, flat, tiny and huge F;
* P is the derivative of psi and dP that of P, by finite differences, and dP is symmetric;
* all values are finite for every finite F, also zero, rank-deficient and inverted ones;
* the corotational rotation is that of NumPy's signed SVD;
* `evaluate_law` takes any number of matrices, refuses invalid arguments, and leaves no runtime open.
"""

import numpy as np
import pytest
import taichi as ti

import taisoft as ts
from taisoft.backend import runtime
from taisoft.backend.runtime import kernel
from taisoft.fem.laws import LAWS
from taisoft.fem.laws.evaluate import evaluate_differential
from taisoft.scene.material import LAWS as NAMES
from tests.backend.lanes import load, opened, packed, store, unpacked
from tests.fem import oracle_laws as oracle
from tests.fem.matrices import MATRICES, rotations

YOUNG, POISSON = 3e5, 0.35  # [Pa]; not round, so that mu, lambda and their multiples all differ
each_law = pytest.mark.parametrize("law", LAWS)


@kernel
def law_numbers(
    law: ti.template(),
    lanes: ti.template(),
    A: ti.types.ndarray(),
    B: ti.types.ndarray(),
    p: ti.types.ndarray(),
    out: ti.types.ndarray(),
):
    """psi, P and dP for F in A and direction D in B, and the stiffness block of two gradients, the first two rows of D."""
    for b in range(A.shape[0]):
        F, D = load(A, b, lanes, 9), load(B, b, lanes, 9)
        c = [ti.Vector([p[k] for q in ti.static(range(lanes))]) for k in ti.static(range(4))]
        energy, P, S = law.psi(F, c), law.pk1(F, c), law.prepare(F, c)
        dP = law.dpk1(F, S, D)
        K = law.block(F, S, [D[0], D[1], D[2]], [D[3], D[4], D[5]])
        store(out, b, 0, [energy], lanes)
        store(out, b, 1, P + dP + K, lanes)


@kernel
def rotation_numbers(law: ti.template(), lanes: ti.template(), A: ti.types.ndarray(), out: ti.types.ndarray()):
    for b in range(A.shape[0]):
        F = load(A, b, lanes, 9)
        R = law.rotation(F)
        store(out, b, 0, R, lanes)


def gap(F) -> np.ndarray:
    """(s1 + s2)/s0: 0 where the rotation of F is not unique; errors of R grow as 1/gap."""
    s = oracle.signed_svd(F)[1]
    return (s[:, 1] + s[:, 2]) / np.where(s[:, 0] > 0, s[:, 0], 1.0)


def smooth(law: str, F) -> np.ndarray:
    """Where a law is differentiable: everywhere except near gap = 0 of the corotational law."""
    return gap(F) > 0.02 if law == "corotational" else np.ones(len(F), dtype=bool)


def moderate() -> np.ndarray:
    """Matrices of small to extreme deformation; a tenth are inverted."""
    rng = np.random.default_rng(3)
    F = np.concatenate([np.eye(3) + size * rng.standard_normal((150, 3, 3)) for size in (0.03, 0.3, 0.8)])
    assert (np.linalg.det(F) < 0).sum() > 40
    return F


MODERATE = moderate()


def differential(law, F, D, projected=False):
    return evaluate_differential(law, F, D, YOUNG, POISSON, projected)


def test_every_law_is_available_to_scenes():
    assert sorted(LAWS) == sorted(NAMES)


@each_law
def test_rest_is_stress_free_and_small_strains_follow_hooke(law):
    psi, P = ts.evaluate_law(law, np.eye(3)[None], YOUNG, POISSON)
    assert psi[0] == 0.0 and np.abs(P).max() < 1e-14 * YOUNG
    mu, lam = oracle.lame(YOUNG, POISSON)
    H = np.random.default_rng(0).standard_normal((20, 3, 3))
    strain = (H + oracle.transposed(H)) / 2
    hooke = 2 * mu * strain + lam * oracle.trace(strain)[:, None, None] * np.eye(3)
    for e in (1e-3, 1e-6, 1e-9):
        F = np.eye(3) + e * H
        psi, P = ts.evaluate_law(law, F, YOUNG, POISSON)
        # Hooke's law is the first-order term; F itself is rounded to 1e-16
        assert np.abs(P / e - hooke).max() < (30 * e + 2e-15 / e) * YOUNG
        energy = np.sum(strain * hooke, axis=(1, 2)) / 2
        assert np.abs(psi / e**2 - energy).max() < (100 * e + 2e-15 / e) * YOUNG


@each_law
def test_objectivity_and_isotropy(law):
    Q = rotations(np.random.default_rng(5), len(MODERATE))
    psi, P = ts.evaluate_law(law, MODERATE, YOUNG, POISSON)
    psi_left, P_left = ts.evaluate_law(law, Q @ MODERATE, YOUNG, POISSON)
    psi_right, P_right = ts.evaluate_law(law, MODERATE @ Q, YOUNG, POISSON)
    ok = smooth(law, MODERATE)
    assert np.abs(psi_left - psi).max() < 1e-10 * YOUNG and np.abs(psi_right - psi).max() < 1e-10 * YOUNG
    assert np.abs(P_left - Q @ P)[ok].max() < 1e-9 * YOUNG and np.abs(P_right - P @ Q)[ok].max() < 1e-9 * YOUNG


@each_law
@pytest.mark.parametrize("kind", ["moderate", *MATRICES])
def test_energy_stress_and_differential_equal_the_oracle(law, kind):
    F = MODERATE if kind == "moderate" else MATRICES[kind]
    if kind == "huge":
        F = F * 1e-20  # so that fourth powers do not overflow
    D = np.random.default_rng(2).standard_normal(F.shape)
    psi, P = ts.evaluate_law(law, F, YOUNG, POISSON)
    assert np.isfinite(psi).all() and np.isfinite(P).all()
    size = 1.0 + np.abs(F).max(axis=(1, 2))
    # polynomials in F of degree at most 6 (energy), 5 (stress) and 4 (differential); errors of R grow as 1/gap^2
    assert (np.abs(psi - oracle.psi(law, F, YOUNG, POISSON)) / size**6).max() < 1e-12 * YOUNG
    ok = smooth(law, F)
    if not ok.any():
        return
    F, D, P, size = F[ok], D[ok], P[ok], size[ok, None, None]
    loss = (1 + 0.05 / gap(F) ** 2)[:, None, None] if law == "corotational" else 1.0
    assert (np.abs(P - oracle.pk1(law, F, YOUNG, POISSON)) / size**5 / loss).max() < 1e-12 * YOUNG
    if law == "corotational":  # dR is of size |dF|/|F|
        loss = loss**2 * (1 + 1 / np.abs(F).max(axis=(1, 2))[:, None, None])
    dP = differential(law, F, D)
    assert (np.abs(dP - oracle.dpk1(law, F, D, YOUNG, POISSON)) / size**4 / loss).max() < 1e-11 * YOUNG


@each_law
def test_derivatives_by_finite_differences(law):
    F = MODERATE[smooth(law, MODERATE) & (np.abs(gap(MODERATE)) > 0.2)]
    rng, h = np.random.default_rng(4), 1e-6
    D, other = rng.standard_normal((2, *F.shape))
    (up, P_up), (down, P_down) = (ts.evaluate_law(law, F + s * D, YOUNG, POISSON) for s in (h, -h))
    P, dP = ts.evaluate_law(law, F, YOUNG, POISSON)[1], differential(law, F, D)
    assert np.abs(dP).max() > YOUNG and np.abs(P).max() > YOUNG
    # errors: h^2 times the third derivative, and the rounding of psi divided by h
    assert np.abs(np.sum(P * D, axis=(1, 2)) - (up - down) / (2 * h)).max() < 1e-7 * YOUNG
    assert np.abs(dP - (P_up - P_down) / (2 * h)).max() < 1e-6 * YOUNG
    assert np.abs(np.sum(dP * other - differential(law, F, other) * D, axis=(1, 2))).max() < 1e-10 * YOUNG


@each_law
@pytest.mark.parametrize("kind", ["moderate", "all alike", "two alike", "inverted", "rank 2", "zero"])
def test_projected_differential_is_the_clamped_hessian(law, kind):
    F = MODERATE if kind == "moderate" else MATRICES[kind]
    H = np.stack([differential(law, F, D, projected=True).reshape(-1, 9) for D in oracle.UNIT], axis=-1)
    assert np.isfinite(H).all()
    assert np.abs(H - oracle.transposed(H)).max() <= 1e-12 * np.abs(H).max()
    assert np.linalg.eigvalsh((H + oracle.transposed(H)) / 2).min() >= -1e-12 * np.abs(H).max()
    ok = smooth(law, F)
    if not ok.any():
        assert law == "corotational" and kind == "zero"  # R is not unique there
        return
    expected = oracle.hessian(law, F[ok], YOUNG, POISSON, projected=True)
    plain = oracle.hessian(law, F[ok], YOUNG, POISSON)
    if kind == "moderate":
        assert np.abs(expected - plain).max() > 0.01 * YOUNG  # the projection matters
    assert np.abs(H[ok] - expected).max() <= 1e-11 * np.abs(plain).max()


@each_law
@pytest.mark.parametrize("kind", ["rank 2", "rank 1", "integer rank 1", "zero", "reflections", "needles", "tiny"])
def test_values_are_finite_for_degenerate_matrices(law, kind):
    F, D = MATRICES[kind], np.random.default_rng(2).standard_normal(MATRICES[kind].shape)
    psi, P = ts.evaluate_law(law, F, YOUNG, POISSON)
    parts = (psi, P, differential(law, F, D), differential(law, F, D, projected=True))
    assert all(np.isfinite(part).all() for part in parts)


@pytest.mark.parametrize("count", [1, 3, 4, 9])
def test_evaluate_law_takes_any_number_of_matrices(count):
    law = "stable_neo_hookean"
    (psi_12, P_12), (psi, P) = (ts.evaluate_law(law, MODERATE[:n], YOUNG, POISSON) for n in (12, count))
    assert psi.shape == (count,) and P.shape == (count, 3, 3)
    assert np.array_equal(psi_12[:count], psi) and np.array_equal(P_12[:count], P)


@pytest.mark.parametrize(
    "change, message",
    [
        ({"law": "stable_neo_hooke"}, "law must be one of .* did you mean 'stable_neo_hookean'"),
        ({"F": np.eye(3)}, r"F has shape \(3, 3\): it must be \(k, 3, 3\)"),
        ({"F": np.zeros((0, 3, 3))}, "with k at least 1"),
        ({"F": np.array([np.eye(3), np.full((3, 3), np.nan)])}, r"F\[1\] is not finite"),
        ({"young": -1.0}, "young must be greater than 0"),
        ({"poisson": 0.5}, "poisson must lie in the open interval"),
    ],
)
def test_invalid_arguments_of_evaluate_law_are_refused(change, message):
    arguments = {"law": "corotational", "F": np.eye(3)[None], "young": YOUNG, "poisson": POISSON, **change}
    with pytest.raises(ts.SceneError, match=message):
        ts.evaluate_law(**arguments)


def evaluate_in_f32(law, F, D, lanes):
    """psi, P, dP and the stiffness block in f32."""
    with opened("f32"):
        constants = np.array(LAWS[law].constants(*oracle.lame(YOUNG, POISSON)), dtype=np.float32)
        A, B = packed(F, lanes, np.float32), packed(D, lanes, np.float32)
        out = np.zeros((len(A), 28, lanes), np.float32)
        law_numbers(LAWS[law], lanes, A, B, constants, out)
    flat = unpacked(out, len(F))
    return flat[:, 0], *(flat[:, k : k + 9].reshape(-1, 3, 3) for k in (1, 10, 19))


@each_law
def test_single_precision(law):
    """Rounding F to f32 changes P by 6e-8 of the stiffness; the formulas may lose some tens of that, and R 1/gap^2 times it."""
    with pytest.raises(ts.SimulationError, match="a test is open with arch 'cpu' and precision 'f32'"), opened("f32"):
        ts.evaluate_law(law, np.eye(3)[None], YOUNG, POISSON)
    F = MODERATE[smooth(law, MODERATE) & (gap(MODERATE) > 0.1)].astype(np.float32).astype(np.float64)
    D = np.random.default_rng(2).standard_normal(F.shape).astype(np.float32).astype(np.float64)
    eps = np.finfo(np.float32).eps
    size = (1.0 + np.abs(F).max(axis=(1, 2)))[:, None, None]
    loss = (1 + 0.05 / gap(F) ** 2)[:, None, None] if law == "corotational" else 1.0
    psi, P, dP, block = evaluate_in_f32(law, F, D, 4)
    assert (np.abs(psi - oracle.psi(law, F, YOUNG, POISSON)) / size[:, 0, 0] ** 6).max() < 20 * eps * YOUNG
    assert (np.abs(P - oracle.pk1(law, F, YOUNG, POISSON)) / size**5 / loss).max() < 20 * eps * YOUNG
    expected = oracle.dpk1(law, F, D, YOUNG, POISSON)
    assert (np.abs(dP - expected) / size**4 / loss**2).max() < 100 * eps * YOUNG
    # block (i, k): the change of P gb along e_k (x) ga
    H = oracle.hessian(law, F, YOUNG, POISSON).reshape(-1, 3, 3, 3, 3)
    expected = np.einsum("nijkl,nl,nj->nik", H, D[:, 0], D[:, 1])
    assert (np.abs(block - expected) / size**4 / loss**2).max() < 300 * eps * YOUNG


@pytest.mark.parametrize("precision", ["f32", "f64"])
def test_the_corotational_rotation_equals_that_of_numpy(precision):
    with opened(precision) as machine:
        lanes = 4 if precision == "f64" else 1
        for kind, F in {"moderate": MODERATE, **MATRICES}.items():
            A = packed(F, lanes, machine.np_real)
            out = np.zeros((len(A), 9, lanes), machine.np_real)
            rotation_numbers(LAWS["corotational"], lanes, A, out)
            R, F = unpacked(out, len(F)).reshape(-1, 3, 3), F.astype(machine.np_real).astype(np.float64)
            loss = 1 + 0.05 / np.maximum(gap(F), 0.02)[:, None, None] ** 2
            tolerance = 1e-12 if precision == "f64" else 100 * machine.eps
            assert (np.abs(oracle.transposed(R) @ R - np.eye(3)) / loss).max() < tolerance, kind
            ok = gap(F) > 1e-3
            assert (np.abs(R - oracle.rotation(F)) / loss)[ok].max(initial=0.0) < tolerance, kind
    assert runtime.open_kind() is None
