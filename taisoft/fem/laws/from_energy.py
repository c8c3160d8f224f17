"""Laws from an energy density: stress, tangent and projection in lanes, differentiated while kernels are traced.

An isotropic law is a function of I1, I2, J and trS, with closed forms of everything from its derivatives by these:
    P = 2 psi_1 F + 2 psi_2 (I1 F - F C) + psi_J cof F + psi_S R,   C = F^T F,   F = R S,
or of the principal stretches in the frame of F's SVD. Any other one is differentiated by the nine entries of F, and its second
derivative is projected by eigenvalues of the 9x9 matrix. The constants p of a law are Lamé's parameters at rest, its own
numbers, with I4 the fibre direction, and the pressure of mean dilatation if there is one.
Source of the modes: Smith, de Goes, Kim, "Analytic Eigensystems for Isotropic Distortion Energies", ACM TOG 38(1), 2019.
"""

from typing import Any

import numpy as np
import taichi as ti

import taisoft.fem.laws.corotational as corotational
from taisoft.backend.private import Expr, impl
from taisoft.backend.tracing import untraced
from taisoft.fem.laws.invariants import (
    add_block_of_I2,
    add_block_of_J,
    add_outer,
    add_scaled,
    added,
    block_of_modes,
    combined,
    invariants_of,
    outer,
    scaled,
    second_gradient,
    second_gradient_differential,
    svd_of,
)
from taisoft.fem.laws.projection import clamp_9x9, dpk1_isotropic, local_array, upper
from taisoft.fem.math3 import add_to_diagonal, cofactor, cofactor_differential, cross, ddot, dot, matmul_nt, matmul_tn, transform
from taisoft.scene.jets import Jet, Space
from taisoft.scene.law import HOOKE, INVARIANTS, Law, invariants, jets_of_F, of_stretches, stretch_modes

UPPER = [(i, j) for i in range(9) for j in range(i, 9)]  # of a symmetric 9x9 matrix


class Lanes(Space):
    """SIMD lanes of a kernel that is being traced, as values."""

    log, exp, sqrt, tanh, select = (staticmethod(getattr(ti, name)) for name in ("log", "exp", "sqrt", "tanh", "select"))
    power = staticmethod(lambda x, n: x**n)

    def __init__(self, like: Expr, order: int):
        """like: a vector of lanes, which gives the precision."""
        super().__init__(order)
        self._real, self._zero = like.element_type(), 0.0 * like
        self.eps = float(np.finfo(np.float64 if self._real == ti.f64 else np.float32).eps)

    def constant(self, value: float) -> Expr:
        """A literal would have the precision of Taichi's default."""
        return Expr(float(value), dtype=self._real)

    def vector(self, value: Any) -> Any:
        """A value in all lanes."""
        is_vector = isinstance(value, Expr) and value.is_tensor()
        return self.bind(value if is_vector else value + self._zero)

    def bind(self, value: Any) -> Any:
        """A variable of the kernel."""
        return impl.expr_init(value) if isinstance(value, Expr) else value


