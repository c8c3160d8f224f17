"""Impact with restitution before an implicit step: a velocity jump at x_n.

    (M + tau^2 K)(v+ - v_n) = J^T p,   u = J v+ - min_velocity,   tau = SPREAD dt,
with Signorini's and Coulomb's laws between p and u; `min_velocity` is the required separation speed of a contact
(`contact.restitution`). With M alone the nodes at the contact would reverse while the body behind them moves on. It would
vibrate, and implicit Euler dissipates vibrations whose period is not many steps. tau^2 K suppresses these: a mode of angular
frequency w gets 1 / (1 + (w tau)^2) of its part of the impulse. With w tau = 1, implicit Euler loses 1 - 1/e of the energy in
a period, which gives SPREAD = 2 pi. A body that waves cross within the step rebounds as a whole. A soft one, or one in short
steps, rebounds at its contacts alone, and elasticity does the rest.

The impact must not create energy. The kinetic energy changes by
    E(s) = s (D.M v_n + p.u_fixed) + s^2 D.M D / 2 <= s sum p_n max(0, min_velocity - |u_n|) / 2,   D = v+ - v_n,
where u_fixed is the part of u_n from obstacles and prescribed nodes, whose work is external, and the right side is energy that
implicit Euler lost before and may be given back. Newton's law violates this if friction reverses the slip (Kane's paradox), or
if bodies vibrate: then the jump is scaled by s < 1. The slack of the inequality is the energy taken by tau^2 K. In the step
after the impact, contacts are constrained to their rebound displacement, which pushes on the lagging body behind them. That
work must not exceed the slack, else the step is repeated without this constraint.

Weakness: within tau the impulse reaches further than sound does. Bodies that waves cross in a few steps rebound lower than e
requires. Fixed nodes act as walls: bodies attached to them absorb the impact.
"""

import math
from dataclasses import replace
from typing import TYPE_CHECKING

import numpy as np
import taichi as ti

from taisoft.backend.arrays import FieldArena, download
from taisoft.backend.runtime import kernel
from taisoft.contact.problem import ContactProblem, to_world
from taisoft.contact.prox import dvec
from taisoft.contact.restitution import find_rebounds
from taisoft.dynamics.contact_terms import TO_IMPULSES
from taisoft.dynamics.simulation_state import SimulationState
from taisoft.fem.chunks import chunk_entry, chunk_size, fold, total
from taisoft.fem.lanes import mass_times
from taisoft.fem.state import IMPACT_CURVATURE, IMPACT_SLOPE, N_NORMS, NORMS, OTHER_SUM, SUM
from taisoft.fem.terms import rayleigh_damping
from taisoft.linear.block_csr import block_times

if TYPE_CHECKING:
    from taisoft.dynamics.results import StageResult
    from taisoft.dynamics.stage_system import Stage, StageSystem

SPREAD = 2.0 * math.pi  # tau / dt
SOLVES = 400  # maximum linear solves of an impact
TOLERANCE = 1e-3  # of the contact laws' residual in an impact; the step after it corrects the rest


@ti.func
def impact_residual(m: ti.template(), A: ti.template(), k: ti.template(), i, tau):
    """Return (A D)_i of the jump D = (x - x_linear) / tau, without impulses.

    Uses differences between neighbours in f64: stiffness does not resist the common part of the jump, which is most of it, and
    its rounding, tau^2 times as large, would hide the rigid motion.
    """
    inertia = ti.cast(1.0, m.real)
    if ti.static(m.damped):
        inertia += ti.cast(tau, m.real) * rayleigh_damping.mass_rate(m, i)
    velocity_jump, mass = (m.state.x[i] - k.x_linear[i]) / tau, m.mass[i]
    if ti.static(m.consistent):
        mass = m.mass_matrix.diagonal[i]
    r = ti.Vector([0.0, 0.0, 0.0], m.real)
    for half in range(2):
        row = i + half * m.n_nodes
        for at in range(A.row_start[row], A.row_start[row + 1]):
            j = A.column[at]
            r += block_times(A.value[at], ti.cast((m.state.x[j] - k.x_linear[j]) / tau - velocity_jump, m.real))
            if ti.static(m.consistent):
                mass += m.mass_matrix.value[at]
    return r + inertia * mass * ti.cast(velocity_jump, m.real)


