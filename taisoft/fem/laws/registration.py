"""Laws of one's own: `register_law` and `check_law`.

A law from its energy density is checked in NumPy, by the formulas that kernels use; one written by hand, in a kernel.
"""

import inspect
import warnings
from collections.abc import Callable, Mapping
from contextlib import nullcontext
from dataclasses import dataclass
from typing import Any

import numpy as np

from taisoft.backend.runtime import open_kind
from taisoft.errors import SceneError, value_text
from taisoft.fem.laws import lane_law
from taisoft.fem.laws.evaluate import double_precision, evaluate_blocks, evaluate_differential, evaluate_dilatation, evaluate_law
from taisoft.scene import checks
from taisoft.scene.jets import Space
from taisoft.scene.law import HOOKE, VARIABLES, Law, Parameter, arguments_of, evaluate, of_stretches
from taisoft.scene.laws import LAWS, SHIPPED
from taisoft.scene.material import Material

H = 1e-5  # step of central differences of F, whose error is its square
ALLOWED = 1e-6  # error of a derivative relative to the stiffness, which is above that of the differences
AT_REST = 1e-8  # stress at rest relative to the stiffness
IN_F32 = 1e-3  # error of a stress in f32 relative to the stiffness: a strain of that size
# names of numbers and of arguments beside which a parameter stands
TAKEN = {*VARIABLES, *HOOKE, *inspect.signature(Material).parameters, "D", "self", "body", "region", "activation", "fibre"}
LANE_FUNCTIONS = ("N_CONSTANTS", "SOFTENS_BELOW", "POINT_SECONDS", "constants", "psi", "pk1", "prepare", "dpk1", "block")


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


def register_law(
    name: str,
    psi: Callable | None = None,
    parameters: Mapping[str, Parameter | str] | None = None,
    *,
    pk1: Callable | None = None,
    dpk1: Callable | None = None,
    dilatation: Callable | None = None,
    modulus: str | None = None,
    functions: Any = None,
) -> LawCheck:
    """Make a law available as Material(law=name, ...), after `check_law`.

    psi: energy density [Pa] as a function of some of F (3,3), the invariants I1 = tr C, I2 = (I1^2 - tr C^2) / 2, J = det F and
    I4 = a.C a along the fibres a (C = F^T F), the principal `stretches` (three) and their sum trS; and of the parameters, by
    their names, or of Lamé's `mu` and `lam` from young and poisson. It uses Python's operators and NumPy's functions; stress
    and tangent follow from it exactly. parameters: a `Parameter` each, or its unit. pk1, dpk1: the stress (3,3) as a function
    of F, and its differential of F and D, of the same arguments besides, if they are not to follow from psi. dilatation,
    modulus: theta(J) and the name of a parameter, or "lam", of which psi has modulus/2 theta^2 besides: mean dilatation then
    keeps linear tets from locking. functions: lane functions written by hand, as the modules of taisoft.fem.laws, instead.
    A name may be registered again, but those of the package. Raises SceneError with what is wrong and where.
    """
    what = f"law {name!r}"
    if not isinstance(name, str) or not name.isidentifier():
        raise SceneError(f"law: name must be an identifier, not {name!r}")
    if name in [law.name for law in SHIPPED]:
        raise SceneError(f"{what}: the name is that of a law of the package")
    if functions is not None:
        projected = "prepare_projected" if hasattr(functions, "prepare_projected") else "hessian_eigen"
        missing = [one for one in (*LANE_FUNCTIONS, projected) if not hasattr(functions, one)]
        if missing or any(one is not None for one in (psi, parameters, pk1, dpk1, dilatation, modulus)):
            raise SceneError(f"{what}: its lane functions lack {missing[0]}" if missing else f"{what}: functions are given alone")
        law = Law(name, functions=functions)
    else:
        if not isinstance(parameters or {}, Mapping):
            raise SceneError(f"{what}: parameters must be a dict of units or Parameters, not {value_text(parameters)}")
        made = {key: one if isinstance(one, Parameter) else Parameter(one) for key, one in (parameters or {}).items()}
        law = Law(name, psi, made, dilatation, modulus or "", pk1=pk1, dpk1=dpk1)
        _check_arguments(law)
    before = LAWS.get(name)
    if before is not None and open_kind() is not None:
        raise SceneError(f"{what}: it is registered already, and a simulator that may use it is open: close that first")
    LAWS[name] = law
    try:
        found = check_law(name)
    except BaseException as error:
        if before is None:
            del LAWS[name]
        else:
            LAWS[name] = before  # at its place among the others
        free = [f"{key} = 1" for key, one in law.parameters.items() if one.default is None]
        if isinstance(error, SceneError) and "unstable at rest" in str(error) and free:
            rule = f"checked with {', '.join(free)}: give a Parameter a default to check the law with another"
            raise SceneError(f"{error} ({rule})") from None
        raise
    if not found.is_finite_inverted:
        rule = "is not finite where det F < 0, so a tet that inverts ends a run: ts.positive(J) continues J"
        warnings.warn(f"{what} {rule}", UserWarning, stacklevel=2)
    return found


