"""Robots that run beside a simulation, and the exchange of motion and forces with MuJoCo, once a step or until both agree.

A step from t to t + dt: MuJoCo advances each robot under the wrenches of its links, in steps of its own that divide dt; the
obstacles that are its shapes are commanded to where they then are, and bodies take their step; contact forces on the shapes, and
forces of what is attached to them, give the wrenches. With one iteration (weak coupling) these act in the next step: an error of
first order in dt, and unstable where touching bodies are heavier than a free link. With more, the step is repeated from its start
under wrenches that are relaxed by Aitken's rule (Irons and Tuck 1969), until they change by less than TOLERANCE.

Wrenches are means over a step, about the centre of mass of a link, where MuJoCo takes them. A robot of one's own control is
`RunningRobot.control`; MuJoCo's records are in `model` and `data`.
"""

import copy
from collections.abc import Callable, Iterator
from typing import TYPE_CHECKING, NamedTuple

import numpy as np

from taisoft.errors import SimulationError
from taisoft.records import StepReport
from taisoft.scene import checks
from taisoft.scene.obstacles import Obstacle
from taisoft.scene.rigid import Pose
from taisoft.scene.robot import PlacedRobot, import_mujoco
from taisoft.scene.robot_shapes import placed_pose
from taisoft.scene.scene import Scene

if TYPE_CHECKING:
    from taisoft.dynamics.dynamics import Dynamics

TOLERANCE = 1e-4  # of iterations: change of the wrenches over the largest one in the step
FIRST_RELAXATION, MAX_RELAXATION = 0.5, 2.0  # of the change of the wrenches, in the first and in later iterations
NEAR = 1e-9  # of a step of MuJoCo, by which dt may exceed a multiple of it


class Wrench(NamedTuple):
    """Force (3,) [N] on a link and torque (3,) [N m] about its centre of mass."""

    force: np.ndarray
    torque: np.ndarray


