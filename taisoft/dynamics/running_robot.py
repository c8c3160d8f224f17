"""A robot while it runs: its state in MuJoCo, its numbers by name, and the wrenches that bodies exert on its links."""

import copy
from collections.abc import Callable, Iterator
from typing import TYPE_CHECKING, NamedTuple, Protocol

import numpy as np

from taisoft.errors import SimulationError
from taisoft.scene import checks
from taisoft.scene.obstacles import Obstacle
from taisoft.scene.rigid import Pose
from taisoft.scene.robot import PlacedRobot, import_mujoco, names_of
from taisoft.scene.robot_shapes import placed_pose
from taisoft.scene.scene import Scene

if TYPE_CHECKING:
    from taisoft.dynamics.contact import ContactStep
    from taisoft.dynamics.explicit_stepper import ExplicitStepper
    from taisoft.dynamics.implicit import ImplicitStepper
    from taisoft.dynamics.simulation_state import SimulationState

NEAR = 1e-9  # of a step of MuJoCo, by which dt may exceed a multiple of it


class Bodies(Protocol):
    """What robots feel: a simulation of bodies, after a step."""

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

    def __init__(self, what: str, names: list[str], first: list[int], values: np.ndarray, was_set: Callable | None = None):
        """what: start of messages, and the kind, such as "robot 'arm': no joint"; first: index of each name's first number, and
        their end; was_set: called with the indices that were set (k,), None: none can be."""
        self._what, self.names, self._first, self._values, self._was_set = what, names, first, values, was_set

    def __getitem__(self, key: str | int | slice) -> float | np.ndarray:
        found = self._values[self._at(key)]
        return float(found) if found.ndim == 0 else found.copy()

    def __setitem__(self, key: str | int | slice, value) -> None:
        at = self._at(key)
        if self._was_set is None:
            raise SimulationError(f"{self._what} can be set, nor {key!r}: a robot moves by its actuators' controls")
        self._values[at] = checks.array(value, f"{self._what}: {key!r}", ((), np.shape(self._values[at])))
        self._was_set(np.atleast_1d(np.arange(len(self._values))[at]))

    def __len__(self) -> int:
        return len(self._values)

    def __iter__(self) -> Iterator[float]:
        return iter(self._values.tolist())

    def __array__(self, dtype=None, copy=None) -> np.ndarray:
        return np.array(self._values, dtype=dtype)

    def __repr__(self) -> str:
        return f"{{{', '.join(f'{name}: {self[name]}' for name in self.names)}}}"

    def _at(self, key: str | int | slice) -> int | slice:
        if not isinstance(key, str):
            return key
        if key not in self.names:
            raise SimulationError(f"{self._what} is called {key!r}{checks.nearest(key, self.names)}; there are {self.names}")
        first, end = self._first[(k := self.names.index(key)) : k + 2]
        return first if end == first + 1 else slice(first, end)