def _check_arguments(law: Law) -> None:
    """Raise SceneError if arguments of psi, pk1 and dpk1 are not known, or parameters not used."""
    what = f"law {law.name!r}"
    for name, function in (("psi", law.psi), ("pk1", law.pk1), ("dpk1", law.dpk1), ("dilatation", law.dilatation)):
        try:
            _ = None if function is None and name != "psi" else arguments_of(function)
        except (TypeError, ValueError):
            raise SceneError(f"{what}: {name} must be a function with named arguments, not {value_text(function)}") from None
    if (law.pk1 is None) != (law.dpk1 is None):
        raise SceneError(f"{what}: pk1 and dpk1 must be given together")
    for name, one in law.parameters.items():
        if not isinstance(name, str) or not name.isidentifier():
            raise SceneError(f"{what}: a parameter's name must be an identifier, not {name!r}")
        if one.default is not None:
            one.checked(one.default, f"{what}: the default of {name}")
        if name in TAKEN or hasattr(Material, name):
            raise SceneError(f"{what}: a parameter cannot be called {name}, which has a meaning already")
    numbers = tuple(law.parameters) or HOOKE
    for function, extra in ((law.psi, ()), (law.pk1, ()), (law.dpk1, ("D",))):
        for name in () if function is None else arguments_of(function):
            if name not in (*VARIABLES, *numbers, *extra):
                there = f"{', '.join(VARIABLES)} and its numbers {', '.join(numbers)}"
                hint = " (I3 is J**2)" if name == "I3" else checks.nearest(name, (*VARIABLES, *numbers))
                raise SceneError(f"{what}: {name} is no variable{hint}; there are {there}")
    if not law.variables:
        raise SceneError(f"{what}: psi depends on none of {', '.join(VARIABLES)}")
    if {"stretches", "trS"} & set(law.variables) and {"F", "I4"} & set(law.variables):
        raise SceneError(f"{what}: psi of principal stretches cannot depend on F or I4 as well")
    if {"stretches", "trS"} & set(law.variables) and law.pk1 is not None:
        raise SceneError(f"{what}: pk1 and dpk1 are functions of F and invariants, and psi beside them, too")
    if law.pk1 is not None and law.dilatation is not None:
        raise SceneError(f"{what}: pk1 and dpk1 are the whole stress, which leaves nothing to a dilatation")
    if (law.dilatation is not None or law.modulus) and law.modulus not in numbers or bool(law.modulus) != bool(law.dilatation):
        raise SceneError(f"{what}: dilatation needs a modulus, one of {', '.join(numbers)}, not {law.modulus!r}")
    for name in law.parameters:
        if name not in law.arguments and name != law.modulus:
            raise SceneError(f"{what}: its parameter {name} is not used")


def check_law(name: str, **numbers: float) -> LawCheck:
    """Check a law against differences in F, in f64: psi, stress, tangent, what kernels use of them, rest, rotations; and f32.

    numbers: of its parameters, or young and poisson, for which it is checked; by default those of each `Parameter`, or 1. Raises
    SceneError with what is wrong and where.
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
    w, Q = np.linalg.eigh(_columns(name, large, used, False))
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
    one, other = (energy([space.fixed(s[k]) for k in order]).value * np.ones(20) for order in ((0, 1, 2), (1, 2, 0)))
    F = s.T[:, :, None] * np.eye(3)
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
