"""Robots: a MuJoCo model whose collision shapes are obstacles of a scene, and which feels the forces of what touches them.

MuJoCo moves a robot: joints, limits, actuators, sensors, contacts between its own links. Bodies of the scene touch its links as
they touch any obstacle. `dynamics.robots` couples the two. The robot's own frame has z up; it is turned so that this becomes the
scene's `up`, then by `rotation`, and moved by `position`. MuJoCo gets the scene's gravity. Scene obstacles and robots do not
touch each other; a floor that a robot stands on belongs in its file.
"""

from collections import Counter
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from taisoft.attributes import guarded_record
from taisoft.errors import MissingPackage, SceneError, value_text
from taisoft.machine import require
from taisoft.mesh.placing import FROM_Y_UP, TO_Y_UP
from taisoft.scene import checks
from taisoft.scene.commands import Command
from taisoft.scene.key_frames import KeyFrames
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
@dataclass(frozen=True, eq=False)
class Robot:
    """A robot as MuJoCo compiled it; made by `Robot.load`. Several scenes, and one scene several times, may hold it."""

    path: Path  #: of its file
    model: Any  #: mujoco.MjModel; not to be changed
    start: np.ndarray  #: joint positions at the start (model.nq,), in MuJoCo's order [m, rad]
    control: np.ndarray  #: actuators' controls at the start (model.nu,)
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
        holds positions and controls at the start. servo: (stiffness, damping), in N m/rad and N m s/rad or N/m and N s/m, or a
        dict of them by joint: adds a position servo to each hinge and slider, or to these, that has no actuator, named like its
        joint, which holds it where it starts; files in URDF name no actuators. MuJoCo's Euler steps, its default, then become
        "implicitfast", since a servo's damping can make them unstable. `package://` in mesh names is looked for in the file's
        folder and those above. Raises SceneError.
        """
        file = Path(path)
        mujoco = import_mujoco()
        if file.suffix.lower() not in SUFFIXES:
            raise SceneError(f"{file}: a robot's file must be MJCF (.xml), URDF (.urdf) or a compiled model (.mjb)")
        if not file.is_file():
            raise SceneError(f"{file}: there is no such file")
        model = _compile(mujoco, file, servo)
        data = _start(mujoco, model, file, joints, keyframe)
        links = tuple(model.body(k).name or f"link{k}" for k in range(1, model.nbody))
        doubled = next((name for name in links if links.count(name) > 1), None)
        if doubled is not None:
            raise SceneError(f"{file}: two links are called {doubled!r}; names must be unique")
        return cls(file, model, data.qpos.copy(), data.ctrl.copy(), links)

    def link_of(self, geom: int) -> str:
        """Return the name of the link that a geom belongs to, "world" for what does not belong to one."""
        k = int(self.model.geom_bodyid[geom])
        return self.links[k - 1] if k else "world"


@dataclass(frozen=True, eq=False)
class PlacedRobot:
    """A robot in a scene; made by `Scene.add_robot`."""

    robot: Robot
    name: str
    position: np.ndarray  #: (3,) of its frame [m]
    axes: np.ndarray  #: (3,3) rotation from its frame to the scene's
    iterations: int  #: most exchanges of forces and motion in a step
    control: dict[int, Callable[[float], float]]  #: actuator -> its control as a function of time [s]
    shapes: dict[str, int] = field(default_factory=dict)  #: obstacle -> MuJoCo's geom


def robot_parts(robot: Robot) -> list[np.ndarray]:
    """Return the values that define a robot: its compiled model, and its start."""
    mujoco = import_mujoco()
    compiled = np.empty(mujoco.mj_sizeModel(robot.model), dtype=np.uint8)
    mujoco.mj_saveModel(robot.model, None, compiled)
    return [compiled, robot.start, robot.control]


def _compile(mujoco, file: Path, servo) -> Any:
    """Return the compiled model. Raises SceneError with MuJoCo's reason."""
    try:
        if file.suffix.lower() == ".mjb":
            if servo is not None:
                raise SceneError(f"{file}: servo= cannot be added to a compiled model")
            return mujoco.MjModel.from_binary_path(str(file))
        spec = mujoco.MjSpec.from_file(str(file))
        for mesh in spec.meshes:
            if mesh.file.startswith("package:"):
                mesh.file = str(_in_package(file, mesh.file))
        if servo is not None:
            _add_servos(mujoco, spec, file, servo)
        return spec.compile()
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


def _add_servos(mujoco, spec, file: Path, servo) -> None:
    """Add a position servo to each hinge and slider that no actuator drives."""
    simple, driven = (mujoco.mjtJoint.mjJNT_HINGE, mujoco.mjtJoint.mjJNT_SLIDE), {actuator.target for actuator in spec.actuators}
    names = [joint.name for joint in spec.joints if joint.type in simple and joint.name and joint.name not in driven]
    for name, numbers in servo.items() if isinstance(servo, Mapping) else [(name, servo) for name in names]:
        _known(name, names, f"{file}: servo: no hinge or slider without an actuator")
        stiffness, damping = checks.array(numbers, f"{file}: servo", ((2,),)).tolist()
        if stiffness <= 0.0 or damping < 0.0:
            raise SceneError(f"{file}: servo must be a stiffness above 0 and a damping of at least 0, not {numbers}")
        made = spec.add_actuator(name=name, target=name, trntype=mujoco.mjtTrn.mjTRN_JOINT)
        made.set_to_position(kp=stiffness, kv=damping)
    if spec.option.integrator == mujoco.mjtIntegrator.mjINT_EULER:
        spec.option.integrator = mujoco.mjtIntegrator.mjINT_IMPLICITFAST