@kernel
def begin_impact(m: ti.template(), s: ti.template(), k: ti.template(), tau: ti.f64):
    """Begin the impact's stage at v_n without impulses, after the matrix was formed; save the last step's in `impact_impulse`.

    scalars: NORMS, as in `form_residual`; the scale is the momentum of all nodes at the largest speed change of a contact.
    """
    (p,) = ti.static((k.problem,))
    ti.loop_config(serialize=m.serial)
    for i in range(m.n_nodes):
        m.state.x[i] = k.x_start[i] + tau * s.v_hat[i]
        s.x_hat[i] = k.x_start[i]
        k.x_linear[i] = m.state.x[i]
    ti.loop_config(serialize=True)
    for _ in range(1):
        speed, mass = ti.cast(0.0, ti.f64), ti.cast(0.0, ti.f64)
        for c in range(p.count[0]):
            p.impact_impulse[c] = p.r[c]
            p.r[c] = dvec(0.0)
            speed = ti.max(speed, p.min_velocity[c] - p.approach[c])
        for i in range(m.n_nodes):
            mass += ti.cast(m.mass[i], ti.f64) ** 2
        for j in ti.static(range(N_NORMS)):
            m.state.scalars[NORMS + j] = 0.0
        m.state.scalars[NORMS + 1] = mass * speed * speed


@kernel
def measure_impact(m: ti.template(), s: ti.template(), k: ti.template(), tau: ti.f64):
    """Store the jump in s.change. scalars: IMPACT_SLOPE, IMPACT_CURVATURE, of E(s)."""
    (p,) = ti.static((k.problem,))
    ti.loop_config(serialize=m.serial)
    for i in range(m.n_nodes):
        s.change[i] = (m.state.x[i] - k.x_linear[i]) / tau
    ti.loop_config(serialize=m.serial)
    for task in range(m.chunks * m.spread):
        if task % m.spread == 0:
            chunk = task // m.spread
            slope, curvature = ti.cast(0.0, ti.f64), ti.cast(0.0, ti.f64)
            for j in range(chunk_size(m, chunk, m.n_nodes)):
                i = chunk_entry(m, chunk, j, m.n_nodes)
                d = mass_times(m, i, s.change)
                slope += d.dot(s.v_hat[i])
                curvature += d.dot(s.change[i])
            m.state.partial[chunk, SUM], m.state.partial[chunk, OTHER_SUM] = slope, curvature
    fold(m, SUM, OTHER_SUM, ())
    ti.loop_config(serialize=True)
    for _ in range(1):
        slope = total(m, SUM)
        for c in range(p.count[0]):
            u_fixed = -(SPREAD / tau) * p.obstacle_displacement[c]
            for j in range(p.arity[c]):
                i = p.node[c, j]
                u_fixed += p.weight[c, j] * (1.0 - ti.cast(m.free[i], ti.f64)) * s.v_hat[i]
            slope += to_world(p, c, p.r[c]).dot(u_fixed)
            if p.min_opening[c] > 0.0:
                slope -= 0.5 * p.r[c][0] * ti.max(0.0, p.min_velocity[c] + p.approach[c])
        m.state.scalars[IMPACT_SLOPE], m.state.scalars[IMPACT_CURVATURE] = slope, total(m, OTHER_SUM)


@kernel
def apply_impact(m: ti.template(), s: ti.template(), k: ti.template(), fraction: ti.f64):
    """Apply that fraction of the jump to v_hat; restore the last step's impulses, and set `impact_impulse` to the impact's."""
    (p,) = ti.static((k.problem,))
    ti.loop_config(serialize=m.serial)
    for i in range(m.n_nodes):
        m.state.x[i] = k.x_start[i]
        s.v_hat[i] += fraction * s.change[i]
    ti.loop_config(serialize=p.serial)
    for c in range(p.count[0]):
        struck = fraction * p.r[c]
        p.r[c] = p.impact_impulse[c]
        p.impact_impulse[c] = struck


@kernel
def start_from(m: ti.template(), s: ti.template(), still: ti.f64):
    """Set the first iterate after an impact: v_hat, or 0 if the step is linearised at x_n (still = 1)."""
    ti.loop_config(serialize=m.serial)
    for i in range(m.n_nodes):
        m.state.x[i] = s.x_hat[i]
        m.state.v[i] = (1.0 - still) * m.free[i] * s.v_hat[i]


