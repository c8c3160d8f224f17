"""The laws that scenes know, by name: those of `taisoft.fem.laws`, and Mooney-Rivlin, Gent, Fung and Ogden.

These four depend on the isochoric part of F, J^(-1/3) F, and have bulk/2 (J - 1)^2 besides. Below J = 0.1, and where a logarithm
or an exponential would not be finite, they are continued twice differentiably, so that every F has a finite stress.
Sources: Mooney, J. Appl. Phys. 11, 1940; Rivlin, Phil. Trans. R. Soc. A 241, 1948; Gent, Rubber Chem. Technol. 69, 1996; Fung,
Am. J. Physiol. 213, 1967, in the isotropic form of Demiray, J. Biomech. 5, 1972; Ogden, Proc. R. Soc. A 326, 1972.
"""

import numpy as np

from taisoft.errors import SceneError
from taisoft.scene.law import Law, Parameter

LARGEST_EXPONENT = 40.0  # of Fung's law: beyond, its exponential becomes a parabola, since f32 ends at exp(88)
SHEAR, BULK = Parameter("Pa", above=0.0), Parameter("Pa", above=0.0)


def positive(x, floor: float = 0.1):
    """Return x where it is above `floor`, and a positive number that tends to 0 below, twice differentiable.

    For energy densities with roots or logarithms of J, which would not be finite for inverted tets. x: a variable of psi.
    """
    t = np.minimum((x - floor) / floor, 0.0)
    return np.maximum(x - floor, 0.0) + floor / (1.0 - t + t * t)


def mooney_rivlin(I1, I2, J, c1, c2):
    """c1 (I1 J^(-2/3) - 3) + c2 (I2 J^(-4/3) - 3); the shear modulus is 2 (c1 + c2)."""
    root = positive(J) ** (-2.0 / 3.0)
    return c1 * (I1 * root - 3.0) + c2 * (I2 * root * root - 3.0)


def gent(I1, J, shear, limit):
    """-shear limit/2 ln(1 - (I1 J^(-2/3) - 3) / limit): chains are stretched out where I1 J^(-2/3) - 3 = limit."""
    stretch = (I1 * positive(J) ** (-2.0 / 3.0) - 3.0) / limit
    return -0.5 * shear * limit * np.log(positive(1.0 - stretch, 0.01))


def fung(I1, J, shear, exponent):
    """shear / (2 exponent) (exp(exponent (I1 J^(-2/3) - 3)) - 1)."""
    z = exponent * (I1 * positive(J) ** (-2.0 / 3.0) - 3.0)
    capped = np.minimum(z, LARGEST_EXPONENT)
    rest = z - capped
    return 0.5 * shear / exponent * (np.exp(capped) * (1.0 + rest + 0.5 * rest * rest) - 1.0)


def ogden(stretches, J, mu1, alpha1, mu2, alpha2, mu3, alpha3):
    """Sum of mu_p / alpha_p (s_1^alpha_p + s_2^alpha_p + s_3^alpha_p - 3), s the isochoric stretches.

    The shear modulus is half the sum of mu_p alpha_p.
    """
    root = positive(J) ** (-1.0 / 3.0)
    s = [positive(one) * root for one in stretches]
    total = 0.0
    for mu, alpha in ((mu1, alpha1), (mu2, alpha2), (mu3, alpha3)):
        total = total + mu / alpha * (s[0] ** alpha + s[1] ** alpha + s[2] ** alpha - 3.0)
    return total


def _volume(J):
    return J - 1.0


_OGDEN = {
    "mu1": Parameter("Pa"),
    "alpha1": Parameter(default=2.0),
    "mu2": Parameter("Pa", default=0.0),
    "alpha2": Parameter(default=-2.0),
    "mu3": Parameter("Pa", default=0.0),
    "alpha3": Parameter(default=4.0),
    "bulk": BULK,
}
SHIPPED = (
    Law("st_venant_kirchhoff"),
    Law("corotational"),
    Law("stable_neo_hookean"),
    Law(
        "mooney_rivlin", mooney_rivlin, {"c1": Parameter("Pa"), "c2": Parameter("Pa", default=0.0), "bulk": BULK}, _volume, "bulk"
    ),
    Law("gent", gent, {"shear": SHEAR, "limit": Parameter(default=30.0, above=0.1), "bulk": BULK}, _volume, "bulk"),
    Law("fung", fung, {"shear": SHEAR, "exponent": Parameter(default=1.0, above=0.0), "bulk": BULK}, _volume, "bulk"),
    Law("ogden", ogden, _OGDEN, _volume, "bulk"),
)
LAWS: dict[str, Law] = {law.name: law for law in SHIPPED}  # `fem.laws.registration` adds others


def registered(name: str, what: str = "") -> Law:
    """Return the law of a name. what: start of messages. Raises SceneError if this process does not know it."""
    if name not in LAWS:
        raise SceneError(f"{what}law {name!r} is not registered in this process: call ts.register_law before")
    return LAWS[name]