def _start(mujoco, model, file: Path, joints, keyframe) -> Any:
    """Return MuJoCo's data at the start."""
    data = mujoco.MjData(model)
    if keyframe is not None:
        at = _known(keyframe, [model.key(k).name for k in range(model.nkey)], f"{file}: no key frame")
        mujoco.mj_resetDataKeyframe(model, data, at)
    names = names_of(model, "joint", model.njnt)
    for name, value in (joints or {}).items():
        _known(name, names, f"{file}: no joint")
        own, one = data.joint(name).qpos, model.joint(name)
        own[:] = checks.array(np.atleast_1d(value), f"{file}: joint {name!r}", (own.shape,))
        if one.limited[0] and len(own) == 1 and not one.range[0] <= own[0] <= one.range[1]:
            raise SceneError(f"{file}: joint {name!r} must start within its limits {one.range.tolist()}, not at {own[0]:g}")
    for k in range(model.nu if keyframe is None else 0):
        joint = model.actuator_trnid[k, 0]
        if model.actuator_trntype[k] == mujoco.mjtTrn.mjTRN_JOINT and model.actuator_biastype[k] == mujoco.mjtBias.mjBIAS_AFFINE:
            if model.actuator_gainprm[k, 0] == -model.actuator_biasprm[k, 1] != 0.0:  # a position servo holds where it starts
                data.ctrl[k] = data.qpos[model.jnt_qposadr[joint]]
    mujoco.mj_kinematics(model, data)
    return data


def add_robot(
    self: "Scene",
    robot: Robot,
    name: str = "robot",
    position=(0.0, 0.0, 0.0),
    rotation=None,
    friction: float = 0.5,
    restitution: float = 0.0,
    control: Mapping[str, Callable[[float], float] | KeyFrames] | None = None,
    iterations: int = 1,
    links: Iterable[str] | None = None,
) -> PlacedRobot:
    """Add a robot, whose collision shapes become obstacles NAME/LINK, NAME/LINK/1 and so on; return its place.

    position: (3,) [m] and rotation (3,3) of its frame, after it was turned from z up to the scene's up. friction, restitution: of
    all its shapes; `set_contact` changes those of a pair. control: by actuator, its control along time, a function t [s] ->
    number or `KeyFrames` of values; others are held, and so is what `sim.robots[name].control` sets. iterations: exchanges of
    forces and motion with MuJoCo in a step, at most: 1, the forces of a step act in the next one, an error of first order in dt,
    which is unstable where touching bodies are heavier than a free link; more: until both agree. links: those whose shapes are
    touched; by default all.

    Shapes are the geoms that collide in MuJoCo: boxes, spheres, capsules and planes as they are, cylinders and ellipsoids as
    meshes, and meshes as they are, or their convex hulls, with a warning, where they do not bound a solid. Raises SceneError.
    """
    from taisoft.scene.robot_shapes import placed_pose, shape_of

    self._check_open("add_robot")
    if not isinstance(robot, Robot):
        raise SceneError(f"add_robot needs a Robot, as Robot.load returns it, not {type(robot).__name__}")
    name = checks.free_name(name, "robot", [one.name for one in self.robots])
    what = f"robot {name!r}"
    position, turn = checked_pose((position, np.eye(3) if rotation is None else rotation), 0.0, f"{what}: its place")
    axes = turn @ FROM_Y_UP[self.up] @ TO_Y_UP["z"]
    iterations = checks.whole(iterations, f"{what}: iterations", range(1, MAX_ITERATIONS + 1))
    touched = set(robot.links) | {"world"} if links is None else set(links)
    for one in touched - set(robot.links) - {"world"}:
        _known(one, robot.links, f"{what}: no link")
    actuators, given = names_of(robot.model, "actuator", robot.model.nu), (control or {}).items()
    paths = {_known(one, actuators, f"{what}: no actuator"): _control(path, f"{what}: control of {one!r}") for one, path in given}
    placed, counts = PlacedRobot(robot, name, position, axes, iterations, paths), Counter()
    mujoco, made = import_mujoco(), []
    data = mujoco.MjData(robot.model)
    data.qpos[:] = robot.start
    mujoco.mj_kinematics(robot.model, data)
    for geom in range(robot.model.ngeom):
        link = robot.link_of(geom)
        if link not in touched or not (robot.model.geom_contype[geom] or robot.model.geom_conaffinity[geom]):
            continue
        own = self._free_name(f"{name}/{link}" + (f"/{counts[link]}" if counts[link] else ""), "obstacle")
        counts[link] += 1
        shape = shape_of(robot.model, geom, f"{what}: link {link!r}")
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
        list.append(self.obstacles, obstacle)
    list.append(self.robots, placed)
    return placed


def names_of(model: Any, kind: str, n: int) -> list[str]:
    """Return the names of a model's n joints, actuators or sensors, by MuJoCo's word for them."""
    return [getattr(model, kind)(k).name for k in range(n)]


def _known(name, names: Sequence[str], what: str) -> int:
    """Return the index of a name. what: start of the message, such as "no joint". Raises SceneError if it is unknown."""
    if name not in names:
        raise SceneError(f"{what} is called {name!r}{checks.nearest(str(name), names)}; there are {list(names)}")
    return list(names).index(name)


def _control(path, what: str) -> Callable[[float], float]:
    """Return a control as a checked function of time [s]."""
    given = path.value_at if isinstance(path, KeyFrames) else path
    if not callable(given) or (isinstance(path, KeyFrames) and path.values is None):
        raise SceneError(f"{what} must be a function of time or KeyFrames of values, not {value_text(path)}")

    def at(t: float) -> float:
        value = checks.path_value(given, t, what, "control", ((),))
        if value is None:
            raise SceneError(f"{what}: the path gives None at t = {t:g}")
        return float(value)

    at(0.0)
    return at