class Named:
    """Numbers of a robot by name, or by index as in an array: `control["elbow"] = 1.0`, `control[:] = 0.0`."""

    def __init__(
        self,
        what: str,
        names: list[str],
        first: list[int],
        values: np.ndarray,
        was_set: Callable[[np.ndarray], None] | None = None,
    ):
        """first: index of each name's first number, and their end; was_set: called with the indices set, None: none can be."""
        self._what, self._names, self._first, self._values, self._was_set = what, names, first, values, was_set

    def __getitem__(self, key: str | int | slice) -> float | np.ndarray:
        found = self._values[self._at(key)]
        return float(found) if found.ndim == 0 else found.copy()

    def __setitem__(self, key: str | int | slice, value) -> None:
        at = self._at(key)
        if self._was_set is None:
            raise SimulationError(f"{self._what} {key!r} cannot be set: a robot moves by its actuators' controls")
        shape = np.shape(self._values[at])
        self._values[at] = checks.array(value, f"{self._what} {key!r}", ((), shape))
        self._was_set(np.atleast_1d(np.arange(len(self._values))[at]))

    def __len__(self) -> int:
        return len(self._values)

    def __iter__(self) -> Iterator[float]:
        return iter(self._values.tolist())

    def __array__(self, dtype=None, copy=None) -> np.ndarray:
        return np.array(self._values, dtype=dtype)

    def __repr__(self) -> str:
        return f"{{{', '.join(f'{name}: {self[name]}' for name in self._names)}}}"

    @property
    def names(self) -> list[str]:
        """The names, in order."""
        return list(self._names)

    def _at(self, key: str | int | slice) -> int | slice:
        if not isinstance(key, str):
            return key
        if key not in self._names:
            hint = checks.nearest(key, self._names)
            raise SimulationError(f"no {self._what} is called {key!r}{hint}; there are {self._names}")
        k = self._names.index(key)
        first, end = self._first[k], self._first[k + 1]
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
        what, names = f"robot {self.name!r}: ", ("actuator", "joint", "sensor")
        actuators, joints, sensors = (
            [getattr(model, n)(k).name for k in range(getattr(model, c))] for n, c in zip(names, ("nu", "njnt", "nsensor"))
        )
        #: actuators' controls, see `Named`; held until they are set again
        self.control = Named(f"{what}actuator", actuators, list(range(model.nu + 1)), data.ctrl, self._hold)
        #: positions of joints [rad, m]; a ball joint has a quaternion, a free one position and quaternion
        self.joint = Named(f"{what}joint", joints, [*model.jnt_qposadr, model.nq], data.qpos)
        #: velocities of joints [rad/s, m/s]
        self.joint_velocity = Named(f"{what}joint", joints, [*model.jnt_dofadr, model.nv], data.qvel)
        #: sensors' values in MuJoCo's units and frames, at the start of its last step
        self.sensor = Named(f"{what}sensor", sensors, [*model.sensor_adr, model.nsensordata], data.sensordata)
        self.wrenches = np.zeros((model.nbody, 6))  # by MuJoCo's body, in the scene's axes: of the last step
        self._applied = np.zeros((model.nbody, 6))  # to the present step, in MuJoCo's axes
        self._scene = scene
        self._obstacles = [scene.obstacle(name) for name in placed.shapes]
        self._colliders = [scene.colliders.index(one) for one in self._obstacles]
        self._geoms = list(placed.shapes.values())
        self._bodies = model.geom_bodyid[self._geoms]
        kind = mujoco.mjtWarning
        self._failures = kind.mjWARN_BADQPOS, kind.mjWARN_BADQVEL, kind.mjWARN_BADQACC
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

    def _link(self, name: str) -> int:
        links = self.placed.robot.links
        if name not in links:
            raise SimulationError(
                f"robot {self.name!r}: no link is called {name!r}{checks.nearest(str(name), links)}; there are {list(links)}"
            )
        return 1 + links.index(name)

    def __repr__(self) -> str:
        return f"RunningRobot({self.name!r}, joints={self.joint.names}, actuators={self.control.names})"

    # --- steps ----------------------------------------------------------------------------------------------------------------

    def restart(self) -> None:
        """Return to the start: joints, controls, no forces."""
        robot = self.placed.robot
        self.mujoco.mj_resetData(self.model, self.data)  # its counts of warnings, too
        self.data.qpos[:], self.data.ctrl[:] = robot.start, robot.control
        self.wrenches[:] = self._applied[:] = 0.0
        self._paths = dict(self.placed.control)  # of controls that were not set since
        self.mujoco.mj_kinematics(self.model, self.data)

    def advance(self, dt: float, end: float) -> dict[str, Pose]:
        """Advance MuJoCo by dt [s], to `end` of the simulation, under the wrenches; return poses of the shapes that can move.

        Raises SimulationError where MuJoCo's state is not finite.
        """
        model, data, mujoco = self.model, self.data, self.mujoco
        n = max(1, int(np.ceil(dt / self._longest - NEAR)))
        model.opt.timestep = dt / n
        model.opt.gravity[:] = self.placed.axes.T @ self._scene.gravity
        data.xfrc_applied[:] = self._applied
        for k, path in self._paths.items():
            data.ctrl[k] = path(end)
        mujoco.mj_step(model, data, n)
        if any(data.warning[int(kind)].number for kind in self._failures):  # MuJoCo has started again from the beginning
            raise SimulationError(
                f"robot {self.name!r}: MuJoCo's positions, velocities or accelerations are not finite or too large"
            )
        mujoco.mj_kinematics(model, data)
        moving = [k for k, body in enumerate(self._bodies) if model.body_weldid[body]]
        return {
            self._obstacles[k].name: Pose(*placed_pose(self.placed, self._obstacles[k].shape, data, self._geoms[k]))
            for k in moving
        }

    def feel(self, dynamics: "Dynamics") -> None:
        """Set the wrenches to those of the last step: of contacts, and of what is attached to the links."""
        total = np.zeros((self.model.nbody, 6))  # force and moment about the origin
        for collider, obstacle, k in zip(self._colliders, self._obstacles, self._bodies):
            if dynamics.contact is not None:
                total[k] += dynamics.contact.mean_on(collider, None)[:6]
            for forces, points in forces_on(dynamics, obstacle):
                total[k] += np.concatenate([forces, np.cross(points, forces)], axis=1).sum(axis=0)
        centres = self.placed.position + self.data.xipos @ self.placed.axes.T
        total[:, 3:] -= np.cross(centres, total[:, :3])
        self.wrenches[:] = total

    def apply(self, wrenches: np.ndarray) -> None:
        """Let wrenches (nbody,6), in the scene's axes, act from the next step on."""
        self._applied[:] = (wrenches.reshape(-1, 3) @ self.placed.axes).reshape(-1, 6)

    def sizes(self) -> np.ndarray:
        """Lengths (nbody,1) [m] that make a torque about a link's centre comparable to a force."""
        reach = np.full(self.model.nbody, np.finfo(np.float64).tiny)
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
        return {"state": state, "wrenches": self.wrenches.copy(), "applied": self._applied.copy(), "paths": paths}

    def restore(self, kept: dict) -> None:
        """Restore a `snapshot`."""
        self.mujoco.mj_setState(self.model, self.data, kept["state"], self.mujoco.mjtState.mjSTATE_INTEGRATION)
        self.mujoco.mj_kinematics(self.model, self.data)
        self.wrenches[:], self._applied[:] = kept["wrenches"], kept["applied"]
        self._paths = {k: self.placed.control[k] for k in kept["paths"].tolist()}

    def _hold(self, actuators: np.ndarray) -> None:
        """Hold controls that were set, whatever their paths."""
        for k in actuators.tolist():
            self._paths.pop(k, None)


