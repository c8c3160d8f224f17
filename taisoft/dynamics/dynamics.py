"""A scene on the device, and everything that steps it: state, contacts, drag spring and integrator.

Steppers are imported only when needed, since decorating kernels takes time. A stepper has `advance(n, dt) -> StepResult`;
`forget`, `numbers_changed`, `loads_changed` and `wake` to follow changes between steps; `settle` to end a step; `held_steps(dt)`,
the steps over which a drag force is held; `reactions`; `snapshot` and `restore`; `field_bytes` and `release`.
"""

import weakref
from typing import TYPE_CHECKING

import numpy as np

from taisoft.backend import runtime
from taisoft.backend.arrays import FieldArena
from taisoft.dynamics.commands import Commands
from taisoft.dynamics.dirichlet import DirichletConditions
from taisoft.dynamics.drag_spring import DragSpring
from taisoft.dynamics.no_contacts import NoContacts
from taisoft.dynamics.prescribed_paths import PrescribedPaths
from taisoft.dynamics.results import StepResult
from taisoft.dynamics.robots import Robots
from taisoft.dynamics.schemes import SCHEMES
from taisoft.dynamics.simulation_state import SimulationState
from taisoft.errors import SimulationError
from taisoft.fem.build import build_model
from taisoft.fem.laws import lane_law
from taisoft.fem.measure import NO_TET, measure, measure_parts
from taisoft.fem.model import Model
from taisoft.fem.state import FIRST_SOFTENED, LOADS
from taisoft.records import Energies, StepReport
from taisoft.scene.commands import Command
from taisoft.scene.plan import Plan
from taisoft.scene.rigid import Pose
from taisoft.scene.scene import Scene
from taisoft.settings import Settings, check_dt

if TYPE_CHECKING:
    from taisoft.collision.detector import Detection
    from taisoft.dynamics.contact import ContactStep
    from taisoft.dynamics.explicit_stepper import ExplicitStepper
    from taisoft.dynamics.implicit import ImplicitStepper


