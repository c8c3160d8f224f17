"""Static equilibrium: load steps of the integrator "static", implicit Euler without inertia, by the code of steps in time."""

from dataclasses import dataclass, field
from typing import TYPE_CHECKING

import numpy as np

from taisoft.backend.runtime import open_kind
from taisoft.display import short_repr
from taisoft.dynamics.schemes import STATIC
from taisoft.errors import SceneError, SimulationError
from taisoft.fem.model import Layout
from taisoft.fem.pressure import cavity_form
from taisoft.fem.spring_table import SpringTable
from taisoft.records import ErrorEstimate, Quantity, StepReport
from taisoft.scene import checks
from taisoft.scene.scene import Scene
from taisoft.simulator import Simulator

if TYPE_CHECKING:
    from taisoft.collision.contacts import Contacts
    from taisoft.dynamics.surface_loads import ContactPressure

LOOSEST = 0.1  # tolerance: a residual of a tenth of the forces is no solution


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
    pressures: "dict[tuple[str, str], ContactPressure]" = field(default_factory=dict)  # by body, and "node" or "triangle"


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

    def contact_pressure(self, body: str, by: str = "node", step: int = -1) -> "ContactPressure":
        """Pressure, traction, state and slip at the surface of a body, as of `Simulator.contact_pressure`.

        Raises SceneError for unknown names, and if nothing can touch.
        """
        self.contacts(step)
        self._scene.body(body)
        return self._at(step).pressures[body, checks.choice(by, "contact_pressure: by", ("node", "triangle"))]

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
    contact_tolerance: float | None = None,
    error: bool = False,
    error_mesh: str | Scene | None = None,
    quantities: dict | None = None,
) -> StaticResult:
    """Find states of rest under gravity, loads, constraints and contacts with friction.

    tolerance: on |residual on free axes| / |applied load| (without load, relative to the constraint forces); with contacts
    relative to all forces. contact_tolerance: as of a Simulator.
    Without contacts, and without `steps`, prescribed nodes and loads have their values at `time` (default 0) [s].
    With contacts that may act, or `steps`, the load is applied in `steps` load steps (default 1), each cut where it does not
    converge: prescribed nodes, obstacles and loads that have paths follow them from 0 to `time` (default 1) [s], constant loads
    and gravity grow from 0. Each load step is one of backward Euler for friction: displacements since its start count as slip, so
    that with friction the result depends on `steps`; error=True estimates by how much, with companions of other load steps and
    tighter tolerances, and with error_mesh the error of the mesh, as `Simulator.run` does, whose `quantities` are those here. An
    open runtime of this precision is reused; otherwise one is opened and closed. Maxwell branches are relaxed, and nothing
    rebounds. Raises SceneError for invalid arguments, and if nothing can hold a body, SimulationError if nothing does, or if the
    runtime is in use. A solve that does not converge returns converged=False.
    """
    _check(scene, tolerance)
    kind, estimate = open_kind(), {"error": error, "error_mesh": error_mesh, "quantities": quantities}
    arch, at = kind[0] if kind is not None and kind[1] == precision else arch, None
    if steps is None and not scene.pushes(self_collision):
        if error or error_mesh is not None or quantities:
            raise SceneError("solve_static: error and quantities need steps, or a scene with contacts")
        at, time = 0.0 if time is None else checks.number(time, "time"), 1.0
    time = 1.0 if time is None else checks.number(time, "time", above=0.0, unit="s")
    steps = 1 if steps is None else checks.whole(steps, "steps")
    settings = {
        "newton_tolerance": tolerance,
        "contact_tolerance": contact_tolerance,
        "self_collision": self_collision,
        "precision": precision,
        "arch": arch,
    }
    with Simulator(scene.snapshot(), dt=time / steps, integrator=STATIC, ramp=time, **settings) as sim:
        sim._host().state.at = at
        return _solve(sim, time, estimate)


def _check(scene: Scene, tolerance: float) -> None:
    if not isinstance(scene, Scene) or not scene.bodies:
        raise SceneError("solve_static needs a Scene that holds a body")
    scene.check()
    checks.number(tolerance, "tolerance", above=0.0, below=LOOSEST)


def _solve(sim: Simulator, time: float, estimate: dict) -> StaticResult:
    """Take load steps until a time [s]. estimate: arguments of the run."""
    states: list[LoadStep] = []

    def keep(sim: Simulator, index: int, _) -> None:
        if index:
            states.append(_load_step(sim))

    run = sim.run(time, fps=None, on_frame=keep, **estimate)
    if run.status == "failed":
        raise SimulationError(f"solve_static: {run.problems[-1]}")
    reports, stepper, state = run.step_reports, sim._host().stepper, sim._host().state
    good = [one.converged and not one.n_inverted for one in reports]
    n_good = good.index(False) if False in good else len(good)
    return StaticResult(
        converged=all(good),
        load=1.0 if all(good) else (n_good + (stepper.reached if n_good == len(good) - 1 else 0.0)) / len(good),
        at_rounding=stepper.last.at_rounding,
        residual=max(one.residual for one in reports),
        iterations=sum(one.newton_iterations for one in reports),
        linear_iterations=sum(one.linear_iterations for one in reports),
        multigrid_solves=sum(one.multigrid_solves for one in reports),
        load_steps=sum(one.substeps for one in reports),
        elastic=reports[-1].elastic,
        n_inverted=reports[-1].n_inverted,
        imbalance="" if reports[-1].converged else stepper.last.imbalance,
        _scene=sim.scene,
        _layout=state.layout,
        _springs=state.springs,
        _states=tuple(states),
        step_reports=tuple(reports),
        problems=tuple(run.problems),
        error_estimate=run.error_estimate,
        quantities=run.quantities,
    )


def _load_step(sim: Simulator) -> LoadStep:
    """Return the present state of a simulator in statics."""
    state, pairs = sim._host().state, sim.pairs_in_contact()
    on_pairs = {
        (a, b): np.concatenate([sim.contact_force(a, b), sim.contact_torque(a, b)]) for one in pairs for a, b in (one, one[::-1])
    }
    time, cavities = sim.time, state.cavity_pressures_by_name(sim.time)
    contacts, every = sim.contacts() if sim.touches else None, [one.name for one in sim.scene.bodies if sim.touches]
    fields = {(name, by): sim.contact_pressure(name, by) for name in every for by in ("node", "triangle")}
    at = time if state.at is None else state.at
    return LoadStep(at, sim.positions(), sim.reactions(), state.amplitudes(time), cavities, contacts, on_pairs, fields)