class EnergyLaw:
    """What the laws from an energy density share. Compared by identity, as the modules of other laws are."""

    SOFTENS_BELOW, POINT_SECONDS = 0.0, 300e-9  # the latter per quadrature point of an explicit step, on one core

    def __init__(self, law: Law):
        self.law, self.NAME = law, law.name
        self.names = (*HOOKE, *law.parameters)
        self.N_FIBRE = 3 if "I4" in law.arguments else 0
        self.N_CONSTANTS = len(self.names) + self.N_FIBRE
        if law.dilatation is None:
            self.dilatation = self.dilatation_gradient = None

    def constants(self, mu: float | np.ndarray, lam: float | np.ndarray, *own: float | np.ndarray) -> tuple:
        """Lamé's parameters at rest, and the law's own numbers."""
        return mu, lam, *own

    def _numbers(self, p: list) -> tuple[dict[str, Any], Any]:
        """Numbers by name, and the pressure or None."""
        return dict(zip(self.names, p)), p[self.N_CONSTANTS] if len(p) > self.N_CONSTANTS else None

    def _at_rest(self, space: Space, p: list) -> Any:
        """psi at F = I, which is counted as 0."""
        one = space.fixed(1.0)
        rest = jets_of_F(space, [1.0, 0.0, 0.0, 0.0, 1.0, 0.0, 0.0, 0.0, 1.0], True)
        known = {"F": rest, "J": one, "I1": 3.0 * one, "I2": 3.0 * one, "I4": one, "stretches": [one, one, one], "trS": 3.0 * one}
        return self.law.energy(space, known, self._numbers(p)[0]).value

    def _volume(self, F: list, order: int) -> Jet:
        space = Lanes(F[0], order)
        return self.law.volume_strain(space.variable(space.bind(dot(F, cofactor(F))), 0))

    @untraced
    def psi(self, F, p):
        """Energy density [Pa], 0 at rest."""
        psi, space = self._energy(F, p, 0)
        return space.vector(psi.value - self._at_rest(space, p))

    @untraced
    def dilatation(self, F):
        """theta(J)."""
        return self._volume(F, 0).value + 0.0 * F[0]

    @untraced
    def dilatation_gradient(self, F):
        """Derivative of `dilatation` by F."""
        theta = self._volume(F, 1)
        return scaled(theta.first.get(0, 0.0) + 0.0 * F[0], cofactor(F))


class StretchLaw(EnergyLaw):
    """A law of the principal stretches."""

    def _energy(self, F: list, p: list, order: int) -> tuple[Jet, Lanes]:
        return self._of_stretches(svd_of(F)[9:12], p, order)

    def _of_stretches(self, s: list, p: list, order: int) -> tuple[Jet, Lanes]:
        space = Lanes(s[0], order)
        energy = of_stretches(self.law, space, *self._numbers(p))
        return energy([space.variable(one, k) for k, one in enumerate(s)]), space

    @untraced
    def hessian_eigen(self, s, p):
        """Second derivatives in the SVD frame [Pa], over the stretches s: see `projection`."""
        psi, space = self._of_stretches(s, p, 2)
        return stretch_modes(space, psi, s)

    @untraced
    def pk1(self, F, p):
        """First Piola-Kirchhoff stress [Pa]."""
        frame = svd_of(F)
        U, V = frame[:9], frame[12:]
        psi, space = self._of_stretches(frame[9:12], p, 1)
        first = [space.vector(psi.first.get(k, 0.0)) for k in range(3)]
        return matmul_nt([U[3 * i + k] * first[k] for i in range(3) for k in range(3)], V)

    @untraced
    def prepare(self, F, p):
        """Precompute for `dpk1` and `block`: U, V, and the modes."""
        frame = svd_of(F)
        A, symmetric, antisymmetric = self.hessian_eigen(frame[9:12], p)
        return frame[:9] + frame[12:] + A + [0.5 * one for one in symmetric + antisymmetric]

    @untraced
    def dpk1(self, F, S, D):
        """Differential of the stress along D [Pa], with S = prepare(F, p)."""
        return dpk1_isotropic(S, D)

    @untraced
    def block(self, F, S, ga, gb):
        """Differential of (P g_b)_i along the displacement gradient e_k (x) g_a: nine entries (i, k) [Pa/m^2]."""
        return block_of_modes(S, ga, gb)


