"""Mean dilatation: the dilatation theta(F) of a law is averaged over patches, so that volumes are constrained patch by patch.

With psi(F; mu, lambda) = psi(F; mu, 0) + lambda/2 theta(F)^2 (`laws`), the energy of a body is
    sum_e V sum_q w_q psi(F_q; mu, 0) + sum_p V_p lambda_p/2 theta_p^2,   theta_p = sum_(e in p) V sum_q w_q theta(F_q) / V_p,
with the patches' volumes V_p and mean lambda_p. Its derivative has the stress P(F; mu, 0) + lambda_p theta_p dtheta/dF; its
second derivative adds lambda_p / V_p times the square of the patch's gradient, see `linear.patch_terms`. A patch is an aggregate
of linear tets of one region, somewhat fewer than there are nodes, or one quadratic tet.
Sources: Nagtegaal, Parks and Rice, "On numerically accurate finite element solutions in the fully plastic range", Comput.
Methods Appl. Mech. Eng. 4, 1974; de Souza Neto, Andrade Pires and Owen, "F-bar-based linear triangles and tetrahedra for finite
strain analysis of nearly incompressible solids", Int. J. Numer. Methods Eng. 62, 2005 (patches; the stress there is not the
derivative of an energy).
Weak: linear tets still bend too little, as at any Poisson's ratio, and the pressures of neighbouring patches may alternate.
"""

from dataclasses import dataclass
from typing import Any

import numpy as np
import taichi as ti

from taisoft.backend.arrays import Count
from taisoft.fem import reference
from taisoft.fem.lanes import (
    broadcast,
    deformation_gradient,
    differences,
    gradient_at,
    law_constants,
    position_differences,
    rest_gradients,
    rest_gradients_of_F,
    volumes,
    weight_at,
)
from taisoft.fem.math3 import ddot
from taisoft.fem.model import Setup
from taisoft.scene.scene import Scene


@dataclass(frozen=True, eq=False)
class MeanDilatation:
    """Patches of tets and their present dilatations."""

    n_patches: Count
    patch: Any  # (n_blocks, lanes) i32: patch of each tet; 0 for tets without and in padding
    tet_start: Any  # (n_patches + 1) i32: rows of tet
    tet: Any  # i32: the patches' tets, block times lanes plus lane
    volume: Any  # (n_patches) f64 [m^3]
    modulus: Any  # (n_patches) f64: mean lambda [Pa]
    content: Any  # (n_blocks * lanes) f64 [m^3]: volume times dilatation of each tet, or times its rate; scratch
    dilatation: Any  # (n_patches) f64
    rate: Any  # (n_patches) f64: change of the dilatation along a velocity or displacement


def model_fields(setup: Setup) -> dict[str, Any]:
    """Fields of Model: the patches of bodies with mean dilatation, if there are any."""
    if not setup.on["mean_dilatation"]:
        return {}
    layout, arena = setup.layout, setup.arena
    of_tet, volume = np.full(layout.tet_start[-1], -1), []
    for k, body in enumerate(setup.scene.bodies):
        if body.dilatation == "mean":
            patch = reference.tet_patches(body)
            of_tet[layout.tets(k)] = patch + sum(len(own) for own in volume)
            volume.append(np.bincount(patch, reference.rest_volumes(body)))
    mean = np.flatnonzero(of_tet >= 0)
    tets = mean[np.argsort(of_tet[mean], kind="stable")]
    volume, n_lanes = np.concatenate(volume), len(layout.tet_of_lane)
    n, patch = len(volume), np.maximum(of_tet[layout.tet_of_lane], 0).reshape(-1, layout.lanes)
    table = MeanDilatation(
        n_patches=n,
        patch=arena.filled("patch", ti.i32, patch),
        tet_start=arena.filled("patch_start", ti.i32, np.searchsorted(of_tet[tets], np.arange(n + 1))),
        tet=arena.filled("patch_tet", ti.i32, layout.lane_of_tet[tets]),
        volume=arena.filled("patch_volume", ti.f64, volume),
        modulus=arena.filled("patch_modulus", ti.f64, patch_moduli(setup.scene)),
        content=arena.field("patch_content", ti.f64, n_lanes),
        dilatation=arena.field("patch_dilatation", ti.f64, n),
        rate=arena.field("patch_rate", ti.f64, n),
    )
    return {"mean_dilatation": True, "mean": table}


def patch_moduli(scene: Scene) -> np.ndarray:
    """Mean lambda (n_patches,) [Pa] of the patches of all bodies."""
    return np.concatenate([reference.patch_moduli(b, reference.tet_patches(b)) for b in scene.bodies if b.dilatation == "mean"])


