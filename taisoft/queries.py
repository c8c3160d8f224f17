"""Results and other queries of a simulator: each function is a method of `Simulator`, whose class body lists them."""

from typing import TYPE_CHECKING

import numpy as np

from taisoft.backend import runtime
from taisoft.backend.arrays import upload
from taisoft.dynamics.drag_spring import Drag
from taisoft.errors import SceneError, SimulationError
from taisoft.fem.reference import gravity_mass, inverse_rest_edges, lumped_mass
from taisoft.fem.terms import elasticity
from taisoft.records import Energies, ErrorEstimate
from taisoft.scene.look import Camera
from taisoft.scene.obstacles import Obstacle
from taisoft.scene.rigid import Pose, RigidBody, Twist
from taisoft.stability import stable_dt as largest_stable_dt

if TYPE_CHECKING:
    from taisoft.dynamics.running_robot import RunningRobot
    from taisoft.simulator import Simulator


def is_open(self: "Simulator") -> bool:
    """Whether the simulator can be used, as it can until `close`."""
    return self._dynamics is not None and self._dynamics.is_open


def time(self: "Simulator") -> float:
    """Simulated time [s]."""
    return self._host().state.time


def step_count(self: "Simulator") -> int:
    """Steps of dt taken."""
    return self._host().state.step_count


def positions(self: "Simulator", body: str | None = None) -> np.ndarray:
    """Return a float64 copy of a body's node positions (n_nodes, 3) [m]; without a name, of all bodies in the order added."""
    return self._open().state.state()[0][nodes_of(self, body)].copy()


def velocities(self: "Simulator", body: str | None = None) -> np.ndarray:
    """Return a float64 copy of the node velocities (n_nodes, 3) [m/s]; body: as for `positions`."""
    return self._open().state.state()[1][nodes_of(self, body)].astype(np.float64)


def momentum(self: "Simulator", body: str | None = None) -> np.ndarray:
    """Return the momentum (3,) of a body [N s]; without a name, of all bodies. Raises SceneError."""
    mass = lumped_mass if self.settings.explicit else gravity_mass  # row sums of the mass matrix of the steps
    bodies = self.scene.bodies if body is None else [self.scene.body(body)]
    return sum((mass(one) @ self.velocities(one.name) for one in bodies), np.zeros(3))


def energies(self: "Simulator", body: str | None = None) -> Energies:
    """Return the energies of the present state [J], or those of one body. Raises SceneError for an unknown name.

    Of all bodies they add up to the whole, less what springs, tendons and attachments by springs store. The mass of nodes that
    are attached exactly counts in the body that they are attached to.
    """
    return self._open().energies() if body is None else self._open().body_energies()[body_index(self, body)]


def reactions(self: "Simulator", body: str | None = None) -> np.ndarray:
    """Return the constraint forces (n_nodes, 3) of the last step [N]: on fixed and prescribed nodes, 0 on others."""
    return self._open().stepper.reactions()[nodes_of(self, body)]


def joint_force(self: "Simulator", name: str) -> float | np.ndarray:
    """Return the force of a connection in the present state [N].

    Of a spring its tension, with damping, negative if it pushes; of a tendon its tension; of an attachment the forces (k,3) on
    the attached nodes. Of exactly attached ones it is the constraint force: what balances their mean acceleration in the last
    step with their own tets, damping, loads, weight, springs and contacts, see `dynamics.joints`. The last step is not in
    checkpoints: until the next one, acceleration and contacts count as 0. Raises SceneError.
    """
    from taisoft.dynamics.joints import joint_force as of_dynamics

    return of_dynamics(self._open(), name)


def tensions(self: "Simulator") -> dict[str, float]:
    """Return the tensions [N] of all springs and tendons in the present state by name, as `joint_force` gives them one by one."""
    from taisoft.dynamics.joints import tensions as of_dynamics

    return of_dynamics(self._open())


def cavity_volume(self: "Simulator", name: str) -> float:
    """Return the present volume [m^3] of a cavity. Raises SceneError if there is none of this name."""
    state = self._open().state
    return state.cavity_form(name).value_and_gradient(state.state()[0])[0]


def cavity_pressure(self: "Simulator", name: str) -> float:
    """Return the pressure [Pa] in a cavity: as given at the present time, or that of the last step if its volume is given.

    Raises SceneError if there is none of this name.
    """
    self.scene.cavity(name)
    return self._open().state.cavity_pressures_by_name(self.time)[name]