class InvariantLaw(StretchLaw):
    """A law of I1, I2, J and trS, by whose numbers 0 to 3 derivatives are known.

    It needs the stretches for the projection alone.
    """

    POINT_SECONDS = 60e-9  # per quadrature point of an explicit step, on one core

    def __init__(self, law: Law):
        super().__init__(law)
        space = Space()
        rest = {name: space.variable(value, k) for k, (name, value) in enumerate(zip(INVARIANTS, (3.0, 3.0, 1.0, 3.0)))}
        psi = law.energy(space, rest, law.sample())
        self.uses, self.pairs = set(psi.first), set(psi.second)  # derivatives that are not 0 for every F

    def _energy(self, F: list, p: list, order: int, R: list | None = None) -> tuple[Jet, Lanes]:
        space, values = Lanes(F[0], order), invariants_of(F)
        if 3 in self.uses:
            values = [*values, ddot(R or corotational.rotation(F), F)]
        used = {name: space.variable(space.bind(value), k) for k, (name, value) in enumerate(zip(INVARIANTS, values))}
        return self.law.energy(space, used, *self._numbers(p)), space

    @untraced
    def pk1(self, F, p):
        """First Piola-Kirchhoff stress [Pa]."""
        R = corotational.rotation(F) if 3 in self.uses else None
        psi, space = self._energy(F, p, 1, R)
        made, total = (lambda F: scaled(2.0, F), second_gradient, cofactor, lambda _: R), None
        for k, factor in psi.first.items():
            factor, gradient = space.vector(factor), made[k](F)
            total = scaled(factor, gradient) if total is None else add_scaled(total, factor, gradient)
        return total

    @untraced
    def prepare(self, F, p):
        """Precompute for `dpk1` and `block`: derivatives of psi, then the gradients of the invariants, I1, C and B."""
        turned = corotational.prepare(F, [0.0 * F[0], 0.0 * F[0]])[:18] if 3 in self.uses else []
        psi, space = self._energy(F, p, 2, turned[:9])
        first = [space.vector(psi.first.get(k, 0.0)) for k in range(4)]
        second = [space.vector(psi.second.get(pair, 0.0)) for pair in SECOND]
        quadratic = [*second_gradient(F), *matmul_tn(F, F), *matmul_nt(F, F)] if 1 in self.uses else []
        return first + second + cofactor(F) + turned + quadratic

    def _parts(self, F: list, S: list) -> tuple[list, list, list, list]:
        """From `prepare`: gradients of the invariants; K of `corotational.prepare`; C and B."""
        G, at = S[14:23], 41 if 3 in self.uses else 23
        return [scaled(2.0, F), S[at : at + 9], G, S[23:32]], S[32:41], S[at + 9 : at + 18], S[at + 18 : at + 27]

    def _coupled(self, k: int, S: list) -> list[tuple[int, Any]]:
        """The invariants l with which psi couples invariant k, and psi_kl."""
        pairs = [(l, (min(k, l), max(k, l))) for l in range(4)]
        return [(l, S[4 + SECOND.index(pair)]) for l, pair in pairs if pair in self.pairs]

    @untraced
    def dpk1(self, F, S, D):
        """Differential of the stress along D [Pa], with S = prepare(F, p)."""
        gradients, K, C, _ = self._parts(F, S)
        total = scaled(2.0 * S[0], D)
        if 2 in self.uses:
            total = add_scaled(total, S[2], cofactor_differential(F, D))
        if 1 in self.uses:
            total = add_scaled(total, S[1], second_gradient_differential(F, C, D))
        if 3 in self.uses:
            R = gradients[3]
            total = added(total, corotational.rotation_differential(R, K, matmul_nt(D, R), S[3]))
        for k in range(4):
            terms = [factor * ddot(gradients[l], D) for l, factor in self._coupled(k, S)]
            if terms:
                total = add_scaled(total, sum(terms[1:], terms[0]), gradients[k])
        return total

    @untraced
    def block(self, F, S, ga, gb):
        """Differential of (P g_b)_i along the displacement gradient e_k (x) g_a: nine entries (i, k) [Pa/m^2]."""
        gradients, K, C, B = self._parts(F, S)
        diagonal = 2.0 * S[0] * dot(ga, gb)
        coupled = [k for k in range(4) if self._coupled(k, S)]
        a, b = ({k: transform(gradients[k], g) for k in coupled} for g in (ga, gb))
        total = None
        for k in coupled:
            y = combined([(factor, a[l]) for l, factor in self._coupled(k, S)])
            total = outer(b[k], y) if total is None else add_outer(total, b[k], y)
        total = [0.0 * diagonal] * 9 if total is None else total
        if 1 in self.uses:
            total = add_block_of_I2(total, F, C, B, S[1], ga, gb)
        if 3 in self.uses:
            Ra, Rb = transform(gradients[3], ga), transform(gradients[3], gb)
            total = added(total, corotational.rotation_block(K, Ra, Rb, S[3]))
        if 2 not in self.uses:
            return add_to_diagonal(total, diagonal)
        return add_block_of_J(total, diagonal, transform(F, cross(ga, gb)), S[2])


