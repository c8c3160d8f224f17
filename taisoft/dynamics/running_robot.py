"""A robot while it runs: its state in MuJoCo, its numbers by name, and the wrenches that bodies exert on its links."""

import copy
from collections.abc import Callable, Iterator
from typing import TYPE_CHECKING, NamedTuple, Protocol

import numpy as np

from taisoft.errors import SceneError, SimulationError, reworded
from taisoft.scene import checks
from taisoft.scene.loads import ScalarLoad, value_at
from taisoft.scene.obstacles import Obstacle
from taisoft.scene.rigid import Pose
from taisoft.scene.robot import PlacedRobot, check_control, import_mujoco, names_of, state_of
from taisoft.scene.robot_shapes import placed_pose
from taisoft.scene.scene import Scene

if TYPE_CHECKING:
    from taisoft.dynamics.contact import ContactStep
    from taisoft.dynamics.explicit_stepper import ExplicitStepper
    from taisoft.dynamics.implicit import ImplicitStepper
    from taisoft.dynamics.simulation_state import SimulationState

NEAR = 1e-9  # of a step of MuJoCo, by which dt may exceed a multiple of it


class Bodies(Protocol):
    """What loads robots: a simulation of bodies, after a step."""

    scene: Scene
    state: "SimulationState"
    contact: "ContactStep | None"
    stepper: "ExplicitStepper | ImplicitStepper"


class Wrench(NamedTuple):
    """Force (3,) [N] on a link and torque (3,) [N m] about its centre of mass."""

    force: np.ndarray
    torque: np.ndarray


class Named:
    """Numbers of a robot by name, or by index as in an array: `control["elbow"] = 1.0`, `control[:] = 0.0`."""

    def __init__(self, what: str, names: list[str], first: list[int], values: np.ndarray, check: Callable | None = None):
        """what: start of messages, and the kind, such as "robot 'arm': no joint"; first: index of each name's first number, and
        their end; check: called with indices and values (k,) that are to be set, None: none can be."""
        self._what, self.names, self._first, self._values, self.check = what, names, first, values, check

    def __getitem__(self, key: str | int | slice) -> float | np.ndarray:
        found = self._values[self._at(key)]
        return float(found) if found.ndim == 0 else found.copy()

    def __setitem__(self, key: str | int | slice, value) -> None:
        at = self._at(key)
        if self.check is None:
            raise SimulationError(f"{self._what} can be set, nor {key!r}: a robot moves by its actuators' controls")
        chosen = np.arange(len(self._values))[at]
        what = f"{self._what.replace(': no ', ': ')} {repr(key) if isinstance(key, str) else 'numbers'}"
        value = np.broadcast_to(checks.array(value, what, ((), chosen.shape)), chosen.shape)
        self.check(np.atleast_1d(chosen), np.atleast_1d(value))
        self._values[at] = value

    def __len__(self) -> int:
        return len(self._values)

    def __array__(self, dtype=None, copy=None) -> np.ndarray:
        return np.array(self._values, dtype=dtype)

    def __repr__(self) -> str:
        return f"{{{', '.join(f'{name}: {self[name]}' for name in self.names)}}}"

    def _at(self, key: str | int | slice) -> int | slice:
        if not isinstance(key, str):
            return key
        k = checks.index(key, self.names, self._what, SimulationError)
        first, end = self._first[k : k + 2]
        return first if end == first + 1 else slice(first, end)


