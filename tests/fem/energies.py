"""Energy densities of laws for tests: those written by hand again, and one of each kind."""

import numpy as np

import taisoft as ts
from taisoft.fem.laws.evaluate import evaluate_differential
from tests.dynamics.scenes import COR, SNH, SVK


def E(F):
    return (F.T @ F - np.eye(3)) / 2


def svk_of_F(F, mu, lam):
    return mu * np.trace(E(F) @ E(F)) + lam / 2 * np.trace(E(F)) ** 2


def svk_stress(F, mu, lam):
    return F @ (2 * mu * E(F) + lam * np.trace(E(F)) * np.eye(3))


def svk_differential(F, D, mu, lam):
    dE = (F.T @ D + D.T @ F) / 2
    return D @ (2 * mu * E(F) + lam * np.trace(E(F)) * np.eye(3)) + F @ (2 * mu * dE + lam * np.trace(dE) * np.eye(3))


def holzapfel(I1, I4, J, c, k1, k2, bulk):
    fibres = np.exp(k2 * np.maximum(I4 - 1, 0) ** 2) - 1
    return c * (I1 * ts.positive(J) ** (-2 / 3) - 3) + k1 / (2 * k2) * fibres + bulk / 2 * (J - 1) ** 2


def neo_hookean(I1, J, mu, lam):
    m, l = 4 / 3 * mu, lam + 5 / 6 * mu
    return m / 2 * (I1 - 3) + l / 2 * (J - 1 - m / l + m / (4 * l)) ** 2 - m / 2 * np.log(I1 + 1)


OLD = {  # those written by hand again, from their energies alone
    SVK: lambda I1, I2, mu, lam: mu / 4 * (I1**2 - 2 * I2 - 2 * I1 + 3) + lam / 8 * (I1 - 3) ** 2,
    COR: lambda I1, trS, mu, lam: mu * (I1 - 2 * trS + 3) + lam / 2 * (trS - 3) ** 2,
    SNH: neo_hookean,
}


def polynomial(I1, J, c1, c2, bulk):
    return c1 * (I1 - 3 - 2 * np.log(J)) + c2 * (I1 - 3) ** 2 + bulk / 2 * (J - 1) ** 2


POLYNOMIAL = {"c1": ts.Parameter("Pa", above=0.0), "c2": "Pa", "bulk": "Pa"}


def tangent(law, F, numbers, projected=False):
    units = np.eye(9).reshape(9, 3, 3)
    return np.stack([evaluate_differential(law, F, D, projected=projected, **numbers).reshape(-1, 9) for D in units], axis=-1)


def block(material, **arguments) -> ts.Scene:
    """A block that is held at its left end and pulled at its right one."""
    scene = ts.Scene()
    body = scene.add_body(ts.box_mesh((2, 1, 1), (2, 1, 1)), material, name="block", **arguments)
    body.fix(lambda X: X[:, 0] < -0.9)
    body.add_force(lambda X: X[:, 0] > 0.9, (3e4, 1e4, 0))
    return scene