def stress(self: "Simulator", body: str | None = None) -> np.ndarray:
    """Return the Cauchy stress per tet (m,3,3) [Pa], of fibres and branches, too; not finite in a flat tet.

    Without a name, of all bodies as added.
    """
    state = self._open().state
    m, layout = state.model, state.layout
    state.set_load_time(state.time)  # of activations
    lanes = layout.lane_of_tet if body is None else layout.lane_of_tet[layout.tets(body_index(self, body))]
    sigma = np.zeros((m.n_blocks * m.lanes, 9))
    elasticity.cauchy_stress(m, sigma)
    return sigma[lanes].reshape(-1, 3, 3)


def fibres(self: "Simulator", body: str | None = None) -> np.ndarray:
    """Return F a (m,3) of the unit vectors a of fibres at rest: their present directions, each as long as its stretch.

    0 in tets without; of quadratic tets with F of the corners. Without a name, of all bodies as added.
    """
    found = []
    for one in self.scene.bodies if body is None else [self.scene.bodies[body_index(self, body)]]:
        a = np.zeros((one.mesh.n_tets, 3)) if one.fibres is None else one.fibres
        corners, Dm_inv = self.positions(one.name)[one.mesh.tets], inverse_rest_edges(one.mesh.vertices, one.mesh.tets)[0]
        found.append(np.einsum("eki,ekj,ej->ei", corners[:, 1:] - corners[:, :1], Dm_inv, a))
    return np.concatenate(found)


def elastic_forces(self: "Simulator") -> np.ndarray:
    """Return the elastic forces on all nodes in the present state (n_nodes, 3) [N]."""
    model = self._open().model
    _, force = _tangent_fields(self)
    elasticity.elastic_forces(model)
    elasticity.gather_forces(model, force)
    return force.to_numpy().astype(np.float64)


def force_differential(self: "Simulator", displacement: np.ndarray) -> np.ndarray:
    """Return the change of the elastic forces (df/dx) dx (n_nodes, 3) [N]; displacement: dx (n_nodes, 3) [m] of all nodes."""
    model = self._open().model
    check_rows(self, "displacement", displacement, slice(None))
    dx, df = _tangent_fields(self)
    upload([(dx, np.asarray(displacement))])
    elasticity.force_differential(model, dx, df)
    return df.to_numpy().astype(np.float64)


def _tangent_fields(sim: "Simulator") -> tuple:
    """Two fields of n_nodes 3-vectors, allocated at the first use."""
    dynamics = sim._host()
    if dynamics.tangent is None:
        make, n, real = dynamics.arena.vectors, dynamics.model.n_nodes, dynamics.runtime.real
        dynamics.tangent = make("tangent_dx", real, n), make("tangent_df", real, n)
    return dynamics.tangent


def stable_dt(self: "Simulator") -> float:
    """Largest stable time step [s] of an explicit integrator about the rest shape: 2/omega_max without damping."""
    if self._stable_dt is None:
        self._stable_dt = largest_stable_dt(self.scene, self.settings.integrator == "velocity_verlet")
    return self._stable_dt


def error_so_far(self: "Simulator") -> ErrorEstimate | None:
    """Estimated error of the run so far, during a run with error=True; else None."""
    return None if self._estimator is None else self._estimator.estimate()


def nodal_errors(self: "Simulator", body: str | None = None) -> np.ndarray:
    """Return estimated errors of the node positions (n_nodes,) [m] during a run with error=True; body: as for `positions`.

    They are those of the last comparison with the companions, in time, of the solvers and, with error_mesh, in space, added:
    without sign, and often twice the true error. NaN where a part is unknown, as before the first comparison, or in space at
    nodes that the other mesh lacks; `np.nanmax` leaves those out. Raises SimulationError outside such a run.
    """
    if self._estimator is None:
        raise SimulationError("errors are estimated only during sim.run(..., error=True): ask for them in on_frame or on_step")
    return self._estimator.nodal_errors()[nodes_of(self, body)]


def robots(self: "Simulator") -> "dict[str, RunningRobot]":
    """The robots that run with the simulation, by name."""
    return dict(self._host().robots.running)


def robot(self: "Simulator") -> "RunningRobot":
    """The only robot. Raises SimulationError if there is none, or more than one."""
    found = self.robots
    if len(found) != 1:
        there_are = f"there are {list(found)}: take one from sim.robots" if found else "the scene has none: call scene.add_robot"
        raise SimulationError(f"sim.robot: {there_are}")
    return next(iter(found.values()))


# --- rigid bodies -----------------------------------------------------------------------------------------------------


