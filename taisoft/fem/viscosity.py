"""Viscosity by Maxwell branches: springs of 2 mu g_i in series with dashpots, beside the law, which is the relaxed response.

The elastic strain M_i of branch i follows dev E, E = (F^T F - I)/2, and relaxes:
    dM/dt = d(dev E)/dt - M/tau,   S = 2 mu g M,   energy mu g |M|^2,   dissipation rate 2 mu g |M|^2 / tau >= 0.
Volumes stay elastic. If E changes linearly over an interval h, then with z = h/tau, exactly,
    M' = e M + k d(dev E),   e = exp(-z),   k = (1 - e)/z,
    dissipation 2 mu g (z k (1 + e)/2 |M|^2 + z k^2 M : dE + c |dE|^2),   c = (1 - k)/z - k^2/2.
So the stress at the end is the derivative of sum mu g/k |e M + k (dev E - dev E_0)|^2, which `laws.viscosity` adds to the law:
    mu' = mu sum g k,   Z = dev E_0 - sum g e M / sum g k.
With h = 0 these are the instantaneous response, whose energy is what the branches store. Forces at the end of an implicit step
use its h, those of the midpoint rule half of it; explicit steps move M with every change of x, and use h = 0.
Source: Simo, "On a fully three-dimensional finite-strain viscoelastic damage model", Comput. Methods Appl. Mech. Eng. 60, 1987;
Simo, Hughes, "Computational Inelasticity", 1998, section 10.3; here with the branches' own strain in place of their stress.
Weak: at large strains a branch is a spring of St. Venant-Kirchhoff's law, whatever the law beside it.
"""

from dataclasses import dataclass
from typing import Any

import numpy as np
import taichi as ti

from taisoft.backend.arrays import Count
from taisoft.backend.runtime import kernel
from taisoft.backend.tracing import arithmetic
from taisoft.fem.dependents import place_all
from taisoft.fem.lanes import broadcast, differences, gradient_at, rest_gradients, volumes, weight_at
from taisoft.fem.laws import viscosity as law
from taisoft.fem.laws.st_venant_kirchhoff import green_strain
from taisoft.fem.model import Group, Layout, Model, Setup
from taisoft.mesh.quadratic import quadrature
from taisoft.scene.scene import Scene

STRAIN, HEAT, BRANCHES = 0, 6, 7  # in a point's history: dev E, dissipated energy density [Pa], M of each branch
SERIES = 14  # terms of (1 - k)/z where z < 1/2; the next is below 1e-17


@dataclass(frozen=True, eq=False)
class Viscosity:
    """Maxwell branches, and their state at the quadrature points of bodies that have some. Numbers are f64."""

    n_branches: int
    n_points: Count
    n_decays: Count
    first_point: Any  # (n_blocks) i32: row of each block's first point; of blocks without branches that of the next one
    stiffness: Any  # (n_points, n_branches, lanes): mu g [Pa]; 0 where a region has fewer branches
    decay_of: Any  # (n_points, n_branches, lanes) i32: row in `decay`
    relaxation_time: Any  # (n_decays): different tau [s]
    decay: Any  # (n_decays, 4): e, k, z, c over the present interval
    history: Any  # (n_points, 7 + 6 n_branches, lanes): see STRAIN; symmetric matrices are (xx, yy, zz, yz, xz, xy)
    constants: Any  # (n_points, 8, lanes): see `laws.viscosity`


def model_fields(setup: Setup) -> dict[str, Any]:
    """Fields of Model: the branches, if a body has any."""
    if not setup.on["viscosity"]:
        return {}
    arena, (first, tets, _) = setup.arena, _points(setup.scene, setup.layout)
    times = _by_tet(setup.scene)[..., 0]
    distinct, row = np.unique(times, return_inverse=True)
    n, (n_points, lanes) = times.shape[1], tets.shape
    table = Viscosity(
        n_branches=n,
        n_points=n_points,
        n_decays=len(distinct),
        first_point=arena.filled("branch_point", ti.i32, first),
        stiffness=arena.filled("branch_stiffness", ti.f64, stiffness_table(setup.scene, setup.layout)),
        decay_of=arena.filled("branch_decay_of", ti.i32, row.reshape(times.shape)[tets].swapaxes(1, 2)),
        relaxation_time=arena.filled("relaxation_time", ti.f64, distinct),
        decay=arena.field("branch_decay", ti.f64, (len(distinct), 4)),
        history=arena.field("branch_history", ti.f64, (n_points, BRANCHES + 6 * n, lanes)),
        constants=arena.field("branch_constants", ti.f64, (n_points, law.N_CONSTANTS, lanes)),
    )
    return {"viscosity": table}


