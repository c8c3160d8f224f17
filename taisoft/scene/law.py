"""Material laws as scenes know them: their names, their numbers, and energy densities from which all else follows.

A law is written by hand for kernels (`taisoft.fem.laws`), with Young's modulus and Poisson's ratio as numbers, or given by its
energy density psi as a function of F, of invariants or of principal stretches, with numbers of its own. Of the second kind this
module evaluates psi, stress and tangent in NumPy: for the moduli at rest, and for checks.
"""

import inspect
from collections.abc import Callable
from dataclasses import dataclass, field
from functools import cached_property
from typing import Any

import numpy as np

from taisoft.errors import SceneError, reason
from taisoft.scene import checks
from taisoft.scene.jets import Jet, Space

# of an isotropic law: I1 = tr C, I2 = (I1^2 - tr C^2) / 2, C = F^T F; J = det F; trS, the sum of the principal stretches
INVARIANTS = ("I1", "I2", "J", "trS")
VARIABLES = (*INVARIANTS, "stretches", "I4", "F")
HOOKE = ("mu", "lam")  # Lamé's parameters of young and poisson, of a law without parameters
PAIRS = ((0, 1), (0, 2), (1, 2))
FIBRE = np.array([1.0, 0.0, 0.0])  # a direction, where it does not matter


@dataclass(frozen=True)
class Parameter:
    """A number of a law: its unit, its range, and its value where a material does not give one (None: it must)."""

    unit: str = ""
    default: float | None = None
    above: float | None = None
    minimum: float | None = None
    maximum: float | None = None

    @property
    def sample(self) -> float:
        """The default, or a number in the range: 1 if that is in it."""
        if self.default is not None:
            return self.default
        value = 1.0 if self.above is None or self.above < 1.0 else 2.0 * self.above
        value = value if self.minimum is None else max(value, self.minimum)
        return value if self.maximum is None else min(value, self.maximum)

    def checked(self, value, what: str) -> float:
        """Return a value in the range. Raises SceneError."""
        return checks.number(value, what, above=self.above, minimum=self.minimum, maximum=self.maximum, unit=self.unit)

    def check_all(self, values: np.ndarray, tets: np.ndarray, what: str) -> None:
        """Raise SceneError for the first of the tets (k,) whose value, of (m,), is not in the range."""
        low, high = -np.inf if self.minimum is None else self.minimum, np.inf if self.maximum is None else self.maximum
        own = values[tets]
        bad = (own < low) | (own > high) | (own <= (-np.inf if self.above is None else self.above))
        if bad.any():
            tet = int(tets[np.argmax(bad)])
            self.checked(float(values[tet]), f"{what} of tet {tet}")