class Dynamics:
    """A simulated scene. `Simulator` checks arguments, and adds queries, changes and runs.

    Memory and runtime are freed by `close`, at the latest with the object. Raises MemoryError, SimulationError or MeshError;
    nothing is then left allocated.
    """

    def __init__(self, scene: Scene, settings: Settings, plan: Plan):
        self.scene, self.plan, self.dt = scene, plan, settings.dt
        self._velocities_before: tuple[np.ndarray, float] | None = None  # before the last step, and its time [s]; of joints only
        self.robots: Robots | None = None  # until it is built
        self.tangent = None  # fields of `Simulator.force_differential`; made on request
        self.changes = 0  # count of user changes to the state or to numbers; at each the energy jumps
        self._time_base = 0.0, 0  # time [s] and step count when dt, the state or the settings last changed
        self.runtime = runtime.open_runtime(
            settings.arch, settings.precision, f"the simulator of {[b.name for b in scene.bodies]}"
        )
        self.arena, self._owned = FieldArena(), []  # the latter have memory of their own
        self._free = weakref.finalize(self, _free, self.arena, self.runtime, self._owned)
        try:
            self._build(scene, settings, plan)
        except BaseException:
            self.close()
            raise

    def _build(self, scene: Scene, settings: Settings, plan: Plan) -> None:
        model, layout = build_model(scene, self.runtime, self.arena, plan.on)
        self.state = SimulationState(scene, self.runtime, self.arena, model, layout, DirichletConditions(scene, layout))
        self.state.ramp, self.state.budget = settings.ramp or 0.0, settings.budget
        self.state.asleep = np.zeros(model.n_nodes, dtype=bool) if plan.on["sleeping"] else None
        self.contact = None
        if plan.on["contact_forces"]:
            from taisoft.dynamics.contact import ContactStep

            self.contact = ContactStep(self.state, settings.self_collision, settings.explicit, settings.static)
            self._owned.append(self.contact)
        self._self_collision, self._static = settings.self_collision, settings.static
        self._idle_detection: Detection | None = None  # of a scene without contact forces; made on request
        self.drag_spring = DragSpring(self.state) if settings.draggable else None
        self.stepper = make_stepper(self.state, settings, self.contact or NoContacts())
        self._owned.append(self.stepper)
        self._paths = PrescribedPaths(scene, self.state.dirichlet)
        self.commands, self._explicit = Commands(scene, self.state.dirichlet), settings.explicit
        self.robots = Robots(scene)
        self.reset()

    @property
    def is_open(self) -> bool:
        """Whether it can be used: `close` was not called yet."""
        return self._free.alive

    def close(self) -> None:
        """Free all memory and the runtime; dt alone stays readable."""
        if self.robots is not None:
            self.robots.close()
        self._free()
        self.state = self.contact = self.stepper = self.drag_spring = self._idle_detection = self.tangent = None

    @property
    def model(self) -> Model:
        """The `Model` of the scene."""
        return self.state.model

    # --- stepping -----------------------------------------------------------------------------------------------------

    def advance(self, n: int) -> StepReport:
        """Take up to n steps of dt, at least one: explicit steps in one launch, implicit steps one per call.

        Robots are not moved, see `Robots.step`. Raises SimulationError that names the step; the state stays the last good one.
        """
        spring, start = self.drag_spring, self.state.step_count
        begin, end = self.state.time, self.state.time + (n if self._explicit else 1) * self.dt
        if spring is not None and spring.drag is not None:
            held = self.stepper.held_steps(self.dt)
            n = min(n, held)
            # the time of a whole batch even if n is smaller: the spring's stiffness, which depends on it, must not change
            spring.apply(held * self.dt)
            self.stepper.loads_changed()
        before = (self.state.state()[1].astype(np.float64), self.state.time) if self.model.has_dependents else None
        begun = {}
        try:
            self._paths.check()
            begun = self.commands.begin(begin + self.dt, end)
            self._paths.begin(begin, self.dt, end)
            result = self.stepper.advance(n, self.dt)
        except BaseException as error:  # Ctrl-C, too
            if self.state.step_count == start:
                self.commands.undo(begun)
            if isinstance(error, SimulationError):
                raise self._failure(error) from None
            raise
        self._velocities_before = before
        self.state.step_count = start + result.steps
        base, count = self._time_base
        self.state.time = base + (self.state.step_count - count) * self.dt
        report = self._report(result)
        problems = [*result.problems, *self._problems(report)]
        self.stepper.settle(self.dt, report.converged and not problems)
        report.problems = [f"step {self.state.step_count}: {problem}" for problem in problems]
        return report

    def warm_up(self) -> None:
        """Take a step, launch what later ones may need besides, and return to the present state: see `Simulator.warm_up`."""
        kept, before = self.snapshot(), self._velocities_before
        try:
            self.stepper.wake()
            self.advance(1)
            self.stepper.warm_up(self.state.time, self.dt)
        finally:
            self.restore(kept)
            self._velocities_before = before

    def _failure(self, error: SimulationError) -> SimulationError:
        """Return a step's error with the step's number; if the state at its start was not finite, name that place instead."""
        self.runtime.check()  # raises its own error
        nonfinite, step = self.state.find_nonfinite(), f"step {self.state.step_count + 1}: "
        if nonfinite is not None:
            return SimulationError(f"{step}{nonfinite} at its start")
        return error if str(error).startswith("step ") else SimulationError(f"{step}{error}")

    def _report(self, result: StepResult) -> StepReport:
        """Return the report of a step: of its `StepResult`, and of the state and the contacts at its end."""
        energies, lowest, inverted = self._measure()
        own = {name: value for name, value in vars(result).items() if name != "problems"}
        report = StepReport(**own, time=self.state.time, **vars(energies))
        report.min_volume_ratio = min(result.min_volume_ratio, lowest)
        report.n_inverted = max(result.n_inverted, inverted)
        if (contact := self.contact) is not None:
            report.n_contacts, report.max_penetration = contact.n_contacts + len(contact.asleep), contact.check.penetration
            report.dropped_contacts, report.deep = contact.dropped, int(contact.check.is_deep)
            report.crossings = contact.check.last_crossing.n_pairs
            report.misplaced, report.contact_error = contact.misplaced.part, contact.misplaced.text
        return report

    def _problems(self, report: StepReport) -> list[str]:
        """Describe what is wrong with the state and the contacts at the end of a step, one sentence per problem."""
        found = []
        if report.dropped_contacts:
            found.append(f"{report.dropped_contacts} triangles belong to inverted tets, so their contacts are unknown")
        if report.deep:
            found.append(
                f"bodies are {report.max_penetration:.3g} m deep in each other or in obstacles"
                + (f", {report.crossings} pairs of surface triangles cross" if report.crossings else "")
            )
            names = [f"'{c.name}'" for c in self.scene.colliders]
            overlaps = self.contact.check.last_crossing.inside
            owners = (f"{names[a]} and {names[b]}" if a != b else f"parts of {names[a]}" for a, b, _ in overlaps)
            found += [f"{owner} overlap by {depth:.3g} m" for owner, (*_, depth) in zip(owners, overlaps)]
        if report.contact_error:
            found.append(report.contact_error)
        if report.n_inverted:
            found.append(f"{report.n_inverted} tets are inverted")
        return found

    # --- changes between steps ----------------------------------------------------------------------------------------

    def reset(self) -> None:
        """Restore the scene's initial state, without commands; changed numbers (dt, gravity, materials, loads) stay.

        Compiles nothing.
        """
        self.commands.reset()
        self.robots.restart()
        self.state.restart()
        self.end_drag()
        self._time_base = 0.0, 0
        self._paths.remember(0.0)
        self.state_changed()

    def state_changed(self) -> None:
        """Discard the stepper's history, after the state was set."""
        self.changes += 1
        self._velocities_before = None
        self.stepper.forget()

    def numbers_changed(self) -> None:
        """Update the stepper, after gravity or materials changed."""
        self.changes += 1
        self.stepper.numbers_changed()

    def loads_changed(self, *bodies: str) -> None:
        """Follow a change of the scene's loads on bodies."""
        self.changes += 1
        self.state.loads_changed()
        self.stepper.loads_changed()
        self.stepper.wake(*bodies)

    def set_dt(self, dt: float) -> None:
        """Set dt [s] of the next step."""
        self._time_base = self.state.time, self.state.step_count
        self.changes += 1
        self.dt = dt
        self.stepper.wake()

    def command(self, commands: dict[int, Command]) -> None:
        """Let movers of `commands` follow others from the next step on."""
        for mover, command in commands.items():
            self.commands.follow(mover, command)
        self.changes += 1
        if self.contact is not None:
            self.contact.search.discard()

    def command_poses(self, poses: dict[str, Pose]) -> None:
        """Let obstacles, by name, move to poses in the next step."""
        commands, now = {}, self.state.time
        for name, last in poses.items():
            mover = self.commands.obstacle(self.scene.obstacle(name))
            first, turned = self.commands.pose(mover, now, name)
            commands[mover] = Command(now, first, last.translation, first_rotation=turned, last_rotation=last.rotation)
        self.command(commands)

    def end_drag(self) -> None:
        """End the drag, if any."""
        if self.drag_spring is not None and self.drag_spring.release():
            self.changes += 1
            self.stepper.loads_changed()

    @property
    def asleep(self) -> list[str]:
        """The names of the bodies that sleep."""
        first, asleep = self.state.layout.node_start, self.state.asleep
        return [] if asleep is None else [body.name for k, body in enumerate(self.scene.bodies) if asleep[first[k]]]

    @property
    def is_driven(self) -> bool:
        """Whether anything does work now that energies do not count: a drag, prescribed nodes, moving obstacles, loads along
        paths or without a potential."""
        moving = self.contact is not None and not all(obstacle.rests(self.state.time) for obstacle in self.scene.obstacles)
        dragged = self.drag_spring is not None and self.drag_spring.drag is not None
        driven = self.state.loads.vary or not self.state.loads.has_potential
        return bool(self.robots) or moving or dragged or driven or not self.state.now.released.all()

    def mean_acceleration(self, nodes: np.ndarray) -> np.ndarray:
        """Return the mean acceleration (k,3) [m/s^2] of nodes (k,) in the last step or batch; 0 before the first one here.

        Kept only in scenes with exact attachments, and not in checkpoints.
        """
        if self._velocities_before is None:
            return np.zeros((len(nodes), 3))
        before, start = self._velocities_before
        return (self.state.state()[1][nodes] - before[nodes]) / (self.state.time - start)

    # --- queries ------------------------------------------------------------------------------------------------------

    def energies(self) -> Energies:
        """Return the energies of the present state [J]."""
        return self._measure()[0]

    def body_energies(self) -> list[Energies]:
        """Return the energies of each body in the present state [J], without those of springs, tendons and attachments."""
        m, layout = self.model, self.state.layout
        lanes, nodes = np.zeros(m.n_blocks * m.lanes), np.zeros((m.n_nodes, 3))
        self.state.set_load_time(self.state.time)
        measure_parts(m, lanes, nodes)
        elastic = np.add.reduceat(lanes[layout.lane_of_tet], layout.tet_start[:-1])
        kinetic, gravity, loads = np.add.reduceat(nodes * (not self._static, 1.0, 1.0), layout.node_start[:-1]).T
        lost = np.add.reduceat(self.state.dissipated()[layout.lane_of_tet], layout.tet_start[:-1])
        return [Energies(*row) for row in zip(*(part.tolist() for part in (kinetic, elastic, gravity, loads, lost)))]

    def _measure(self) -> tuple[Energies, float, int]:
        """Return the energies of the present state [J], its smallest J, and its number of inverted tets."""
        self.state.set_load_time(self.state.time)
        measure(self.model)
        elastic, lowest, inverted, kinetic, gravity, _, loads = self.model.state.scalars.to_numpy()[: LOADS + 1].tolist()
        lost, kinetic = float(self.state.dissipated().sum()) if self.model.viscous else 0.0, 0.0 if self._static else kinetic
        return Energies(kinetic, elastic, gravity, loads, lost), lowest, int(inverted)

    def describe_softening(self) -> str | None:
        """Name the tet that was first compressed so far that its material law softens; None if there is none."""
        layout, first = self.state.layout, int(self.model.state.scalars[FIRST_SOFTENED])
        if first == NO_TET:
            return None
        at = int(layout.tet_of_lane[first])
        k = int(np.searchsorted(layout.tet_start, at, side="right")) - 1
        body, tet = self.scene.bodies[k], at - layout.tet_start[k]
        law = lane_law(body.composition.law_of_tet(tet))
        floor = np.broadcast_to(body.composition.number("volume_floor"), body.mesh.n_tets)[tet]
        collapse = f"collapse to below their volume_floor of {floor:g}" if floor > 0.0 else "collapse or invert, and stay so"
        return (
            f"step {self.state.step_count}: tet {tet} of body '{body.name}' is compressed below {law.SOFTENS_BELOW} of its "
            f"length, where {law.NAME} softens: tets may {collapse}"
        )

    def find_contacts(self, dt: float) -> "Detection":
        """Detect the contacts of the present state swept by dt [s]; with 0, paths are evaluated at the present time only."""
        state = self.state
        if self.contact is not None:
            self.contact.search.find_all(state.time, dt)
            return self.contact.detection
        if self._idle_detection is None:
            from taisoft.collision.detector import Detection

            self._idle_detection = Detection(self.scene, state.model, state.layout, self.runtime, self._self_collision)
            self._owned.append(self._idle_detection)
        self._idle_detection.find(state.time, dt)
        return self._idle_detection

    @property
    def detection(self) -> "Detection | None":
        """The contact detection in use; None if none was needed yet."""
        return self.contact.detection if self.contact is not None else self._idle_detection

    @property
    def field_bytes(self) -> dict[str, int]:
        """Size of every allocated array [bytes], by name."""
        found = self.contact or self._idle_detection
        return self.arena.bytes | (found.field_bytes if found else {}) | self.stepper.field_bytes

    # --- checkpoints --------------------------------------------------------------------------------------------------

    def snapshot(self) -> dict:
        """Return everything the next step depends on besides scene and settings, for a checkpoint."""
        start, count = self._time_base
        own = {"dt": self.dt, "time_base": start, "count_base": count}
        parts = {"simulation": self.state.snapshot(), "stepper": self.stepper.snapshot(), "commands": self.commands.snapshot()}
        return own | parts | {"robots": self.robots.snapshot()}

    def restore(self, kept: dict) -> None:
        """Restore a `snapshot` of the same scene with the same numbers."""
        self.dt, self._time_base = check_dt(kept["dt"]), (float(kept["time_base"]), int(kept["count_base"]))
        self.commands.restore(kept["commands"])
        self.robots.restore(kept["robots"])
        self.state.restore(kept["simulation"])
        self._paths.remember(self.state.time)
        self._velocities_before = None
        self.stepper.restore(kept["stepper"])

    def continue_from(self, other: "Dynamics") -> None:
        """Take over the state of another instance of the same scene, as `state_changed` does without history."""
        self.commands.continue_from(other.commands)
        self.robots.restore(other.robots.snapshot())
        self.state.restore(other.state.snapshot())
        self._paths.remember(self.state.time)
        self.stepper.forget()
        self._time_base = other.state.time, other.state.step_count
        self.changes = other.changes + 1


def _free(arena: FieldArena, claim: runtime.Runtime, owned: list) -> None:
    while owned:
        owned.pop().release()
    arena.release()
    claim.close()


def make_stepper(
    simulation: SimulationState, settings: Settings, contact: "ContactStep | NoContacts"
) -> "ExplicitStepper | ImplicitStepper":
    """Return the stepper of checked settings."""
    if settings.integrator in SCHEMES:
        from taisoft.dynamics.implicit import ImplicitStepper

        return ImplicitStepper(simulation, settings, contact)
    if contact.idle:
        from taisoft.dynamics.explicit_stepper import ExplicitStepper

        return ExplicitStepper(simulation, settings)
    from taisoft.dynamics.explicit_contact_stepper import ContactExplicitStepper

    return ContactExplicitStepper(simulation, settings, contact)
