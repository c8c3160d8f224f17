"""Simulation state shared by all steppers: model, constraints, loads and time."""

from dataclasses import dataclass, field
from functools import cached_property

import numpy as np

from taisoft.backend.arrays import FieldArena, download, upload
from taisoft.backend.runtime import Runtime
from taisoft.dynamics.dirichlet import DirichletConditions
from taisoft.dynamics.state import StepState
from taisoft.fem import viscosity
from taisoft.fem.dependent_table import DependentTable
from taisoft.fem.elements import law_table
from taisoft.fem.fibres import fibre_table
from taisoft.fem.loads import SceneLoads
from taisoft.fem.masses import upload_mass_matrix
from taisoft.fem.mean_dilatation import patch_moduli
from taisoft.fem.model import Layout, Model
from taisoft.fem.pressure import CavityForm, cavity_form, pressures_of
from taisoft.fem.reference import gravity_masses, lumped_masses
from taisoft.fem.spring_table import SpringTable
from taisoft.fem.springs import spring_table
from taisoft.fem.terms.rayleigh_damping import damping_table
from taisoft.scene.loads import Cavity
from taisoft.scene.scene import Scene


@dataclass
class SimulationState:
    """A scene on the device. time [s] is start + count * dt, so that it does not drift.

    Loads on the device are those of one time, which `set_load_time` changes; steppers evaluate forces within a step.
    """

    scene: Scene
    runtime: Runtime
    arena: FieldArena
    model: Model
    layout: Layout
    dirichlet: DirichletConditions
    time: float = 0.0
    step_count: int = 0
    releases: int = 0  # number of releases of prescribed nodes; each invalidates the steppers' history
    now: StepState = field(init=False)
    drag: tuple[np.ndarray, np.ndarray] | None = None  # nodes (k,) and forces (k, 3) [N] of a drag spring
    ramp: float = 0.0  # [s] from the start, in which constant loads and gravity grow; statics only, as is:
    budget: float | None = None  # wall time of an implicit step in time [s]
    asleep: np.ndarray | None = None  # (n_nodes,) bool: of bodies that sleep, see `sleeping`; None: none ever does
    at: float | None = None  # [s] when all that follows paths has the values towards which it grows, too; None: it follows them
    free: np.ndarray | None = None  # (n_nodes, 3) 1 on free axes, as uploaded last
    _loads: SceneLoads | None = None  # None: not computed, or outdated
    load_time: float | None = None  # of the loads on the device; None: several, or outdated
    _start: list[np.ndarray] | None = None  # free axes, positions and velocities at the start
    _cavity_forms: dict[str, CavityForm] = field(default_factory=dict)  # those built so far, by name

    def __post_init__(self) -> None:
        nodes, gravity = self.model.state, np.array(self.scene.gravity)
        multipliers, flight = np.zeros(len(self.loads.multipliers)), np.zeros(len(self.scene.colliders))
        self.now = StepState(self.model, nodes.x, nodes.v, self.dirichlet.released, multipliers, flight, gravity)
        self.now.history = self.model.viscosity.history if self.model.viscous else None

    @property
    def dependents(self) -> DependentTable | None:
        """The nodes that are attached exactly; None if there are none."""
        return self.layout.dependents

    @property
    def springs(self) -> SpringTable | None:
        """The elements of springs, tendons and attachments; None if there are none."""
        return self.layout.springs

    @cached_property
    def own_springs(self) -> SpringTable | None:
        """The same at the nodes where they end, even if these depend on others."""
        return self.springs if self.dependents is None else spring_table(self.scene, None)

    @property
    def has_paths(self) -> bool:
        """Whether motion is prescribed: the user may change it between two steps, and a path may end with the last one."""
        return self.dirichlet.n_prescribed > 0 or not all(obstacle.rests(self.time) for obstacle in self.scene.obstacles)

    def state(self) -> tuple[np.ndarray, np.ndarray]:
        """Return positions and velocities of all nodes, in their stored precision."""
        x, v = download([self.model.state.x, self.model.state.v])
        return x, v

    def velocities(self) -> np.ndarray:
        """Return the velocities of all nodes, in their stored precision."""
        return self.model.state.v.to_numpy()

    def set_state(self, x: np.ndarray, v: np.ndarray) -> None:
        """Set positions [m] and velocities [m/s] of all nodes, (n_nodes, 3); those of dependent nodes follow from the others'."""
        if self.dependents is not None:
            x, v = x.copy(), v.copy()
            self.dependents.place(x)
            self.dependents.place(v)
        upload([(self.model.state.x, x), (self.model.state.v, v)])

    def begin_branches(self, h: float) -> None:
        """Let Maxwell branches have their stresses at the end of an interval h [s], which begins at their history."""
        if self.model.viscous:
            viscosity.begin_interval(self.model, h)

    def move_branches(self, h: float) -> None:
        """Move Maxwell branches over an interval h [s] to the present positions; 0: a jump, which they resist as springs."""
        if self.model.viscous:
            viscosity.end_interval(self.model, h)

    def dissipated(self) -> np.ndarray:
        """Return the energies (n_blocks * lanes,) [J] that Maxwell branches have dissipated, by lane."""
        lanes = np.zeros(self.model.n_blocks * self.model.lanes)
        if self.model.viscous:
            viscosity.dissipated_energies(self.model, lanes)
        return lanes

    def snapshot(self) -> dict:
        """Return the state for a checkpoint; see `taisoft/checkpoint.py`."""
        own = {"time": self.time, "step_count": self.step_count} | self.now.snapshot()
        return own | ({"branches": viscosity.history_by_tet(self.model, self.scene, self.layout)} if self.model.viscous else {})

    def restore(self, kept: dict) -> None:
        """Restore a `snapshot`, also one of another instance of the same scene."""
        for name in ("released", "flight", "gravity"):
            getattr(self.now, name)[:] = kept[name]
        self.now.none_cross = bool(kept["none_cross"])
        if self.now.held is not None and "held" in kept:  # another instance may have no contacts
            self.now.held, self.now.misplaced = self.now.held.at_start(kept["held"]), kept["misplaced"]
        if self.now.slip is not None and "slip" in kept:
            self.now.slip.from_numpy(kept["slip"])
        if self.model.viscous:
            viscosity.set_history(self.model, self.scene, self.layout, kept["branches"])
        self.upload_constraints()
        self.set_state(kept["x"], kept["v"])
        self._begin_at(float(kept["time"]), int(kept["step_count"]), kept["multipliers"])

    def restart(self) -> None:
        """Set the initial state of the scene. From the first reset after a step on, it is kept ready: learning resets often."""
        self.now.released[:] = False
        if self.asleep is not None:
            self.asleep[:] = False
        m = self.model
        if m.viscous:
            m.viscosity.history.fill(0.0)
        if self.now.slip is not None:
            self.now.slip.fill(0.0)
        arrays = (m.free, m.state.x, m.state.v)
        if self._start is not None:
            upload(list(zip(arrays, self._start)))
            self.free = self._start[0]
        else:
            self.upload_constraints()
            self.set_state(self.layout.rest, self._rest_velocities())
            self._start = download(arrays) if self.step_count else None
        self._begin_at(0.0, 0, np.zeros(len(self.loads.multipliers)))

    def _begin_at(self, time: float, step_count: int, multipliers: np.ndarray) -> None:
        self.time, self.step_count = time, step_count
        self.set_multipliers(multipliers)
        self.set_load_time(time)
        self.begin_branches(0.0)

    def return_to(self, earlier: StepState) -> None:
        """Return to an earlier state of the same step."""
        is_constrained_alike = (self.now.released == earlier.released).all()
        self.now.copy_from(earlier)
        self.set_multipliers(earlier.multipliers)
        self.begin_branches(0.0)
        if not is_constrained_alike:
            self.upload_constraints()

    def prescribed_moves(self, t: float) -> tuple[np.ndarray, np.ndarray] | None:
        """Return nodes (k,) whose motion from the present state to a time t [s] is prescribed, those that depend on such nodes
        included, and their displacements (k,3) [m], nan where free; None if there are none."""
        nodes = self.dirichlet.prescribed_nodes
        if not len(nodes):
            return None
        moves = self.dirichlet.target_positions(t) - self.model.state.x.to_numpy()[nodes]
        if self.dependents is None:
            return nodes, moves
        every = np.where(self.dirichlet.constrained(), 0.0, np.nan)  # of fixed nodes, and of those whose path gives None
        row, axis = np.nonzero(~np.isnan(moves))
        every[nodes[row], axis] = moves[row, axis]
        return np.concatenate([nodes, self.dependents.node]), np.concatenate([moves, self.dependents.rows @ every])

    def upload_constraints(self) -> None:
        """Upload the free axes."""
        free = ~self.dirichlet.constrained()
        if self.dependents is not None:
            free[self.dependents.node] = False
        if self.asleep is not None:
            free[self.asleep] = False
        self.free = free.astype(np.float64)
        upload([(self.model.free, free)])

    def upload_gravity(self) -> None:
        """Upload the scene's gravity."""
        upload([(self.model.gravity, self.scene.gravity[None])])

    def upload_material(self, density: bool) -> None:
        """Upload material numbers of the bodies, and masses if a density changed."""
        m = self.model
        numbers = [(m.law_constants, law_table(self.scene, self.layout, m.elasticity_by_tet))]
        if m.mean_dilatation:
            numbers.append((m.mean.modulus, patch_moduli(self.scene)))
        if m.fibres is not None:
            numbers.append((m.fibres.numbers, fibre_table(self.scene, self.layout)))
        if m.damping is not None:
            numbers.append((m.damping, damping_table(self.scene)))
        if m.viscous:
            numbers.append((m.viscosity.stiffness, viscosity.stiffness_table(self.scene, self.layout)))
        if density:
            numbers.append((m.mass, lumped_masses(self.scene, self.dependents)))
            if m.gravity_mass is not m.mass:
                numbers.append((m.gravity_mass, gravity_masses(self.scene, self.dependents)))
        upload(numbers)
        self.begin_branches(0.0)
        if density and m.consistent:
            upload_mass_matrix(self.scene, self.dependents, m.mass_matrix)

    @property
    def loads(self) -> SceneLoads:
        """The scene's loads with their present values."""
        if self._loads is None:
            self._loads = SceneLoads(self.scene, self.springs)
        return self._loads

    def loads_changed(self) -> None:
        """Compute the loads anew when they are used next: a controller changes several before a step."""
        self._loads = self.load_time = None

    def set_multipliers(self, values: np.ndarray) -> None:
        """Set the Lagrange multipliers (k,) [Pa] or [N]; `set_load_time` uploads them."""
        self.now.multipliers = np.array(values)
        if len(values):
            self.load_time = None

    def set_drag(self, drag: tuple[np.ndarray, np.ndarray] | None) -> None:
        """Set nodes and forces of a drag spring, or None, and upload the loads of the present time."""
        self.drag, self.load_time = drag, None
        self.set_load_time(self.time)

    def set_load_time(self, time: float) -> None:
        """Upload the loads of a time [s], with the drag force, unless the device has them or they are the same at any time."""
        m = self.model
        has_loads = m.loaded or m.amplitudes is not None or self.ramp
        if not has_loads or self.load_time == time or not (self.load_time is None or self.ramp or self.loads.vary):
            return
        fraction = self.fraction(time)
        fields = [(m.gravity, fraction * np.array(self.scene.gravity)[None])] if self.ramp else []
        if m.loaded:
            loads = self.loads.at(time, fraction) if self.at is None else fraction * self.loads.at(self.at)
            if self.drag is not None:
                np.add.at(loads, *self.drag)
            fields.append((m.loads, loads))
        if m.amplitudes is not None:
            fields.append((m.amplitudes, self.amplitudes(time)))
        upload(fields)
        self.load_time = time

    def fraction(self, time: float) -> float:
        """Return the fraction of constant loads that acts at a time [s]."""
        return min(1.0, time / self.ramp) if self.ramp else 1.0

    def amplitudes(self, time: float) -> np.ndarray:
        """Return the loads that are one number at a time [s], with the present Lagrange multipliers."""
        amplitudes, fraction = self.loads.amplitudes([time if self.at is None else self.at])[0], self.fraction(time)
        if fraction < 1.0:
            n, springs = len(amplitudes), self.springs
            rest = np.zeros(n) if springs is None else springs.rest_amplitudes(n, self.layout.rest)
            amplitudes = np.where(
                self.loads.is_constant | (self.at is not None), rest + fraction * (amplitudes - rest), amplitudes
            )
        amplitudes[self.loads.multipliers] = self.now.multipliers
        return amplitudes

    def cavity_pressures_by_name(self, time: float) -> dict[str, float]:
        """Return the pressures [Pa] in all cavities at a time [s]."""
        found = zip(pressures_of(self.scene), self.amplitudes(time))
        return {load.name: float(p) for (_, load), p in found if isinstance(load, Cavity)}

    def cavity_form(self, name: str) -> CavityForm:
        """Return the form of a cavity, built on first use. Raises SceneError if there is none of this name."""
        if name not in self._cavity_forms:
            self._cavity_forms[name] = cavity_form(self.scene, name)
        return self._cavity_forms[name]

    def load_rows(self, times: np.ndarray, nodes: np.ndarray) -> np.ndarray:
        """Return loads (r, k, 3) [N] at times (r,) on nodes (k,), ascending, for kernels that set them."""
        rows = self.loads.rows(times, nodes)
        if self.drag is not None:
            forces = np.zeros((self.model.n_nodes, 3))
            np.add.at(forces, *self.drag)
            rows += forces[nodes]
        return rows

    def _rest_velocities(self) -> np.ndarray:
        """Return initial velocities, 0 on constrained axes, (n_nodes, 3)."""
        start = [np.broadcast_to(b.velocity, b.rest_positions.shape) for b in self.scene.bodies]
        return np.where(self.dirichlet.constrained(), 0.0, np.concatenate(start))

    def next_targets(self, times: np.ndarray) -> np.ndarray | None:
        """Return targets of prescribed nodes (r, n_prescribed, 3), r >= 1, for the first r of the times; None without such nodes.

        Nodes whose path ends at the first time are released.
        """
        if self.dirichlet.n_prescribed == 0:
            return None
        asked = times if self.at is None else np.full(len(times), self.at)
        rows, releasing = self.dirichlet.targets(asked)
        while releasing and len(rows) == 0:
            self.releases += 1
            self.upload_constraints()
            rows, releasing = self.dirichlet.targets(asked)
        if self.at is not None:
            rest = self.layout.rest[self.dirichlet.prescribed_nodes]
            rows = rest + np.array([self.fraction(t) for t in times[: len(rows)]])[:, None, None] * (rows - rest)
        return rows

    def next_target(self, t: float) -> np.ndarray | None:
        """Return targets (n_prescribed, 3) at one time; None without prescribed nodes."""
        rows = self.next_targets(np.array([t]))
        return None if rows is None else rows[0]

    def find_nonfinite(self, force: np.ndarray | None = None) -> str | None:
        """Describe the first node whose position, velocity or force (n_nodes, 3) is not finite; None if there is none."""
        x, v = self.state()
        # explicit steps fail beyond the range of f32
        finite = np.isfinite(x).all(axis=1) & (np.abs(v) <= np.finfo(np.float32).max).all(axis=1)
        if force is not None:
            with np.errstate(over="ignore"):  # a force whose square overflows counts as infinite
                finite &= np.isfinite((force.astype(np.float64) ** 2).sum(axis=1))
        bad = np.flatnonzero(~finite)
        if len(bad) == 0:
            return None
        body = int(np.searchsorted(self.layout.node_start, bad[0], side="right")) - 1
        name, node = self.scene.bodies[body].name, bad[0] - self.layout.node_start[body]
        return f"body '{name}', node {node}: position, velocity or force is no longer finite ({len(bad)} nodes in all)"