class RunningRobot:
    """A robot while it runs, between the steps of a simulator; `Simulator.robots` holds them.

    Vectors are in the scene's axes. model, data: MuJoCo's own records, of this simulator alone. Its `xfrc_applied` is overwritten
    in each step, and what is changed in `model` is in no checkpoint.
    """

    def __init__(self, placed: PlacedRobot, scene: Scene):
        self.mujoco = import_mujoco()
        self.placed, self.name, self._scene = placed, placed.name, scene
        self.model = model = copy.copy(placed.robot.model)  # of its own, since its time step and gravity are set
        self.data = data = placed.robot.make_data(model)
        actuators, joints, sensors = (
            (f"robot {self.name!r}: no {kind}", names_of(model, kind)) for kind in ("actuator", "joint", "sensor")
        )
        self._axes = *joints, [*model.jnt_dofadr.tolist(), model.nv]
        #: actuators' controls, see `Named`; held until they are set again
        self.control = Named(*actuators, list(range(model.nu + 1)), data.ctrl, self._set_control)
        #: positions of joints [rad, m]; a ball joint has a quaternion, a free one position and quaternion
        self.joint = Named(*joints, [*model.jnt_qposadr.tolist(), model.nq], data.qpos)
        #: velocities of joints [rad/s, m/s]
        self.joint_velocity = Named(*self._axes, data.qvel)
        #: sensors' values in MuJoCo's units and frames, at the start of its last step
        self.sensor = Named(*sensors, [*model.sensor_adr.tolist(), model.nsensordata], data.sensordata)
        self.wrenches = np.zeros((model.nbody, 6))  # by MuJoCo's body, in the scene's axes: of the last step,
        self.applied = np.zeros((model.nbody, 6))  # and those that act in the next one
        welded = model.body_weldid
        self.can_yield = (welded > 0) & (model.body_mocapid[welded] < 0)  # (nbody,) whether forces can move a body
        shapes = [(scene.obstacle(name), geom, int(model.geom_bodyid[geom])) for name, geom in placed.shapes.items()]
        self._body_of = {one.name: body for one, _, body in shapes}
        self._body_of_collider = {scene.colliders.index(one): body for one, _, body in shapes}
        self._moving = [(one, geom) for one, geom, body in shapes if welded[body]]
        touched = [body for *_, body in shapes if self.can_yield[body]]
        self.lightest = float(model.body_mass[touched].min(initial=np.inf))  # touched link that forces can move [kg]
        self._paths: dict[int, ScalarLoad] = {}  # of controls that were not set since the start, which `restart` brings

    # --- for users ----------------------------------------------------------------------------------------------------------

    def link_pose(self, link: str) -> Pose:
        """Return where a link's frame is now: position (3,) [m] and rotation (3,3). Raises SimulationError."""
        k, axes = self._link(link), self.placed.axes
        return Pose(self.placed.position + axes @ self.data.xpos[k], axes @ self.data.xmat[k].reshape(3, 3))

    def link_wrench(self, link: str) -> Wrench:
        """Return what touches and what is attached exerts on a link, mean over the last step. Raises SimulationError."""
        found = self.wrenches[self._link(link)]
        return Wrench(found[:3].copy(), found[3:].copy())

    @property
    def joint_load(self) -> Named:
        """What touches and what is attached exerts along each joint [N m, N], mean over the last step, in its present pose."""
        load, axes = np.zeros(self.model.nv), self.placed.axes
        for k in np.flatnonzero(self.wrenches.any(axis=1)):
            force, torque = self.wrenches[k].reshape(2, 3) @ axes
            self.mujoco.mj_applyFT(self.model, self.data, force, torque, self.data.xipos[k], k, load)
        return Named(*self._axes, load)

    def _link(self, name: str) -> int:
        return 1 + checks.index(name, self.placed.robot.links, f"robot {self.name!r}: no link", SimulationError)

    def _set_control(self, actuators: np.ndarray, values: np.ndarray) -> None:
        """Check controls that are to be set, and hold them from now on, whatever their paths."""
        for k, value in zip(actuators.tolist(), values.tolist()):
            check_control(self.model, k, value, f"robot {self.name!r}: control of {self.control.names[k]!r}")
        for k in actuators.tolist():
            self._paths.pop(k, None)

    def __repr__(self) -> str:
        return f"RunningRobot({self.name!r}, joints={self.joint.names}, actuators={self.control.names})"

    # --- steps ----------------------------------------------------------------------------------------------------------------

    def restart(self) -> None:
        """Return to the start: joints, controls, no forces."""
        scratch = self.placed.robot.make_data(self.model)
        self.mujoco.mj_forward(self.model, scratch)  # would change what the first step begins with
        self._paths = dict(self.placed.control)
        none = np.zeros_like(self.wrenches)
        self._set_state(self.placed.robot.state, scratch.sensordata, none, none)

    def advance(self, dt: float, end: float) -> dict[str, Pose]:
        """Advance MuJoCo by dt [s], to `end` of the simulation, under the wrenches; return poses of the shapes that can move.

        Raises SimulationError with MuJoCo's words where it warns of its state, and where a control's path fails.
        """
        model, data = self.model, self.data
        n = max(1, int(np.ceil(dt / self.placed.robot.model.opt.timestep - NEAR)))
        model.opt.timestep = dt / n
        model.opt.gravity[:] = self.placed.axes.T @ self._scene.gravity
        data.xfrc_applied[:] = (self.applied.reshape(-1, 3) @ self.placed.axes).reshape(-1, 6)
        for k, path in self._paths.items():
            what = f"robot {self.name!r}: control of {self.control.names[k]!r}"
            data.ctrl[k] = float(value_at(path, end, what))
            with reworded(SceneError, raised=SimulationError):
                check_control(model, k, data.ctrl[k], f"{what} at t = {end:g}")
        self._take_steps(n)
        self._place()
        return {one.name: Pose(*placed_pose(self.placed, one.shape, data, geom)) for one, geom in self._moving}

    def _place(self) -> None:
        """Compute where links are, and what Jacobians need."""
        self.mujoco.mj_kinematics(self.model, self.data)
        self.mujoco.mj_comPos(self.model, self.data)

    def _take_steps(self, n: int) -> None:
        """Take n of MuJoCo's steps. It warns of what it cannot compute, then goes on with controls of 0, or from its start."""
        mujoco, warnings = self.mujoco, []
        for one in self.data.warning:  # MuJoCo speaks of the first of each kind only
            one.number = 0
        before = mujoco.get_mju_user_warning()
        mujoco.set_mju_user_warning(warnings.append)  # else MuJoCo writes a file into the working folder
        try:
            mujoco.mj_step(self.model, self.data, n)
        finally:
            mujoco.set_mju_user_warning(before)
        if self.data.warning.number.any():
            text = warnings[0].strip().rstrip(".") if warnings else "its state is not finite"
            raise SimulationError(f"robot {self.name!r}: MuJoCo: {text}")

    def measure_wrenches(self, bodies: Bodies) -> None:
        """Set the wrenches to those of the last step: of contacts, and of what is attached to the links."""
        total = np.zeros((self.model.nbody, 6))  # force and moment about the origin
        touched = set() if bodies.contact is None else set(bodies.contact.pairs()[0].ravel().tolist())
        for collider in sorted(touched & self._body_of_collider.keys()):  # in a fixed order, for the same bits
            total[self._body_of_collider[collider]] += bodies.contact.mean_on(collider, None)[:6]
        for obstacle, forces, points in forces_on_obstacles(bodies):
            if (k := self._body_of.get(obstacle.name)) is not None:
                total[k] += np.concatenate([forces, np.cross(points, forces)], axis=1).sum(axis=0)
        centres = self.placed.position + self.data.xipos @ self.placed.axes.T
        total[:, 3:] -= np.cross(centres, total[:, :3])
        self.wrenches[:] = total

    def sizes(self) -> np.ndarray:
        """Lengths (nbody,1) [m] that make a torque about a link's centre comparable to a force."""
        reach = np.full(self.model.nbody, np.inf)  # no torque acts on a link without shapes
        for _, geom in self._moving:
            k = self.model.geom_bodyid[geom]
            arm = np.linalg.norm(self.data.geom_xpos[geom] - self.data.xipos[k]) + self.model.geom_rbound[geom]
            reach[k] = max(arm, reach[k]) if np.isfinite(reach[k]) else arm
        return reach[:, None]

    # --- its state ------------------------------------------------------------------------------------------------------------

    def snapshot(self) -> dict:
        """Return what the next step depends on, and the sensors."""
        arrays = {name: getattr(self, name).copy() for name in ("wrenches", "applied")}
        arrays |= {"state": state_of(self.model, self.data), "sensors": self.data.sensordata.copy()}
        return arrays | {"paths": np.array(list(self._paths), dtype=np.int64)}

    def restore(self, kept: dict) -> None:
        """Restore a `snapshot`."""
        self._paths = {k: self.placed.control[k] for k in kept["paths"].tolist()}
        self._set_state(kept["state"], kept["sensors"], kept["wrenches"], kept["applied"])

    def _set_state(self, state: np.ndarray, sensors: np.ndarray, wrenches: np.ndarray, applied: np.ndarray) -> None:
        self.mujoco.mj_setState(self.model, self.data, state, self.mujoco.mjtState.mjSTATE_INTEGRATION)
        self._place()
        self.data.sensordata[:], self.wrenches[:], self.applied[:] = sensors, wrenches, applied

    def close(self) -> None:
        """Refuse controls from now on: the simulator is closed, or was rebuilt with a robot of its own."""

        def refuse(*_) -> None:
            raise SimulationError(f"robot {self.name!r}: its simulator was closed or rebuilt: take it from sim.robots again")

        self.control.check = refuse


def forces_on_obstacles(bodies: Bodies) -> Iterator[tuple[Obstacle, np.ndarray, np.ndarray]]:
    """Yield obstacles that connections hold on to, their forces (k,3) [N] in the last step, and where they act (k,3) [m]."""
    scene, state = bodies.scene, bodies.state
    obstacles = {one.name: one for one in scene.obstacles}
    for one in scene.exact_attachments:
        if one.b in obstacles:
            nodes = scene.first_nodes[one.a] + one.nodes
            yield obstacles[one.b], -bodies.stepper.reactions()[nodes], state.state()[0][nodes]
    if state.springs is not None and (moving := state.springs.moving) is not None:
        x, v = state.state()
        pulls = state.springs.pulls(x, v.astype(np.float64), state.amplitudes(state.time))[moving.element]
        for obstacle, places, signs, points in moving.ends:
            yield obstacle, signs[:, None] * pulls[places], obstacle.points_at(state.time, points)