SECOND = [(k, l) for k in range(4) for l in range(k, 4)]  # pairs of invariants


class GeneralLaw(EnergyLaw):
    """Any other law: a function of F, or of I4 and others."""

    def _energy(self, F: list, p: list, order: int) -> tuple[Jet, Lanes]:
        space, (numbers, pressure) = Lanes(F[0], order), self._numbers(p)
        return self.law.energy(space, invariants(self.law, jets_of_F(space, F), self._fibre(space, p)), numbers, pressure), space

    def _fibre(self, space: Lanes, p: list) -> list:
        return [space.fixed(one) for one in p[len(self.names) : self.N_CONSTANTS]]

    @untraced
    def given(self, F, D, p):
        """The given stress, or its given differential along D if that is not None [Pa]."""
        space = Lanes(F[0], 0)
        values = self.law.stress(space, F, D, self._numbers(p)[0], self._fibre(space, p))
        return [space.vector(one) for one in values]

    @untraced
    def pk1(self, F, p):
        """First Piola-Kirchhoff stress [Pa]."""
        if self.law.pk1 is not None:
            return self.given(F, None, p)
        psi, space = self._energy(F, p, 1)
        return [space.vector(psi.first.get(k, 0.0)) for k in range(9)]

    @untraced
    def prepare(self, F, p):
        """Precompute for `dpk1` and `block`: the upper triangle of the second derivative."""
        if self.law.pk1 is not None:
            return tangent(self, F, p)
        psi, space = self._energy(F, p, 2)
        return [space.vector(psi.second.get(pair, 0.0)) for pair in UPPER]

    @untraced
    def dpk1(self, F, S, D):
        """Differential of the stress along D [Pa], with S = prepare(F, p)."""
        return self.dpk1_projected(S, D)

    @untraced
    def block(self, F, S, ga, gb):
        """Differential of (P g_b)_i along the displacement gradient e_k (x) g_a: nine entries (i, k) [Pa/m^2]."""
        entries = []
        for i in range(3):
            for k in range(3):
                rows = [dot([S[upper(3 * i + j, 3 * k + l)] for l in range(3)], ga) for j in range(3)]
                entries.append(dot(rows, gb))
        return entries

    @untraced
    def prepare_projected(self, F, p):
        """The upper triangle of the second derivative's positive semi-definite part."""
        return clamp_9x9(self.prepare(F, p))

    @untraced
    def dpk1_projected(self, S, D):
        """Stress differential along D [Pa], with S = prepare_projected(F, p)."""
        return [ddot([S[upper(i, j)] for j in range(9)], D) for i in range(9)]


def lanes_of(law: Law) -> EnergyLaw:
    """The functions in lanes of a law that is given by its energy density."""
    if not law.is_isotropic:
        return GeneralLaw(law)
    return StretchLaw(law) if "stretches" in law.arguments else InvariantLaw(law)


@ti.func
def tangent(law: ti.template(), F, p):
    """The upper triangle of the second derivative from the given differential, a column at a time, which compiles faster."""
    store = local_array(F[0][0], [0.0] * (81 * ti.static(F[0].n)))
    for column in range(9):
        D = [0.0 * F[k] + ti.cast(column == k, ti.i32) for k in ti.static(range(9))]
        T = law.given(F, D, p)
        for k in ti.static(range(9)):
            for q in ti.static(range(F[0].n)):
                store[(9 * column + k) * F[0].n + q] = T[k][q]
    return [
        ti.Vector([store[(9 * j + i) * F[0].n + q] for q in ti.static(range(F[0].n))])
        for i in ti.static(range(9))
        for j in ti.static(range(i, 9))
    ]
