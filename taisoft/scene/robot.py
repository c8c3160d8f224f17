"""Robots: a MuJoCo model whose collision shapes are obstacles of a scene, and which is loaded by what touches them.

MuJoCo moves a robot: joints, limits, actuators, sensors, contacts between its own links. Bodies of the scene touch its links as
they touch any obstacle. `dynamics.robots` couples the two. The robot's own frame has z up; it is turned so that this becomes the
scene's `up`, then by `rotation`, and moved by `position`. MuJoCo gets the scene's gravity. Obstacles of the scene, and robots
among each other, do not touch; a floor that a robot stands on belongs in its file.
"""

from collections import Counter
from collections.abc import Iterable, Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from taisoft.attributes import guarded_record
from taisoft.errors import MissingPackage, SceneError
from taisoft.machine import require
from taisoft.mesh.placing import FROM_Y_UP, TO_Y_UP
from taisoft.scene import checks
from taisoft.scene.commands import Command
from taisoft.scene.loads import ScalarLoad, value_or_path
from taisoft.scene.obstacles import HalfSpace, Obstacle, checked_pose

if TYPE_CHECKING:
    from taisoft.scene.scene import Scene

VERSION = (4, 0, 1)  # of MuJoCo, before which its solver used a wrong Hessian
SUFFIXES = (".xml", ".urdf", ".mjb")
MAX_ITERATIONS = 100


def import_mujoco() -> Any:
    """Return the module. Raises MissingPackage if it is missing, or too old."""
    mujoco = require("mujoco", "a robot", "robot", MissingPackage)
    if tuple(int(part) for part in mujoco.__version__.split(".")[:3]) < VERSION:
        raise MissingPackage(f"a robot needs MuJoCo 4.0.1 or later, not {mujoco.__version__}: pip install 'taisoft[robot]'")
    return mujoco


@guarded_record("robot", "load it again, with other arguments")
class Robot:
    """A robot as MuJoCo compiled it; made by `Robot.load`. Several scenes, and one scene several times, may hold it."""

    path: Path  #: of its file
    model: Any  #: mujoco.MjModel; not to be changed
    state: np.ndarray  #: MuJoCo's state at the start, mjSTATE_INTEGRATION
    links: tuple[str, ...]  #: names of its bodies, without the world

    @classmethod
    def load(
        cls,
        path: str | Path,
        joints: Mapping[str, float] | None = None,
        keyframe: str | None = None,
        servo: tuple[float, float] | Mapping[str, tuple[float, float]] | None = None,
    ) -> "Robot":
        """Read a robot from MJCF (.xml), URDF (.urdf) or a compiled model (.mjb).

        joints: positions at the start by joint [rad or m], instead of those in the file. keyframe: the file's key frame that
        holds the start. servo: (stiffness, damping), in N m/rad and N m s/rad or N/m and N s/m: adds a position servo to each
        hinge and slider that neither an actuator nor another joint drives, named like its joint; or a dict of them by joint.
        Servos hold where they start. MuJoCo's Euler steps, its default, then become "implicitfast", since a servo's damping can
        make them unstable. `package://` in mesh names is looked for in the file's folder and those above. Raises SceneError.
        """
        file = Path(path)
        mujoco = import_mujoco()
        if file.suffix.lower() not in SUFFIXES:
            raise SceneError(f"{file}: a robot's file must be MJCF (.xml), URDF (.urdf) or a compiled model (.mjb)")
        if not file.is_file():
            raise SceneError(f"{file}: there is no such file")
        model, added = _compile(mujoco, file, servo)
        links = tuple(model.body(k).name or f"link{k}" for k in range(1, model.nbody))
        doubled = next((name for name, n in Counter(links).items() if n > 1), None)
        if doubled is not None:
            raise SceneError(f"{file}: two links are called {doubled!r}; names must be unique")
        return cls(file, model, state_of(model, _start(mujoco, model, file, joints or {}, keyframe, added)), links)

    def make_data(self, model: Any = None) -> Any:
        """Return mujoco.MjData at the start, with positions of links and geoms. model: a copy of the robot's own, or None."""
        mujoco, model = import_mujoco(), self.model if model is None else model
        data = mujoco.MjData(model)
        mujoco.mj_setState(model, data, self.state, mujoco.mjtState.mjSTATE_INTEGRATION)
        mujoco.mj_kinematics(model, data)
        return data


@dataclass(frozen=True, eq=False)
class PlacedRobot:
    """A robot in a scene; made by `Scene.add_robot`."""

    robot: Robot
    name: str
    position: np.ndarray  #: (3,) of its frame [m]
    axes: np.ndarray  #: (3,3) rotation from its frame to the scene's
    iterations: int  #: most exchanges of forces and motion in a step
    control: dict[int, ScalarLoad]  #: actuator -> its control, a number or along a path
    shapes: dict[str, int] = field(default_factory=dict)  #: obstacle -> MuJoCo's geom


