"""The registry of material laws by name.

A law has NAME, N_CONSTANTS, SOFTENS_BELOW (the compressive stretch below which it softens, 0 for none), POINT_SECONDS
(approximate time of a quadrature point in an explicit step, which sizes launches), `constants(mu, lam)` (on the host, its numbers
per body) and the lane functions `psi`, `pk1`, `prepare`, `dpk1`, `block` (the same differential along e_k (x) g_a, times g_b, for
assembly) and `hessian_eigen(s, p)`, see `projection`. Tests over the registry check them by finite differences.

For mean dilatation a law is psi(F; mu, lambda) = psi(F; mu, 0) + lambda/2 theta(F)^2, with the lane functions `dilatation`,
theta, and `dilatation_gradient`. p then has one more entry at its end, a pressure q [Pa], for which `pk1`, `prepare`, `dpk1`,
`block` and `hessian_eigen` are those of psi(F; p) + q theta(F).

A law that is not isotropic, or one `WithAdditions`, has `prepare_projected(F, p)` and `dpk1_projected(S, D)` instead of
`hessian_eigen`: a positive semi-definite part of its second derivative.
"""

from typing import Any
from weakref import WeakKeyDictionary

import taichi as ti

from taisoft.backend.tracing import untraced
from taisoft.fem.laws import corotational, st_venant_kirchhoff, stable_neo_hookean
from taisoft.fem.laws.additions import WithAdditions
from taisoft.fem.laws.from_energy import EnergyLaw, lanes_of
from taisoft.fem.laws.projection import dpk1_isotropic, prepare_isotropic
from taisoft.scene.law import Law
from taisoft.scene.laws import registered

# written by hand
LAWS = {law.NAME: law for law in (st_venant_kirchhoff, corotational, stable_neo_hookean)}


def law_of(name: str, additions: tuple = ()) -> Any:
    """The law of a name with `additions` (modules, see there)."""
    return WithAdditions(lane_law(name), additions) if additions else lane_law(name)


_made: "WeakKeyDictionary[Law, EnergyLaw]" = WeakKeyDictionary()  # each is compiled once


def lane_law(name: str) -> Any:
    """The law of a name in lanes."""
    law = registered(name)
    if law.psi is None:
        return law.functions or LAWS[name]
    if law not in _made:
        _made[law] = lanes_of(law)
    return _made[law]


@untraced
def n_constants(law):
    """Number of the constants p of a law with its additions, without the pressure of mean dilatation."""
    return law.N_CONSTANTS + (law.n_added if hasattr(law, "n_added") else 0)


@ti.func
def prepare_projected(law: ti.template(), F, p):
    """Precompute for `dpk1_projected`: a list whose entries depend on the law."""
    if ti.static(hasattr(law, "prepare_projected")):
        return law.prepare_projected(F, p)
    else:
        return prepare_isotropic(law, F, p)


@ti.func
def dpk1_projected(law: ti.template(), S, D):
    """Stress differential along D [Pa] by the projected second derivative, with S = prepare_projected(law, F, p)."""
    if ti.static(hasattr(law, "dpk1_projected")):
        return law.dpk1_projected(S, D)
    else:
        return dpk1_isotropic(S, D)
