"""Simulator: builds a scene into the machine, steps it, and tells about it."""

import dataclasses
import warnings
import weakref

import numpy as np

from taisoft import runtime
from taisoft.attributes import thawed
from taisoft.dynamics import make_stepper
from taisoft.dynamics.dirichlet import DirichletConditions
from taisoft.dynamics.drag_spring import DragSpring, batch
from taisoft.dynamics.no_contacts import NoContacts
from taisoft.dynamics.simulation_state import SimulationState
from taisoft.elasticity import NO_TET, measure
from taisoft.errors import SceneError, SimulationError, no_memory
from taisoft.fields import FieldArena
from taisoft.materials import LAWS
from taisoft.model import build_model
from taisoft.records import RunReport, StepReport
from taisoft.resuming import Resuming
from taisoft.running import run
from taisoft.scalars import FIRST_SOFTENED, LOADS
from taisoft.scene.scene import Scene
from taisoft.settings import check_count, check_settings, plan_of
from taisoft.stability import scale_warnings


def _release(arena: FieldArena, claim: runtime.Runtime, owned: list) -> None:
    """Give memory and runtime back; also when a simulator is dropped without `close`."""
    while owned:
        owned.pop().release()
    arena.release()
    claim.close()


class Simulator(Resuming):
    """A scene being simulated, as it was when this was made. SI units; positions are float64 in either precision.

    The scene is frozen: what a simulator can change while it runs are its own numbers, by its set_ methods and dt.
    dt [s]; integrator: one of taisoft.dynamics.INTEGRATORS; newton_tolerance, linear_tolerance: relative, None is adaptive.
    An explicit integrator refuses a dt above `stable_dt` unless allow_unstable, which only warns. draggable: `pull` is wanted.
    Raises SceneError for a scene that cannot be simulated, SimulationError for settings that cannot be met.
    """

    def __init__(
        self, scene: Scene, dt: float = 1 / 60, integrator: str = "implicit_euler", contact_solver: str = "auto",
        self_collision: bool = False, precision: str = "f32", arch: str = "cpu", allow_unstable: bool = False,
        newton_tolerance: float | None = None, linear_tolerance: float | None = None,
        contact_tolerance: float | None = None, draggable: bool = False,
    ):  # fmt: skip
        self.settings = check_settings(
            scene, dt, integrator, contact_solver, self_collision, precision, arch, allow_unstable, newton_tolerance,
            linear_tolerance, contact_tolerance, draggable,
        )  # fmt: skip
        self.scene = scene.snapshot()  # numbers that change while it runs are not those of the user's scene
        self._given, scene = scene, self.scene
        self._dt = self.settings.dt
        self._stable_dt: float | None = None
        self._owned = []  # what has memory of its own to give back
        self._contact = None
        self._idle_detection = None  # of a scene without contact forces, once asked for
        self._softens = any(LAWS[b.material.law].SOFTENS_BELOW for b in scene.bodies)  # and it was not told yet
        self._tangent = None  # fields of force_differential, once asked for
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
        for one in (self._given, scene):
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
        """Whether contact forces are modelled."""
        return self._contact is not None

    def contact_limit(self, a: str, b: str) -> float:
        """Penetration [m] of two colliders, by name, above which a step counts as deep, where contact forces are modelled."""
        names = [c.name for c in self.scene.colliders]
        return self._contact.deep_from(names.index(a), names.index(b))

    # --- stepping -------------------------------------------------------------------------------------------------

    def step(self) -> StepReport:
        """Exactly one step of dt. Raises SimulationError when the result is not finite; the state is then the last good."""
        return self.advance(1)

    def advance(self, n: int) -> StepReport:
        """Up to n steps of dt, at least one: explicit ones in one launch, implicit ones one at a time.

        Raises SimulationError as `step` does, and unless n is an integer of at least 1.
        """
        simulation, start, n, unbalanced = self._open_simulation(), self.step_count, check_count("n", n), (0.0, "")
        if self.dragged is not None:
            most = batch(self._dt) if self.settings.explicit else 1
            n = min(n, most)
            self._drag_spring.apply(most * self._dt)  # of less than a batch, too: the spring must not change its stiffness
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
        if self._softens:
            self._warn_softened()
        report.problems = [f"step {simulation.step_count}: {what}" for what in self._problems(report, unbalanced)]
        return report

    def _failure(self, error: SimulationError) -> SimulationError:
        """The error of a step with the step's number; where the state that it began with was spoilt, with the place."""
        self._runtime.check()  # says so itself
        where, step = self._simulation.find_nonfinite(), f"step {self.step_count + 1}: "
        if where is not None:
            return SimulationError(f"{step}{where} at its start")
        return error if str(error).startswith("step ") else SimulationError(f"{step}{error}")

    def _warn_softened(self) -> None:
        """Warn, once, of the first tet that is squeezed so far that its law softens."""
        layout, first = self._simulation.layout, int(self._simulation.model.state.scalars[FIRST_SOFTENED])
        if first == NO_TET:
            return
        self._softens = False
        place = first - layout.block_start * self._runtime.lanes
        k = int(np.flatnonzero((place >= 0) & (place < layout.n_tets))[0])
        body = self.scene.bodies[k]
        law = LAWS[body.material.law]
        warnings.warn(
            f"step {self.step_count}: tet {place[k]} of body '{body.name}' is squeezed to less than {law.SOFTENS_BELOW} of its "
            f"length, where {law.NAME} softens: tets may collapse and turn inside out, and stay so",
            UserWarning, stacklevel=3,
        )  # fmt: skip

    def _problems(self, report: StepReport, unbalanced: tuple[float, str]) -> list[str]:
        """What was not as it should be, in sentences. unbalanced: see `StageResult`."""
        found = []
        if not report.converged and not self.settings.explicit:
            found.append(
                f"Newton stopped after {report.newton_iterations} iterations at a relative residual of {report.residual:.2e}"
                + (f", that of the contacts {report.contact_residual:.2e}" if report.n_contacts else "")
            )
            if unbalanced[1]:
                worst, name = unbalanced
                found.append(f"forces on {name} are unbalanced by {worst:.2g} of their size, beside larger ones on others")
        elif not report.converged:
            found.append(f"the contact solver stopped at a residual of {report.contact_residual:.2e}")
        if report.dropped_contacts:
            found.append(f"{report.dropped_contacts} triangles lie under inverted tets, so their contacts are not known")
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
    ) -> RunReport:  # fmt: skip
        """Run for some seconds; see `taisoft.running.run`."""
        return run(self, seconds, on_frame, fps, stop, resumed, on_step)

    def reset(self) -> None:
        """Back to the scene's start; changed numbers (dt, gravity, materials, loads) stay. Copies arrays; compiles nothing."""
        self._open_simulation().restart()
        self.release()
        self._changes += 1
        self._time_base = (0.0, 0)
        self._stepper.forget()

    def rebuild(self, **changes) -> None:
        """Go on from the present state with other settings, arguments of this class; arch and precision cannot change.

        Positions, velocities, time, count of steps, let-go nodes and changed numbers stay as they are. What the integrator knew
        of earlier steps is forgotten, as by `set_state`, and a pull ends. Memory is held twice meanwhile.
        Raises SimulationError where the settings cannot be met; this simulator is then as it was.
        """
        kept, start = self._open_simulation().snapshot(), self.scene.snapshot()
        start.allow_initial_overlap = True  # where bodies start is not where they are
        new = Simulator(start, **(dataclasses.asdict(self.settings) | {"dt": self._dt} | changes))
        with thawed(new.scene):
            new.scene.allow_initial_overlap = self.scene.allow_initial_overlap
        new._simulation.restore(kept)
        new._stepper.forget()
        new._time_base, new._given = (self.time, self.step_count), self._given
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

    # --- life ---------------------------------------------------------------------------------------------------------

    @property
    def compile_seconds(self) -> float:
        """Seconds spent starting Taichi and compiling kernels for this simulator, its construction included."""
        return runtime.compile_clock() - self._compiled_before

    def _take_compile_seconds(self) -> float:
        """Those that no run has reported yet."""
        now = runtime.compile_clock()
        seconds, self._compile_reported = now - self._compile_reported, now
        return seconds

    @property
    def field_bytes(self) -> dict[str, int]:
        """Bytes of every allocated array by name."""
        self._kept_simulation()
        searched = self._contact or self._idle_detection
        return self._arena.bytes | (searched.field_bytes if searched else {}) | self._stepper.field_bytes

    @property
    def buffer_growths(self) -> dict[str, int]:
        """How often each buffer of the search for contacts grew since the start; those that never did are left out."""
        searched = self._contact.detection if self._contact is not None else self._idle_detection
        return {name: n for name, n in searched.counts.growths.items() if n} if searched is not None else {}

    def close(self) -> None:
        """Give memory and runtime back; a closed simulator cannot be used."""
        if self._simulation is not None:
            self._release()
            self._simulation = self._stepper = self._contact = self._idle_detection = self._tangent = self._drag_spring = None

    def __enter__(self) -> "Simulator":
        return self

    def __exit__(self, *exception) -> None:
        self.close()
