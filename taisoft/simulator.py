"""Simulator: builds a scene into the machine, steps it, and tells about it."""

import warnings

import numpy as np

from taisoft import runtime
from taisoft.elasticity import cauchy_stress, measure
from taisoft.errors import SceneError, SimulationError
from taisoft.model import build_model, changed_material
from taisoft.records import Energies, RunReport, StepReport
from taisoft.running import run
from taisoft.scene.plan import make_plan
from taisoft.scene.scene import Scene
from taisoft.settings import check_dt, check_settings
from taisoft.stability import stable_dt
from taisoft.stepping import SCHEMES, make_stepper
from taisoft.stepping.motion import Motion
from taisoft.stepping.world import World


class Simulator:
    """A scene being simulated. SI units; positions are float64 in either precision.

    dt [s]; integrator: one of taisoft.stepping.INTEGRATORS; newton_tolerance, linear_tolerance: relative, None is adaptive.
    An explicit integrator refuses a dt above `stable_dt` unless allow_unstable, which only warns.
    Raises SceneError for a scene that cannot be simulated, SimulationError for settings that cannot be met.
    """

    def __init__(
        self, scene: Scene, dt: float = 1 / 60, integrator: str = "implicit_euler", contact_solver: str = "auto",
        self_collision: bool = False, precision: str = "f32", arch: str = "cpu", allow_unstable: bool = False,
        newton_tolerance: float | None = None, linear_tolerance: float | None = None,
        contact_tolerance: float | None = None,
    ):  # fmt: skip
        self.settings = check_settings(
            scene, dt, integrator, contact_solver, self_collision, precision, arch, allow_unstable, newton_tolerance,
            linear_tolerance, contact_tolerance,
        )  # fmt: skip
        self.scene = scene
        self._dt = self.settings.dt
        self._stable_dt: float | None = None
        if self.settings.explicit:
            self._check_stability(self._dt)
        scheme = SCHEMES.get(integrator)
        self.plan = make_plan(scene, self.settings.explicit, scheme is not None and scheme.before > 0.0)
        self._runtime = runtime.open_runtime(arch, precision, f"the simulator of {[b.name for b in scene.bodies]}")
        self._compiled_before = runtime.compile_clock()
        self._arena = runtime.FieldArena()
        try:
            model, layout = build_model(scene, self._runtime, self._arena, self.plan.on)
            self._world = World(scene, self._runtime, self._arena, model, layout, Motion(scene, layout))
            self._stepper = make_stepper(self._world, integrator)
        except BaseException:
            self._arena.release()
            self._runtime.close()
            raise
        if not self.settings.explicit:
            self._stepper.tolerance = newton_tolerance or self._stepper.tolerance
            self._stepper.linear_tolerance = linear_tolerance
        self.reset()

    # --- stepping -------------------------------------------------------------------------------------------------

    def step(self) -> StepReport:
        """Exactly one step of dt. Raises SimulationError when the result is not finite; the state is then the last good."""
        return self.advance(1)

    def advance(self, n: int) -> StepReport:
        """Up to n steps of dt, at least one: explicit ones in one launch, implicit ones one at a time."""
        world, start = self._open_world(), self.step_count
        if self.settings.explicit:
            result = self._stepper.advance(n, self._dt)
            self._count(result.done)
            report = self._report()
            report.min_volume_ratio = min(report.min_volume_ratio, result.min_volume_ratio)
            report.n_inverted = max(report.n_inverted, result.n_inverted)
        else:
            result = self._stepper.step(self._dt)
            self._count(1)
            report = self._report()
            report.newton_iterations, report.linear_iterations = result.newton_iterations, result.linear_iterations
            report.residual, report.converged = result.residual, result.converged
            if not result.converged:
                report.problems.append(
                    f"step {world.step_count}: Newton stopped after {result.newton_iterations} iterations at a relative residual of "
                    f"{result.residual:.2e}"
                )
        report.steps = self.step_count - start
        if report.n_inverted:
            report.problems.append(f"step {world.step_count}: {report.n_inverted} tets are inverted")
        return report

    def run(self, seconds: float, on_frame=None, fps: float | None = 60, stop=None) -> RunReport:
        """Run for some seconds; see `taisoft.running.run`."""
        return run(self, seconds, on_frame, fps, stop)

    def reset(self) -> None:
        """Back to the scene's start."""
        world = self._open_world()
        world.motion.reset()
        world.upload_constraints()
        world.model.x.from_numpy(world.layout.rest)
        world.model.v.from_numpy(world.rest_velocities().astype(self._runtime.np_real))
        world.time, world.step_count, self._time_base = 0.0, 0, (0.0, 0)
        self._stepper.forget()

    def _count(self, done: int) -> None:
        world = self._world
        world.step_count += done
        start, count = self._time_base
        world.time = start + (world.step_count - count) * self._dt

    def _report(self) -> StepReport:
        measure(self._world.model)
        s = self._world.model.scalars.to_numpy()
        return StepReport(
            time=self.time, min_volume_ratio=float(s[1]), n_inverted=int(s[2]), kinetic=float(s[3]), elastic=float(s[0]),
            gravity=float(s[4]),
        )  # fmt: skip

    # --- state ----------------------------------------------------------------------------------------------------

    @property
    def time(self) -> float:
        """Simulated time [s]."""
        return self._world.time

    @property
    def step_count(self) -> int:
        """Steps of dt taken."""
        return self._world.step_count

    def positions(self, body: str | None = None) -> np.ndarray:
        """(n_nodes, 3) float64 copy [m]; of all bodies, concatenated in the order added, without a name."""
        return self._rows(self._open_world().model.x, body)

    def velocities(self, body: str | None = None) -> np.ndarray:
        """(n_nodes, 3) float64 copy [m/s]."""
        return self._rows(self._open_world().model.v, body)

    def set_state(self, positions=None, velocities=None, body: str | None = None) -> None:
        """Set positions [m] and velocities [m/s], (n_nodes, 3) each; velocities of constrained axes become 0."""
        world, rows = self._open_world(), self._slice(body)
        for name, field, value in (("positions", world.model.x, positions), ("velocities", world.model.v, velocities)):
            if value is not None:
                self._check_rows(name, value, rows)
        for field, value in ((world.model.x, positions), (world.model.v, velocities)):
            if value is not None:
                whole = field.to_numpy()
                whole[rows] = value
                if field is world.model.v:
                    whole[world.motion.constrained()] = 0.0
                field.from_numpy(whole)
        self._stepper.forget()

    def energies(self) -> Energies:
        """Energies of the present state [J]."""
        self._open_world()
        r = self._report()
        return Energies(r.kinetic, r.elastic, r.gravity)

    def reactions(self, body: str | None = None) -> np.ndarray:
        """(n_nodes, 3) force of the constraint on each fixed or moved node in the last step [N], else 0."""
        self._open_world()
        return self._stepper.reactions()[self._slice(body)]

    def stress(self, body: str) -> np.ndarray:
        """Cauchy stress per tet (m,3,3) [Pa]; infinite in a flat one."""
        world, k = self._open_world(), self._index(body)
        m = world.model
        sigma = np.zeros((m.n_blocks * m.lanes, 9))
        cauchy_stress(m, sigma)
        first = world.layout.block_start[k] * m.lanes
        return sigma[first : first + world.layout.n_tets[k]].reshape(-1, 3, 3)

    # --- run-time data ----------------------------------------------------------------------------------------------

    @property
    def dt(self) -> float:
        """Step [s]; setting it takes effect with the next step."""
        return self._dt

    @dt.setter
    def dt(self, value: float) -> None:
        value = check_dt(value)
        if value == self._dt:
            return
        if self.settings.explicit:
            self._check_stability(value)
        self._time_base = (self.time, self.step_count)
        self._dt = value
        self._stepper.forget()

    @property
    def stable_dt(self) -> float:
        """Largest stable step [s] of an explicit integrator about the rest shape: 2/omega_max without damping."""
        if self._stable_dt is None:
            self._stable_dt = stable_dt(self.scene, self.settings.integrator == "velocity_verlet")
        return self._stable_dt

    def set_gravity(self, gravity) -> None:
        """Change gravity (3,) [m/s^2]."""
        world = self._open_world()
        self.scene.gravity = gravity
        world.model.gravity.from_numpy(np.asarray(self.scene.gravity, dtype=self._runtime.np_real)[None])
        self._stepper.forget()

    def set_material(self, body: str, **numbers) -> None:
        """Change numbers of a body's material (young, poisson, density, mass_damping, stiffness_damping); law stays."""
        world, k = self._open_world(), self._index(body)
        changed_material(self.scene.bodies[k], numbers, self.plan.on)
        self._stable_dt = None
        world.upload_material()
        if self.settings.explicit:
            self._check_stability(self._dt)
        self._stepper.material_changed()
        self._stepper.forget()

    # --- life ---------------------------------------------------------------------------------------------------------

    @property
    def compile_seconds(self) -> float:
        """Seconds spent compiling kernels since this simulator was made."""
        return runtime.compile_clock() - self._compiled_before

    @property
    def field_bytes(self) -> dict[str, int]:
        """Bytes of every allocated field by name."""
        return dict(self._arena.bytes)

    def close(self) -> None:
        """Release the fields and the runtime; a closed simulator cannot be used."""
        if self._world is not None:
            self._arena.release()
            self._runtime.close()
            self._world = None

    def __enter__(self) -> "Simulator":
        return self

    def __exit__(self, *exception) -> None:
        self.close()

    # --- helpers ------------------------------------------------------------------------------------------------------

    def _open_world(self) -> World:
        if self._world is None:
            raise SimulationError("the simulator is closed")
        return self._world

    def _check_stability(self, dt: float) -> None:
        limit = self.stable_dt
        if dt <= limit:
            return
        text = f"dt = {dt:.3g} s is above the estimated stability limit of {limit:.3g} s of {self.settings.integrator}"
        if not self.settings.allow_unstable:
            raise SimulationError(f"{text}: take a smaller dt (0.9 of the limit is {0.9 * limit:.3g} s) or allow_unstable=True")
        warnings.warn(text, stacklevel=3)

    def _index(self, body: str) -> int:
        for k, b in enumerate(self.scene.bodies):
            if b.name == body:
                return k
        raise SceneError(f"the scene has no body {body!r}; it has {[b.name for b in self.scene.bodies]}")

    def _slice(self, body: str | None) -> slice:
        return slice(None) if body is None else self._world.layout.nodes(self._index(body))

    def _rows(self, field, body: str | None) -> np.ndarray:
        return field.to_numpy()[self._slice(body)].astype(np.float64)

    def _check_rows(self, name: str, value, rows: slice) -> None:
        value = np.asarray(value)
        wanted = (len(range(*rows.indices(self._world.model.n_nodes))), 3)
        if value.shape != wanted or value.dtype.kind not in "fiu":
            raise SceneError(f"{name} have shape {value.shape} and type {value.dtype}: they must be {wanted} numbers")
        bad = np.flatnonzero(~np.isfinite(value).all(axis=1))
        if len(bad):
            raise SceneError(f"{name}: vertex {bad[0]} is not finite")
