"""The laws, each against NumPy and against itself:

* a scene may name each of them;
* no energy and no stress at rest, Hooke's law for small strains down to 1e-9;
* psi(QF) = psi(F) = psi(FQ), P(QF) = Q P(F), P(FQ) = P(F) Q;
* psi, P, dP and the projected dP equal the oracle's, in f64 and f32, also for inverted, flat, tiny and huge F;
* P is the derivative of psi, dP that of P and symmetric, by finite differences of the package's own numbers;
* finite for every finite F: zero, rank-deficient and inverted too;
* the corotational rotation is that of NumPy's signed SVD;
* `evaluate_law` takes any number of matrices, refuses what is none, and leaves the runtime as it found it.
"""

import numpy as np
import oracle_laws as oracle
import pytest
import taichi as ti
from lanes import load, opened, packed, store, unpacked
from matrices import MATRICES, rotations

import taisoft as ts
from taisoft.backend import runtime
from taisoft.backend.runtime import kernel
from taisoft.fem.laws import LAWS
from taisoft.fem.laws.evaluate import evaluate_differential
from taisoft.scene.body import LAWS as NAMES

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
    """psi, P and dP of F in A along D in B, and the block of the gradients that are D's first two rows."""
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
    """(s1 + s2)/s0: how far the rotation in F is from not being unique; errors of R grow as 1/gap."""
    s = oracle.signed_svd(F)[1]
    return (s[:, 1] + s[:, 2]) / np.where(s[:, 0] > 0, s[:, 0], 1.0)


def smooth(law: str, F) -> np.ndarray:
    """Where a law can be differentiated: all but the corotational one everywhere."""
    return gap(F) > 0.02 if law == "corotational" else np.ones(len(F), dtype=bool)


def moderate() -> np.ndarray:
    """Matrices as they occur in a simulation and in one that goes badly, a tenth of them inverted."""
    rng = np.random.default_rng(3)
    F = np.concatenate([np.eye(3) + size * rng.standard_normal((150, 3, 3)) for size in (0.03, 0.3, 0.8)])
    assert (np.linalg.det(F) < 0).sum() > 40
    return F


MODERATE = moderate()


def differential(law, F, D, projected=False):
    return evaluate_differential(law, F, D, YOUNG, POISSON, projected)


def test_scenes_know_every_law():
    assert sorted(LAWS) == sorted(NAMES)


@each_law
def test_rest_and_small_strains(law):
    psi, P = ts.evaluate_law(law, np.eye(3)[None], YOUNG, POISSON)
    assert psi[0] == 0.0 and np.abs(P).max() < 1e-14 * YOUNG
    mu, lam = oracle.lame(YOUNG, POISSON)
    H = np.random.default_rng(0).standard_normal((20, 3, 3))
    strain = (H + oracle.transposed(H)) / 2
    hooke = 2 * mu * strain + lam * oracle.trace(strain)[:, None, None] * np.eye(3)
    for e in (1e-3, 1e-6, 1e-9):
        F = np.eye(3) + e * H
        psi, P = ts.evaluate_law(law, F, YOUNG, POISSON)
        # Hooke's law is the first term in e (the next is of size e); F itself is rounded to 1e-16
        assert np.abs(P / e - hooke).max() < (30 * e + 2e-15 / e) * YOUNG
        energy = np.sum(strain * hooke, axis=(1, 2)) / 2
        assert np.abs(psi / e**2 - energy).max() < (100 * e + 2e-15 / e) * YOUNG


@each_law
def test_rotations_change_nothing(law):
    Q = rotations(np.random.default_rng(5), len(MODERATE))
    psi, P = ts.evaluate_law(law, MODERATE, YOUNG, POISSON)
    turned, turned_P = ts.evaluate_law(law, Q @ MODERATE, YOUNG, POISSON)
    other, other_P = ts.evaluate_law(law, MODERATE @ Q, YOUNG, POISSON)
    ok = smooth(law, MODERATE)
    assert np.abs(turned - psi).max() < 1e-10 * YOUNG and np.abs(other - psi).max() < 1e-10 * YOUNG
    assert np.abs(turned_P - Q @ P)[ok].max() < 1e-9 * YOUNG and np.abs(other_P - P @ Q)[ok].max() < 1e-9 * YOUNG


@each_law
@pytest.mark.parametrize("kind", ["moderate", *MATRICES])
def test_energy_stress_and_differential_are_the_oracles(law, kind):
    F = MODERATE if kind == "moderate" else MATRICES[kind]
    if kind == "huge":
        F = F * 1e-20  # the fourth power of 1e10 still is a number
    D = np.random.default_rng(2).standard_normal(F.shape)
    psi, P = ts.evaluate_law(law, F, YOUNG, POISSON)
    assert np.isfinite(psi).all() and np.isfinite(P).all()
    size = 1.0 + np.abs(F).max(axis=(1, 2))
    # energies are polynomials of degree 6 at most in F, stresses 5, their differentials 4; R loses digits as 1/gap^2
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
    # central differences: h^2 of the third derivative, and the rounding of psi over h
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
        assert law == "corotational" and kind == "zero"  # R is not unique there: nothing to compare with
        return
    expected = oracle.hessian(law, F[ok], YOUNG, POISSON, projected=True)
    plain = oracle.hessian(law, F[ok], YOUNG, POISSON)
    if kind == "moderate":
        assert np.abs(expected - plain).max() > 0.01 * YOUNG  # the projection has something to do
    assert np.abs(H[ok] - expected).max() <= 1e-11 * np.abs(plain).max()


