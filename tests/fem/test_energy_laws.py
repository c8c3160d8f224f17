"""Laws from an energy density: in kernels they equal their derivatives in NumPy, those written by hand and closed forms; wrong
ones are refused with what is wrong.
"""

import types

import numpy as np
import pytest

import taisoft as ts
from taisoft.backend.tracing import untraced
from taisoft.fem.laws import stable_neo_hookean
from taisoft.fem.laws.evaluate import evaluate_blocks
from taisoft.scene.law import evaluate
from taisoft.scene.laws import LAWS, SHIPPED
from tests.dynamics.scenes import SVK
from tests.fem.energies import OLD, POLYNOMIAL, holzapfel, polynomial, svk_differential, svk_of_F, svk_stress, tangent

pytestmark = pytest.mark.usefixtures("known_laws")
RNG = np.random.default_rng(5)
MODERATE = np.eye(3) + 0.35 * RNG.uniform(-1.0, 1.0, (37, 3, 3))
STRETCHES = [[1.0, 1.0, 1.0], [1.3, 1.3, 1.3], [1.2, 1.2, 0.8], [1.2, 1.2 + 1e-7, 0.8], [1.2, 0.8, -0.9], [1.2, 0.8, -0.8]]
SPECIAL = np.array([np.diag(one) for one in STRETCHES])
EXTREME = np.array([np.zeros((3, 3)), -9.0 * np.eye(3), np.diag([30.0, 0.0, -2.0])])
ALL = np.concatenate([MODERATE, SPECIAL])
SHIPPED_NUMBERS = {
    "mooney_rivlin": {"c1": 0.9, "c2": 0.3, "bulk": 7.0},
    "gent": {"shear": 1.3, "limit": 5.0, "bulk": 7.0},
    "fung": {"shear": 1.3, "exponent": 0.7, "bulk": 7.0},
    "ogden": {"mu1": 0.9, "alpha1": 1.7, "mu2": -0.2, "alpha2": -2.3, "mu3": 0.1, "alpha3": 3.1, "bulk": 7.0},
}


def compare_with_numpy(law: str, F, numbers: dict, constants: dict, allowed: float = 1e-12):
    psi, P, H = evaluate(LAWS[law], F, constants)
    psi = psi - evaluate(LAWS[law], np.eye(3)[None], constants)[0]
    found_psi, found_P = ts.evaluate_law(law, F, **numbers)
    size = np.abs(H).max()
    assert np.abs(found_psi - psi).max() < allowed * size
    assert np.abs(found_P - P).max() < allowed * size
    assert np.abs(tangent(law, F, numbers) - H).max() < 100 * allowed * size
    assert np.abs(evaluate_blocks(law, F, **numbers) - H).max() < 100 * allowed * size
    w, Q = np.linalg.eigh(H)
    clamped = (Q * np.maximum(w, 0.0)[:, None]) @ Q.swapaxes(1, 2)
    assert w.min() < -0.01 * size  # the projection matters
    assert np.abs(tangent(law, F, numbers, projected=True) - clamped).max() < 1e-10 * size


@pytest.mark.parametrize("law", SHIPPED_NUMBERS)
def test_shipped_laws_in_kernels_equal_their_derivatives_in_numpy(law, kernels):
    numbers = SHIPPED_NUMBERS[law]
    ts.check_law(law, **numbers)
    # two stretches that nearly coincide leave half of the digits of a symmetric mode of principal stretches
    F, allowed = (ALL[:-1], 1e-10) if law == "ogden" else (ALL, 1e-12)  # whose stress jumps where two stretches cancel
    compare_with_numpy(law, F, numbers, numbers, allowed)
    assert np.isfinite(ts.evaluate_law(law, EXTREME, **numbers)[1]).all()
    flat = np.array([np.diag([1.0, 1e-3, -1e-3]), np.diag([1.0, 0.0, 0.0]), np.zeros((3, 3))])
    if law != "ogden":
        w, Q = np.linalg.eigh(tangent(law, flat, numbers))
        clamped = (Q * np.maximum(w, 0.0)[:, None]) @ Q.swapaxes(1, 2)
        assert np.abs(tangent(law, flat, numbers, projected=True) - clamped).max() < 1e-9 * np.abs(clamped).max()


