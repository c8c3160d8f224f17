"""Simulator: a scene on the device, stepped, changed and queried. Its methods lie in the modules named beside them."""

import dataclasses
import warnings
from typing import TYPE_CHECKING

from taisoft import changes, checkpoint, commanding, contact_queries, details, queries, running
from taisoft.attributes import Guarded, SimulationAttributeError, thawed
from taisoft.backend import runtime
from taisoft.display import drawn, simulator_text
from taisoft.dynamics.dynamics import Dynamics
from taisoft.errors import SceneError, SimulationError, no_memory
from taisoft.estimation.first_choice import settings_for
from taisoft.fem.laws import lane_law
from taisoft.output.vtu import to_pyvista, write_vtu
from taisoft.records import StepReport
from taisoft.scene import checks
from taisoft.scene.scene import Scene
from taisoft.settings import NAMES, Settings, check_settings, plan_of
from taisoft.stability import scale_warnings

if TYPE_CHECKING:
    from taisoft.estimation.estimator import ErrorEstimator


class Simulator(Guarded):
    """A simulation of a scene as it was at construction. SI units; positions are float64 in either precision.

    The scene is frozen. The simulator has its own copy of the scene's numbers, which its set_ methods change, as `dt` changes dt.
    dt: step [s]. integrator: "symplectic_euler" or "velocity_verlet" (explicit), "linearly_implicit_euler", "implicit_euler",
    "implicit_midpoint" (without contacts) or "bdf2" (implicit); "static": each step is a load step, which ends at rest under the
    loads, prescribed nodes and obstacles of its end, see `solve_static`; constant loads grow during `ramp` [s], by default the
    first dt. contact_solver: "auto"; in explicit steps also "gauss_seidel",
    "coloured_gauss_seidel", "jacobi" or "hybrid", in implicit ones "augmented_lagrangian". self_collision: whether bodies touch
    themselves. precision: "f32" or "f64". arch: "cpu" or "cuda". newton_tolerance, linear_tolerance, contact_tolerance: relative;
    None: the default of the precision, for linear solves adaptive. draggable: allow `drag`.
    tolerance: wanted error of positions in time over the largest excursion; `run` then chooses integrator and dt by trials
    (`taisoft.estimation.tolerance`), whatever they were before, and tolerances that are None follow from it.
    budget: wall time for an implicit step in time [s]. Where it is used up Newton's method ends at its last iterate, after one
    iteration at least; bodies that would then pass through something, or invert, are held back. Such steps are reported as not
    converged (`StepReport.on_budget`). Results then depend on the machine and its load.
    sleep: leave bodies that rest out of implicit steps until something moves them, see `taisoft.dynamics.sleeping`; never with a
    tolerance.
    An explicit integrator refuses a dt above `stable_dt`; with allow_unstable it only warns.
    Raises SceneError for a scene that cannot be simulated, SimulationError for settings that cannot be met.
    """

    _error = SimulationAttributeError
    _read_only = frozenset(("settings", "scene", "plan"))
    _instead = changes.INSTEAD
    settings: Settings
    _dynamics: Dynamics | None = None  # None until it is made
    _estimator: "ErrorEstimator | None" = None  # of a run with error=True, while it lasts

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
        tolerance: float | None = None,
        ramp: float | None = None,
        budget: float | None = None,
        sleep: bool = True,
    ):
        given = locals()  # of the arguments alone, as long as this is the first line
        self.settings = check_settings(scene, **{name: given[name] for name in NAMES})
        self._stable_dt: float | None = None  # None: not computed yet, or outdated
        if tolerance is not None:
            self.settings, self._stable_dt = settings_for(scene, self.settings)
        given_scene, self._start_scene = scene, scene.start
        self.scene = scene = scene.snapshot()  # run-time changes must not reach the user's scene
        changes.check_stability(self, self.settings.dt)
        for text in scale_warnings(scene):
            warnings.warn(text, UserWarning, stacklevel=2)
        self.plan = plan_of(self._start_scene, self.settings.integrator, self_collision, draggable, self.settings.sleeps)
        laws = {law for body in scene.bodies for law in body.composition.laws}
        self._may_soften = any(lane_law(law).SOFTENS_BELOW for law in laws)  # until a warning says so
        self._compiled_before = self._compile_reported = runtime.compile_clock()
        try:
            self._dynamics = Dynamics(scene, self.settings, self.plan)
            self._refuse_overlap()
            if self.touches:
                self.plan.add_why("contact_forces", f"they keep {self.contact_offset:.3g} m apart")
        except BaseException as error:
            self.close()
            if isinstance(error, MemoryError):
                raise no_memory("this scene", error) from None
            raise
        for one in (given_scene, scene):
            one.freeze()
        self._seal(Simulator.__init__)

    def _refuse_overlap(self) -> None:
        found = None if self.scene.allow_initial_overlap or not self.touches else self.deepest_overlap()
        if found is not None:
            raise SceneError(
                f"'{found.name_a}' and '{found.name_b}' overlap at the start, {found.depth:.3g} m deep: move them apart, or set "
                "scene.allow_initial_overlap = True"
            )

    # --- stepping -----------------------------------------------------------------------------------------------------

    def step(self) -> StepReport:
        """Take exactly one step of dt. Raises SimulationError if the result is not finite; the state stays the last good one."""
        return self.advance(1)

    def advance(self, n: int) -> StepReport:
        """Take up to n steps of dt, at least one: explicit steps in one launch, implicit ones and those of robots one per call.

        Raises SimulationError as `step` does, and unless n is an integer of at least 1.
        """
        dynamics, n = self._open(), checks.whole(n, "n", error=SimulationError)
        report = dynamics.robots.step(dynamics) if dynamics.robots else dynamics.advance(n)
        if self._may_soften and (text := self._dynamics.describe_softening()):
            self._may_soften = False
            warnings.warn(text, UserWarning, stacklevel=2)
        return report

    def warm_up(self) -> None:
        """Compile, or load from disk, what later steps need, such as the first one in which something touches: none waits for it
        then. For what must keep up with the clock; takes some seconds. The state stays. Raises SimulationError as `step` does.
        """
        self._open().warm_up()

    run = running.run

    def _begin_estimate(self, steps: int, mesh: str | Scene | None, measured: dict) -> "ErrorEstimator":
        """Make the companions of a run of `steps` steps, in which quantities are measured too; see `run`."""
        from taisoft.estimation.estimator import ErrorEstimator  # loads modules with kernels that the run may not need

        if self._estimator is not None:
            raise SimulationError("a run with error=True cannot be started during another one")
        commanding.refuse_commands(self, "error=True")
        self._estimator = ErrorEstimator(self, steps, mesh, measured)
        return self._estimator

    def _end_estimate(self) -> None:
        """Release the companions of a run."""
        if self._estimator is not None:
            self._estimator.close()
            self._estimator = None

    def _take_compile_seconds(self) -> float:
        """Return the compile time since the last call [s], so that each run reports its own."""
        before, self._compile_reported = self._compile_reported, runtime.compile_clock()
        return self._compile_reported - before

    # --- results: queries.py, contact_queries.py ---------------------------------------------------------------------

    is_open = property(queries.is_open)
    time = property(queries.time)
    step_count = property(queries.step_count)
    positions = queries.positions
    velocities = queries.velocities
    momentum = queries.momentum
    energies = queries.energies
    reactions = queries.reactions
    joint_force = queries.joint_force
    tensions = queries.tensions
    cavity_volume = queries.cavity_volume
    cavity_pressure = queries.cavity_pressure
    stress = queries.stress
    fibres = queries.fibres
    elastic_forces = queries.elastic_forces
    force_differential = queries.force_differential
    stable_dt = property(queries.stable_dt)
    touches = property(contact_queries.touches)
    contact_limit = contact_queries.contact_limit
    detect_contacts = contact_queries.detect_contacts
    contacts = contact_queries.contacts
    contact_offset = property(contact_queries.contact_offset)
    contact_pressure = contact_queries.contact_pressure
    details = details.details
    contact_force = contact_queries.contact_force
    contact_torque = contact_queries.contact_torque
    slip_velocity = contact_queries.slip_velocity
    pairs_in_contact = contact_queries.pairs_in_contact
    pose = queries.pose
    twist = queries.twist
    rigid_strain = queries.rigid_strain
    robots = property(queries.robots)
    robot = property(queries.robot)
    deepest_overlap = contact_queries.deepest_overlap
    overlaps = contact_queries.overlaps
    intersecting_triangles = contact_queries.intersecting_triangles
    error_so_far = property(queries.error_so_far)
    nodal_errors = queries.nodal_errors
    draggable = property(queries.draggable)
    dragged = property(queries.dragged)
    asleep = property(queries.asleep)
    picture = queries.picture
    compile_seconds = property(queries.compile_seconds)
    field_bytes = property(queries.field_bytes)
    buffer_growths = property(queries.buffer_growths)

    # --- changes: changes.py ------------------------------------------------------------------------------------------

    dt = property(changes.dt, changes.set_dt)
    budget = property(changes.budget, changes.set_budget)
    reset = changes.reset
    set_state = changes.set_state
    set_gravity = changes.set_gravity
    set_material = changes.set_material
    set_contact = changes.set_contact
    set_load = changes.set_load
    set_force = changes.set_force
    set_traction = changes.set_traction
    set_tension = changes.set_tension
    set_length = changes.set_length
    set_pressure = changes.set_pressure
    set_cavity = changes.set_cavity
    set_activation = changes.set_activation
    set_pose = commanding.set_pose
    set_velocity = commanding.set_velocity
    set_displacement = commanding.set_displacement
    drag = changes.drag
    release = changes.release

    def rebuild(self, **settings) -> None:
        """Continue from the present state with other settings, arguments of this class; arch and precision cannot change.

        Another tolerance changes those of the solvers that follow from it. With a tolerance the integrator cannot be set.

        Positions, velocities, time, step count, released nodes and changed numbers are kept. The integrator's history is
        discarded, as by `set_state`, and a drag ends. Both simulators are in memory during the call.
        Raises SimulationError if the settings cannot be met; this simulator is then unchanged.
        """
        if "tolerance" in settings:
            settings = {"newton_tolerance": None, "contact_tolerance": None} | settings
        if "integrator" in settings and settings.get("tolerance", self.settings.tolerance) is not None:
            raise SimulationError(
                "with a tolerance, run() chooses the integrator: call sim.rebuild(tolerance=None, integrator=...)"
            )
        self._replace(**settings)

    def _replace(self, **settings) -> None:
        """Do as `rebuild`, with any settings."""
        before, new = self._open(), self._copy(**settings)
        kept = {name: self.__dict__[name] for name in ("_compiled_before", "_compile_reported")}
        before.close()
        self.__dict__.update(new.__dict__ | kept)

    def _copy(self, **settings) -> "Simulator":
        """Return a second simulator in the present state, as `rebuild` makes it."""
        before, start = self._open(), self.scene.snapshot(self._start_scene)
        start.allow_initial_overlap = True  # bodies move to the present positions below
        new = Simulator(start, **(self._arguments() | settings))
        with thawed(new.scene):
            new.scene.allow_initial_overlap = self.scene.allow_initial_overlap
        try:
            new._dynamics.continue_from(before)
        except BaseException:
            new.close()
            raise
        return new

    def _arguments(self) -> dict:
        """Return the arguments, besides the scene, that make a simulator with the present settings."""
        return dataclasses.asdict(self.settings) | {"dt": self.dt}

    # --- files and resources --------------------------------------------------------------------------------------------

    save_checkpoint = checkpoint.save_checkpoint
    load_checkpoint = classmethod(checkpoint.load_checkpoint)
    from_checkpoint = classmethod(checkpoint.from_checkpoint)
    write_vtu = write_vtu
    to_pyvista = to_pyvista

    def close(self) -> None:
        """Release memory and runtime; a closed simulator cannot be used."""
        self._end_estimate()
        if self._dynamics is not None:
            self._dynamics.close()

    def __enter__(self) -> "Simulator":
        return self

    def __exit__(self, *exception) -> None:
        self.close()

    __repr__ = simulator_text

    def _repr_html_(self) -> str | None:
        return drawn("simulator_html", self)

    def _host(self) -> Dynamics:
        """Return the dynamics for data on the host alone. Raises SimulationError after `close`."""
        if not self._dynamics.is_open:
            raise SimulationError("the simulator is closed")
        return self._dynamics

    def _open(self) -> Dynamics:
        """Return the dynamics, whose device memory is usable. Raises SimulationError after `close`, or with another runtime."""
        dynamics = self._host()
        dynamics.runtime.check()
        return dynamics