@ti.func
def patch_values(m: ti.template(), b, values: ti.template(), real: ti.template()):
    """The values of the patches of the tets of block b, times their mean lambda, per lane."""
    patch = [m.mean.patch[b, q] for q in ti.static(range(m.lanes))]
    return ti.Vector([ti.cast(m.mean.modulus[patch[q]] * values[patch[q]], real) for q in ti.static(range(m.lanes))])


@ti.func
def patch_energy(m: ti.template(), b):
    """Energy density lambda_p/2 theta_p^2 [Pa] of the patches of the tets of block b, per lane, in f64."""
    patch = [m.mean.patch[b, q] for q in ti.static(range(m.lanes))]
    theta = [m.mean.dilatation[patch[q]] for q in ti.static(range(m.lanes))]
    return ti.Vector([0.5 * m.mean.modulus[patch[q]] * theta[q] * theta[q] for q in ti.static(range(m.lanes))])


@ti.func
def stress_constants(m: ti.template(), g: ti.template(), b, real: ti.template()):
    """`law_constants`, with the pressure of mean dilatation at the end if group g has it."""
    p = law_constants(m, g, b, real)
    if ti.static(g.mean_dilatation):
        return p + [patch_values(m, b, m.mean.dilatation, real)]
    else:
        return p


@ti.func
def store_content(m: ti.template(), b, content):
    """Set the content of the tets of block b."""
    for q in ti.static(range(m.lanes)):
        m.mean.content[b * m.lanes + q] = ti.cast(content[q], ti.f64)


@ti.func
def element_dilatation(m: ti.template(), g: ti.template(), b):
    """Set the content of the tets of block b to their volumes times mean dilatations.

    It is computed in f64: near incompressibility the rounding of F in f32, times lambda, would exceed all other stress errors.
    """
    X, M = differences(m, g, m.state.x, b, ti.f64), rest_gradients(m, b, ti.f64)
    total = broadcast(ti.cast(0.0, ti.f64), m.lanes)
    for q in range(g.n_points):
        F = gradient_at(m, g, X, M, b, q, ti.f64)
        total += weight_at(m, g, b, q, ti.f64) * g.law.dilatation(F)
    store_content(m, b, volumes(m, b, ti.f64) * total)


@ti.func
def element_rate(m: ti.template(), g: ti.template(), b, u: ti.template()):
    """Set the content of the tets of block b to their volumes times the mean changes of dilatation along the nodal field u."""
    X, N = position_differences(m, g, b), rest_gradients_of_F(m, g, b)
    U, M = differences(m, g, u, b, m.real), rest_gradients(m, b, m.real)
    total = broadcast(ti.cast(0.0, m.real), m.lanes)
    for q in range(g.n_points):
        F = deformation_gradient(m, g, X, N, b, q, m.real)
        dF = gradient_at(m, g, U, M, b, q, m.real)
        G = g.law.dilatation_gradient(F)
        total += weight_at(m, g, b, q, m.real) * ddot(G, dF)
    store_content(m, b, volumes(m, b, m.real) * total)


@ti.func
def patch_mean(m: ti.template(), p):
    """Mean of the tets' contents over patch p."""
    total = ti.cast(0.0, ti.f64)
    for k in range(m.mean.tet_start[p], m.mean.tet_start[p + 1]):
        total += m.mean.content[m.mean.tet[k]]
    return total / m.mean.volume[p]


@ti.func
def find_dilatations(m: ti.template()):
    """Compute the patches' dilatations at x, if there are any, as top-level loops of a kernel."""
    if ti.static(m.mean_dilatation):
        for g in ti.static(m.groups):
            if ti.static(g.mean_dilatation):
                ti.loop_config(serialize=m.serial)
                for b in range(g.first, g.last):
                    element_dilatation(m, g, b)
        ti.loop_config(serialize=m.serial)
        for p in range(m.mean.n_patches):
            m.mean.dilatation[p] = patch_mean(m, p)


@ti.func
def find_rates(m: ti.template(), u: ti.template()):
    """Compute their changes along the nodal field u, in the same way."""
    if ti.static(m.mean_dilatation):
        for g in ti.static(m.groups):
            if ti.static(g.mean_dilatation):
                ti.loop_config(serialize=m.serial)
                for b in range(g.first, g.last):
                    element_rate(m, g, b, u)
        ti.loop_config(serialize=m.serial)
        for p in range(m.mean.n_patches):
            m.mean.rate[p] = patch_mean(m, p)