@kernel
def rebound_work(k: ti.template(), beta: ti.f64) -> ti.f64:
    """Return the work of contacts constrained to their rebound displacement, at the end of the step [J]."""
    p, w = ti.static((k.problem, k.work))
    work = ti.cast(0.0, ti.f64)
    ti.loop_config(serialize=True)
    for _ in range(1):
        for c in range(p.count[0]):
            if p.min_opening[c] > 0.0:
                displacement = w.tangential_offset[c]
                for j in range(p.arity[c]):
                    displacement += p.weight[c, j] * k.displacement[p.node[c, j]]
                work += p.r[c][0] * p.normal[c].dot(displacement) / beta
    return work


@kernel
def release_contacts(p: ti.template()):
    """Release all contacts from their rebound displacement."""
    ti.loop_config(serialize=p.serial)
    for c in range(p.count[0]):
        p.min_opening[c] = 0.0


def solve_bouncing(system: "StageSystem", stage: "Stage") -> "StageResult":
    """Solve a step of implicit Euler with restitution: the impact, then the stage."""
    from taisoft.dynamics.contact_newton import solve
    from taisoft.dynamics.newton import Newton
    from taisoft.dynamics.results import count_all, merge

    m, w, tau = system.model, system.work, SPREAD * stage.dt
    impact_stage = replace(stage, beta=tau, contact_tolerance=max(stage.contact_tolerance, TOLERANCE), max_newton=SOLVES)
    k = system.begin_impact(impact_stage)
    begin_impact(m, w, k, tau)
    impact = Newton(system, impact_stage).run(*system.evaluate(new_multipliers=TO_IMPULSES), fresh=True)
    measure_impact(m, w, k, tau)
    slope, curvature = m.state.scalars.to_numpy()[[IMPACT_SLOPE, IMPACT_CURVATURE]]
    gain = slope + 0.5 * curvature
    fraction = 1.0 if gain <= 0.0 else max(0.0, -2.0 * slope / curvature)
    slack = max(0.0, -fraction * (slope + 0.5 * fraction * curvature))  # 0 except for rounding if the jump is scaled down
    apply_impact(m, w, k, fraction)
    if fraction < 1.0:
        release_contacts(k.problem)
    results = [impact]
    while True:
        start_from(m, w, float(stage.linearised))
        results.append(solve(system, replace(stage, beta=stage.dt, prescribed_fraction=1.0)))
        if rebound_work(k, stage.dt) <= slack:
            return count_all(merge([impact, results[-1]]), results[1:-1])
        release_contacts(k.problem)


class Rebounds:
    """Finds contacts that rebound. `StepState.flight`: sum of dt^2 over the steps since each collider's last contact.

    Free flight in dissipative steps loses energy, which a rebound may give back, see `contact.restitution`.
    """

    def __init__(self, simulation: SimulationState, arena: FieldArena):
        self._simulation = simulation
        self._flight = arena.field("flight", ti.f64, len(simulation.scene.colliders))  # for kernels
        self.numbers_changed()

    def numbers_changed(self) -> None:
        """Update for changed coefficients of restitution."""
        self._any = self._simulation.scene.bounces

    def detect(self, problem: ContactProblem, dt: float, contact_offset: float) -> bool:
        """Return whether surfaces rebound in the step of dt [s] that has begun."""
        now, gravity = self._simulation.now, self._simulation.scene.gravity
        if not self._any:
            return False
        if (now.gravity != gravity).any():  # energy lost under another gravity is unknown
            now.gravity[:], now.flight[:] = gravity, 0.0
        self._flight.from_numpy(now.flight)
        return find_rebounds(problem, self._simulation.model.gravity, self._flight, dt, contact_offset) > 0

    def count_flight(self, problem: ContactProblem, n: int, dt: float, dissipative: bool) -> None:
        """Update `flight` after a substep of dt with n contacts. dissipative: whether free flight loses energy, as with
        implicit Euler."""
        if not self._any:
            return
        simulation, flight = self._simulation, self._simulation.now.flight
        flight += np.where(flight > 0.0, dt**2 if dissipative else 0.0, dt**2)
        r, struck, collider = download([problem.r, problem.impact_impulse, problem.body], n)
        flight[collider[(r != 0.0).any(axis=1)]] = 0.0
        flight[collider[(struck != 0.0).any(axis=1)]] = dt**2
        starts = simulation.layout.node_start[:-1]
        constrained = np.logical_or.reduceat(simulation.dirichlet.constrained().any(axis=1), starts)
        flight[: len(starts)][constrained] = flight[len(starts) :] = 0.0