class Robots:
    """All robots of a scene."""

    def __init__(self, scene: Scene):
        self.running = {placed.name: RunningRobot(placed, scene) for placed in scene.robots}
        self._iterations = max((placed.iterations for placed in scene.robots), default=1)

    def __bool__(self) -> bool:
        return bool(self.running)

    def restart(self) -> None:
        """Return all to their starts."""
        for robot in self.running.values():
            robot.restart()

    def snapshot(self) -> dict:
        """Return what the next step depends on, by name."""
        return {name: robot.snapshot() for name, robot in self.running.items()}

    def restore(self, kept: dict) -> None:
        """Restore a `snapshot`."""
        for name, robot in self.running.items():
            robot.restore(kept[name])

    def step(self, dynamics: "Dynamics") -> StepReport:
        """Take one step of the simulation and of the robots. Raises SimulationError; both are then as before."""
        before, start = self.snapshot(), dynamics.snapshot() if self._iterations > 1 else {}
        try:
            report = self._take(dynamics)
            exchange = Exchange(list(self.running.values()))
            for _ in range(self._iterations - 1):
                if exchange.agrees():
                    break
                wrenches = exchange.relaxed()
                dynamics.restore(start)
                self.restore(before)
                exchange.apply(wrenches)
                report = _sum(report, self._take(dynamics))
            if self._iterations > 1 and not exchange.agrees():
                report.converged = False
                report.problems.append(
                    f"step {dynamics.state.step_count}: forces and motion of {', '.join(self.running)} do not agree after "
                    f"{self._iterations} iterations: wrenches still change by {exchange.change:.2g} of their size"
                )
        except BaseException:  # Ctrl-C, too
            if start and dynamics.is_open:
                dynamics.restore(start)
            self.restore(before)
            raise
        exchange.apply(exchange.felt())
        return report

    def _take(self, dynamics: "Dynamics") -> StepReport:
        """Let the robots move, and the bodies take their step against them."""
        poses, dt = {}, dynamics.dt
        for robot in self.running.values():
            poses |= robot.advance(dt, dynamics.state.time + dt)
        dynamics.command_poses(poses)
        report = dynamics.take_steps(1)
        for robot in self.running.values():
            robot.feel(dynamics)
        return report


class Exchange:
    """Wrenches of robots in the iterations of one step, with Aitken's relaxation."""

    def __init__(self, robots: list[RunningRobot]):
        self._robots = robots
        self._applied = np.concatenate([(robot._applied.reshape(-1, 3) @ robot.placed.axes.T).reshape(-1, 6) for robot in robots])
        self._lengths = np.concatenate([robot.sizes() for robot in robots])
        self._last: np.ndarray | None = None  # change at the last relaxation
        self._relaxation = FIRST_RELAXATION

    def felt(self) -> np.ndarray:
        """The wrenches of the last iteration, those of all robots one below the other."""
        return np.concatenate([robot.wrenches for robot in self._robots])

    def apply(self, wrenches: np.ndarray) -> None:
        """Let wrenches act in the next iteration, or the next step."""
        self._applied, first = wrenches, 0
        for robot in self._robots:
            robot.apply(wrenches[first : first + len(robot.wrenches)])
            first += len(robot.wrenches)

    @property
    def change(self) -> float:
        """How much the bodies' answer to the applied wrenches differs from these, over the larger of both."""
        largest = max(np.abs(self._as_forces(self.felt())).max(), np.abs(self._as_forces(self._applied)).max())
        return float(np.abs(self._as_forces(self.felt() - self._applied)).max() / largest) if largest > 0.0 else 0.0

    def agrees(self) -> bool:
        """Whether it is within TOLERANCE."""
        return self.change <= TOLERANCE

    def relaxed(self) -> np.ndarray:
        """Return the wrenches of the next iteration."""
        change = self._as_forces(self.felt() - self._applied).ravel()
        if self._last is not None:
            turn = change - self._last
            if square := float(turn @ turn):
                self._relaxation *= -float(self._last @ turn) / square
                self._relaxation = min(max(self._relaxation, -MAX_RELAXATION), MAX_RELAXATION) or FIRST_RELAXATION
        self._last = change
        return self._applied + self._relaxation * (self.felt() - self._applied)

    def _as_forces(self, wrenches: np.ndarray) -> np.ndarray:
        return np.concatenate([wrenches[:, :3], wrenches[:, 3:] / self._lengths], axis=1)


def forces_on(dynamics: "Dynamics", obstacle: Obstacle) -> Iterator[tuple[np.ndarray, np.ndarray]]:
    """Yield forces (k,3) [N] of connections on an obstacle in the last step, and where they act (k,3) [m]."""
    scene, state = dynamics.scene, dynamics.state
    for one in scene.exact_attachments:
        if one.b == obstacle.name:
            nodes = scene.first_nodes[one.a] + one.nodes
            yield -dynamics.stepper.reactions()[nodes], state.state()[0][nodes]
    moving = None if state.springs is None else state.springs.moving
    for other, places, signs, points in () if moving is None else moving.ends:
        if other is obstacle:
            x, v = state.state()
            pulls = state.springs.pulls(x, v.astype(np.float64), state.amplitudes(state.time))[moving.element[places]]
            yield signs[:, None] * pulls, obstacle.points_at(state.time, points)


def _sum(first: StepReport, last: StepReport) -> StepReport:
    """The report of a step's last iteration, with the work of all."""
    for name in ("newton_iterations", "linear_iterations", "contact_iterations"):
        setattr(last, name, getattr(first, name) + getattr(last, name))
    return last