class RunningRobot:
    """A robot while it runs, between the steps of a simulator; `Simulator.robots` holds them.

    Vectors are in the scene's axes. model, data: MuJoCo's own records, of this simulator; what changes their positions or times
    is not followed.
    """

    def __init__(self, placed: PlacedRobot, scene: Scene):
        self.mujoco = mujoco = import_mujoco()
        self.placed, self.name, robot = placed, placed.name, placed.robot
        self.model = model = copy.copy(robot.model)  # of its own, since its time step and gravity are set
        self.data = data = mujoco.MjData(model)
        self._longest = float(robot.model.opt.timestep)
        kinds = {"actuator": model.nu, "joint": model.njnt, "sensor": model.nsensor}
        actuators, joints, sensors = ((f"robot {self.name!r}: no {one}", names_of(model, one, n)) for one, n in kinds.items())
        self._axes = *joints, [*model.jnt_dofadr.tolist(), model.nv]
        #: actuators' controls, see `Named`; held until they are set again
        self.control = Named(*actuators, list(range(model.nu + 1)), data.ctrl, self._hold)
        #: positions of joints [rad, m]; a ball joint has a quaternion, a free one position and quaternion
        self.joint = Named(*joints, [*model.jnt_qposadr.tolist(), model.nq], data.qpos)
        #: velocities of joints [rad/s, m/s]
        self.joint_velocity = Named(*self._axes, data.qvel)
        #: sensors' values in MuJoCo's units and frames, at the start of its last step
        self.sensor = Named(*sensors, [*model.sensor_adr.tolist(), model.nsensordata], data.sensordata)
        self.wrenches = np.zeros((model.nbody, 6))  # by MuJoCo's body, in the scene's axes: of the last step,
        self.applied = np.zeros((model.nbody, 6))  # and those that act in the next one
        self._scene = scene
        self._obstacles = [scene.obstacle(name) for name in placed.shapes]
        self._colliders = [scene.colliders.index(one) for one in self._obstacles]
        self._geoms = list(placed.shapes.values())
        self._bodies = model.geom_bodyid[self._geoms]
        self.restart()

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
        self.mujoco.mj_comPos(self.model, self.data)
        for k in np.flatnonzero(self.wrenches.any(axis=1)):
            force, torque = self.wrenches[k].reshape(2, 3) @ axes
            self.mujoco.mj_applyFT(self.model, self.data, force, torque, self.data.xipos[k], k, load)
        return Named(*self._axes, load)

    def _link(self, name: str) -> int:
        links = self.placed.robot.links
        if name not in links:
            hint = f"{checks.nearest(str(name), links)}; there are {list(links)}"
            raise SimulationError(f"robot {self.name!r}: no link is called {name!r}{hint}")
        return 1 + links.index(name)

    def __repr__(self) -> str:
        return f"RunningRobot({self.name!r}, joints={self.joint.names}, actuators={self.control.names})"

    # --- steps ----------------------------------------------------------------------------------------------------------------

    def restart(self) -> None:
        """Return to the start: joints, controls, no forces."""
        robot = self.placed.robot
        self.mujoco.mj_resetData(self.model, self.data)  # its counts of warnings, too
        self.data.qpos[:], self.data.ctrl[:] = robot.start, robot.control
        self.wrenches[:] = self.applied[:] = 0.0
        self._paths = dict(self.placed.control)  # of controls that were not set since
        self.mujoco.mj_kinematics(self.model, self.data)

    def advance(self, dt: float, end: float) -> dict[str, Pose]:
        """Advance MuJoCo by dt [s], to `end` of the simulation, under the wrenches; return poses of the shapes that can move.

        Raises SimulationError with MuJoCo's words where it warns of its state.
        """
        model, data, mujoco = self.model, self.data, self.mujoco
        n = max(1, int(np.ceil(dt / self._longest - NEAR)))
        model.opt.timestep = dt / n
        model.opt.gravity[:] = self.placed.axes.T @ self._scene.gravity
        data.xfrc_applied[:] = (self.applied.reshape(-1, 3) @ self.placed.axes).reshape(-1, 6)
        for k, path in self._paths.items():
            data.ctrl[k] = path(end)
        self._take_steps(n)
        mujoco.mj_kinematics(model, data)
        moving = [k for k, body in enumerate(self._bodies) if model.body_weldid[body]]
        return {
            self._obstacles[k].name: Pose(*placed_pose(self.placed, self._obstacles[k].shape, data, self._geoms[k]))
            for k in moving
        }

    def _take_steps(self, n: int) -> None:
        """Take n of MuJoCo's steps. It warns of what it cannot compute, then goes on with controls of 0, or from its start."""
        mujoco, warnings = self.mujoco, []
        before = mujoco.get_mju_user_warning()
        mujoco.set_mju_user_warning(warnings.append)  # else MuJoCo writes a file into the working folder
        try:
            mujoco.mj_step(self.model, self.data, n)
        finally:
            mujoco.set_mju_user_warning(before)
        if warnings:
            text = warnings[0].decode() if isinstance(warnings[0], bytes) else str(warnings[0])
            raise SimulationError(f"robot {self.name!r}: MuJoCo: {text.strip().rstrip('.')}")

    def feel(self, bodies: Bodies) -> None:
        """Set the wrenches to those of the last step: of contacts, and of what is attached to the links."""
        total = np.zeros((self.model.nbody, 6))  # force and moment about the origin
        touched = set() if bodies.contact is None else set(bodies.contact.pairs()[0].ravel().tolist())
        for collider, obstacle, k in zip(self._colliders, self._obstacles, self._bodies):
            if collider in touched:
                total[k] += bodies.contact.mean_on(collider, None)[:6]
            for forces, points in forces_on(bodies, obstacle):
                total[k] += np.concatenate([forces, np.cross(points, forces)], axis=1).sum(axis=0)
        centres = self.placed.position + self.data.xipos @ self.placed.axes.T
        total[:, 3:] -= np.cross(centres, total[:, :3])
        self.wrenches[:] = total

    def sizes(self) -> np.ndarray:
        """Lengths (nbody,1) [m] that make a torque about a link's centre comparable to a force."""
        reach = np.full(self.model.nbody, np.finfo(np.float64).tiny)  # no torque acts on a link without shapes
        ends = np.linalg.norm(self.data.geom_xpos - self.data.xipos[self.model.geom_bodyid], axis=1) + self.model.geom_rbound
        np.maximum.at(reach, self.model.geom_bodyid, ends)
        return reach[:, None]

    # --- its state ------------------------------------------------------------------------------------------------------------

    def snapshot(self) -> dict:
        """Return what the next step depends on."""
        kind = self.mujoco.mjtState.mjSTATE_INTEGRATION
        state = np.empty(self.mujoco.mj_stateSize(self.model, kind))
        self.mujoco.mj_getState(self.model, self.data, state, kind)
        paths = np.array(list(self._paths), dtype=np.int64)
        return {"state": state, "wrenches": self.wrenches.copy(), "applied": self.applied.copy(), "paths": paths}

    def restore(self, kept: dict) -> None:
        """Restore a `snapshot`."""
        self.mujoco.mj_setState(self.model, self.data, kept["state"], self.mujoco.mjtState.mjSTATE_INTEGRATION)
        self.mujoco.mj_kinematics(self.model, self.data)
        self.wrenches[:], self.applied[:] = kept["wrenches"], kept["applied"]
        self._paths = {k: self.placed.control[k] for k in kept["paths"].tolist()}

    def _hold(self, actuators: np.ndarray) -> None:
        """Hold controls that were set, whatever their paths."""
        for k in actuators.tolist():
            self._paths.pop(k, None)


def forces_on(bodies: Bodies, obstacle: Obstacle) -> Iterator[tuple[np.ndarray, np.ndarray]]:
    """Yield forces (k,3) [N] of connections on an obstacle in the last step, and where they act (k,3) [m]."""
    scene, state = bodies.scene, bodies.state
    for one in scene.exact_attachments:
        if one.b == obstacle.name:
            nodes = scene.first_nodes[one.a] + one.nodes
            yield -bodies.stepper.reactions()[nodes], state.state()[0][nodes]
    moving = None if state.springs is None else state.springs.moving
    for other, places, signs, points in () if moving is None else moving.ends:
        if other is obstacle:
            x, v = state.state()
            pulls = state.springs.pulls(x, v.astype(np.float64), state.amplitudes(state.time))[moving.element[places]]
            yield signs[:, None] * pulls, obstacle.points_at(state.time, points)
