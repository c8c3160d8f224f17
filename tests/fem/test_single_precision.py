"""f32, the default, with the loops of several threads: P, dP, the stiffness block and the dilatation of laws, also under the
pressure of mean dilatation, and energies and forces of a scene are the oracle's, and the same bits in every run.
"""

import numpy as np
import pytest
import taichi as ti

import taisoft as ts
from taisoft.backend.runtime import kernel
from taisoft.fem.laws import LAWS
from taisoft.fem.state import GRAVITY
from tests.backend.lanes import load, opened, packed, store, unpacked
from tests.dynamics.scenes import COR, SNH, SVK, built, mixed_scene
from tests.fem import oracle_laws as oracle
from tests.fem.composition import energy, forces
from tests.fem.test_laws import MODERATE, POISSON, YOUNG, gap

EPS = float(np.finfo(np.float32).eps)


@kernel
def stresses(law: ti.template(), A: ti.types.ndarray(), B: ti.types.ndarray(), p: ti.types.ndarray(), out: ti.types.ndarray()):
    """P, dP and the block of two gradients, the first two rows of D, for F in A and D in B."""
    for b in range(A.shape[0]):
        F, D = load(A, b, 1, 9), load(B, b, 1, 9)
        c = [ti.Vector([p[k]]) for k in ti.static(range(5))]
        P, S = law.pk1(F, c), law.prepare(F, c)
        dP = law.dpk1(F, S, D)
        K = law.block(F, S, [D[0], D[1], D[2]], [D[3], D[4], D[5]])
        store(out, b, 0, P + dP + K, 1)


@kernel
def dilatations(law: ti.template(), A: ti.types.ndarray(), out: ti.types.ndarray()):
    """theta and dtheta/dF for F in A."""
    for b in range(A.shape[0]):
        F = load(A, b, 1, 9)
        theta, G = law.dilatation(F), law.dilatation_gradient(F)
        store(out, b, 0, G + [theta], 1)


def dilatation(law: str, F):
    """theta, its gradient and its Hessian (9,9) or (k,9,9)."""
    if law == COR:
        H = (2.0 * np.eye(9) - oracle.hessian(law, F, 2.0, 0.0)) / 2.0  # of mu = 1, lambda = 0: 2 (I - dR)
        return oracle.signed_svd(F)[1].sum(axis=1) - 3.0, oracle.rotation(F), H
    return (np.sum(F * F, axis=(1, 2)) - 3.0) / 2.0, F, np.eye(9)


def test_laws():
    """Rounding F to f32 changes P by 6e-8 of the stiffness; the formulas may lose some tens of that, and R 1/gap^2 times it."""
    ok = gap(MODERATE) > 0.1
    F = MODERATE[ok].astype(np.float32).astype(np.float64)
    D = np.random.default_rng(2).standard_normal(F.shape).astype(np.float32).astype(np.float64)
    size, pressure = (1.0 + np.abs(F).max(axis=(1, 2)))[:, None, None], 2e5  # [Pa], that of mean dilatation
    with opened("f32"):
        with pytest.raises(ts.SimulationError, match="a test is open with arch 'cpu' and precision 'f32'"):
            ts.evaluate_law(SNH, np.eye(3)[None], YOUNG, POISSON)
        A, B, numbers = packed(F, 1, np.float32), packed(D, 1, np.float32), {}
        for name in (SVK, COR):
            law, out = LAWS[name], [np.zeros((len(A), n, 1), np.float32) for n in (27, 10)]
            constants = np.array([*law.constants(*oracle.lame(YOUNG, POISSON)), pressure], dtype=np.float32)
            stresses(law, A, B, constants, out[0])
            dilatations(law, A, out[1])
            numbers[name] = np.concatenate([unpacked(one, len(F)) for one in out], axis=1)
    for law, flat in numbers.items():
        loss = (1 + 0.05 / gap(F) ** 2)[:, None, None] if law == COR else 1.0
        theta, (P, dP, block, G) = flat[:, 36], (flat[:, k : k + 9].reshape(-1, 3, 3) for k in (0, 9, 18, 27))
        value, gradient, second = dilatation(law, F)
        assert (np.abs(theta - value) / size[:, 0, 0] ** 3).max() < 20 * EPS
        assert (np.abs(G - gradient) / size**2 / loss).max() < 20 * EPS
        expected = oracle.pk1(law, F, YOUNG, POISSON) + pressure * gradient
        assert (np.abs(P - expected) / size**5 / loss).max() < 20 * EPS * YOUNG
        H = (oracle.hessian(law, F, YOUNG, POISSON) + pressure * second).reshape(-1, 3, 3, 3, 3)
        assert (np.abs(dP - np.einsum("nijkl,nkl->nij", H, D)) / size**4 / loss**2).max() < 100 * EPS * YOUNG
        # block (i, k): the change of P gb along e_k (x) ga
        expected = np.einsum("nijkl,nl,nj->nik", H, D[:, 0], D[:, 1])
        assert (np.abs(block - expected) / size**4 / loss**2).max() < 300 * EPS * YOUNG


def test_forces_and_energies_on_several_threads():
    with built(mixed_scene((SNH,) * 4), "f32") as rig:
        m, truth = rig.parallel, rig.oracle
        x = truth.rest * [0.7, 1.1, 0.8] + 0.1 * np.random.default_rng(11).standard_normal(truth.rest.shape)
        found = [(forces(rig, x, m), energy(rig, x, m), m.state.scalars[GRAVITY]) for _ in range(6)]
        assert all(np.array_equal(a, b) for again in found for a, b in zip(found[0], again))
        f, elastic, weight = found[0]
        assert np.abs(f - truth.force(x)).max() < 30 * EPS * np.abs(f).max()
        # sums are in f64, but the rest shape, masses and gravity are stored in f32
        assert (elastic, weight) == pytest.approx((truth.energy(x), truth.weight(x, False)), rel=10 * EPS)
        far = truth.rest + [1e4, -2e4, 5e3]  # positions and their differences are f64
        assert np.abs(forces(rig, far, m)).max() < 10 * EPS * 1e5 and energy(rig, far, m) < 10 * EPS * 1e5
