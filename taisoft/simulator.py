"""Simulator: allocates a scene on the device, steps it, and reports on it."""

import dataclasses
import warnings
import weakref

import numpy as np

from taisoft.attributes import thawed
from taisoft.backend import runtime
from taisoft.backend.arrays import FieldArena
from taisoft.dynamics import make_stepper
from taisoft.dynamics.dirichlet import DirichletConditions
from taisoft.dynamics.drag_spring import DragSpring, batch
from taisoft.dynamics.no_contacts import NoContacts
from taisoft.dynamics.simulation_state import SimulationState
from taisoft.errors import SceneError, SimulationError, no_memory
from taisoft.fem.laws import LAWS
from taisoft.fem.measure import NO_TET, measure
from taisoft.fem.model import build_model
from taisoft.fem.state import FIRST_SOFTENED, LOADS
from taisoft.records import RunReport, StepReport
from taisoft.resuming import Resuming
from taisoft.running import run
from taisoft.scene.scene import Scene
from taisoft.settings import check_count, check_settings, plan_of
from taisoft.stability import scale_warnings


def _release(arena: FieldArena, claim: runtime.Runtime, owned: list) -> None:
    """Release memory and runtime; also the finalizer of a simulator that was never closed."""
    while owned:
        owned.pop().release()
    arena.release()
    claim.close()