def _points(scene: Scene, layout: Layout) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """First point (n_blocks,) of each block, tets (n_points, lanes) of each point, and its number (n_points, lanes) by tets."""
    counts = [len(quadrature(b.quadrature_degree).weights) if law.applies(b) else 0 for b in scene.bodies]
    by_tet = np.repeat(counts, np.diff(layout.tet_start))
    tets = layout.tet_of_lane.reshape(-1, layout.lanes)
    by_block = by_tet[tets[:, 0]]
    first, first_of_tet = np.cumsum(by_block) - by_block, np.cumsum(by_tet) - by_tet
    point = np.arange(by_block.sum()) - np.repeat(first, by_block)  # of its block
    tets = np.repeat(tets, by_block, axis=0)
    return first, tets, first_of_tet[tets] + point[:, None]


def _by_tet(scene: Scene) -> np.ndarray:
    """Relaxation time [s] and fraction of the branches of all tets (n_tets, n_branches, 2)."""
    tables = [body.composition.branches for body in scene.bodies]
    n = max(table.shape[1] for table in tables)
    padded = [np.concatenate([table, np.tile((1.0, 0.0), (len(table), n - table.shape[1], 1))], axis=1) for table in tables]
    return np.concatenate(padded)


def stiffness_table(scene: Scene, layout: Layout) -> np.ndarray:
    """mu g (n_points, n_branches, lanes) [Pa] of the branches."""
    mu = np.concatenate([np.broadcast_to(body.composition.lame[0], body.mesh.n_tets) for body in scene.bodies])
    return (mu[:, None] * _by_tet(scene)[..., 1])[_points(scene, layout)[1]].swapaxes(1, 2)


def history_by_tet(m: Model, scene: Scene, layout: Layout) -> np.ndarray:
    """The history (n, 7 + 6 n_branches) by tets and their points, whatever the lanes."""
    number, values = _points(scene, layout)[2], m.viscosity.history.to_numpy().swapaxes(1, 2)
    out = np.empty((int(number.max()) + 1, values.shape[2]))
    out[number] = values
    return out


def set_history(m: Model, scene: Scene, layout: Layout, by_tet: np.ndarray) -> None:
    """Set the history from `history_by_tet`."""
    m.viscosity.history.from_numpy(by_tet[_points(scene, layout)[2]].swapaxes(1, 2))


def viscous_groups(m: Model) -> tuple[Group, ...]:
    """The groups whose law has branches."""
    return tuple(g for g in m.groups if hasattr(g.law, "additions") and law in g.law.additions)


# --- at a quadrature point ----------------------------------------------------------------------------------------------


@arithmetic
def _deviator(F):
    """dev E of F: six numbers."""
    E = green_strain(F)
    t = (E[0] + E[4] + E[8]) / 3.0
    return [E[0] - t, E[4] - t, E[8] - t, E[5], E[2], E[1]]


@arithmetic
def _inner(A, B):
    """A : B of symmetric matrices of six numbers."""
    off = A[3] * B[3] + A[4] * B[4] + A[5] * B[5]
    return A[0] * B[0] + A[1] * B[1] + A[2] * B[2] + 2.0 * off


@ti.func
def _load(m: ti.template(), values: ti.template(), at, first: ti.template(), n: ti.template()):
    return [ti.Vector([values[at, first + k, l] for l in ti.static(range(m.lanes))]) for k in ti.static(range(n))]


@ti.func
def _store(m: ti.template(), values: ti.template(), at, first: ti.template(), A):
    for k in ti.static(range(len(A))):
        for l in ti.static(range(m.lanes)):
            values[at, first + k, l] = A[k][l]


@ti.func
def _decays(m: ti.template(), at, i: ti.template()):
    """e, k, z and c of branch i at point `at`."""
    row = [m.viscosity.decay_of[at, i, l] for l in ti.static(range(m.lanes))]
    return [ti.Vector([m.viscosity.decay[row[l], j] for l in ti.static(range(m.lanes))]) for j in ti.static(range(4))]


@ti.func
def _zeros(m: ti.template(), n: ti.template()):
    return [broadcast(ti.cast(0.0, ti.f64), m.lanes) for k in ti.static(range(n))]


@ti.func
def _set_constants(m: ti.template(), at, E, sums):
    """Set the constants of point `at`. E: dev E_0; sums: mu g times k, e^2/k |M|^2 and e M, over the branches."""
    Y = [sums[2 + j] / ti.select(sums[0] > 0.0, sums[0], 1.0) for j in ti.static(range(6))]  # dev E_0 - Z
    _store(m, m.viscosity.constants, at, 0, [sums[0], sums[1] - sums[0] * _inner(Y, Y)])
    _store(m, m.viscosity.constants, at, 2, [E[j] - Y[j] for j in ti.static(range(6))])