def state_of(model: Any, data: Any) -> np.ndarray:
    """Return MuJoCo's state, all that its next step depends on."""
    mujoco = import_mujoco()
    kind = mujoco.mjtState.mjSTATE_INTEGRATION
    state = np.empty(mujoco.mj_stateSize(model, kind))
    mujoco.mj_getState(model, data, state, kind)
    return state


def names_of(model: Any, kind: str) -> list[str]:
    """Return the names of a model's things of a kind, by MuJoCo's word: "joint", "actuator", "sensor" or "key"."""
    n = {"joint": model.njnt, "actuator": model.nu, "sensor": model.nsensor, "key": model.nkey}[kind]
    return [getattr(model, kind)(k).name for k in range(n)]


def check_control(model: Any, actuator: int, value: float, what: str) -> None:
    """Raise SceneError unless a control is within its limits, to which MuJoCo would clamp it."""
    low, high = model.actuator_ctrlrange[actuator].tolist()
    if model.actuator_ctrllimited[actuator] and not low <= value <= high:
        raise SceneError(f"{what} must be within its limits {low:g} to {high:g}, not {value:g}")


def _compile(mujoco, file: Path, servo) -> tuple[Any, list[str]]:
    """Return the compiled model, and the joints with added servos. Raises SceneError with MuJoCo's reason."""
    try:
        if file.suffix.lower() == ".mjb":
            if servo is not None:
                raise SceneError(f"{file}: servo= cannot be added to a compiled model")
            return mujoco.MjModel.from_binary_path(str(file)), []
        spec = mujoco.MjSpec.from_file(str(file))
        for mesh in spec.meshes:
            if mesh.file.startswith("package:"):
                mesh.file = str(_in_package(file, mesh.file))
        added = [] if servo is None else _add_servos(mujoco, spec, file, servo)
        return spec.compile(), added
    except (ValueError, RuntimeError, OSError) as error:
        text = " ".join(str(error).split())
        raise SceneError(f"{file}: MuJoCo cannot read this robot: {text}") from None


def _in_package(file: Path, name: str) -> Path:
    """Return the file that a URDF's `package://` name means."""
    parts = [part for part in name.removeprefix("package:").split("/") if part]
    for folder in file.resolve().parents:
        for own in (parts, parts[1:]):
            if own and (found := folder.joinpath(*own)).is_file():
                return found
    raise SceneError(f"{file}: mesh {name!r} is neither in this folder nor in one above")


def _add_servos(mujoco, spec, file: Path, servo) -> list[str]:
    """Add position servos, see `Robot.load`; return their joints."""
    simple, equal = (mujoco.mjtJoint.mjJNT_HINGE, mujoco.mjtJoint.mjJNT_SLIDE), mujoco.mjtEq.mjEQ_JOINT
    followers = {one.name1 for one in spec.equalities if one.type == equal and one.name2}  # of URDF's mimic
    driven = {actuator.target for actuator in spec.actuators}
    names = [joint.name for joint in spec.joints if joint.type in simple and joint.name and joint.name not in driven]
    by_joint = servo if isinstance(servo, Mapping) else {name: servo for name in names if name not in followers}
    for name, numbers in by_joint.items():
        checks.index(name, names, f"{file}: servo: no hinge or slider without an actuator")
        stiffness, damping = checks.array(numbers, f"{file}: servo", ((2,),)).tolist()
        if stiffness <= 0.0 or damping < 0.0:
            raise SceneError(f"{file}: servo must be a stiffness above 0 and a damping of at least 0, not {numbers}")
        made = spec.add_actuator(name=name, target=name, trntype=mujoco.mjtTrn.mjTRN_JOINT)
        made.set_to_position(kp=stiffness, kv=damping)
    if spec.option.integrator == mujoco.mjtIntegrator.mjINT_EULER:
        spec.option.integrator = mujoco.mjtIntegrator.mjINT_IMPLICITFAST
    return list(by_joint)


def _start(mujoco, model, file: Path, joints: Mapping, keyframe, added: list[str]) -> Any:
    """Return MuJoCo's data at the start. Position servos hold where they are, but for those whose control a key frame gives."""
    data, names = mujoco.MjData(model), names_of(model, "joint")
    if keyframe is not None:
        mujoco.mj_resetDataKeyframe(model, data, checks.index(keyframe, names_of(model, "key"), f"{file}: no key frame"))
    for name, value in joints.items():
        checks.index(name, names, f"{file}: no joint")
        own, one = data.joint(name).qpos, model.joint(name)
        own[:] = checks.array(np.atleast_1d(value), f"{file}: joint {name!r}", (own.shape,))
        if one.limited[0] and len(own) == 1 and not one.range[0] <= own[0] <= one.range[1]:
            raise SceneError(f"{file}: joint {name!r} must start within its limits {one.range.tolist()}, not at {own[0]:g}")
    at = mujoco.MjData(model)
    at.qpos[:] = data.qpos
    mujoco.mj_fwdPosition(model, at)  # lengths of actuators
    for k in range(model.nu):
        is_servo = model.actuator_biastype[k] == mujoco.mjtBias.mjBIAS_AFFINE
        is_servo = is_servo and model.actuator_gainprm[k, 0] == -model.actuator_biasprm[k, 1] != 0.0
        if is_servo and (keyframe is None or {names[model.actuator_trnid[k, 0]]} & {*joints, *added}):
            data.ctrl[k] = at.actuator_length[k]
            if model.actuator_actnum[k]:  # a filtered servo's activation follows its control
                data.act[model.actuator_actadr[k]] = data.ctrl[k]
    return data