@pytest.mark.parametrize("law", OLD)
def test_the_laws_written_by_hand_follow_from_their_energies(law, kernels):
    ts.register_law("again", OLD[law])
    numbers = {"young": 3e5, "poisson": 0.35}
    for found, expected in zip(ts.evaluate_law("again", MODERATE, **numbers), ts.evaluate_law(law, MODERATE, **numbers)):
        assert np.abs(found - expected).max() < 1e-10 * np.abs(expected).max()
    for projected in (False, True):
        found, expected = (tangent(name, MODERATE, numbers, projected) for name in ("again", law))
        assert np.abs(found - expected).max() < 1e-10 * np.abs(expected).max()


def test_general_laws_of_F_of_fibres_and_with_a_given_stress(kernels):
    numbers, lame = {"young": 1.0, "poisson": 0.3}, {"mu": 1 / 2.6, "lam": 0.3 / 0.52}
    ts.register_law("of_F", svk_of_F)
    compare_with_numpy("of_F", ALL, numbers, lame)
    ts.register_law("given", svk_of_F, pk1=svk_stress, dpk1=svk_differential)
    compare_with_numpy("given", ALL, numbers, lame)
    ts.register_law("tissue", holzapfel, {"c": "Pa", "k1": "Pa", "k2": "", "bulk": "Pa"})
    own = {"c": 1.0, "k1": 5.0, "k2": 0.8, "bulk": 6.0}
    compare_with_numpy("tissue", ALL, own, own)
    turned = ts.evaluate_law("tissue", MODERATE, fibre=(0.0, 0.6, 0.8), **own)[1]
    assert np.abs(turned - evaluate(LAWS["tissue"], MODERATE, own, np.array([0.0, 0.6, 0.8]))[1]).max() < 1e-12


def free_stretches(stress, s: float, free: tuple[int, ...], F) -> np.ndarray:
    """Stretches with s given and those of the free axes, equal, such that their stress vanishes: closed forms in pressure."""
    from scipy.optimize import brentq

    return brentq(lambda t: stress(F(s, t))[free[0]], 0.3, 2.0, xtol=1e-15)


STRESSES = {  # principal stresses [Pa] over the principal stretches, by hand
    "mooney_rivlin": lambda l, J, p: (
        2 * p["c1"] * J ** (-2 / 3) * (l**2 - np.sum(l**2) / 3) / l
        + 2 * p["c2"] * J ** (-4 / 3) * (np.sum(l**2) * l**2 - l**4 - 2 / 3 * (J**2 * np.sum(l**-2.0))) / l
        + p["bulk"] * (J - 1) * J / l
    ),
    "gent": lambda l, J, p: (
        p["shear"]
        * p["limit"]
        / (p["limit"] - (np.sum(l**2) * J ** (-2 / 3) - 3))
        * J ** (-2 / 3)
        * (l**2 - np.sum(l**2) / 3)
        / l
        + p["bulk"] * (J - 1) * J / l
    ),
    "fung": lambda l, J, p: (
        p["shear"] * np.exp(p["exponent"] * (np.sum(l**2) * J ** (-2 / 3) - 3)) * J ** (-2 / 3) * (l**2 - np.sum(l**2) / 3) / l
        + p["bulk"] * (J - 1) * J / l
    ),
    "ogden": lambda l, J, p: (
        sum(
            p[f"mu{k}"] * J ** (-p[f"alpha{k}"] / 3) * (l ** p[f"alpha{k}"] - np.mean(l ** p[f"alpha{k}"])) / l for k in (1, 2, 3)
        )
        + p["bulk"] * (J - 1) * J / l
    ),
}


