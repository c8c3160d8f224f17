"""Static equilibrium: Newton's method on the forces, in load steps where contacts, friction or the caller ask for them.

Without contacts the full load is applied in one step, and in smaller ones if that fails. With contacts each load step is a step
of the integrator "static": implicit Euler without inertia, by the code of steps in time.
"""

from dataclasses import dataclass, field
from typing import TYPE_CHECKING

import numpy as np

from taisoft.backend.arrays import FieldArena, upload
from taisoft.backend.runtime import Runtime, open_kind, open_runtime
from taisoft.display import short_repr
from taisoft.dynamics.dirichlet import DirichletConditions
from taisoft.dynamics.imbalance import describe_imbalance
from taisoft.dynamics.multipliers import Multipliers
from taisoft.dynamics.newton import solve
from taisoft.dynamics.no_contacts import NoContacts
from taisoft.dynamics.results import StageResult
from taisoft.dynamics.schemes import STATIC
from taisoft.dynamics.simulation_state import SimulationState
from taisoft.dynamics.stage import Stage
from taisoft.dynamics.stage_system import StageSystem
from taisoft.errors import SceneError, SimulationError
from taisoft.fem.build import build_model
from taisoft.fem.measure import measure
from taisoft.fem.model import Layout
from taisoft.fem.pressure import cavity_form
from taisoft.fem.spring_table import SpringTable
from taisoft.fem.state import ELASTIC, N_INVERTED
from taisoft.records import ErrorEstimate, Quantity, StepReport
from taisoft.scene import checks
from taisoft.scene.holding import check_held
from taisoft.scene.plan import make_plan
from taisoft.scene.scene import Scene
from taisoft.settings import check_count

if TYPE_CHECKING:
    from taisoft.collision.contacts import Contacts
    from taisoft.simulator import Simulator

MAX_NEWTON = 100
SMALLEST_LOAD_STEP = 1.0 / 256.0


@dataclass(frozen=True)
class LoadStep:
    """A state of equilibrium at the end of a load step."""

    time: float  # [s]
    x: np.ndarray  # (n_nodes, 3) [m]
    reactions: np.ndarray  # (n_nodes, 3) [N]
    amplitudes: np.ndarray  # loads that are one number, see `SceneLoads`
    cavity_pressures: dict[str, float]  # [Pa]
    contacts: "Contacts | None" = None  # None where nothing can touch
    on_pairs: dict[tuple[str, str], np.ndarray] = field(default_factory=dict)  # force [N] and torque [N m] on the first, (6,)


