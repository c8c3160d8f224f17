"""What a simulator shows of its state and lets a user change while it runs."""

import warnings
from typing import TYPE_CHECKING

import numpy as np

from taisoft.attributes import Guarded, SimulationAttributeError, thawed
from taisoft.dynamics.simulation_state import SimulationState
from taisoft.elasticity import cauchy_stress, elastic_forces, force_differential, gather_forces, measure
from taisoft.errors import SceneError, SimulationError
from taisoft.records import Energies
from taisoft.scalars import ELASTIC, GRAVITY, KINETIC, LOADS
from taisoft.scene.changes import CHANGEABLE, change_material
from taisoft.settings import Settings, check_dt
from taisoft.stability import stable_dt
from taisoft.transfer import upload

if TYPE_CHECKING:
    from taisoft.collision.contacts import Contacts
    from taisoft.collision.overlap import Overlap
    from taisoft.collision.pipeline import Detection
    from taisoft.dynamics.contact import ContactStep

_REBUILT = (
    "integrator", "contact_solver", "self_collision", "allow_unstable", "newton_tolerance", "linear_tolerance",
    "contact_tolerance", "draggable",
)  # fmt: skip
INSTEAD = {  # of assigning to an attribute of a simulator, or to one that it might be thought to have
    **{name: f"call sim.set_material(body, {name}=...)" for name in CHANGEABLE},
    **{name: f"call sim.set_contact(name_a, name_b, {name}=...)" for name in ("friction", "restitution")},
    **{name: f"call sim.set_state({name}=...)" for name in ("positions", "velocities")},
    **{name: f"call sim.rebuild({name}=...)" for name in _REBUILT},
    **dict.fromkeys(("force", "forces"), "call sim.set_force(body, index, value)"),
    **dict.fromkeys(("traction", "tractions"), "call sim.set_traction(body, index, value)"),
    **dict.fromkeys(("time", "step_count"), "call sim.reset() to go back to the start"),
    **dict.fromkeys(("arch", "precision"), "make a new Simulator"),
    "gravity": "call sim.set_gravity(gravity)", "material": "call sim.set_material(body, young=...)",
    "scene": "make a new Simulator of the other scene", "settings": "call sim.rebuild(integrator=...)",
    "plan": "it follows from the scene and the settings", "stable_dt": "it follows from the scene; set sim.dt",
    "dragged": "call sim.drag(...) or sim.release()",
}  # fmt: skip


