"""f32, the default, with the loops of several threads:

* matrix functions over one lane, as on CUDA, and decompositions, are NumPy's to a few roundings;
* psi, P, dP, the stiffness block and the dilatation of laws are the oracle's, also with the pressure of mean dilatation
  (`test_elasticity` has the third law); `evaluate_law` is refused while f32 is open;
* energies and forces of a scene are the oracle's, and the same bits in every run; a body at rest has no force, however far away.
"""

import numpy as np
import pytest
import taichi as ti

import taisoft as ts
from taisoft.backend.runtime import kernel
from taisoft.fem.laws import LAWS
from taisoft.fem.measure import measure
from taisoft.fem.state import ELASTIC, GRAVITY
from taisoft.fem.terms import elasticity
from tests.backend.lanes import load, opened, packed, store, unpacked
from tests.dynamics.scenes import COR, SNH, SVK, built, mixed_scene
from tests.fem import oracle_laws as oracle
from tests.fem.test_laws import MODERATE, POISSON, YOUNG, gap
from tests.fem.test_math3 import check_decompositions, check_products

EPS = float(np.finfo(np.float32).eps)
LANES = 4


@kernel
def law_numbers(law: ti.template(), A: ti.types.ndarray(), B: ti.types.ndarray(), p: ti.types.ndarray(), out: ti.types.ndarray()):
    """psi, theta, P, dP, dtheta/dF and the block of two gradients, the first two rows of D, for F in A and D in B."""
    for b in range(A.shape[0]):
        F, D = load(A, b, LANES, 9), load(B, b, LANES, 9)
        c = [ti.Vector([p[k] for q in ti.static(range(LANES))]) for k in ti.static(range(5))]
        energy, P, S = law.psi(F, c[:4]), law.pk1(F, c), law.prepare(F, c)
        dP = law.dpk1(F, S, D)
        K = law.block(F, S, [D[0], D[1], D[2]], [D[3], D[4], D[5]])
        theta, G = law.dilatation(F), law.dilatation_gradient(F)
        store(out, b, 0, [energy, theta], LANES)
        store(out, b, 2, P + dP + G + K, LANES)


def test_matrix_functions_over_one_lane():
    with opened("f32") as runtime:
        check_products(runtime, lanes=1)
        check_decompositions(runtime, lanes=1)


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
        A, B, numbers = packed(F, LANES, np.float32), packed(D, LANES, np.float32), {}
        for name in (SVK, COR):
            law = LAWS[name]
            constants, out = [*law.constants(*oracle.lame(YOUNG, POISSON)), pressure], np.zeros((len(A), 38, LANES), np.float32)
            law_numbers(law, A, B, np.array(constants, dtype=np.float32), out)
            numbers[name] = unpacked(out, len(F))
    for law, flat in numbers.items():
        loss = (1 + 0.05 / gap(F) ** 2)[:, None, None] if law == COR else 1.0
        psi, theta, (P, dP, G, block) = flat[:, 0], flat[:, 1], (flat[:, k : k + 9].reshape(-1, 3, 3) for k in (2, 11, 20, 29))
        value, gradient, second = dilatation(law, F)
        assert (np.abs(theta - value) / size[:, 0, 0] ** 3).max() < 20 * EPS and (
            np.abs(G - gradient) / size**2 / loss
        ).max() < 20 * EPS
        assert (np.abs(psi - oracle.psi(law, F, YOUNG, POISSON)) / size[:, 0, 0] ** 6).max() < 20 * EPS * YOUNG
        expected = oracle.pk1(law, F, YOUNG, POISSON) + pressure * gradient
        assert (np.abs(P - expected) / size**5 / loss).max() < 20 * EPS * YOUNG
        H = (oracle.hessian(law, F, YOUNG, POISSON) + pressure * second).reshape(-1, 3, 3, 3, 3)
        assert (np.abs(dP - np.einsum("nijkl,nkl->nij", H, D)) / size**4 / loss**2).max() < 100 * EPS * YOUNG
        # block (i, k): the change of P gb along e_k (x) ga
        expected = np.einsum("nijkl,nl,nj->nik", H, D[:, 0], D[:, 1])
        assert (np.abs(block - expected) / size**4 / loss**2).max() < 300 * EPS * YOUNG


def test_forces_and_energies_on_several_threads():
    with built(mixed_scene((SNH,) * 4), "f32") as rig:
        m, force, oracle_of = rig.parallel, rig.vectors("force"), rig.oracle
        rng = np.random.default_rng(11)
        x = oracle_of.rest * [0.7, 1.1, 0.8] + 0.1 * rng.standard_normal(oracle_of.rest.shape)
        v = rng.standard_normal(x.shape).astype(np.float32)
        m.state.v.from_numpy(v)

        def numbers(x: np.ndarray) -> list[np.ndarray]:
            m.state.x.from_numpy(x)
            elasticity.elastic_forces(m)
            elasticity.gather_forces(m, force)
            measure(m)
            return [force.to_numpy(), m.state.scalars.to_numpy()[: GRAVITY + 1]]

        f, scalars = numbers(x)
        for _ in range(5):
            assert all(np.array_equal(a, b) for a, b in zip((f, scalars), numbers(x)))
        assert np.abs(f - oracle_of.force(x)).max() < 30 * EPS * np.abs(f).max()
        of_mass = oracle_of.kinetic(v.astype(np.float64), False), oracle_of.weight(x, False)
        # sums are in f64, but the rest shape, masses and gravity are stored in f32
        assert scalars == pytest.approx((oracle_of.energy(x), *oracle_of.volume_ratios(x), *of_mass), rel=10 * EPS, abs=10 * EPS)
        f, scalars = numbers(oracle_of.rest + [1e4, -2e4, 5e3])  # positions and their differences are f64
        assert np.abs(f).max() < 10 * EPS * 1e5 and scalars[ELASTIC] < 10 * EPS * 1e5
