"""Stages of an implicit integrator: x = x_hat + beta v, M (v - v_hat) = beta f(x, v), from the search of contacts to the result.

An integrator is a `Scheme` (`schemes`): how x_hat, v_hat and beta follow from previous states, and whether the stage is the
step's midpoint.
"""

import math
from dataclasses import dataclass, replace

import numpy as np
import taichi as ti

from taisoft.backend.arrays import download, upload
from taisoft.backend.runtime import kernel
from taisoft.dynamics import impact
from taisoft.dynamics.contact import TOLERANCE, ContactStep
from taisoft.dynamics.friction import extrapolate_multipliers
from taisoft.dynamics.imbalance import describe_imbalance
from taisoft.dynamics.multipliers import Multipliers
from taisoft.dynamics.newton import solve
from taisoft.dynamics.no_contacts import NoContacts
from taisoft.dynamics.pieces import Pieces
from taisoft.dynamics.results import StageResult, count_all
from taisoft.dynamics.schemes import SCHEMES, Scheme
from taisoft.dynamics.simulation_state import SimulationState
from taisoft.dynamics.stage import Stage
from taisoft.dynamics.stage_system import StageSystem
from taisoft.fem.dependents import place_all
from taisoft.fem.rigid_tets import begin_rigid_stage
from taisoft.settings import Settings

MAX_NEWTON, MAX_NEWTON_WITH_CONTACTS = 50, 25  # a stage that needs more has failed
MAX_STATIC, MAX_FALL = 100, 8  # of static ones without contacts; the latter where bodies have to meet something first
DEFAULT_TOLERANCE = {"f32": 1e-4, "f64": 1e-8}  # relative residual; f32 forces carry 1e-6 to 1e-5 of rounding


@kernel
def begin_step(
    m: ti.template(),
    w: ti.template(),
    h: ti.template(),
    multistep: ti.template(),
    now: ti.f64,
    before: ti.f64,
    still: ti.f64,
    extrapolation: ti.f64,
):
    """Store state n in the history; compute x_hat and v_hat of the stage, and the first iterate of v on the free axes.

    The iterate is (1 - still) v_n + extrapolation (v_n - v_(n-1)). still is 1 for the linearly implicit step, which is
    linearised at x_n. Fixed axes keep 0; prescribed nodes are set with the targets.
    """
    ti.loop_config(serialize=m.serial)
    for i in range(m.n_nodes):
        if ti.static(multistep):
            h.x_before[i] = h.x_now[i]
        h.v_before[i] = h.v_now[i]
        h.x_now[i] = m.state.x[i]
        h.v_now[i] = m.state.v[i]
        w.x_hat[i] = h.x_now[i]
        w.v_hat[i] = h.v_now[i]
        if ti.static(multistep):
            w.x_hat[i] = now * h.x_now[i] - before * h.x_before[i]
            w.v_hat[i] = now * h.v_now[i] - before * h.v_before[i]
        v = (1.0 - still) * h.v_now[i] + extrapolation * (h.v_now[i] - h.v_before[i])
        m.state.v[i] = m.free[i] * v


@kernel
def finish_midpoint(m: ti.template(), h: ti.template()):
    """Extrapolate from the midpoint: x = 2 x_m - x_n, v = 2 v_m - v_n."""
    ti.loop_config(serialize=m.serial)
    for i in range(m.n_nodes):
        m.state.x[i] = 2.0 * m.state.x[i] - h.x_now[i]
        m.state.v[i] = m.state.v[i] + m.free[i] * (m.state.v[i] - h.v_now[i])
    place_all(m)


@dataclass(frozen=True, eq=False)
class History:
    """States n and n - 1, (n_nodes) 3-vectors f64; x_before only for multistep schemes."""

    x_now: object
    v_now: object
    v_before: object
    x_before: object


