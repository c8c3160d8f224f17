"""Checks of laws against differences: `check_law`.

A law from its energy density is checked in NumPy, by the formulas that kernels use; one written by hand, in a kernel.
"""

from collections.abc import Callable
from contextlib import nullcontext
from dataclasses import dataclass

import numpy as np

from taisoft.errors import SceneError
from taisoft.fem.laws import lane_law
from taisoft.fem.laws.evaluate import double_precision, evaluate_blocks, evaluate_differential, evaluate_dilatation, evaluate_law
from taisoft.scene import checks
from taisoft.scene.jets import Space
from taisoft.scene.law import HOOKE, Law, evaluate, of_stretches
from taisoft.scene.laws import LAWS
from taisoft.scene.material import Material

H = 1e-5  # step of central differences of F, whose error is its square
ALLOWED = 1e-6  # error of a derivative relative to the stiffness, which is above that of the differences
AT_REST = 1e-8  # stress at rest relative to the stiffness
IN_F32 = 1e-3  # error of a stress in f32 relative to the stiffness: a strain of that size


@dataclass(frozen=True)
class LawCheck:
    """What `check_law` has found, with the numbers used: moduli at rest; whether rotations of the material change psi; whether
    psi and its stress are finite if det F < 0."""

    name: str
    numbers: dict[str, float]
    young: float
    poisson: float
    is_isotropic: bool
    is_finite_inverted: bool


def check_law(name: str, **numbers: float) -> LawCheck:
    """Check a law against differences in F, in f64: psi, stress, tangent, what kernels use of them, rest, rotations; and f32.

    numbers: of its parameters, or young and poisson, for which it is checked; by default the default of each `Parameter`, or a
    number in its range, 1 if it can be. Raises SceneError with what is wrong and where.
    """
    law = LAWS[checks.choice(name, "law", tuple(LAWS))]
    with nullcontext() if law.psi is not None else double_precision():  # one runtime for all evaluations
        return _check(law, numbers)


def _check(law: Law, numbers: dict[str, float]) -> LawCheck:
    name, what = law.name, f"law {law.name!r}"
    try:
        material = Material(law=name, **{**_sample(law), **numbers})
    except SceneError as error:
        raise SceneError(str(error).replace("material: ", f"{what}: ", 1)) from None
    used = material.parameters or {"young": material.young, "poisson": material.poisson}
    scale, rng = material.mu + abs(material.lam), np.random.default_rng(0)
    rest, F = np.eye(3)[None], np.eye(3) + 0.15 * rng.uniform(-1.0, 1.0, (40, 3, 3))
    D, (Q, W) = rng.uniform(-1.0, 1.0, F.shape), (_rotations(rng, len(F)) for _ in range(2))
    values = _evaluator(law, material)
    psi, P, tangent = values(F)
    _refuse(what, "psi, its stress or its tangent is not finite", F, ~np.isfinite(psi + P.sum((1, 2)) + tangent.sum((1, 2))))
    at_rest = np.abs(values(rest)[1]).max()
    if not at_rest <= AT_REST * scale:
        rule = f"where shear is resisted by {material.mu:.3g} Pa: a term such as -c (J - 1) balances it"
        raise SceneError(f"{what}: it has a stress of {at_rest:.3g} Pa at rest, F = I, {rule}")
    allowed = ALLOWED * max(scale, np.abs(tangent).max())
    _check_derivatives(what, values, F, D, allowed)
    if law.pk1 is not None:
        large = np.concatenate([1.5 * F - 0.5 * np.eye(3), F * [1.0, 1.0, -1.0]])
        finite = np.isfinite(sum(part.reshape(len(large), -1).sum(axis=1) for part in values(large)))
        _check_derivatives(what, values, large[finite], np.tile(D, (2, 1, 1))[finite], 10.0 * allowed)
    if law.psi is None:
        _check_lanes(what, name, F, used, tangent, allowed)
        if hasattr(lane_law(name), "dilatation"):
            _check_dilatation(what, name, F, D, used)
    _compare(what, "psi changes with a rotation of space: it is not objective", F, values(Q @ F)[0], psi, ALLOWED * scale)
    turned = values(F @ W)[0]
    if law.is_isotropic:
        _compare(what, "psi changes with a rotation of the material: it is not isotropic", F, turned, psi, ALLOWED * scale)
    if "stretches" in law.variables:
        _check_order(what, law, law.numbers_of(material), ALLOWED * scale)
    _check_rest(what, law, material, values(rest)[2][0])
    _check_volume(what, law)
    numbers = {name: np.float32(value) for name, value in law.numbers_of(material).items()}
    small = evaluate(law, F.astype(np.float32), numbers)[1] if law.psi is not None else P
    error = np.abs(small - P).max(axis=(1, 2)) / scale
    _refuse(what, "in f32 its stress is not finite or loses more than three digits", F, ~(error <= IN_F32))
    inverted = np.concatenate([F * [1.0, 1.0, -1.0], np.zeros((1, 3, 3)), np.diag([2.0, 0.5, 0.0])[None]])
    finite = all(np.isfinite(one).all() for one in values(inverted))
    return LawCheck(
        name, dict(used), material.young, material.poisson, bool(np.abs(turned - psi).max() <= ALLOWED * scale), finite
    )