@ti.func
def _look_ahead(m: ti.template(), at):
    """Set the constants of point `at` for the interval of `decay`, which begins at its history."""
    (v,) = ti.static((m.viscosity,))
    sums = _zeros(m, 8)
    for i in ti.static(range(v.n_branches)):
        (stiff,) = _load(m, v.stiffness, at, i, 1)
        e, k, _, _ = _decays(m, at, i)
        M = _load(m, v.history, at, BRANCHES + 6 * i, 6)
        sums[0] += stiff * k
        sums[1] += stiff * e * e / k * _inner(M, M)
        for j in ti.static(range(6)):
            sums[2 + j] += stiff * e * M[j]
    E = _load(m, v.history, at, STRAIN, 6)
    _set_constants(m, at, E, sums)


@ti.func
def _follow(m: ti.template(), at, F):
    """Move the history of point `at` over the interval of `decay` to F, and set its constants for no interval."""
    (v,) = ti.static((m.viscosity,))
    sums = _zeros(m, 8)
    E, start = _deviator(F), _load(m, v.history, at, STRAIN, 6)
    D = [E[j] - start[j] for j in ti.static(range(6))]
    (heat,) = _load(m, v.history, at, HEAT, 1)
    for i in ti.static(range(v.n_branches)):
        (stiff,) = _load(m, v.stiffness, at, i, 1)
        e, k, z, c = _decays(m, at, i)
        M = _load(m, v.history, at, BRANCHES + 6 * i, 6)
        heat += 2.0 * stiff * (z * k * (0.5 * (1.0 + e) * _inner(M, M) + k * _inner(M, D)) + c * _inner(D, D))
        N = [e * M[j] + k * D[j] for j in ti.static(range(6))]
        _store(m, v.history, at, BRANCHES + 6 * i, N)
        sums[0] += stiff
        sums[1] += stiff * _inner(N, N)
        for j in ti.static(range(6)):
            sums[2 + j] += stiff * N[j]
    _store(m, v.history, at, STRAIN, E + [heat])
    _set_constants(m, at, E, sums)


# --- loops: at the top level of a kernel, or inside another loop on one thread --------------------------------------------


@ti.func
def set_interval(m: ti.template(), h):
    """Set the decays over an interval h [s]."""
    for row in range(m.viscosity.n_decays):
        z = h / m.viscosity.relaxation_time[row]
        e, k, w = ti.exp(-z), ti.cast(1.0, ti.f64), ti.cast(0.0, ti.f64)
        if z < 0.5:
            for n in range(SERIES):  # of w = (1 - k)/z, by Horner's rule
                w = (1.0 - z * w) / (SERIES + 1 - n)
            k = 1.0 - z * w
        else:
            k = (1.0 - e) / z
            w = (1.0 - k) / z
        for j, number in ti.static(enumerate((e, k, z, w - 0.5 * k * k))):
            m.viscosity.decay[row, j] = number


@ti.func
def follow(m: ti.template()):
    """Move the branches, if there are any, to the present x, over the interval of `set_interval`."""
    if ti.static(m.viscous):
        place_all(m)
        for g in ti.static(viscous_groups(m)):
            ti.loop_config(serialize=m.serial)
            for b in range(g.first, g.last):
                X, N = differences(m, g, m.state.x, b, ti.f64), rest_gradients(m, b, ti.f64)
                for q in range(g.n_points):
                    F = gradient_at(m, g, X, N, b, q, ti.f64)
                    _follow(m, m.viscosity.first_point[b] + q, F)


# --- kernels ------------------------------------------------------------------------------------------------------------


@kernel
def begin_interval(m: ti.template(), h: ti.f64):
    """Let stresses be those at the end of an interval h [s] that begins at the history; 0: the instantaneous response."""
    set_interval(m, h)
    ti.loop_config(serialize=m.serial)
    for at in range(m.viscosity.n_points):
        _look_ahead(m, at)


@kernel
def end_interval(m: ti.template(), h: ti.f64):
    """Move the branches to the present x over an interval h [s]; stresses are then the instantaneous response."""
    set_interval(m, h)
    follow(m)


@kernel
def copy_history(m: ti.template(), to: ti.template(), source: ti.template()):
    """Copy a history."""
    ti.loop_config(serialize=m.serial)
    for at in range(m.viscosity.n_points):
        for k in range(ti.static(BRANCHES + 6 * m.viscosity.n_branches)):
            for l in ti.static(range(m.lanes)):
                to[at, k, l] = source[at, k, l]


@kernel
def dissipated_energies(m: ti.template(), tets: ti.types.ndarray()):
    """Compute the energies that branches have dissipated by lane (n_blocks * lanes,) [J]; leave those of others."""
    for g in ti.static(viscous_groups(m)):
        ti.loop_config(serialize=m.serial)
        for b in range(g.first, g.last):
            heat = broadcast(ti.cast(0.0, ti.f64), m.lanes)
            for q in range(g.n_points):
                (own,) = _load(m, m.viscosity.history, m.viscosity.first_point[b] + q, HEAT, 1)
                heat += weight_at(m, g, b, q, ti.f64) * own
            lost = volumes(m, b, ti.f64) * heat
            for l in ti.static(range(m.lanes)):
                tets[b * m.lanes + l] = lost[l]