def add_robot(
    self: "Scene",
    robot: Robot,
    name: str = "robot",
    position=(0.0, 0.0, 0.0),
    rotation=None,
    friction: float = 0.5,
    restitution: float = 0.0,
    control: Mapping[str, Any] | None = None,
    iterations: int = 1,
    links: Iterable[str] | None = None,
) -> PlacedRobot:
    """Add a robot, whose collision shapes become obstacles NAME/LINK, NAME/LINK/1 and so on; return its place.

    position: (3,) [m] and rotation (3,3) of its frame, after it was turned from z up to the scene's up. friction, restitution: of
    all its shapes; `set_contact` changes those of a pair. control: by actuator, a number, a function t [s] -> number, or
    `KeyFrames` of values, of which a step holds the value at its end; others are held, and so is what `sim.robots[name].control`
    sets. iterations: exchanges of forces and motion with MuJoCo in a step, at most, the largest of all robots: 1, the forces of a
    step act in the next one, an error of first order in dt, which is unstable where touching bodies are heavier than a free link;
    more: until both agree. links: those whose shapes are touched; by default all, and the file's world.

    Shapes are the geoms that collide in MuJoCo: boxes, spheres, capsules and planes as they are, cylinders and ellipsoids as
    meshes, and meshes as they are, or their convex hulls, with a warning, where they do not bound a solid. Raises SceneError.
    """
    from taisoft.scene.robot_shapes import placed_pose, shape_of

    self._check_open("add_robot")
    if not isinstance(robot, Robot):
        raise SceneError(f"add_robot needs a Robot, as Robot.load returns it, not {type(robot).__name__}")
    name = checks.free_name(name, "robot", [one.name for one in self.robots])
    what, model = f"robot {name!r}", robot.model
    position, turn = checked_pose((position, np.eye(3) if rotation is None else rotation), 0.0, f"{what}: its place")
    axes = turn @ FROM_Y_UP[self.up] @ TO_Y_UP["z"]
    iterations = checks.whole(iterations, f"{what}: iterations", range(1, MAX_ITERATIONS + 1))
    touched = {"world", *robot.links} if links is None else set(links)
    for one in touched - {"world"}:
        checks.index(one, robot.links, f"{what}: no link")
    controls, actuators = {}, names_of(model, "actuator")
    for one, given in (control or {}).items():
        k = checks.index(one, actuators, f"{what}: no actuator")
        controls[k] = load = ScalarLoad(**value_or_path(given, what, f"control of {one!r}", ((),)))
        if load.path is None:
            check_control(model, k, float(load.value), f"{what}: control of {one!r}")
    placed, data = PlacedRobot(robot, name, position, axes, iterations, controls), robot.make_data()
    taken, made = {one.name for one in self.colliders}, []
    for geom in range(model.ngeom):
        body = int(model.geom_bodyid[geom])
        link = robot.links[body - 1] if body else "world"
        if link not in touched or not (model.geom_contype[geom] or model.geom_conaffinity[geom]):
            continue
        candidates = (f"{name}/{link}" + (f"/{k}" if k else "") for k in range(model.ngeom + len(taken) + 1))
        own = next(one for one in candidates if one not in placed.shapes and one not in taken)
        shape = shape_of(model, geom, f"{what}: link {link!r}")
        translation, turned = placed_pose(placed, shape, data, geom)
        still = {"last": translation, "rate": np.zeros(3), "last_rotation": turned, "spin": np.zeros(3), "end": 0.0}
        path = Command(0.0, translation, first_rotation=turned, **still)
        if link == "world" and isinstance(shape, HalfSpace):  # a ground, drawn as one
            shape, path = HalfSpace(translation, turned @ shape.normal), None
        made.append(Obstacle(shape, own, friction, restitution, path))
        placed.shapes[own] = geom
    if not made:
        raise SceneError(f"{what}: {robot.path} has no shape that collides" + ("" if links is None else " in these links"))
    for obstacle in made:
        self._add("obstacles", obstacle)
    return self._add("robots", placed)