def _check_derivatives(what: str, values: Callable, F: np.ndarray, D: np.ndarray, allowed: float) -> None:
    """Compare the stress with differences of psi along D, and the tangent with those of the stress."""
    (_, P, tangent), (up, P_up, _), (down, P_down, _) = values(F), values(F + H * D), values(F - H * D)
    _compare(what, "its stress is not the derivative of psi", F, np.sum(P * D, axis=(1, 2)), (up - down) / (2.0 * H), allowed)
    dP = np.einsum("epq,eq->ep", tangent, D.reshape(-1, 9))
    _compare(what, "its tangent is not the derivative of its stress", F, dP, (P_up - P_down).reshape(-1, 9) / (2.0 * H), allowed)


def _sample(law: Law) -> dict[str, float]:
    return {name: value for name, value in law.sample().items() if name not in HOOKE} or {"young": 1.0, "poisson": 0.3}


def _evaluator(law: Law, material: Material) -> Callable[[np.ndarray], tuple[np.ndarray, ...]]:
    """Return F (k,3,3) -> psi (k,) from rest, P (k,3,3), tangent (k,9,9)."""
    if law.psi is not None:
        numbers = law.numbers_of(material)

        def values(F: np.ndarray) -> tuple[np.ndarray, ...]:
            psi, P, tangent = evaluate(law, F, numbers)
            return psi - evaluate(law, np.eye(3)[None], numbers)[0], P, tangent

        return values
    numbers = {"young": material.young, "poisson": material.poisson}

    def kernel_values(F: np.ndarray) -> tuple[np.ndarray, ...]:
        psi, P = evaluate_law(law.name, F, **numbers)
        return psi, P, _columns(law.name, F, numbers, False)

    return kernel_values


def _columns(name: str, F: np.ndarray, numbers: dict, projected: bool) -> np.ndarray:
    units = np.eye(9).reshape(9, 3, 3)
    return np.stack(
        [evaluate_differential(name, F, one, projected=projected, **numbers).reshape(-1, 9) for one in units], axis=-1
    )


def _check_lanes(what: str, name: str, F: np.ndarray, used: dict, tangent: np.ndarray, allowed: float) -> None:
    """Compare `block` and the projection of a law that is written by hand with its tangent."""
    _compare(what, "its block is not its differential", F, evaluate_blocks(name, F, **used), tangent, allowed)
    large = np.concatenate([F, 0.5 * F, 1.5 * F - 0.5 * np.eye(3), F * [1.0, 1.0, -1.0]])
    exact = _columns(name, large, used, False)
    finite = np.isfinite(exact).all(axis=(1, 2))
    large, (w, Q) = large[finite], np.linalg.eigh(exact[finite])
    clamped = (Q * np.maximum(w, 0.0)[:, None]) @ Q.swapaxes(1, 2)
    allowed = ALLOWED * max(1.0, np.abs(clamped).max())
    wrong = "its eigenvalues (hessian_eigen) do not give the positive semi-definite part of its tangent"
    _compare(what, wrong, large, _columns(name, large, used, True), clamped, allowed)