@dataclass(frozen=True)
class StaticResult:
    """States of equilibrium, by load step, or the closest ones found. `step` counts load steps, from 0 or back from -1."""

    converged: bool  #: the residual is within the tolerance in every load step, for the whole load
    load: float  #: fraction of the load for which equilibrium was found; below 1 the state is that of the last, failed attempt
    at_rounding: bool  #: the residual is down at the rounding of the forces, so no tolerance below it can be met
    residual: float  #: |force on free axes| / |applied load|, without load relative to the constraint forces
    iterations: int  #: of Newton's method, over all load steps
    linear_iterations: int  #: of conjugate gradients
    multigrid_solves: int  #: linear systems that multigrid preconditioned
    load_steps: int  #: steps that the load was applied in, with the parts of those that were cut
    elastic: float  #: stored energy [J]
    n_inverted: int  #: tets with J <= 0
    imbalance: str  #: the node where forces are least balanced, and the largest of them, if it has not converged
    _scene: Scene
    _layout: Layout
    _springs: SpringTable | None
    _states: tuple[LoadStep, ...]
    step_reports: tuple[StepReport, ...] = ()  #: one a load step, of solves with contacts or `steps`
    problems: tuple[str, ...] = ()  #: sentences, as of a `RunReport`
    error_estimate: ErrorEstimate | None = None  #: with error=True; its error in time is that of the load steps
    quantities: dict[str, Quantity] = field(default_factory=dict)  #: those asked for, at the end, by name

    __repr__ = short_repr

    @property
    def times(self) -> np.ndarray:
        """Times (n_steps,) [s] of the ends of the load steps."""
        return np.array([state.time for state in self._states])

    def positions(self, name: str | None = None, step: int = -1) -> np.ndarray:
        """Positions (n_nodes, 3) [m] of a body, or of all bodies concatenated."""
        return self._at(step).x[self._rows(name)].copy()

    def reactions(self, name: str | None = None, step: int = -1) -> np.ndarray:
        """Constraint forces (n_nodes, 3) [N] of a body, or of all bodies concatenated."""
        return self._at(step).reactions[self._rows(name)].copy()

    def contacts(self, step: int = -1) -> "Contacts":
        """The contacts of a load step, as of `Simulator.contacts`: `impulse / duration` is the force [N] of each.

        Raises SceneError if nothing can touch.
        """
        if (found := self._at(step).contacts) is None:
            raise SceneError("contacts: nothing in the scene can touch")
        return found

    def contact_force(self, name: str, other: str | None = None, step: int = -1) -> np.ndarray:
        """Contact force (3,) [N] on a body or an obstacle, from all others or from `other`. Raises SceneError."""
        return self._on(name, other, step)[:3]

    def contact_torque(self, name: str, other: str | None = None, step: int = -1) -> np.ndarray:
        """Torque (3,) [N m] of `contact_force`, about a body's centre of mass or an obstacle's pivot. Raises SceneError."""
        return self._on(name, other, step)[3:]

    def cavity_volume(self, name: str, step: int = -1) -> float:
        """Volume [m^3] of a cavity."""
        return cavity_form(self._scene, name).value_and_gradient(self._at(step).x)[0]

    def cavity_pressure(self, name: str, step: int = -1) -> float:
        """Pressure [Pa] in a cavity."""
        self._scene.cavity(name)
        return self._at(step).cavity_pressures[name]

    def tension(self, name: str, step: int = -1) -> float:
        """Tension [N] of a spring or tendon; negative: it pushes. Raises SceneError."""
        names = [one.name for one in (*self._scene.springs, *self._scene.tendons)]
        checks.index(name, names, "tension: no spring or tendon")
        x, amplitudes = self._at(step).x, self._at(step).amplitudes
        return float(self._springs.tensions(x, np.zeros_like(x), amplitudes)[self._springs.elements[name]][0])

    def _at(self, step: int) -> LoadStep:
        n = len(self._states)
        return self._states[checks.whole(step, "step", range(-n, n))]

    def _on(self, name: str, other: str | None, step: int) -> np.ndarray:
        for one in (name, *(() if other is None else (other,))):
            self._scene.collider(one)
        found = [own for pair, own in self._at(step).on_pairs.items() if pair[0] == name and other in (None, pair[1])]
        return np.sum(found, axis=0) if found else np.zeros(6)

    def _rows(self, name: str | None) -> slice:
        if name is None:
            return slice(None)
        return self._layout.nodes(self._scene.bodies.index(self._scene.body(name)))


def solve_static(
    scene: Scene,
    tolerance: float = 1e-6,
    precision: str = "f64",
    arch: str = "cpu",
    time: float | None = None,
    steps: int | None = None,
    self_collision: bool = False,
    error: bool = False,
    error_mesh: str | Scene | None = None,
    quantities: dict | None = None,
) -> StaticResult:
    """Find states of rest under gravity, loads, constraints and contacts with friction.

    tolerance: on |residual on free axes| / |applied load| (without load, relative to the constraint forces); with contacts
    relative to all forces.
    Without contacts, and without `steps`, prescribed nodes and loads have their values at `time` (default 0) [s].
    With contacts that may act, or `steps`, the load is applied in `steps` load steps (default 1), each cut where it does not
    converge: prescribed nodes, obstacles and loads that have paths follow them from 0 to `time` (default 1) [s], constant loads
    and gravity grow from 0. Each load step is one of backward Euler for friction: displacements since its start count as slip, so
    that with friction the result depends on `steps`; error=True estimates by how much, with twins of other load steps and tighter
    tolerances, and with error_mesh the error of the mesh, as `Simulator.run` does, whose `quantities` are those here.
    An open runtime of this precision is reused; otherwise one is opened and closed. Maxwell branches are relaxed, and nothing
    rebounds. Raises SceneError for invalid arguments, and if nothing can hold a body, SimulationError if nothing does, or if the
    runtime is in use. A solve that does not converge returns converged=False.
    """
    _check(scene, tolerance)
    kind = open_kind()
    arch = kind[0] if kind is not None and kind[1] == precision else arch
    if steps is not None or scene.pushes(self_collision):
        return _solve_in_steps(
            scene,
            1.0 if time is None else checks.number(time, "time", above=0.0, unit="s"),
            1 if steps is None else check_count("steps", steps),
            {"error": error, "error_mesh": error_mesh, "quantities": quantities},
            newton_tolerance=tolerance,
            self_collision=self_collision,
            precision=precision,
            arch=arch,
        )
    if error or error_mesh is not None or quantities:
        raise SceneError("solve_static: error and quantities need steps, or a scene with contacts")
    check_held(scene)
    scene = scene.snapshot()  # in which rigid bodies are as stiff as the others ask for
    time = 0.0 if time is None else checks.number(time, "time")
    runtime = open_runtime(arch, precision, "solve_static")
    arena, solver = FieldArena(), None
    try:
        solver = StaticSolver(scene, runtime, arena, tolerance, time)
        return solver.solve()
    finally:
        if solver is not None:
            solver.solver.release()
        arena.release()
        runtime.close()