class Simulator(Resuming):
    """A simulation of a scene as it was at construction. SI units; positions are float64 in either precision.

    The scene is frozen. The simulator has its own copy of the scene's numbers, which its set_ methods change, as `dt` changes dt.
    dt: step [s]. integrator: "symplectic_euler" or "velocity_verlet" (explicit), "linearly_implicit_euler", "implicit_euler",
    "implicit_midpoint" (without contacts) or "bdf2" (implicit). contact_solver: "auto"; in explicit steps also "gauss_seidel",
    "coloured_gauss_seidel", "jacobi" or "hybrid", in implicit ones "augmented_lagrangian". self_collision: whether bodies touch
    themselves. precision: "f32" or "f64". arch: "cpu" or "cuda". newton_tolerance, linear_tolerance, contact_tolerance: relative;
    None: the default of the precision, for linear solves adaptive. draggable: allow `drag`.
    An explicit integrator refuses a dt above `stable_dt`; with allow_unstable it only warns.
    Raises SceneError for a scene that cannot be simulated, SimulationError for settings that cannot be met.
    """

    def __init__(
        self,
        scene: Scene,
        dt: float = 1 / 60,
        integrator: str = "implicit_euler",
        contact_solver: str = "auto",
        self_collision: bool = False,
        precision: str = "f32",
        arch: str = "cpu",
        allow_unstable: bool = False,
        newton_tolerance: float | None = None,
        linear_tolerance: float | None = None,
        contact_tolerance: float | None = None,
        draggable: bool = False,
    ):
        self.settings = check_settings(
            scene,
            dt,
            integrator,
            contact_solver,
            self_collision,
            precision,
            arch,
            allow_unstable,
            newton_tolerance,
            linear_tolerance,
            contact_tolerance,
            draggable,
        )
        self.scene = scene.snapshot()  # run-time changes must not reach the user's scene
        self._start_scene, scene = scene, self.scene
        self._dt = self.settings.dt
        self._stable_dt: float | None = None
        self._owned = []  # objects that have memory of their own to release
        self._contact = None
        self._idle_detection = None  # of a scene without contact forces; made on request
        self._may_soften = any(LAWS[b.material.law].SOFTENS_BELOW for b in scene.bodies)  # until `_warn_softened` has warned
        self._tangent = None  # fields of force_differential; made on request
        if self.settings.explicit:
            self._check_stability(self._dt)
        for text in scale_warnings(scene):
            warnings.warn(text, UserWarning, stacklevel=2)
        self.plan = plan_of(scene, integrator, self_collision, draggable)
        self._compiled_before = self._compile_reported = runtime.compile_clock()
        self._runtime = runtime.open_runtime(arch, precision, f"the simulator of {[b.name for b in scene.bodies]}")
        self._arena = FieldArena()
        try:
            model, layout = build_model(scene, self._runtime, self._arena, self.plan.on)
            dirichlet = DirichletConditions(scene, layout)
            self._simulation = SimulationState(scene, self._runtime, self._arena, model, layout, dirichlet)
            touching = self.plan.on["contact_forces"]
            if touching:
                from taisoft.dynamics.contact import ContactStep

                self._contact = ContactStep(self._simulation, self_collision, self.settings.explicit)
                self._owned.append(self._contact)
            self._drag_spring = DragSpring(self._simulation) if draggable else None
            self._stepper = make_stepper(self._simulation, integrator, self._contact or NoContacts(), contact_solver)
            self._owned.append(self._stepper)
            self.reset()
            if touching and not scene.allow_initial_overlap:
                self._refuse_overlap()
        except BaseException as error:
            _release(self._arena, self._runtime, self._owned)
            if isinstance(error, MemoryError):
                raise no_memory("this scene", error) from None
            raise
        if not self.settings.explicit:
            self._stepper.tolerance = newton_tolerance or self._stepper.tolerance
            self._stepper.linear_tolerance = linear_tolerance
        if self._contact is not None:
            self._stepper.contact_tolerance = contact_tolerance or self._stepper.contact_tolerance
        self._release = weakref.finalize(self, _release, self._arena, self._runtime, self._owned)
        for one in (self._start_scene, scene):
            one.freeze()
        self._seal(Simulator.__init__)

    def _refuse_overlap(self) -> None:
        found = self.deepest_overlap()
        if found is not None:
            raise SceneError(
                f"'{found.name_a}' and '{found.name_b}' overlap at the start, {found.depth:.3g} m deep: move them apart, or set "
                "scene.allow_initial_overlap = True"
            )

    @property
    def touches(self) -> bool:
        """Whether contact forces are simulated."""
        return self._contact is not None

    def contact_limit(self, a: str, b: str) -> float:
        """Penetration [m] of colliders a and b above which a step counts as deep. Requires contact forces (`touches`)."""
        names = [c.name for c in self.scene.colliders]
        return self._contact.deep_from(names.index(a), names.index(b))

    # --- stepping -------------------------------------------------------------------------------------------------

    def step(self) -> StepReport:
        """Take exactly one step of dt. Raises SimulationError if the result is not finite; the state stays the last good one."""
        return self.advance(1)

    def advance(self, n: int) -> StepReport:
        """Take up to n steps of dt, at least one: explicit steps in one launch, implicit steps one per call.

        Raises SimulationError as `step` does, and unless n is an integer of at least 1.
        """
        simulation, start, n, unbalanced = self._open_simulation(), self.step_count, check_count("n", n), (0.0, "")
        if self.dragged is not None:
            max_steps = batch(self._dt) if self.settings.explicit else 1
            n = min(n, max_steps)
            # the time of a whole batch even if n is smaller: the spring's stiffness, which depends on it, must not change
            self._drag_spring.apply(max_steps * self._dt)
            self._loads_changed()
        try:
            result = self._stepper.advance(n, self._dt) if self.settings.explicit else self._stepper.step(self._dt)
        except SimulationError as error:
            raise self._failure(error) from None
        if self.settings.explicit:
            self._count(result.done)
            report = self._report()
            report.min_volume_ratio = min(report.min_volume_ratio, result.min_volume_ratio)
            report.n_inverted = max(report.n_inverted, result.n_inverted)
        else:
            self._count(1)
            report = self._report()
            report.newton_iterations, report.linear_iterations = result.newton_iterations, result.linear_iterations
            report.residual, report.converged, report.substeps = result.residual, result.converged, self._stepper.substeps
            worst, name = unbalanced = result.unbalanced
            if name:
                report.residual, report.converged = max(report.residual, worst), False
        if self._contact is not None:
            report.contact_iterations, report.contact_residual = result.contact_iterations, result.contact_residual
            report.n_contacts, report.max_penetration = self._contact.n_contacts, self._contact.penetration
            report.dropped_contacts = self._contact.dropped
            if self.settings.explicit:
                report.converged = result.contacts_converged
            report.deep, report.crossings = int(self._contact.is_deep), self._contact.crossings
        report.steps = self.step_count - start
        if self._may_soften:
            self._warn_softened()
        report.problems = [f"step {simulation.step_count}: {problem}" for problem in self._problems(report, unbalanced)]
        return report

    def _failure(self, error: SimulationError) -> SimulationError:
        """Return a step's error with the step's number; if the state at its start was not finite, name that place instead."""
        self._runtime.check()  # raises its own error
        nonfinite, step = self._simulation.find_nonfinite(), f"step {self.step_count + 1}: "
        if nonfinite is not None:
            return SimulationError(f"{step}{nonfinite} at its start")
        return error if str(error).startswith("step ") else SimulationError(f"{step}{error}")

    def _warn_softened(self) -> None:
        """Warn once, of the first tet compressed so far that its material law softens."""
        layout, first = self._simulation.layout, int(self._simulation.model.state.scalars[FIRST_SOFTENED])
        if first == NO_TET:
            return
        self._may_soften = False
        place = first - layout.block_start * self._runtime.lanes
        k = int(np.flatnonzero((place >= 0) & (place < layout.n_tets))[0])
        body = self.scene.bodies[k]
        law = LAWS[body.material.law]
        warnings.warn(
            f"step {self.step_count}: tet {place[k]} of body '{body.name}' is compressed below {law.SOFTENS_BELOW} of its "
            f"length, where {law.NAME} softens: tets may collapse or invert, and stay so",
            UserWarning,
            stacklevel=3,
        )

    def _problems(self, report: StepReport, unbalanced: tuple[float, str]) -> list[str]:
        """Describe what went wrong in the step, one sentence per problem. unbalanced: see `StageResult`."""
        found = []
        if not report.converged and not self.settings.explicit:
            found.append(
                f"Newton stopped after {report.newton_iterations} iterations at a relative residual of {report.residual:.2e}"
                + (f" and a contact residual of {report.contact_residual:.2e}" if report.n_contacts else "")
            )
            if unbalanced[1]:
                worst, name = unbalanced
                found.append(f"forces on {name} are unbalanced by {worst:.2g} of their size, beside larger forces elsewhere")
        elif not report.converged:
            found.append(f"the contact solver stopped at a residual of {report.contact_residual:.2e}")
        if report.dropped_contacts:
            found.append(f"{report.dropped_contacts} triangles belong to inverted tets, so their contacts are unknown")
        if report.deep:
            found.append(
                f"bodies are {report.max_penetration:.3g} m deep in each other or in obstacles"
                + (f", {report.crossings} pairs of surface triangles cross" if report.crossings else "")
            )
            found += [
                f"'{a}' and '{b}' overlap by {depth:.3g} m" if a != b else f"parts of '{a}' overlap by {depth:.3g} m"
                for a, b, depth in self._contact.inside
            ]
        if report.n_inverted:
            found.append(f"{report.n_inverted} tets are inverted")
        return found

    def run(
        self, seconds: float, on_frame=None, fps: float | None = 60, stop=None, resumed: bool = False, on_step=None
    ) -> RunReport:
        """Run for the given simulated time [s]; see `taisoft.running.run`."""
        return run(self, seconds, on_frame, fps, stop, resumed, on_step)

    def reset(self) -> None:
        """Restore the scene's initial state; changed numbers (dt, gravity, materials, loads) stay. Compiles nothing."""
        self._open_simulation().restart()
        self.release()
        self._changes += 1
        self._time_base = (0.0, 0)
        self._stepper.forget()

    def rebuild(self, **changes) -> None:
        """Continue from the present state with other settings, arguments of this class; arch and precision cannot change.

        Positions, velocities, time, step count, released nodes and changed numbers are kept. The integrator's history is
        discarded, as by `set_state`, and a drag ends. Both simulators are in memory during the call.
        Raises SimulationError if the settings cannot be met; this simulator is then unchanged.
        """
        kept, start = self._open_simulation().snapshot(), self.scene.snapshot()
        start.allow_initial_overlap = True  # bodies move to the present positions below
        new = Simulator(start, **(dataclasses.asdict(self.settings) | {"dt": self._dt} | changes))
        with thawed(new.scene):
            new.scene.allow_initial_overlap = self.scene.allow_initial_overlap
        new._simulation.restore(kept)
        new._stepper.forget()
        new._time_base, new._start_scene = (self.time, self.step_count), self._start_scene
        new._compiled_before, new._compile_reported = self._compiled_before, self._compile_reported
        new._changes = self._changes + 1
        self._release()
        _, give_back, owned, _ = new._release.detach()
        self.__dict__.update(new.__dict__)
        self._release = weakref.finalize(self, give_back, *owned)

    def _count(self, done: int) -> None:
        simulation = self._simulation
        simulation.step_count += done
        start, count = self._time_base
        simulation.time = start + (simulation.step_count - count) * self._dt

    def _report(self) -> StepReport:
        measure(self._simulation.model)
        scalars = self._simulation.model.state.scalars.to_numpy()[: LOADS + 1].tolist()
        elastic, lowest, inverted, kinetic, gravity, _, loads = scalars
        return StepReport(
            time=self.time,
            min_volume_ratio=lowest,
            n_inverted=int(inverted),
            kinetic=kinetic,
            elastic=elastic,
            gravity=gravity,
            loads=loads,
        )

    # --- resources ----------------------------------------------------------------------------------------------------

    @property
    def compile_seconds(self) -> float:
        """Time spent starting Taichi and compiling kernels for this simulator, including its construction [s]."""
        return runtime.compile_clock() - self._compiled_before

    def _take_compile_seconds(self) -> float:
        """Return the compile time since the last call [s], so that each run reports its own."""
        now = runtime.compile_clock()
        seconds, self._compile_reported = now - self._compile_reported, now
        return seconds

    @property
    def field_bytes(self) -> dict[str, int]:
        """Size of every allocated array [bytes], by name."""
        self._host_simulation()
        detection = self._contact or self._idle_detection
        return self._arena.bytes | (detection.field_bytes if detection else {}) | self._stepper.field_bytes

    @property
    def buffer_growths(self) -> dict[str, int]:
        """How often each buffer of contact detection grew since the start; buffers that never grew are left out."""
        detection = self._contact.detection if self._contact is not None else self._idle_detection
        return {name: n for name, n in detection.counts.growths.items() if n} if detection is not None else {}

    def close(self) -> None:
        """Release memory and runtime; a closed simulator cannot be used."""
        if self._simulation is not None:
            self._release()
            self._simulation = self._stepper = self._contact = self._idle_detection = self._tangent = self._drag_spring = None

    def __enter__(self) -> "Simulator":
        return self

    def __exit__(self, *exception) -> None:
        self.close()
