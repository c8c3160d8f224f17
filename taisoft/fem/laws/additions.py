"""A law with additions: energies that come on top of any law, with data of their own at each tet or quadrature point.

An addition is a module with N_CONSTANTS and N_PREPARED, and these lane functions of F and its own constants p:
`psi(F, p)`, `add_stress(P, F, p)`, `prepared(F, p)` (N_PREPARED entries), `add_differential(T, F, S, D)`,
`add_block(K, F, S, ga, gb)`. `constants(m, g, b, q, real)` gives the N_CONSTANTS numbers of quadrature point q of block b in
lanes, and `applies(body)` says on the host whether a body has the addition. An isotropic one has
`add_eigen(A, symmetric, antisymmetric, s, p)`, so that it is projected with the law, exactly. Others have
`prepared_projected(F, p)` (N_PROJECTED entries) and `add_projected(T, S, D)`, whose differential has no negative eigenvalue.
The constants of a law with additions are the law's own, those of each addition, and the pressure of mean dilatation, if any.
"""

from dataclasses import dataclass
from typing import Any

from taisoft.backend.tracing import untraced
from taisoft.fem.laws.projection import clamp_9x9, dpk1_isotropic, prepare_isotropic, upper


@dataclass(frozen=True)
class WithAdditions:
    """A law with additions, with the functions of a law."""

    law: Any
    additions: tuple  # modules, isotropic ones first

    def __getattr__(self, name: str) -> Any:
        if name in ("SOFTENS_BELOW", "POINT_SECONDS", "NAME", "N_CONSTANTS", "dilatation", "dilatation_gradient"):
            return getattr(self.law, name)
        raise AttributeError(name)

    @property
    def n_added(self) -> int:
        """Number of the additions' constants."""
        return sum(one.N_CONSTANTS for one in self.additions)

    def _of_law(self, p: list) -> list:
        return p[: self.law.N_CONSTANTS] + p[self.law.N_CONSTANTS + self.n_added :]

    def _of_additions(self, p: list) -> list[tuple[Any, list]]:
        """Each addition with its constants."""
        return self._split(p[self.law.N_CONSTANTS :], "N_CONSTANTS")

    def _split(self, values: list, size: str) -> list[tuple[Any, list]]:
        """Each addition with its values, whose number is its attribute `size`, in a list that begins with them."""
        found, at = [], 0
        for one in self.additions:
            n = getattr(one, size, 0)
            found.append((one, values[at : at + n]))
            at += n
        return found

    def _tail(self, S: list, size: str) -> tuple[list, list[tuple[Any, list]]]:
        """What the law has prepared, and what each addition has."""
        at = len(S) - sum(getattr(one, size, 0) for one in self.additions)
        return S[:at], self._split(S[at:], size)

    @untraced
    def psi(self, F, p):
        """Energy density [Pa]."""
        total = self.law.psi(F, self._of_law(p))
        for one, constants in self._of_additions(p):
            total = total + one.psi(F, constants)
        return total

    @untraced
    def pk1(self, F, p):
        """First Piola-Kirchhoff stress [Pa]."""
        P = self.law.pk1(F, self._of_law(p))
        for one, constants in self._of_additions(p):
            P = one.add_stress(P, F, constants)
        return P

    @untraced
    def prepare(self, F, p):
        """Precompute for `dpk1` and `block`: what the law does, then each addition."""
        S = self.law.prepare(F, self._of_law(p))
        for one, constants in self._of_additions(p):
            S = S + one.prepared(F, constants)
        return S

    @untraced
    def dpk1(self, F, S, D):
        """Differential of the stress along D [Pa], with S = prepare(F, p)."""
        own, others = self._tail(S, "N_PREPARED")
        T = self.law.dpk1(F, own, D)
        for one, prepared in others:
            T = one.add_differential(T, F, prepared, D)
        return T

    @untraced
    def block(self, F, S, ga, gb):
        """Differential of (P g_b)_i along the displacement gradient e_k (x) g_a: nine entries (i, k) [Pa/m^2]."""
        own, others = self._tail(S, "N_PREPARED")
        K = self.law.block(F, own, ga, gb)
        for one, prepared in others:
            K = one.add_block(K, F, prepared, ga, gb)
        return K

    @untraced
    def hessian_eigen(self, s, p):
        """Second derivatives of the law and of isotropic additions in the SVD frame [Pa], see `projection`."""
        modes = self.law.hessian_eigen(s, self._of_law(p))
        for one, constants in self._of_additions(p):
            modes = one.add_eigen(*modes, s, constants) if hasattr(one, "add_eigen") else modes
        return modes

    @untraced
    def prepare_projected(self, F, p):
        """Precompute for `dpk1_projected`: the law with isotropic additions, then each of the others."""
        if hasattr(self.law, "hessian_eigen"):
            S = prepare_isotropic(self, F, p)
        else:
            S = clamp_9x9(self._upper(F, p))
        for one, constants in self._of_additions(p):
            S = S + (one.prepared_projected(F, constants) if hasattr(one, "add_projected") else [])
        return S

    def _upper(self, F: list, p: list) -> list:
        """Upper triangle of the second derivative of a law that is not isotropic, with isotropic additions."""
        H, zero = self.law.prepare(F, self._of_law(p)), 0.0 * F[0]
        for one, constants in self._of_additions(p):
            if hasattr(one, "add_eigen"):
                S = one.prepared(F, constants)
                for k in range(9):
                    T = one.add_differential([zero] * 9, F, S, [zero + float(k == i) for i in range(9)])
                    for i in range(k + 1):
                        H[upper(i, k)] = H[upper(i, k)] + T[i]
        return H

    @untraced
    def dpk1_projected(self, S, D):
        """Stress differential along D [Pa] by the sum of the projected second derivatives, with S = prepare_projected(F, p)."""
        own, others = self._tail(S, "N_PROJECTED")
        T = dpk1_isotropic(own, D) if hasattr(self.law, "hessian_eigen") else self.law.dpk1_projected(own, D)
        for one, prepared in others:
            T = one.add_projected(T, prepared, D) if hasattr(one, "add_projected") else T
        return T