@pytest.mark.parametrize("law", SHIPPED_NUMBERS)
def test_uniaxial_biaxial_and_shear_follow_the_closed_forms(law, kernels):
    p = SHIPPED_NUMBERS[law]
    stress = lambda l: STRESSES[law](np.asarray(l), float(np.prod(l)), p)  # noqa: E731
    for s in (0.8, 1.3):
        for shape, free in ((lambda s, t: [s, t, t], (1, 2)), (lambda s, t: [s, s, t], (2,))):
            t = free_stretches(stress, s, free, shape)
            _, P = ts.evaluate_law(law, np.diag(shape(s, t))[None], **p)
            assert np.abs(P[0] - np.diag(stress(shape(s, t)))).max() < 1e-8
            assert np.abs(np.diag(P[0])[list(free)]).max() < 1e-8
    k = 0.4  # simple shear: principal stretches l, 1/l, 1; the shear stress is (s_1 l - s_2 / l) / (l + 1/l) by Rivlin's relation
    l = k / 2 + np.sqrt(1 + k**2 / 4)
    P = ts.evaluate_law(law, np.array([[[1.0, k, 0.0], [0.0, 1.0, 0.0], [0.0, 0.0, 1.0]]]), **p)[1][0]
    principal = stress([l, 1 / l, 1.0])
    assert abs(P[0, 1] - (principal[0] * l - principal[1] / l) / (l + 1 / l)) < 1e-8


def with_function(**changes) -> types.ModuleType:
    """Lane functions of stable neo-Hookean, some of them replaced."""
    module = types.ModuleType("changed")
    vars(module).update({**vars(stable_neo_hookean), **changes})
    return module


def times(name: str, factor: float):
    """That function of stable neo-Hookean with a factor."""
    original = getattr(stable_neo_hookean, name)

    @untraced
    def changed(*arguments):
        found = original(*arguments)
        return [factor * one for one in found] if isinstance(found, list) else factor * found

    return changed


@untraced
def wrong_eigenvalues(s, p):
    A, symmetric, antisymmetric = stable_neo_hookean.hessian_eigen(s, p)
    return A, antisymmetric, symmetric