@dataclass(frozen=True, eq=False)
class Law:
    """A law. psi: its energy density [Pa], None if it is written by hand; its arguments are some of VARIABLES, HOOKE, parameters.

    pk1, dpk1: the stress P and its differential along D, of F, D, VARIABLES and numbers, where they are not to follow from psi.
    dilatation: theta(J), of which the energy density has modulus/2 theta^2 besides psi; it may be averaged over patches.
    """

    name: str
    psi: Callable | None = None
    parameters: dict[str, Parameter] = field(default_factory=dict)
    dilatation: Callable | None = None
    modulus: str = ""
    pk1: Callable | None = None
    dpk1: Callable | None = None
    functions: Any = None  # in lanes, if it is written by hand and not one of taisoft.fem.laws

    @cached_property
    def arguments(self) -> tuple[str, ...]:
        """Names of the arguments of psi, pk1 and dpk1."""
        given = [arguments_of(one) for one in (self.psi, self.pk1, self.dpk1) if one is not None]
        return tuple(dict.fromkeys(name for names in given for name in names))

    @property
    def variables(self) -> list[str]:
        """Those of VARIABLES on which psi depends."""
        return [name for name in VARIABLES if name in self.arguments]

    @property
    def numbers(self) -> tuple[str, ...]:
        """Names of the numbers of a material that the law takes."""
        return tuple(self.parameters) or ("young", "poisson")

    def checked(self, given: dict[str, Any], what: str) -> dict[str, float]:
        """Return a value for each parameter. given: some of them. what: start of messages. Raises SceneError."""
        for name in given:
            checks.index(name, list(self.parameters), f"{what}law {self.name}: no parameter", SceneError)
        for name, one in self.parameters.items():
            if given.get(name, one.default) is None:
                raise SceneError(f"{what}law {self.name} needs {name}{one.unit and f' [{one.unit}]'}")
        return {name: one.checked(given.get(name, one.default), what + name) for name, one in self.parameters.items()}

    def moduli(self, numbers: dict[str, Any]) -> tuple[Any, Any]:
        """Return Young's modulus [Pa] and Poisson's ratio at rest, floats or (k,). numbers: all parameters. Raises SceneError."""
        mu, lam = self.lame(numbers)
        with np.errstate(all="ignore"):
            young, poisson = mu * (3.0 * lam + 2.0 * mu) / (lam + mu), lam / (2.0 * (lam + mu))
        bad = ~((mu > 0.0) & (3.0 * lam + 2.0 * mu > 0.0))
        if bad.any():
            first, k = int(np.argmax(bad)), lam + 2.0 / 3.0 * mu
            own = ", ".join(f"{name} = {np.broadcast_to(value, mu.shape)[first]:g}" for name, value in numbers.items())
            found = f"shear modulus {mu[first]:.3g} and bulk modulus {k[first]:.3g}"
            raise SceneError(f"law {self.name!r} is unstable at rest with {own}: {found} must be above 0")
        return (young, poisson) if any(np.ndim(one) for one in numbers.values()) else (float(young[0]), float(poisson[0]))

    @property
    def has_dilatation(self) -> bool:
        """Whether it has a volumetric part that can be averaged over patches; laws written by hand have lambda/2 theta^2."""
        if self.psi is not None:
            return self.dilatation is not None
        return self.functions is None or hasattr(self.functions, "dilatation")

    @property
    def is_classic(self) -> bool:
        """Whether it is one of those written by hand in taisoft.fem.laws."""
        return self.psi is None and self.functions is None

    def numbers_of(self, material: Any) -> dict[str, float]:
        """Return the numbers of a `Material` by which psi is evaluated: Lamé's, and the parameters."""
        return {"mu": material.mu, "lam": material.lam, **material.parameters}

    def fingerprint(self) -> list:
        """Return values by which two laws of a name differ: numbers of psi and the stress, rounded, at two F."""
        if self.psi is None:
            return []
        F = np.array([[[1.1, 0.1, 0.0], [0.05, 0.9, 0.1], [0.0, -0.1, 1.2]], [[0.8, 0.0, 0.1], [0.1, 1.1, 0.0], [0.1, 0.2, 0.9]]])
        psi, P, _ = evaluate(self, F, self.sample())
        return [*self.parameters, *(f"{value:.6g}" for value in (*psi, *P.reshape(-1)))]

    @property
    def is_isotropic(self) -> bool:
        """Whether psi is a function of the principal stretches."""
        return self.pk1 is None and not {"F", "I4"} & set(self.arguments)

    def energy(self, space: Space, variables: dict[str, Any], numbers: dict[str, Any], pressure: Any = None) -> Jet:
        """Return psi, and its volumetric part, plus pressure * theta if a pressure is given.

        variables: jets by name, "J" always; numbers: values of HOOKE and the parameters.
        """
        known = {**variables, **{name: space.fixed(value) for name, value in numbers.items()}}
        total = self._call(self.psi, known)
        if not isinstance(total, (Jet, int, float, np.number)):
            raise SceneError(f"law {self.name!r}: psi must return a number, not {type(total).__name__}")
        total = total if isinstance(total, Jet) else space.fixed(float(total))
        if self.dilatation is not None:
            theta = self.volume_strain(variables["J"])
            total = total + 0.5 * known[self.modulus] * theta * theta
            total = total if pressure is None else total + space.fixed(pressure) * theta
        return total

    def _call(self, function: Callable, known: dict[str, Any]) -> Any:
        try:
            return function(**{name: known[name] for name in arguments_of(function)})
        except Exception as error:  # a user's function may raise anything
            hint = "; det F is the variable J" if "'det'" in str(error) else ""
            raise SceneError(f"law {self.name!r}: its function failed: {reason(error)}{hint}") from error

    def volume_strain(self, J: Jet) -> Jet:
        """Return theta of J."""
        try:
            theta = self.dilatation(J)
            return theta if isinstance(theta, Jet) else J.space.fixed(float(theta))
        except Exception as error:  # a user's function may raise anything
            raise SceneError(f"law {self.name!r}: its dilatation failed: {reason(error)}") from error

    def stress(self, space: Space, F: list, D: list | None, numbers: dict[str, Any], fibre: list) -> list:
        """Return the given P, or its differential along D if that is not None: nine values. F, D: nine values."""
        matrices = {name: jets_of_F(space, one, True) for name, one in (("F", F), ("D", D)) if one is not None}
        known = invariants(self, matrices["F"], fibre) | matrices | {name: space.fixed(one) for name, one in numbers.items()}
        function = self.pk1 if D is None else self.dpk1
        made = np.asarray(self._call(function, known), dtype=object)
        if made.shape != (3, 3):
            raise SceneError(f"law {self.name!r}: pk1 and dpk1 must return a matrix (3, 3), not of shape {made.shape}")
        made = made.reshape(9)
        return [one.value if isinstance(one, Jet) else one for one in made]

    def sample(self) -> dict[str, float]:
        """Return numbers for checks: those of the parameters' `sample`, or Lamé's for a Poisson's ratio of 0.3."""
        given = {name: one.sample for name, one in self.parameters.items()}
        return given | (dict(zip(HOOKE, (1.0 / 2.6, 0.3 / 0.52))) if not self.parameters else {})

    def rest_tangent(self, numbers: dict[str, Any], fibres: np.ndarray = FIBRE) -> np.ndarray:
        """Return d2psi/dF2 at F = I (k,9,9) [Pa]. numbers: values of the parameters, floats or (k,). fibres: (3,) or (k,3)."""
        k = max([1, *(np.size(value) for value in numbers.values()), np.size(fibres) // 3])
        return evaluate(self, np.broadcast_to(np.eye(3), (k, 3, 3)), numbers, fibres)[2]

    def lame(self, numbers: dict[str, Any]) -> tuple[np.ndarray, np.ndarray]:
        """Return Lamé's parameters (mu, lambda) at rest (k,) [Pa]; of an anisotropic law their means over directions (Voigt)."""
        C = self.rest_tangent(numbers).reshape(-1, 3, 3, 3, 3)
        a, b = np.einsum("eiijj->e", C), np.einsum("eijij->e", C)
        return (3.0 * b - a) / 30.0, (2.0 * a - b) / 15.0


def arguments_of(function: Callable) -> tuple[str, ...]:
    """Return the names of the arguments of a function."""
    return tuple(inspect.signature(function).parameters)


def invariants(law: Law, F: Any, fibre: list) -> dict[str, Any]:
    """Return the variables of a law as jets of the entries of F, an array (3,3) of jets. fibre: three values."""
    C = F.T @ F
    cofactors = np.array([F[1, (k + 1) % 3] * F[2, (k + 2) % 3] - F[1, (k + 2) % 3] * F[2, (k + 1) % 3] for k in range(3)])
    known = {"F": F, "J": F[0] @ cofactors, "I1": np.trace(C)}
    if "I2" in law.arguments:
        known["I2"] = 0.5 * (known["I1"] * known["I1"] - np.trace(C @ C))
    if "I4" in law.arguments:
        along = [F[i, 0] * fibre[0] + F[i, 1] * fibre[1] + F[i, 2] * fibre[2] for i in range(3)]
        known["I4"] = along[0] * along[0] + along[1] * along[1] + along[2] * along[2]
    return known


def jets_of_F(space: Space, F: list, fixed: bool = False) -> np.ndarray:
    """Return (3,3) independent variables, or jets without derivatives, with the values F, row by row."""
    jets = np.empty(9, dtype=object)
    jets[:] = [space.fixed(one) if fixed else space.variable(one, k) for k, one in enumerate(F)]
    return jets.reshape(3, 3)


def stretch_modes(space: Space, psi: Jet, s: list) -> tuple[list, list, list]:
    """Return the second derivative in the frame of F's SVD, see `fem.laws.projection`: the block A and the eigenvalues.

    psi: of the principal stretches s, largest first. The eigenvalue (psi_i - psi_j) / (s_i - s_j) of a symmetric mode is, where
    two stretches nearly coincide, (psi_ii + psi_jj) / 2 - psi_ij, which errs by the square of their difference; that of an
    antisymmetric one, with plus signs, where they nearly cancel.
    """
    zero = space.bind(0.0 * (s[0] + psi.value))
    first = [space.bind(zero + psi.first.get(k, 0.0)) for k in range(3)]
    A = [space.bind(zero + psi.second.get((min(i, j), max(i, j)), 0.0)) for i in range(3) for j in range(3)]
    symmetric, antisymmetric = [], []
    small = space.bind(space.eps ** (1.0 / 3.0) * abs(s[0]) + 1e-30)
    for i, j in PAIRS:
        for sign, modes in ((-1.0, symmetric), (1.0, antisymmetric)):
            width = s[i] + sign * s[j]
            close = space.bind(abs(width) <= small)
            quotient = (first[i] + sign * first[j]) / space.select(close, 1.0 + zero, width)
            modes.append(space.select(close, 0.5 * (A[4 * i] + A[4 * j]) + sign * A[3 * i + j], quotient))
    return A, symmetric, antisymmetric


def evaluate(law: Law, F: np.ndarray, numbers: dict[str, Any], fibre: np.ndarray = FIBRE) -> tuple[np.ndarray, ...]:
    """Return psi (k,), P (k,3,3) and d2psi/dF2 (k,9,9) [Pa] at F (k,3,3), in the precision of F; not finite where psi is not.

    fibre: (3,) or (k,3), the unit direction of I4.
    """
    space, k = Space(), len(F)
    space.eps = float(np.finfo(F.dtype).eps)
    with np.errstate(all="ignore"):
        if {"stretches", "trS"} & set(law.arguments):
            return _from_stretches(law, space, F, numbers)
        values, direction = list(F.reshape(k, 9).T), [space.fixed(one) for one in np.asarray(fibre, F.dtype).T]
        psi = law.energy(space, invariants(law, jets_of_F(space, values), direction), numbers)
        P, H = np.zeros((k, 9), F.dtype), np.zeros((k, 9, 9), F.dtype)
        if law.pk1 is not None:
            units = [[float(i == j) for i in range(9)] for j in range(9)]
            P.T[:] = law.stress(space, values, None, numbers, direction)
            H.T[:] = [law.stress(space, values, one, numbers, direction) for one in units]
            psi.first = psi.second = {}
        for i, value in psi.first.items():
            P[:, i] = value
        for (i, j), value in psi.second.items():
            H[:, i, j] = H[:, j, i] = value
    return psi.value * np.ones(k, F.dtype), P.reshape(k, 3, 3), H


def of_stretches(law: Law, space: Space, numbers: dict[str, Any], pressure: Any = None) -> Callable:
    """Return the energy as a function of three jets, the principal stretches."""

    def energy(s: list[Jet]) -> Jet:
        squares = [one * one for one in s]
        I1, I2 = squares[0] + squares[1] + squares[2], squares[0] * (squares[1] + squares[2]) + squares[1] * squares[2]
        sums = {"I1": I1, "I2": I2, "trS": s[0] + s[1] + s[2]}
        return law.energy(space, {"stretches": s, "J": s[0] * s[1] * s[2], **sums}, numbers, pressure)

    return energy


def _from_stretches(law: Law, space: Space, F: np.ndarray, numbers: dict[str, Any]) -> tuple[np.ndarray, ...]:
    U, s, Vt = np.linalg.svd(F)
    flip = np.linalg.det(U) * np.linalg.det(Vt) < 0.0
    U[flip, :, 2], s[flip, 2] = -U[flip, :, 2], -s[flip, 2]
    psi = of_stretches(law, space, numbers)([space.variable(one, i) for i, one in enumerate(s.T)])
    A, symmetric, antisymmetric = stretch_modes(space, psi, list(s.T))
    k = len(F)
    K = np.zeros((k, 3, 3, 3, 3), F.dtype)
    for i in range(3):
        for j in range(3):
            K[:, i, i, j, j] = A[3 * i + j]
    for (i, j), plus, minus in zip(PAIRS, symmetric, antisymmetric):
        K[:, i, j, i, j] = K[:, j, i, j, i] = 0.5 * (plus + minus)
        K[:, i, j, j, i] = K[:, j, i, i, j] = 0.5 * (plus - minus)
    first = np.stack([np.broadcast_to(psi.first.get(i, 0.0), (k,)) for i in range(3)], axis=1)
    H = np.einsum("eia,ejb,eabcd,ekc,eld->eijkl", U, Vt.swapaxes(1, 2), K, U, Vt.swapaxes(1, 2), optimize=True)
    return psi.value * np.ones(k, F.dtype), np.einsum("eia,ea,eaj->eij", U, first, Vt), H.reshape(k, 9, 9)
