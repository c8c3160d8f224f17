"""Static equilibrium: Newton's method on the elastic forces, with load steps if the full load fails in one step."""

from dataclasses import dataclass

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
from taisoft.scene import checks
from taisoft.scene.plan import make_plan
from taisoft.scene.scene import Scene

MAX_NEWTON = 100
SMALLEST_LOAD_STEP = 1.0 / 256.0


@dataclass(frozen=True)
class StaticResult:
    """A state of equilibrium, or the closest one found."""

    converged: bool  #: the residual is within the tolerance, for the whole load
    load: float  #: fraction of the load for which equilibrium was found; below 1 the state is that of the last, failed attempt
    at_rounding: bool  #: the residual is down at the rounding of the forces, so no tolerance below it can be met
    residual: float  #: |force on free axes| / |applied load|, without load relative to the constraint forces
    iterations: int  #: of Newton's method, over all load steps; at most as many as in an implicit step
    linear_iterations: int  #: of conjugate gradients
    multigrid_solves: int  #: linear systems that multigrid preconditioned
    load_steps: int  #: steps that the load was applied in
    elastic: float  #: stored energy [J]
    n_inverted: int  #: tets with J <= 0
    imbalance: str  #: the node where forces are least balanced, and the largest of them, if it has not converged
    _scene: Scene
    _layout: Layout
    _positions: np.ndarray
    _reactions: np.ndarray
    _pressures: dict[str, float]
    _springs: SpringTable | None
    _amplitudes: np.ndarray

    __repr__ = short_repr

    def positions(self, name: str | None = None) -> np.ndarray:
        """Positions (n_nodes, 3) [m] of a body, or of all bodies concatenated."""
        return self._positions[self._rows(name)].copy()

    def reactions(self, name: str | None = None) -> np.ndarray:
        """Constraint forces (n_nodes, 3) [N] of a body, or of all bodies concatenated."""
        return self._reactions[self._rows(name)].copy()

    def cavity_volume(self, name: str) -> float:
        """Volume [m^3] of a cavity."""
        return cavity_form(self._scene, name).value_and_gradient(self._positions)[0]

    def cavity_pressure(self, name: str) -> float:
        """Pressure [Pa] in a cavity."""
        self._scene.cavity(name)
        return self._pressures[name]

    def tension(self, name: str) -> float:
        """Tension [N] of a spring or tendon; negative: it pushes. Raises SceneError."""
        names = [one.name for one in (*self._scene.springs, *self._scene.tendons)]
        checks.index(name, names, "tension: no spring or tendon")
        state = self._positions, np.zeros_like(self._positions), self._amplitudes
        return float(self._springs.tensions(*state)[self._springs.elements[name]][0])

    def _rows(self, name: str | None) -> slice:
        if name is None:
            return slice(None)
        return self._layout.nodes(self._scene.bodies.index(self._scene.body(name)))


def solve_static(
    scene: Scene, tolerance: float = 1e-6, precision: str = "f64", arch: str = "cpu", time: float = 0.0
) -> StaticResult:
    """Find the rest state under gravity, loads and constraints; prescribed nodes and loads follow their paths at `time` [s].

    tolerance: on |residual on free axes| / |applied load| (without load, relative to the constraint forces). An open f64
    runtime is reused; otherwise one is opened and closed. Contact is ignored, and Maxwell branches are relaxed. Raises SceneError
    if a body is not constrained along every axis, the scene has obstacles and contact forces, or `time` is no finite number,
    SimulationError if the runtime is in use. A solve that does not converge returns converged=False.
    """
    _check(scene, tolerance)
    scene = scene.snapshot()  # in which rigid bodies are as stiff as the others ask for
    time = checks.number(time, "time")
    kind = open_kind()
    arch = kind[0] if kind is not None and kind[1] == precision else arch
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
    if scene.obstacles and scene.contact_forces:
        raise SceneError(
            f"solve_static models no contact, and '{scene.obstacles[0].name}' is an obstacle: take implicit_euler steps with "
            "mass_damping in the materials until the bodies rest (contact_forces = False would solve another problem)"
        )
    held = {body.name: np.any([c.axes for c in body.constraints], axis=0) for body in scene.bodies if body.constraints}
    for names in _connected(scene):
        together = np.any([held.get(name, np.zeros(3, dtype=bool)) for name in names], axis=0)
        held |= dict.fromkeys(names, together | any(name not in [body.name for body in scene.bodies] for name in names))
    for body in scene.bodies:
        constrained = held.get(body.name, np.zeros(3, dtype=bool))
        if not constrained.all():
            missing = "".join(a for a, is_constrained in zip("xyz", constrained, strict=True) if not is_constrained)
            raise SceneError(f"body '{body.name}': nothing holds it along {missing}, so it has no static state")


def _connected(scene: Scene) -> list[set[str]]:
    """Return the names of bodies and obstacles that connections join, a set for each group."""
    groups: list[set[str]] = []
    for one in scene.connections:
        joined = [group for group in groups if group & set(one.owners)]
        groups = [group for group in groups if group not in joined] + [set(one.owners).union(*joined)]
    return groups


class StaticSolver:
    """Static solver of a scene in an open runtime; each call of `solve` starts from the rest positions."""

    def __init__(self, scene: Scene, runtime: Runtime, arena: FieldArena, tolerance: float, time: float):
        plan = make_plan(scene, explicit=False, multistep=False)
        model, layout = build_model(
            scene,
            runtime,
            arena,
            plan.on
            | dict.fromkeys(("mass_damping", "stiffness_damping", "spring_damping", "consistent_mass", "viscosity"), False),
        )
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

    def _residual(self, result: StageResult) -> float:
        """The residual of the result; 0 without load and constraint forces, where it would be rounding over rounding."""
        m, active = self.simulation.model, self.simulation.loads.activations
        applied = [np.delete(full, active) if field is m.amplitudes else full for field, _, full in self.loads]
        loaded = self.gravity.any() or any(full.any() for full in applied) or self.multipliers is not None
        only_rounding = not loaded and np.linalg.norm(self.solver.held_residual()) <= self.solver.rounding.force
        return 0.0 if only_rounding and result.converged else result.residual

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
            residual=self._residual(result),
            iterations=round(self.newton),
            linear_iterations=self.linear,
            multigrid_solves=self.multigrid,
            load_steps=steps,
            elastic=float(scalars[ELASTIC]),
            n_inverted=int(scalars[N_INVERTED]),
            imbalance="" if result.converged else describe_imbalance(simulation, self.solver, NoContacts()),
            _scene=simulation.scene,
            _layout=simulation.layout,
            _positions=simulation.model.state.x.to_numpy(),
            _reactions=self.solver.held_residual(),
            _pressures=simulation.cavity_pressures_by_name(self.time),
            _springs=simulation.springs,
            _amplitudes=simulation.amplitudes(self.time),
        )