SKEWED = np.array([[1.0, 0.3, 0.0], [0.0, 1.0, 0.0], [0.0, 0.0, 1.0]])
WRONG = {
    "a psi with half the stress": (
        {"psi": lambda F, mu, lam: svk_of_F(F, mu, lam) / 2, "pk1": svk_stress, "dpk1": svk_differential},
        "its stress is not the derivative of psi",
    ),
    "stress at rest": ({"psi": lambda I1, c1: c1 * I1, "parameters": {"c1": "Pa"}}, "stress of 2 Pa at rest"),
    "a tangent times 3": (
        {"psi": svk_of_F, "pk1": svk_stress, "dpk1": lambda F, D, mu, lam: 3 * svk_differential(F, D, mu, lam)},
        "its tangent is not the derivative of its stress",
    ),
    "a stress that is no gradient": (
        {
            "psi": svk_of_F,
            "pk1": lambda F, mu, lam: svk_stress(F, mu, lam) @ SKEWED,
            "dpk1": lambda F, D, mu, lam: svk_differential(F, D, mu, lam) @ SKEWED,
        },
        "its stress is not the derivative of psi",
    ),
    "not objective": ({"psi": lambda F, mu, lam: svk_of_F(F.T, mu, lam) + mu * (F[0, 1] - F[1, 0]) ** 2}, "not objective"),
    "unstable": (
        {"psi": lambda I1, J, c1: c1 * (I1 - 3 - 2 * np.log(J)) - 5 * c1 * (J - 1) ** 2, "parameters": {"c1": "Pa"}},
        "unstable",
    ),
    "other moduli": ({"psi": lambda I1, I2, mu, lam: 2 * OLD[SVK](I1, I2, mu, lam)}, "shear modulus at rest is 2 times"),
    "a dilatation that is none": (
        {"psi": lambda I1, I2, mu, lam: OLD[SVK](I1, I2, mu, 0), "dilatation": lambda J: J, "modulus": "lam"},
        "stress of .* at rest",
    ),
    "the order of stretches": (
        {"psi": lambda stretches, J, mu: mu * (sum(s**2 for s in stretches) - 3 - 2 * (J - 1)) + mu * (stretches[0] - 1) ** 2},
        "depends on the order of the stretches",
    ),
    "two stretches that are swapped": (
        {
            "psi": lambda stretches, J, mu: (
                mu * (sum(s**2 for s in stretches) - 3 - 2 * (J - 1))
                + mu * (stretches[0] - stretches[1]) * (stretches[1] - stretches[2]) * (stretches[2] - stretches[0])
            )
        },
        "depends on the order of the stretches",
    ),
    "the name of an option": ({"psi": polynomial, "parameters": {**POLYNOMIAL, "floor": ""}}, "cannot be called floor"),
    "a comparison": ({"psi": lambda I1, mu: mu * (I1 - 3) * (1 if mu == 1 else 2)}, "use np.maximum or np.minimum"),
    "a branch": ({"psi": lambda I1, mu, lam: mu * (I1 - 3) if I1 > 3 else 0.0}, "use np.maximum or np.minimum"),
    "another function": ({"psi": lambda I1, mu, lam: mu * np.sin(I1 - 3)}, "there is no numpy.sin"),
    "a name that does not exist": ({"psi": lambda I1, J, c3: I1, "parameters": {"c1": "Pa"}}, "c3 is no variable"),
    "a parameter that is not used": ({"psi": polynomial, "parameters": {**POLYNOMIAL, "c4": ""}}, "parameter c4 is not used"),
    "the name of an argument": ({"psi": polynomial, "parameters": {**POLYNOMIAL, "region": ""}}, "cannot be called region"),
    "a default out of range": (
        {"psi": polynomial, "parameters": {**POLYNOMIAL, "c2": ts.Parameter("Pa", default=-1.0, above=0.0)}},
        "the default of c2 must be greater than 0",
    ),
    "a matrix of another shape": (
        {"psi": svk_of_F, "pk1": lambda F, mu, lam: mu, "dpk1": svk_differential},
        r"must return a matrix \(3, 3\)",
    ),
    "no number": ({"psi": lambda I1, mu: None}, "psi must return a number, not NoneType"),
    "the name of a number": ({"psi": polynomial, "parameters": {**POLYNOMIAL, "friction": ""}}, "cannot be called friction"),
    "no modulus": ({"psi": polynomial, "parameters": POLYNOMIAL, "dilatation": lambda J: J - 1}, "dilatation needs a modulus"),
    "lane functions: psi": ({"functions": with_function(psi=times("psi", 2.0))}, "its stress is not the derivative of psi"),
    "lane functions: tangent": ({"functions": with_function(dpk1=times("dpk1", 3.0))}, "its tangent is not the derivative"),
    "lane functions: dilatation": (
        {"functions": with_function(dilatation=times("dilatation", 2.0))},
        "its dilatation_gradient is not that of its dilatation",
    ),
    "lane functions: its gradient": (
        {"functions": with_function(dilatation_gradient=times("dilatation_gradient", 2.0))},
        "its dilatation_gradient is not that of its dilatation",
    ),
    "lane functions with parameters": ({"functions": with_function(), "parameters": {"c": "Pa"}}, "functions are given alone"),
    "lane functions: block": ({"functions": with_function(block=times("block", 1.1))}, "its block is not its differential"),
    "lane functions: eigenvalues": ({"functions": with_function(hessian_eigen=wrong_eigenvalues)}, "its eigenvalues"),
}


@pytest.mark.parametrize("case", WRONG)
def test_wrong_laws_are_refused_with_what_is_wrong(case):
    arguments, message = WRONG[case]
    with pytest.raises(ts.SceneError, match=f"law 'wrong'.*{message}"):
        ts.register_law("wrong", **arguments)
    assert "wrong" not in LAWS


def test_a_volume_floor_on_any_law():
    """Beside a law of F it is projected with it."""
    ts.register_law("of_F", svk_of_F)
    flat = np.array([np.diag([1.1, 0.9, 0.05]), np.diag([1.1, 0.9, -0.05])])
    numbers = {"young": 1.0, "poisson": 0.3, "volume_floor": 0.2}
    for found, expected in zip(ts.evaluate_law("of_F", flat, **numbers), ts.evaluate_law(SVK, flat, **numbers)):
        assert np.abs(found - expected).max() < 1e-12
    for projected in (False, True):
        found, expected = (tangent(law, flat, numbers, projected) for law in ("of_F", SVK))
        assert np.abs(found - expected).max() < 1e-10


def test_every_law_of_the_package_passes_the_check(kernels):
    for law in SHIPPED:
        found = ts.check_law(law.name)
        assert found.is_isotropic and found.is_finite_inverted