@each_law
@pytest.mark.parametrize("kind", ["rank 2", "rank 1", "integer rank 1", "zero", "reflections", "needles", "tiny"])
def test_everything_is_finite(law, kind):
    F, D = MATRICES[kind], np.random.default_rng(2).standard_normal(MATRICES[kind].shape)
    psi, P = ts.evaluate_law(law, F, YOUNG, POISSON)
    parts = (psi, P, differential(law, F, D), differential(law, F, D, projected=True))
    assert all(np.isfinite(part).all() for part in parts)


@pytest.mark.parametrize("count", [1, 3, 4, 9])
def test_any_number_of_matrices(count):
    law = "stable_neo_hookean"
    whole, some = (ts.evaluate_law(law, MODERATE[:n], YOUNG, POISSON) for n in (12, count))
    assert some[0].shape == (count,) and some[1].shape == (count, 3, 3)
    assert np.array_equal(whole[0][:count], some[0]) and np.array_equal(whole[1][:count], some[1])


@pytest.mark.parametrize(
    "change, words",
    [
        ({"law": "stable_neo_hooke"}, "law must be one of .* did you mean 'stable_neo_hookean'"),
        ({"F": np.eye(3)}, r"F has shape \(3, 3\): it must be \(k, 3, 3\)"),
        ({"F": np.zeros((0, 3, 3))}, "with k at least 1"),
        ({"F": np.array([np.eye(3), np.full((3, 3), np.nan)])}, r"F\[1\] is not finite"),
        ({"young": -1.0}, "young must be greater than 0"),
        ({"poisson": 0.5}, "poisson must lie in the open interval"),
    ],
)
def test_bad_arguments_are_refused(change, words):
    arguments = {"law": "corotational", "F": np.eye(3)[None], "young": YOUNG, "poisson": POISSON, **change}
    with pytest.raises(ts.SceneError, match=words):
        ts.evaluate_law(**arguments)


def numbers_in_f32(law, F, D, lanes):
    """psi, P, dP and the block of the law's lane functions, run in f32."""
    with opened("f32"):
        constants = np.array(LAWS[law].constants(*oracle.lame(YOUNG, POISSON)), dtype=np.float32)
        A, B = packed(F, lanes, np.float32), packed(D, lanes, np.float32)
        out = np.zeros((len(A), 28, lanes), np.float32)
        law_numbers(LAWS[law], lanes, A, B, constants, out)
    flat = unpacked(out, len(F))
    return flat[:, 0], *(flat[:, k : k + 9].reshape(-1, 3, 3) for k in (1, 10, 19))


@each_law
def test_single_precision(law):
    """Rounding F to f32 moves P by 6e-8 of the stiffness; the formulas may add some tens of that, and R as 1/gap^2."""
    with pytest.raises(ts.SimulationError, match="a test is open with arch 'cpu' and precision 'f32'"), opened("f32"):
        ts.evaluate_law(law, np.eye(3)[None], YOUNG, POISSON)
    F = MODERATE[smooth(law, MODERATE) & (gap(MODERATE) > 0.1)].astype(np.float32).astype(np.float64)
    D = np.random.default_rng(2).standard_normal(F.shape).astype(np.float32).astype(np.float64)
    eps = np.finfo(np.float32).eps
    size = (1.0 + np.abs(F).max(axis=(1, 2)))[:, None, None]
    loss = (1 + 0.05 / gap(F) ** 2)[:, None, None] if law == "corotational" else 1.0
    psi, P, dP, block = numbers_in_f32(law, F, D, 4)
    assert (np.abs(psi - oracle.psi(law, F, YOUNG, POISSON)) / size[:, 0, 0] ** 6).max() < 20 * eps * YOUNG
    assert (np.abs(P - oracle.pk1(law, F, YOUNG, POISSON)) / size**5 / loss).max() < 20 * eps * YOUNG
    expected = oracle.dpk1(law, F, D, YOUNG, POISSON)
    assert (np.abs(dP - expected) / size**4 / loss**2).max() < 100 * eps * YOUNG
    # block (i, k): the change of P gb along e_k (x) ga
    H = oracle.hessian(law, F, YOUNG, POISSON).reshape(-1, 3, 3, 3, 3)
    expected = np.einsum("nijkl,nl,nj->nik", H, D[:, 0], D[:, 1])
    assert (np.abs(block - expected) / size**4 / loss**2).max() < 300 * eps * YOUNG


@pytest.mark.parametrize("precision", ["f32", "f64"])
def test_corotational_rotation_is_numpys(precision):
    with opened(precision) as machine:
        lanes = 4 if precision == "f64" else 1
        for kind, F in {"moderate": MODERATE, **MATRICES}.items():
            A = packed(F, lanes, machine.np_real)
            out = np.zeros((len(A), 9, lanes), machine.np_real)
            rotation_numbers(LAWS["corotational"], lanes, A, out)
            R, F = unpacked(out, len(F)).reshape(-1, 3, 3), F.astype(machine.np_real).astype(np.float64)
            free = gap(F)
            loss = 1 + 0.05 / np.maximum(free, 0.02)[:, None, None] ** 2
            orthogonal = np.abs(oracle.transposed(R) @ R - np.eye(3))
            tolerance = 1e-12 if precision == "f64" else 100 * machine.eps
            assert (orthogonal / loss).max() < tolerance, kind
            ok = free > 1e-3
            assert (np.abs(R - oracle.rotation(F)) / loss)[ok].max(initial=0.0) < tolerance, kind
    assert runtime.open_kind() is None