def _check(scene: Scene, tolerance: float) -> None:
    if not isinstance(scene, Scene) or not scene.bodies:
        raise SceneError("solve_static needs a Scene that holds a body")
    scene.check()
    if isinstance(tolerance, bool) or not isinstance(tolerance, (int, float)) or not 0.0 < tolerance < 1.0:
        raise SceneError(f"tolerance = {tolerance!r}: it must lie between 0 and 1")


def _solve_in_steps(scene: Scene, time: float, steps: int, estimate: dict, **settings) -> StaticResult:
    """Solve as a run of the integrator "static" for `time` [s]. estimate, settings: arguments of that run and its simulator."""
    from taisoft.simulator import Simulator

    states: list[LoadStep] = []
    with Simulator(scene.snapshot(), dt=time / steps, integrator=STATIC, ramp=time, **settings) as sim:
        state = sim._host().state
        run = sim.run(
            time, fps=None, on_frame=lambda sim, index, report: states.append(_load_step(sim)) if index else None, **estimate
        )
        reports = run.step_reports
        if run.status == "failed":
            raise SimulationError(f"solve_static: {run.problems[-1]}")
        return StaticResult(
            converged=all(one.converged and not one.n_inverted for one in reports),
            load=max([one.time for one in reports if one.converged and not one.n_inverted], default=0.0) / time,
            at_rounding=False,
            residual=max(one.residual for one in reports),
            iterations=sum(one.newton_iterations for one in reports),
            linear_iterations=sum(one.linear_iterations for one in reports),
            multigrid_solves=sum(one.multigrid_solves for one in reports),
            load_steps=sum(one.substeps for one in reports),
            elastic=reports[-1].elastic,
            n_inverted=reports[-1].n_inverted,
            imbalance="; ".join(text for one in reports if not one.converged for text in one.problems),
            _scene=sim.scene,
            _layout=state.layout,
            _springs=state.springs,
            _states=tuple(states),
            step_reports=tuple(reports),
            problems=tuple(run.problems),
            error_estimate=run.error_estimate,
            quantities=run.quantities,
        )


def _load_step(sim: "Simulator") -> LoadStep:
    """Return the present state of a simulator in statics."""
    state, pairs = sim._host().state, sim.pairs_in_contact()
    on_pairs = {
        (a, b): np.concatenate([sim.contact_force(a, b), sim.contact_torque(a, b)]) for one in pairs for a, b in (one, one[::-1])
    }
    fraction = min(1.0, sim.time / state.ramp)
    amplitudes, pressures = state.amplitudes(sim.time, fraction), state.cavity_pressures_by_name(sim.time, fraction)
    contacts = sim.contacts() if sim.touches else None
    return LoadStep(sim.time, sim.positions(), sim.reactions(), amplitudes, pressures, contacts, on_pairs)


