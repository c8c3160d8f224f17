"""Motions commanded from a loop: methods of `Simulator`, as in `changes`."""

from typing import TYPE_CHECKING

import numpy as np

from taisoft.errors import SceneError, SimulationError
from taisoft.scene import checks
from taisoft.scene.commands import Command
from taisoft.scene.obstacles import Obstacle, checked_pose
from taisoft.scene.rigid import Pose, RigidBody
from taisoft.settings import refuse_robots

if TYPE_CHECKING:
    from taisoft.simulator import Simulator


def set_pose(self: "Simulator", name: str, translation, rotation=None, seconds: float | None = None) -> None:
    """Command an obstacle, or a rigid body that `move` holds, to a pose, at constant velocity from where it is now.

    translation: (3,) [m] and rotation: (3,3), as a path gives them; None: the present rotation. seconds: how long it takes [s];
    None: as long as the next call of `step` or `advance`, an implicit step or all explicit steps that it asks for; `advance` may
    take fewer, the command then goes on in the next call. At least a step. The pose then holds; each command replaces the one
    before, and paths, until `reset`.
    Raises SceneError, and SimulationError with `tolerance` or during a run with error=True.
    """
    commands, seconds = {}, _duration("set_pose", seconds)
    for mover, first in _commanded(self, "set_pose", name).items():
        given = (translation, first.rotation if rotation is None else rotation)
        last, turned = checked_pose(given, self.time, f"set_pose of {name}")
        turn = {"first_rotation": first.rotation, "last_rotation": turned}
        commands[mover] = Command(self.time, first.translation, last, **turn, seconds=seconds)
    self._open().command(commands)


def set_velocity(self: "Simulator", name: str, velocity, angular_velocity=(0.0, 0.0, 0.0)) -> None:
    """Command an obstacle, or a rigid body that `move` holds, to move on at a velocity, until the next command.

    velocity: (3,) [m/s] of its pivot or centre; angular_velocity: (3,) [rad/s]. Errors as for `set_pose`.
    """
    rate, spin = (
        checks.array(value, f"set_velocity: {name!r}: {what}", ((3,),))
        for what, value in (("velocity", velocity), ("angular_velocity", angular_velocity))
    )
    held = _commanded(self, "set_velocity", name)
    self._open().command({k: Command(self.time, x, rate=rate, first_rotation=R, spin=spin) for k, (x, R) in held.items()})


def set_displacement(self: "Simulator", body: str, index: int, value, seconds: float | None = None) -> None:
    """Command nodes that `body.move` holds to a displacement, at constant velocity from where they are now.

    index: of the call of `move`, from 0 in the order of the calls. value: displacement from the start, (3,) or (k,3) [m].
    seconds, errors: as for `set_pose`.
    """
    _refuse_foresight(self, "set_displacement")
    dynamics, what = self._open(), f"body {body!r}: set_displacement"
    one = self.scene.collider(body)
    if isinstance(one, (Obstacle, RigidBody)):
        raise SceneError(f"{what}: it is {'rigid' if isinstance(one, RigidBody) else 'an obstacle'}: call sim.set_pose")
    found = dynamics.commands.moved_nodes(body)
    if not found:
        raise SceneError(f"{what}: it has no moved nodes: hold them by body.move(where) before the Simulator is made")
    mover = found[checks.whole(index, f"{what}: index", range(len(found)))]
    first = dynamics.commands.displacement(mover, self.time, f"{what}: {index}")
    last = np.broadcast_to(checks.array(value, f"{what}: value", ((3,), first.shape)), first.shape)
    dynamics.command({mover: Command(self.time, first, last.copy(), seconds=_duration(what, seconds))})


def _commanded(sim: "Simulator", call: str, name: str) -> dict[int, Pose]:
    """Return what moves by a command to an obstacle or a rigid body, with its present pose."""
    _refuse_foresight(sim, call)
    commands, one = sim._open().commands, sim.scene.collider(name)
    if owner := next((robot.name for robot in sim.scene.robots if name in robot.shapes), None):
        raise SceneError(f"{call}: {name!r} belongs to robot {owner!r}: set sim.robots[{owner!r}].control")
    if isinstance(one, Obstacle):
        mover = commands.obstacle(one)
        return {mover: commands.pose(mover, sim.time, call)}
    if not isinstance(one, RigidBody):
        raise SceneError(f"{call}: body {name!r} is elastic: sim.set_displacement moves the nodes that body.move holds")
    movers = commands.moved_nodes(name)
    if not movers:
        raise SceneError(f"{call}: rigid body {name!r} is not held: call its move() before the Simulator is made")
    return {mover: commands.pose(mover, sim.time, f"{call}: rigid body {name!r}") for mover in movers}


def _refuse_foresight(sim: "Simulator", call: str) -> None:
    """Refuse a command where other simulators take the same steps, ahead of this one or beside it."""
    if sim.settings.tolerance is not None:
        raise SimulationError(f"{call}: with a tolerance, steps are chosen ahead, and commands cannot be foreseen: give a path")
    if sim._estimator is not None:
        raise SimulationError(f"{call}: the companions of a run with error=True do not follow commands: give a path")


def refuse_commands(sim: "Simulator", what: str) -> None:
    """Refuse a run that has to foresee motion while anything follows a command, or robots move. what: what asks for it."""
    refuse_robots(sim.scene, what)
    for name in sim._host().commands:
        raise SimulationError(f"{what}: {name!r} follows a command, which cannot be foreseen: give a path, or call sim.reset()")


def _duration(what: str, seconds: float | None) -> float | None:
    return None if seconds is None else checks.number(seconds, f"{what}: seconds", above=0.0, unit="s")
