"""Access to a simulator's state and results, and its run-time changes."""

import warnings
from typing import TYPE_CHECKING

import numpy as np

from taisoft.attributes import Guarded, SimulationAttributeError, thawed
from taisoft.backend.transfer import upload
from taisoft.dynamics.simulation_state import SimulationState
from taisoft.errors import SceneError, SimulationError
from taisoft.fem.elasticity import cauchy_stress, elastic_forces, force_differential, gather_forces, measure
from taisoft.fem.scalars import ELASTIC, GRAVITY, KINETIC, LOADS
from taisoft.records import Energies
from taisoft.scene.changes import CHANGEABLE, change_material
from taisoft.settings import Settings, check_dt
from taisoft.stability import stable_dt

if TYPE_CHECKING:
    from taisoft.collision.contacts import Contacts
    from taisoft.collision.detector import Detection
    from taisoft.collision.overlap import Overlap
    from taisoft.dynamics.contact import ContactStep

_REBUILT = (
    "integrator",
    "contact_solver",
    "self_collision",
    "allow_unstable",
    "newton_tolerance",
    "linear_tolerance",
    "contact_tolerance",
    "draggable",
)
INSTEAD = {  # what to do instead of assigning to an attribute that a simulator has or might be expected to have
    **{name: f"call sim.set_material(body, {name}=...)" for name in CHANGEABLE},
    **{name: f"call sim.set_contact(name_a, name_b, {name}=...)" for name in ("friction", "restitution")},
    **{name: f"call sim.set_state({name}=...)" for name in ("positions", "velocities")},
    **{name: f"call sim.rebuild({name}=...)" for name in _REBUILT},
    **dict.fromkeys(("force", "forces"), "call sim.set_force(body, index, value)"),
    **dict.fromkeys(("traction", "tractions"), "call sim.set_traction(body, index, value)"),
    **dict.fromkeys(("time", "step_count"), "call sim.reset() to go back to the start"),
    **dict.fromkeys(("arch", "precision"), "make a new Simulator"),
    "gravity": "call sim.set_gravity(gravity)",
    "material": "call sim.set_material(body, young=...)",
    "scene": "make a new Simulator of the other scene",
    "settings": "call sim.rebuild(integrator=...)",
    "plan": "it follows from the scene and the settings",
    "stable_dt": "it follows from the scene; set sim.dt",
    "dragged": "call sim.drag(...) or sim.release()",
}