class ImplicitStages:
    """Stages of one scheme for a simulation state and its contacts; `ImplicitStepper` makes steps of them."""

    LOOSE_LAW = 10.0  # times the tolerance of |r|: to what the laws are solved at least, if their tolerance is above the default

    def __init__(self, simulation: SimulationState, settings: Settings, contact: ContactStep | NoContacts):
        self.simulation, self.scheme, self.contact = simulation, SCHEMES[settings.integrator], contact
        model, arena = simulation.model, simulation.arena
        self.start = simulation.now.another(arena, "now")  # of the part
        self.history = History(
            self.start.x,
            self.start.v,
            arena.vectors("v_before", ti.f64, model.n_nodes),
            arena.vectors("x_before", ti.f64, model.n_nodes) if self.scheme.before else None,
        )
        self._multipliers = Multipliers(simulation) if len(simulation.loads.multipliers) else None
        self.solver = StageSystem(simulation, contact, self.history.x_now, self._multipliers)
        self.tolerance = settings.newton_tolerance or DEFAULT_TOLERANCE[settings.precision]
        self.contact_tolerance = settings.contact_tolerance or TOLERANCE[settings.precision]
        self.linear_tolerance = settings.linear_tolerance
        # laws that hold better than they must let |r| converge in fewer iterations; but a looser tolerance was asked for
        is_loose = self.contact_tolerance > TOLERANCE[settings.precision]
        self._law_aim = min(self.contact_tolerance, (self.LOOSE_LAW if is_loose else 1.0) * self.tolerance)

    def forget(self) -> None:
        """Discard the history, after the state was set."""
        self.n_previous = 0  # previous states in the history
        self._beta = self._dt = 0.0  # of the last step
        if self.scheme.c == 0.0 and self._multipliers is not None and self.simulation.time == 0.0:
            self.simulation.set_multipliers(self._multipliers.static_start())
        self.contact.forget()
        self.solver.forget()

    def numbers_changed(self) -> None:
        """Update for changed gravity or material numbers."""
        self.solver.numbers_changed()

    def snapshot(self) -> dict:
        """Return the history, and the state of solver and contacts."""
        x, v = download([self.start.x, self.start.v])
        return {
            "past": self.n_previous,
            "beta": self._beta,
            "dt": self._dt,
            "x_now": x,
            "v_now": v,
            "contact": self.contact.snapshot(),
            "solver": self.solver.snapshot(),
        }

    def restore(self, kept: dict) -> None:
        """Restore a `snapshot`. It has no x_before and v_before, since each step writes them first."""
        upload([(self.start.x, kept["x_now"]), (self.start.v, kept["v_now"])])
        self.n_previous, self._beta, self._dt = int(kept["past"]), float(kept["beta"]), float(kept["dt"])
        self.contact.restore(kept["contact"])
        self.solver.restore(kept["solver"])  # after the contacts, whose fields it uses

    def solve_stage(self, time: float, dt: float, start: np.ndarray | None) -> StageResult:
        """Solve the stage of a part of dt from a time with the contacts of one search. start: (n_nodes, 3) [m/s] first iterate of
        v, or None."""
        simulation, solver = self.simulation, self.solver
        scheme, bounces = self._prepare(time, dt, start)
        stage = replace(self._stage(scheme, dt, self.tolerance), renews=not bounces)
        result = impact.solve_bouncing(solver, stage) if bounces else solve(solver, stage)
        if scheme.one_iteration and solver.pieces.several and result.converged and np.isfinite(result.residual):
            result = self._balance(scheme, stage, result, may_repeat=not (bounces or solver.budget.is_out_of_time()))
        if not (result.converged or solver.budget.ran_out):
            result = replace(result, imbalance=describe_imbalance(simulation, solver, self.contact))
        if scheme.midpoint:
            finish_midpoint(simulation.model, self.history)
        if not math.isfinite(result.residual):  # a NaN anywhere in x or v reaches the residual
            where = simulation.find_nonfinite(solver.work.residual.to_numpy()) or "the residual is not finite"
            return replace(result, converged=False, free=False, imbalance=where)
        self.n_previous += 1
        if self.contact.had_impact:
            self.n_previous = 0
        return result

    def follow_prescribed(self, time: float, dt: float) -> np.ndarray | None:
        """Return first velocities (n_nodes, 3) [m/s] of a static part from the present state, at which all follow the prescribed
        nodes and nothing resists; None if these rest. What is met on that way is searched."""
        simulation, moves = self.simulation, self.simulation.prescribed_moves(time + dt)
        if moves is None or not np.nan_to_num(moves[1]).any():
            return None
        self.start.copy_nodes_from(simulation.now)
        x, v = simulation.state()
        v[:] = 0.0
        v[moves[0]] = np.nan_to_num(moves[1]) / dt
        v = self.solver.follow(v, dt)
        simulation.set_state(x + dt * v, v)
        v = simulation.velocities()
        self.contact.paths.search_way(time, dt, self.start)
        simulation.now.copy_nodes_from(self.start)
        return v

    def _prepare(self, time: float, dt: float, start: np.ndarray | None) -> tuple[Scheme, bool]:
        """Search contacts and begin the stage of a substep; return its scheme, and whether any contacts rebound."""
        simulation, model, work = self.simulation, self.simulation.model, self.solver.work
        releases = simulation.releases
        target = simulation.next_target(time + dt)
        if simulation.releases != releases or dt != self._dt:
            self.n_previous = 0
        self.contact.begin(time, dt)
        # multistep schemes restart at an impact: they would take the velocity jump for an acceleration
        impact = self.scheme.before and self.contact.detect_impact(dt)
        if (bounces := self.scheme.c > 0.0 and self.contact.detect_rebounds(dt)) or impact:
            self.n_previous = 0
        self._dt = dt
        scheme = self.scheme if self.n_previous > 0 or self.scheme.start is None else self.scheme.start
        self.dissipative = scheme.before == 0.0
        if target is not None:
            if scheme.midpoint:
                target = 0.5 * (target + model.state.x.to_numpy()[simulation.dirichlet.prescribed_nodes])
            prescribed = [(work.prescribed_axes, simulation.dirichlet.prescribed_axes()), (work.targets, target)]
            if model.consistent:
                accelerations = simulation.dirichlet.accelerations(time, dt, self.scheme.before == 0.0)
                prescribed.append((work.prescribed_acceleration, accelerations))
            upload(prescribed)
        simulation.set_load_time(time + (0.5 if scheme.midpoint else 1.0) * dt)
        if self._multipliers is not None:
            self._multipliers.begin(time + dt, self.contact.n_contacts == 0 and model.on_cpu)
        self._beta = scheme.beta_over_dt * dt
        self.contact.set_impulse_fraction(scheme.beta_over_dt)
        simulation.begin_branches((0.5 if scheme.midpoint else 1.0) * dt)
        self.solver.assemble_damper()
        extrapolation = (0.5 if scheme.midpoint else 1.0) if self.n_previous > 1 and not scheme.one_iteration else 0.0
        self._begin(scheme, extrapolation)
        if start is not None and not scheme.one_iteration:  # that one is linearised at the step's start
            upload([(model.state.v, start)])
        return scheme, bounces

    def _begin(self, scheme: Scheme, extrapolation: float) -> None:
        """Begin the stage from the present state."""
        multistep, still = self.scheme.before > 0.0, float(scheme.one_iteration or scheme.c == 0.0)
        begin_step(
            self.simulation.model, self.solver.work, self.history, multistep, scheme.now, scheme.before, still, extrapolation
        )
        if self.simulation.model.rigid_tets is not None:
            begin_rigid_stage(self.simulation.model, self.history, multistep, scheme.now, scheme.before, self._beta)

    def _balance(self, scheme: Scheme, stage: Stage, result: StageResult, may_repeat: bool) -> StageResult:
        """Solve a linearised stage again, to a tighter tolerance, if the forces on a piece as a whole are unbalanced."""
        worst, name = self._unbalanced_mean()
        if worst > Pieces.LIMIT and may_repeat:
            self.simulation.now.copy_nodes_from(self.start)
            self._begin(scheme, 0.0)
            tighter = self.tolerance * Pieces.LIMIT / min(worst, 1.0) * 0.1  # a tenth of what would just balance the piece
            stage = replace(stage, tolerance=tighter)
            result = count_all(solve(self.solver, stage), [result])
            worst, name = self._unbalanced_mean()
        return replace(result, unbalanced=(worst, name)) if worst > Pieces.LIMIT else result

    def _unbalanced_mean(self) -> tuple[float, str]:
        rounding = self.solver.rounding
        return self.solver.pieces.unbalanced_mean(self.solver.work, self._beta, rounding.eps, rounding.piece_mass)

    def _stage(self, scheme: Scheme, dt: float, tolerance: float) -> Stage:
        max_newton = MAX_NEWTON if self.contact.n_contacts == 0 else MAX_NEWTON_WITH_CONTACTS
        if scheme.c == 0.0 and self.contact.n_contacts == 0:
            max_newton = MAX_FALL if not self.contact.idle and self.solver.is_loose else MAX_STATIC
        return Stage(
            scheme.c,
            self._beta,
            dt,
            tolerance,
            self.contact_tolerance,
            max_newton,
            self.linear_tolerance,
            scheme.one_iteration,
            # prescribed nodes change their velocity once a step, not twice within the midpoint's half step
            0.5 if scheme.midpoint else 1.0,
            law_aim=self._law_aim,
        )

    def warm_up(self, time: float, dt: float) -> None:
        """Launch the kernels that only later steps of dt may need, after a step that has ended at a time; the state is then
        invalid."""
        if self.contact.idle:
            self.solver.warm_up()
            return
        self.contact.begin(time, dt)
        self.solver.warm_up()
        extrapolate_multipliers(self.solver.contacts, 0)
        if self.simulation.scene.bounces:
            self.contact.rebounds.detect(self.contact.problem, dt, self.contact.contact_offset)
            impact.warm_up(self.solver)
        self.contact.warm_up(time, dt, self.start.x, self.solver.contacts.displacement)

    def reactions(self) -> np.ndarray:
        """Return the constraint forces of the last step, (n_nodes, 3) [N]."""
        if self._beta == 0.0:
            return np.zeros((self.simulation.model.n_nodes, 3))
        return self.solver.held_residual() / self._beta

    @property
    def field_bytes(self) -> dict[str, int]:
        """Bytes by name of the solver's temporary fields."""
        return self.solver.field_bytes

    def release(self) -> None:
        """Free the memory of these fields."""
        self.solver.release()