class StateAccess(Guarded):
    """State, results and run-time data of a world; `Simulator` adds building and stepping."""

    _error = SimulationAttributeError
    _read_only = frozenset(("settings", "scene", "plan"))
    _instead = INSTEAD
    settings: Settings
    _changes: int = 0  # of the state and of numbers, from outside: the energy then jumps
    _simulation: SimulationState | None = None
    _contact: "ContactStep | None"
    _idle_detection: "Detection | None"

    @property
    def time(self) -> float:
        """Simulated time [s]."""
        return self._kept_simulation().time

    @property
    def step_count(self) -> int:
        """Steps of dt taken."""
        return self._kept_simulation().step_count

    def positions(self, body: str | None = None) -> np.ndarray:
        """(n_nodes, 3) float64 copy [m]; of all bodies, concatenated in the order added, without a name."""
        return self._open_simulation().state()[0][self._slice(body)].copy()

    def velocities(self, body: str | None = None) -> np.ndarray:
        """(n_nodes, 3) float64 copy [m/s]."""
        return self._open_simulation().state()[1][self._slice(body)].astype(np.float64)

    def set_state(self, positions=None, velocities=None, body: str | None = None) -> None:
        """Set positions [m] and velocities [m/s], (n_nodes, 3) each; constrained axes stop. Copies arrays; compiles nothing."""
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
        """Energies of the present state [J]."""
        model = self._open_simulation().model
        measure(model)
        scalars = model.state.scalars.to_numpy().tolist()
        return Energies(scalars[KINETIC], scalars[ELASTIC], scalars[GRAVITY], scalars[LOADS])

    def reactions(self, body: str | None = None) -> np.ndarray:
        """(n_nodes, 3) force of the constraint on each fixed or moved node in the last step [N], else 0."""
        self._open_simulation()
        return self._stepper.reactions()[self._slice(body)]

    def detect_contacts(self) -> "Contacts":
        """The contacts of the present state swept by dt v, impulses 0; no step.

        How it is done is the scene's (`Scene.collision`, each body's `collision`), and by what each is hit the plan tells. Memory
        and kernels for it are made at the first call. Raises MeshError where a distance field cannot be made, SimulationError
        where positions or velocities are not finite, or a buffer would grow beyond `max_capacity`.
        """
        return self._find_contacts(self._dt).contacts()

    def set_contact(
        self, name_a: str, name_b: str, friction: float | None = None, restitution: float | None = None
    ) -> None:
        """Change the friction or restitution of a pair of bodies, or of a body and an obstacle; as `Scene.set_contact`."""
        scene = self._open_simulation().scene
        with thawed(scene):
            scene.set_contact(name_a, name_b, friction=friction, restitution=restitution)
        self._changes += 1
        if self._contact is not None:
            self._contact.numbers_changed()

    def contacts(self) -> "Contacts":
        """The contacts that the last step began with, gaps those of its start, and the impulses that it gave them [N s].

        Where a step was cut into parts, of its last part. Empty before the first step, and where nothing can touch.
        """
        self._open_simulation()
        if self._contact is not None:
            return self._contact.contacts()
        from taisoft.collision.contacts import no_contacts

        return no_contacts()

    def contact_force(self, name: str) -> np.ndarray:
        """Sum (3,) of the contact forces on a body or an obstacle over the last step [N]."""
        scene = self._open_simulation().scene
        scene.surface_of(name)
        if self._contact is None:
            return np.zeros(3)
        return self._contact.force([c.name for c in scene.colliders].index(name))

    def deepest_overlap(self) -> "Overlap | None":
        """Which two overlap deepest in the present state, and how deep [m]; None where nothing overlaps.

        Slow, and unlike `StepReport.max_penetration` it looks at all pairs, whether or not their surfaces meet. The depth is that
        of the deepest vertex, node, middle of a tet, or cut of a triangle into a tet of either inside the other; a body is as
        deep in a sphere or a capsule as it comes near its middle or axis.
        """
        return next(iter(self.overlaps()), None)

    def overlaps(self) -> "list[Overlap]":
        """All pairs that overlap in the present state, as `deepest_overlap`; the deepest, by the smaller one's size, first."""
        from taisoft.collision.overlap import find_overlaps

        return find_overlaps(self._find_contacts(0.0))

    def intersecting_triangles(self) -> list[tuple[str, int, str, int]]:
        """Surface triangles that intersect in the present state, each pair once: name and triangle of each.

        Triangles are rows of `body.nodes.surface`, or of an obstacle's surface. Of one body only where self_collision is on;
        triangles that share a vertex are left out.
        """
        detection = self._find_contacts(0.0)
        first, colliders = detection.topology.first, self._simulation.scene.colliders
        pairs = detection.intersections()
        owner = np.searchsorted(first, pairs, side="right") - 1
        return [
            (colliders[a].name, int(t - first[a]), colliders[b].name, int(u - first[b])) for (t, u), (a, b) in zip(pairs, owner)
        ]

    def _find_contacts(self, dt: float) -> "Detection":
        """The contacts of the present state swept by dt [s]; with 0 no path is asked for a later time."""
        simulation = self._open_simulation()
        if self._contact is not None:
            self._contact.search(simulation.time, dt)
            return self._contact.detection
        if self._idle_detection is None:
            from taisoft.collision.pipeline import Detection

            itself = self.settings.self_collision
            self._idle_detection = Detection(simulation.scene, simulation.model, simulation.layout, self._runtime, itself)
            self._owned.append(self._idle_detection)
        self._idle_detection.find(simulation.time, dt)
        return self._idle_detection

    @property
    def _detection(self) -> "Detection | None":
        """What finds the contacts; None where it was not needed yet."""
        return self._contact.detection if self._contact is not None else self._idle_detection

    def stress(self, body: str | None = None) -> np.ndarray:
        """Cauchy stress per tet (m,3,3) [Pa], not finite in a flat one; of all bodies, in the order added, without a name."""
        simulation = self._open_simulation()
        m, layout = simulation.model, simulation.layout
        bodies = range(len(layout.n_tets)) if body is None else [self._index(body)]
        sigma = np.zeros((m.n_blocks * m.lanes, 9))
        cauchy_stress(m, sigma)
        first = layout.block_start * m.lanes
        return np.concatenate([sigma[first[k] : first[k] + layout.n_tets[k]] for k in bodies]).reshape(-1, 3, 3)

    def elastic_forces(self) -> np.ndarray:
        """(n_nodes, 3) elastic forces of the present state on all nodes [N]."""
        simulation = self._open_simulation()
        _, force = self._tangent_fields()
        elastic_forces(simulation.model)
        gather_forces(simulation.model, force)
        return force.to_numpy().astype(np.float64)

    def force_differential(self, displacement: np.ndarray) -> np.ndarray:
        """Change of the elastic forces (n_nodes, 3) [N] along a displacement (n_nodes, 3) [m] of all bodies: (df/dx) dx."""
        simulation = self._open_simulation()
        self._check_rows("displacement", displacement, slice(None))
        dx, df = self._tangent_fields()
        upload([(dx, np.asarray(displacement))])
        force_differential(simulation.model, dx, df)
        return df.to_numpy().astype(np.float64)

    def _tangent_fields(self) -> tuple:
        """Two fields of (n_nodes) 3-vectors, allocated when first asked for."""
        if self._tangent is None:
            make, n, real = self._arena.vectors, self._simulation.model.n_nodes, self._runtime.real
            self._tangent = make("tangent_dx", real, n), make("tangent_df", real, n)
        return self._tangent

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
            self._check_stability(value, stacklevel=4)
        self._time_base = (self.time, self.step_count)
        self._changes += 1
        self._dt = value

    @property
    def stable_dt(self) -> float:
        """Largest stable step [s] of an explicit integrator about the rest shape: 2/omega_max without damping."""
        if self._stable_dt is None:
            self._stable_dt = stable_dt(self.scene, self.settings.integrator == "velocity_verlet")
        return self._stable_dt

    def set_gravity(self, gravity) -> None:
        """Change gravity (3,) [m/s^2]. Copies it, recomputes the rounding floor of the residual; compiles nothing."""
        self._open_simulation()
        with thawed(self.scene):
            self.scene.gravity = gravity
        self._load_gravity()
        self._changes += 1
        self._stepper.numbers_changed()

    def _load_gravity(self) -> None:
        """The scene's gravity to the device."""
        upload([(self._simulation.model.gravity, self.scene.gravity[None])])

    def set_material(self, body: str, **numbers) -> None:
        """Change numbers of a body's material (young, poisson, density, mass_damping, stiffness_damping); law stays.

        Copies arrays, recomputes the rounding floor of the residual and the limit of a stable dt; compiles nothing.
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
        if "density" in numbers:  # a total force is spread by mass: the shares stay, but for their rounding
            self._upload_loads()
        self._stepper.numbers_changed()

    def _open_simulation(self) -> SimulationState:
        """The world, with memory on the device."""
        simulation = self._kept_simulation()
        self._runtime.check()
        return simulation

    def _kept_simulation(self) -> SimulationState:
        """The world, for what the host knows."""
        if self._simulation is None:
            raise SimulationError("the simulator is closed")
        return self._simulation

    def _check_stability(self, dt: float, stacklevel: int = 3) -> None:
        limit = self.stable_dt
        if dt <= limit:
            return
        text = f"dt = {dt:.3g} s is above the estimated stability limit of {limit:.3g} s of {self.settings.integrator}"
        if not self.settings.allow_unstable:
            raise SimulationError(
                f"{text}: take a smaller dt (0.9 of the limit is {0.9 * limit:.3g} s) or allow_unstable=True"
            )
        warnings.warn(text, stacklevel=stacklevel)

    def _index(self, body: str) -> int:
        return self.scene.bodies.index(self.scene.body(body))

    def _slice(self, body: str | None) -> slice:
        return slice(None) if body is None else self._simulation.layout.nodes(self._index(body))

    def _check_rows(self, name: str, value, rows: slice) -> None:
        value = np.asarray(value)
        wanted = (len(range(*rows.indices(self._simulation.model.n_nodes))), 3)
        if value.shape != wanted or value.dtype.kind not in "fiu":
            raise SceneError(f"{name} have shape {value.shape} and type {value.dtype}: they must be {wanted} numbers")
        with np.errstate(over="ignore"):
            bad = np.flatnonzero(~np.isfinite(value.astype(self._runtime.np_real)).all(axis=1))
        if len(bad):
            raise SceneError(f"{name}: node {bad[0]} is not finite or too large for {self._runtime.precision}")