class StateAccess(Guarded):
    """State, results and run-time data of a simulation; `Simulator` adds construction and stepping."""

    _error = SimulationAttributeError
    _read_only = frozenset(("settings", "scene", "plan"))
    _instead = INSTEAD
    settings: Settings
    _changes: int = 0  # count of user changes to the state or to numbers; at each the energy jumps
    _simulation: SimulationState | None = None
    _contact: "ContactStep | None"
    _idle_detection: "Detection | None"

    @property
    def time(self) -> float:
        """Simulated time [s]."""
        return self._host_simulation().time

    @property
    def step_count(self) -> int:
        """Steps of dt taken."""
        return self._host_simulation().step_count

    def positions(self, body: str | None = None) -> np.ndarray:
        """Return a float64 copy of a body's node positions (n_nodes, 3) [m]; without a name, of all bodies in the order added."""
        return self._open_simulation().state()[0][self._slice(body)].copy()

    def velocities(self, body: str | None = None) -> np.ndarray:
        """Return a float64 copy of the node velocities (n_nodes, 3) [m/s]; body: as for `positions`."""
        return self._open_simulation().state()[1][self._slice(body)].astype(np.float64)

    def set_state(self, positions=None, velocities=None, body: str | None = None) -> None:
        """Set positions [m] and velocities [m/s], (n_nodes, 3) each. Velocities on constrained axes become 0.

        Copies arrays; compiles nothing.
        """
        simulation, rows = self._open_simulation(), self._slice(body)
        for name, value in (("positions", positions), ("velocities", velocities)):
            if value is not None:
                self._check_rows(name, value, rows)
        x, v = simulation.state()
        if positions is not None:
            x[rows] = positions
        if velocities is not None:
            v[rows] = velocities
            v[simulation.dirichlet.constrained()] = 0.0
        simulation.set_state(x, v)
        self._changes += 1
        self._stepper.forget()

    def energies(self) -> Energies:
        """Return the energies of the present state [J]."""
        model = self._open_simulation().model
        measure(model)
        scalars = model.state.scalars.to_numpy().tolist()
        return Energies(scalars[KINETIC], scalars[ELASTIC], scalars[GRAVITY], scalars[LOADS])

    def reactions(self, body: str | None = None) -> np.ndarray:
        """Return the constraint forces (n_nodes, 3) of the last step [N]: on fixed and prescribed nodes, 0 on others."""
        self._open_simulation()
        return self._stepper.reactions()[self._slice(body)]

    def detect_contacts(self) -> "Contacts":
        """Detect the contacts of the present state swept by dt v, with impulses 0, without taking a step.

        `Scene.collision` and each body's `collision` choose the method; the plan lists which one each body and obstacle gets.
        Memory and kernels are made at the first call. Raises MeshError if a distance field cannot be made, SimulationError
        if positions or velocities are not finite or a buffer would grow beyond `max_capacity`.
        """
        return self._find_contacts(self._dt).contacts()

    def set_contact(self, name_a: str, name_b: str, friction: float | None = None, restitution: float | None = None) -> None:
        """Change the friction or restitution between two bodies, or a body and an obstacle; see `Scene.set_contact`."""
        scene = self._open_simulation().scene
        with thawed(scene):
            scene.set_contact(name_a, name_b, friction=friction, restitution=restitution)
        self._changes += 1
        if self._contact is not None:
            self._contact.numbers_changed()

    def contacts(self) -> "Contacts":
        """Return the contacts of the last step, with gaps at its start [m] and the impulses it applied [N s].

        After a step that was cut into substeps, those of the last substep. Empty before the first step and if nothing can touch.
        """
        self._open_simulation()
        if self._contact is not None:
            return self._contact.contacts()
        from taisoft.collision.contacts import no_contacts

        return no_contacts()

    def contact_force(self, name: str) -> np.ndarray:
        """Return the total contact force (3,) on a body or an obstacle in the last step [N]."""
        scene = self._open_simulation().scene
        scene.surface_of(name)
        if self._contact is None:
            return np.zeros(3)
        return self._contact.force([c.name for c in scene.colliders].index(name))

    def deepest_overlap(self) -> "Overlap | None":
        """Return the deepest overlapping pair in the present state and its depth [m], or None if nothing overlaps.

        Slow: unlike `StepReport.max_penetration` it checks all pairs, whether or not their surfaces meet. The depth is the
        largest over the vertices, nodes, tet centres and triangle-tet cuts of either that lie inside the other. In a sphere or
        a capsule it is the radius minus the body's distance from the centre or axis.
        """
        return next(iter(self.overlaps()), None)

    def overlaps(self) -> "list[Overlap]":
        """Return all overlapping pairs in the present state, deepest relative to the smaller one's size first."""
        from taisoft.collision.overlap import find_overlaps

        return find_overlaps(self._find_contacts(0.0))

    def intersecting_triangles(self) -> list[tuple[str, int, str, int]]:
        """Return the pairs of surface triangles that intersect in the present state: name and triangle of each, each pair once.

        Triangles are rows of `body.nodes.surface`, or of an obstacle's surface. Pairs within one body are included only with
        self_collision; triangles that share a vertex are left out.
        """
        detection = self._find_contacts(0.0)
        first, colliders = detection.topology.first, self._simulation.scene.colliders
        pairs = detection.intersections()
        owner = np.searchsorted(first, pairs, side="right") - 1
        return [
            (colliders[a].name, int(t - first[a]), colliders[b].name, int(u - first[b])) for (t, u), (a, b) in zip(pairs, owner)
        ]

    def _find_contacts(self, dt: float) -> "Detection":
        """Detect the contacts of the present state swept by dt [s]; with 0, paths are evaluated at the present time only."""
        simulation = self._open_simulation()
        if self._contact is not None:
            self._contact.search(simulation.time, dt)
            return self._contact.detection
        if self._idle_detection is None:
            from taisoft.collision.detector import Detection

            within = self.settings.self_collision
            self._idle_detection = Detection(simulation.scene, simulation.model, simulation.layout, self._runtime, within)
            self._owned.append(self._idle_detection)
        self._idle_detection.find(simulation.time, dt)
        return self._idle_detection

    @property
    def _detection(self) -> "Detection | None":
        """The contact detection in use; None if none was needed yet."""
        return self._contact.detection if self._contact is not None else self._idle_detection

    def stress(self, body: str | None = None) -> np.ndarray:
        """Return the Cauchy stress per tet (m,3,3) [Pa], not finite in a flat tet; without a name, of all bodies as added."""
        simulation = self._open_simulation()
        m, layout = simulation.model, simulation.layout
        bodies = range(len(layout.n_tets)) if body is None else [self._index(body)]
        sigma = np.zeros((m.n_blocks * m.lanes, 9))
        cauchy_stress(m, sigma)
        first = layout.block_start * m.lanes
        return np.concatenate([sigma[first[k] : first[k] + layout.n_tets[k]] for k in bodies]).reshape(-1, 3, 3)

    def elastic_forces(self) -> np.ndarray:
        """Return the elastic forces on all nodes in the present state (n_nodes, 3) [N]."""
        simulation = self._open_simulation()
        _, force = self._tangent_fields()
        elastic_forces(simulation.model)
        gather_forces(simulation.model, force)
        return force.to_numpy().astype(np.float64)

    def force_differential(self, displacement: np.ndarray) -> np.ndarray:
        """Return the change of the elastic forces (df/dx) dx (n_nodes, 3) [N]; displacement: dx (n_nodes, 3) [m] of all nodes."""
        simulation = self._open_simulation()
        self._check_rows("displacement", displacement, slice(None))
        dx, df = self._tangent_fields()
        upload([(dx, np.asarray(displacement))])
        force_differential(simulation.model, dx, df)
        return df.to_numpy().astype(np.float64)

    def _tangent_fields(self) -> tuple:
        """Two fields of n_nodes 3-vectors, allocated at the first use."""
        if self._tangent is None:
            make, n, real = self._arena.vectors, self._simulation.model.n_nodes, self._runtime.real
            self._tangent = make("tangent_dx", real, n), make("tangent_df", real, n)
        return self._tangent

    @property
    def dt(self) -> float:
        """Time step [s]; a new value takes effect with the next step."""
        return self._dt

    @dt.setter
    def dt(self, value: float) -> None:
        value = check_dt(value)
        if value == self._dt:
            return
        if self.settings.explicit:
            self._check_stability(value, stacklevel=4)
        self._time_base = (self.time, self.step_count)
        self._changes += 1
        self._dt = value

    @property
    def stable_dt(self) -> float:
        """Largest stable time step [s] of an explicit integrator about the rest shape: 2/omega_max without damping."""
        if self._stable_dt is None:
            self._stable_dt = stable_dt(self.scene, self.settings.integrator == "velocity_verlet")
        return self._stable_dt

    def set_gravity(self, gravity) -> None:
        """Change gravity (3,) [m/s^2]. Recomputes the rounding floor of the residual; compiles nothing."""
        self._open_simulation()
        with thawed(self.scene):
            self.scene.gravity = gravity
        self._load_gravity()
        self._changes += 1
        self._stepper.numbers_changed()

    def _load_gravity(self) -> None:
        """Copy the scene's gravity to the device."""
        upload([(self._simulation.model.gravity, self.scene.gravity[None])])

    def set_material(self, body: str, **numbers) -> None:
        """Change numbers of a body's material (young, poisson, density, mass_damping, stiffness_damping); the law stays.

        Copies arrays and recomputes the rounding floor of the residual and the stable dt; compiles nothing.
        """
        simulation, k = self._open_simulation(), self._index(body)
        old, old_limit = self.scene.bodies[k].material, self._stable_dt
        change_material(self.scene.bodies[k], numbers, self.plan.on)
        self._stable_dt = None
        try:
            if self.settings.explicit:
                self._check_stability(self._dt)
        except SimulationError:
            with thawed(self.scene.bodies[k]):
                self.scene.bodies[k].material, self._stable_dt = old, old_limit
            raise
        self._changes += 1
        simulation.upload_material("density" in numbers)
        if "density" in numbers:  # a total force is spread by mass: the nodes' fractions change only by rounding
            self._upload_loads()
        self._stepper.numbers_changed()

    def _open_simulation(self) -> SimulationState:
        """Return the state and check that its device memory is usable. Raises SimulationError after `close`."""
        simulation = self._host_simulation()
        self._runtime.check()
        return simulation

    def _host_simulation(self) -> SimulationState:
        """Return the state for host data alone. Raises SimulationError after `close`."""
        if self._simulation is None:
            raise SimulationError("the simulator is closed")
        return self._simulation

    def _check_stability(self, dt: float, stacklevel: int = 3) -> None:
        limit = self.stable_dt
        if dt <= limit:
            return
        text = f"dt = {dt:.3g} s is above the estimated stability limit of {limit:.3g} s of {self.settings.integrator}"
        if not self.settings.allow_unstable:
            raise SimulationError(f"{text}: take a smaller dt (0.9 of the limit is {0.9 * limit:.3g} s) or allow_unstable=True")
        warnings.warn(text, stacklevel=stacklevel)

    def _index(self, body: str) -> int:
        return self.scene.bodies.index(self.scene.body(body))

    def _slice(self, body: str | None) -> slice:
        return slice(None) if body is None else self._simulation.layout.nodes(self._index(body))

    def _check_rows(self, name: str, value, rows: slice) -> None:
        value = np.asarray(value)
        expected = (len(range(*rows.indices(self._simulation.model.n_nodes))), 3)
        if value.shape != expected or value.dtype.kind not in "fiu":
            raise SceneError(f"{name} have shape {value.shape} and type {value.dtype}: they must be {expected} numbers")
        with np.errstate(over="ignore"):
            bad = np.flatnonzero(~np.isfinite(value.astype(self._runtime.np_real)).all(axis=1))
        if len(bad):
            raise SceneError(f"{name}: node {bad[0]} is not finite or too large for {self._runtime.precision}")