def pose(self: "Simulator", name: str) -> Pose:
    """Return translation (3,) [m] of a rigid body's centre since the start, and rotation (3,3) about it; or an obstacle's pose.

    A point at X in the mesh is at rotation @ (X - body.centre) + body.centre + body.position + translation; one of an obstacle,
    at rotation @ (X - pivot) + pivot + translation, with the pivot of its shape. Raises SceneError.
    """
    one = self.scene.collider(name)
    if isinstance(one, Obstacle):
        return Pose(*one.pose(self.time))
    return _rigid(self, name).pose(self.positions(name))


def twist(self: "Simulator", name: str) -> Twist:
    """Return the velocity (3,) [m/s] of a rigid body's centre, and its angular velocity (3,) [rad/s]. Raises SceneError."""
    return _rigid(self, name).twist(self.positions(name), self.velocities(name))


def rigid_strain(self: "Simulator", name: str) -> float:
    """Return the largest strain of a rigid body in the present state, which its stiffness keeps small. Raises SceneError."""
    return _rigid(self, name).strain(self.positions(name))


def _rigid(sim: "Simulator", name: str) -> RigidBody:
    body = sim.scene.body(name)
    if not isinstance(body, RigidBody):
        raise SceneError(f"body {name!r} is not rigid: its motion is that of its nodes, see positions and velocities")
    return body


# --- dragging and resources -------------------------------------------------------------------------------------------


def draggable(self: "Simulator") -> bool:
    """Whether `drag` can be called."""
    return self.settings.draggable


def asleep(self: "Simulator") -> list[str]:
    """Names of the bodies that sleep: the next step leaves them out unless something wakes them."""
    return self._host().asleep


def dragged(self: "Simulator") -> Drag | None:
    """The present drag, with its point [m] and force [N] at the start of the last step; None if nothing is dragged."""
    spring = self._dynamics.drag_spring
    return None if spring is None else spring.drag


def compile_seconds(self: "Simulator") -> float:
    """Time spent starting Taichi and compiling kernels for this simulator, including its construction [s]."""
    return runtime.compile_clock() - self._compiled_before


def field_bytes(self: "Simulator") -> dict[str, int]:
    """Size of every allocated array [bytes], by name."""
    return self._host().field_bytes


def buffer_growths(self: "Simulator") -> dict[str, int]:
    """How often each buffer of contact detection grew since the start; buffers that never grew are left out."""
    detection = self._dynamics.detection
    return {name: n for name, n in detection.counts.growths.items() if n} if detection is not None else {}


def picture(
    self: "Simulator", size: tuple[int, int] = (1280, 720), colour: str = "stress", camera: Camera | None = None
) -> np.ndarray:
    """Return a picture of the present state, uint8 (height, width, 3), first row on top.

    size: width and height in pixels; colour: of the bodies, by "stress" (von Mises), "stretch", "speed", contact "pressure" or
    accumulated "slip", on a scale up to the state's 99 % quantile, "error" in a run with error=True, or "body". camera: by
    default the scene's own, else one that frames the bodies at the start, and steps back if one would leave the picture. Needs no
    display. Raises OutputError for another size or colour.
    """
    from taisoft.view.offscreen import Offscreen  # compiles kernels at the first picture

    return Offscreen(self.scene, size, camera, colour).image(self)


# --- arguments --------------------------------------------------------------------------------------------------------


def body_index(sim: "Simulator", body: str) -> int:
    """Return a body's number in its scene. Raises SceneError."""
    return sim.scene.bodies.index(sim.scene.body(body))


def nodes_of(sim: "Simulator", body: str | None) -> slice:
    """Return a body's rows among all nodes; all of them without a name."""
    return slice(None) if body is None else sim._host().state.layout.nodes(body_index(sim, body))


def check_rows(sim: "Simulator", name: str, value, rows: slice) -> None:
    """Raise SceneError unless value holds finite 3-vectors for those rows."""
    dynamics, value = sim._host(), np.asarray(value)
    expected = (len(range(*rows.indices(dynamics.model.n_nodes))), 3)
    if value.shape != expected or value.dtype.kind not in "fiu":
        raise SceneError(f"{name} have shape {value.shape} and type {value.dtype}: they must be {expected} numbers")
    with np.errstate(over="ignore"):
        bad = np.flatnonzero(~np.isfinite(value.astype(dynamics.runtime.np_real)).all(axis=1))
    if len(bad):
        raise SceneError(f"{name}: node {bad[0]} is not finite or too large for {dynamics.runtime.precision}")