def _check_dilatation(what: str, name: str, F: np.ndarray, D: np.ndarray, used: dict) -> None:
    """Compare the parts of mean dilatation of a law that is written by hand with each other."""
    n, at = len(F), np.concatenate([F, F + H * D, F - H * D, np.eye(3)[None]])
    theta, G, pressed = evaluate_dilatation(name, at, **used)
    slopes, along = (theta[n : 2 * n] - theta[2 * n : -1]) / (2.0 * H), np.sum(G[:n] * D, axis=(1, 2))
    _compare(what, "its dilatation_gradient is not that of its dilatation", F, along, slopes, ALLOWED)
    _compare(what, "a pressure does not add dilatation_gradient to its stress", F, pressed[:n], G[:n], ALLOWED)
    _compare(what, "its dilatation has another slope than 1 at F = I", at[-1:], G[-1:], at[-1:], ALLOWED)
    _compare(what, "its dilatation is not 0 at F = I", at[-1:], theta[-1:], 0.0 * theta[-1:], ALLOWED)


def _check_rest(what: str, law: Law, material: Material, tangent: np.ndarray) -> None:
    """Raise SceneError if a law is unstable at rest, or has other moduli there than the numbers it takes."""
    symmetric = 0.5 * (np.eye(9) + np.eye(9).reshape(3, 3, 9).swapaxes(0, 1).reshape(9, 9))
    w, Q = np.linalg.eigh(symmetric @ tangent @ symmetric)
    strains = w[np.argsort(np.abs(np.einsum("pk,pk->k", Q, symmetric @ Q)))[3:]]  # without the three rotations
    if not strains.min() > 0.0:
        raise SceneError(f"{what}: it is unstable at rest: a strain is resisted by {strains.min():.3g} Pa")
    if not law.parameters and law.psi is not None:
        mu, lam = (float(one[0]) for one in law.lame({"mu": material.mu, "lam": material.lam}))
        for symbol, found, asked in (("shear modulus", mu, material.mu), ("lambda", lam, material.lam)):
            if abs(found - asked) > ALLOWED * (material.mu + abs(material.lam)):
                rule = "write psi with mu and lam, or give its own numbers as parameters"
                raise SceneError(f"{what}: its {symbol} at rest is {found / asked:.6g} times that of young and poisson: {rule}")


def _check_order(what: str, law: Law, numbers: dict[str, float], allowed: float) -> None:
    """Raise SceneError if psi depends on the order of the principal stretches."""
    space, s = Space(0), np.random.default_rng(1).uniform(0.8, 1.2, (3, 20))
    energy = of_stretches(law, space, numbers)
    F, orders = s.T[:, :, None] * np.eye(3), ((0, 1, 2), (1, 2, 0), (1, 0, 2))
    one, *others = (energy([space.fixed(s[k]) for k in order]).value * np.ones(20) for order in orders)
    for other in others:
        _compare(what, "psi depends on the order of the stretches: it is not isotropic", F, other, one, allowed)


def _check_volume(what: str, law: Law) -> None:
    """Raise SceneError if a dilatation is not a volume strain."""
    if law.dilatation is not None:
        theta = law.volume_strain(Space().variable(1.0, 0))
        if abs(theta.value) > AT_REST or abs(theta.first.get(0, 0.0) - 1.0) > ALLOWED:
            found = f"{float(theta.value):.3g} with slope {float(theta.first.get(0, 0.0)):.3g}"
            raise SceneError(f"{what}: its dilatation must be 0 with slope 1 at J = 1, not {found}")


def _rotations(rng: np.random.Generator, k: int) -> np.ndarray:
    Q = np.linalg.qr(rng.standard_normal((k, 3, 3)))[0]
    return Q * np.sign(np.linalg.det(Q))[:, None, None]


def _compare(what: str, wrong: str, F: np.ndarray, found: np.ndarray, expected: np.ndarray, allowed: float) -> None:
    """Raise SceneError where values (k, ...) differ by more than is allowed [Pa]."""
    found, expected = found.reshape(len(F), -1), expected.reshape(len(F), -1)
    error = np.where(np.isfinite(found), np.abs(found - expected), np.inf)
    k, i = np.unravel_index(np.argmax(error), error.shape)
    if error[k, i] > allowed:
        rows = np.array2string(F[k], precision=3, suppress_small=True).replace("\n", "")
        raise SceneError(f"{what}: {wrong}: {found[k, i]:.6g} against {expected[k, i]:.6g} Pa at F = {rows}")


def _refuse(what: str, wrong: str, F: np.ndarray, bad: np.ndarray) -> None:
    if bad.any():
        rows = np.array2string(F[int(np.argmax(bad))], precision=3, suppress_small=True).replace("\n", "")
        raise SceneError(f"{what}: {wrong} at F = {rows}")