class StaticSolver:
    """Static solver of a scene in an open runtime; each call of `solve` starts from the rest positions."""

    def __init__(self, scene: Scene, runtime: Runtime, arena: FieldArena, tolerance: float, time: float):
        plan = make_plan(scene, explicit=False, multistep=False).without_rates()
        model, layout = build_model(scene, runtime, arena, plan.on)
        self.simulation = SimulationState(scene, runtime, arena, model, layout, DirichletConditions(scene, layout))
        self.multipliers, self.time = None, time
        if len(self.simulation.loads.multipliers):
            self.multipliers = Multipliers(self.simulation)
            self.simulation.set_multipliers(self.multipliers.static_start())
        self.solver = StageSystem(self.simulation, NoContacts(), multipliers=self.multipliers)
        self.tolerance = tolerance
        self.target = self.simulation.next_target(time)
        self.simulation.upload_constraints()
        self.gravity = np.array(scene.gravity, dtype=np.float64)
        self.simulation.set_load_time(time)
        self.loads = [(field, 0.0, field.to_numpy()) for field in (model.loads, model.amplitudes) if field is not None]
        if self.simulation.springs is not None and model.amplitudes is not None:
            full = model.amplitudes.to_numpy()
            self.loads[-1] = model.amplitudes, self.simulation.springs.rest_amplitudes(len(full), layout.rest), full

    def solve(self) -> StaticResult:
        """Apply the full load in one step; if that fails, use load steps that halve on failure and grow by half on success."""
        rest = self.simulation.layout.rest
        self.newton = self.linear = self.multigrid = 0
        self.solver.budget.begin()
        result, steps, applied = self._attempt(rest, 1.0, self.tolerance), 1, 1.0
        if not self._is_acceptable(result):
            applied, step, x, steps = 0.0, 0.25, rest, 0
            while applied < 1.0 and step >= SMALLEST_LOAD_STEP and self.solver.budget.left:
                target = min(1.0, applied + step)
                result = self._attempt(x, target, self.tolerance if target == 1.0 else max(self.tolerance, 1e-3))
                if self._is_acceptable(result):
                    applied, step, steps, x = target, 1.5 * step, steps + 1, self.simulation.model.state.x.to_numpy()
                else:
                    step *= 0.5
            if applied < 1.0:  # residual of the last good state under the full load
                result = self._attempt(x, 1.0, self.tolerance, max_newton=0)
        return self._result(result, steps, applied)

    def _is_acceptable(self, result: StageResult) -> bool:
        """Whether no tet is inverted and the residual has met the tolerance or reached rounding."""
        measure(self.simulation.model)
        return (result.converged or result.at_rounding) and self.simulation.model.state.scalars[N_INVERTED] == 0.0

    def _attempt(self, x: np.ndarray, fraction: float, tolerance: float, max_newton: int = MAX_NEWTON) -> StageResult:
        """Solve with a fraction of the load, starting at x."""
        m, w = self.simulation.model, self.solver.work
        start = [(m.gravity, fraction * self.gravity[None]), (w.x_hat, x), (m.state.x, x), (m.state.v, np.zeros_like(x))]
        start += [(field, rest + fraction * (full - rest)) for field, rest, full in self.loads]
        if self.target is not None:
            rest = self.simulation.layout.rest[self.simulation.dirichlet.prescribed_nodes]
            axes = self.simulation.dirichlet.prescribed_axes()
            start += [(w.targets, rest + fraction * (self.target - rest)), (w.prescribed_axes, axes)]
        upload(start)
        if self.multipliers is not None:
            self.multipliers.begin(self.time, m.on_cpu, fraction)
        stage = Stage(0.0, 1.0, 1.0, tolerance, max_newton=max_newton)
        result = solve(self.solver, stage)
        self.newton += result.newton_iterations
        self.linear += result.linear_iterations
        self.multigrid += result.multigrid_solves
        return result

    def _result(self, result: StageResult, steps: int, load: float) -> StaticResult:
        simulation = self.simulation
        measure(simulation.model)
        scalars = simulation.model.state.scalars.to_numpy()
        if not np.isfinite(result.residual):
            raise SimulationError(f"solve_static: {simulation.find_nonfinite() or 'the residual is not finite'}")
        return StaticResult(
            converged=result.converged and load == 1.0,
            load=load,
            at_rounding=result.at_rounding,
            residual=result.residual,
            iterations=round(self.newton),
            linear_iterations=self.linear,
            multigrid_solves=self.multigrid,
            load_steps=steps,
            elastic=float(scalars[ELASTIC]),
            n_inverted=int(scalars[N_INVERTED]),
            imbalance="" if result.converged else describe_imbalance(simulation, self.solver, NoContacts()),
            _scene=simulation.scene,
            _layout=simulation.layout,
            _springs=simulation.springs,
            _states=(
                LoadStep(
                    self.time,
                    simulation.model.state.x.to_numpy(),
                    self.solver.held_residual(),
                    simulation.amplitudes(self.time),
                    simulation.cavity_pressures_by_name(self.time),
                ),
            ),
        )
