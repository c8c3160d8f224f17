"""Motions commanded from a loop: methods of `Simulator`, as in `changes`."""

from typing import TYPE_CHECKING

import numpy as np

from taisoft.errors import SceneError, SimulationError
from taisoft.queries import body_index
from taisoft.scene import checks
from taisoft.scene.commands import Command
from taisoft.scene.obstacles import Obstacle, checked_pose
from taisoft.scene.rigid import Pose, RigidBody

if TYPE_CHECKING:
    from taisoft.simulator import Simulator


def set_pose(self: "Simulator", name: str, translation, rotation=None, seconds: float | None = None) -> None:
    """Command an obstacle, or a rigid body that `move` holds, to a pose, at constant velocity from where it is now.

    translation: (3,) [m] and rotation: (3,3), as a path gives them; None: the present rotation. seconds: how long it takes [s];
    None: as long as the next call of `step` or `advance`, an implicit step or all explicit steps that it asks for. The pose then
    holds; each command replaces the one before, and paths, until `reset`.
    Raises SceneError, and SimulationError with `tolerance` or during a run with error=True.
    """
    movers, first = _commanded(self, "set_pose", name)
    last = checked_pose((translation, first.rotation if rotation is None else rotation), self.time, f"set_pose: {name!r}")
    ends = {"last": last[0], "first_rotation": first.rotation, "last_rotation": last[1]}
    self._open().command(movers, Command(self.time, first.translation, **ends, seconds=_duration("set_pose", seconds)))


def set_velocity(self: "Simulator", name: str, velocity, angular_velocity=(0.0, 0.0, 0.0)) -> None:
    """Command an obstacle, or a rigid body that `move` holds, to move on at a velocity, until the next command.

    velocity: (3,) [m/s] of its pivot or centre; angular_velocity: (3,) [rad/s]. Errors as for `set_pose`.
    """
    movers, first = _commanded(self, "set_velocity", name)
    rate, spin = (
        checks.array(value, f"set_velocity: {name!r}: {what}", ((3,),))
        for what, value in (("velocity", velocity), ("angular_velocity", angular_velocity))
    )
    command = Command(self.time, first.translation, rate=rate, first_rotation=first.rotation, spin=spin)
    self._open().command(movers, command)


def set_displacement(self: "Simulator", body: str, index: int, value, seconds: float | None = None) -> None:
    """Command nodes that `body.move` holds to a displacement, at constant velocity from where they are now.

    index: of the call of `move`, from 0 in the order of the calls. value: displacement from the start, (3,) or (k,3) [m].
    seconds, errors: as for `set_pose`.
    """
    _refuse_foresight(self, "set_displacement")
    dynamics, what = self._open(), f"body {body!r}: set_displacement"
    if isinstance(self.scene.bodies[body_index(self, body)], RigidBody):
        raise SceneError(f"{what}: it is rigid: call sim.set_pose")
    found = dynamics.commands.moved_nodes(body)
    if not found:
        raise SceneError(f"{what}: it has no moved nodes: hold them by body.move(where) before the Simulator is made")
    mover = found[checks.whole(index, f"{what}: index", range(len(found)))]
    group = dynamics.commands.nodes(mover, f"{what}: {index}")
    shape = (len(group.nodes), 3)
    last = checks.array(value, f"{what}: value", ((3,), shape))
    first = checks.path_value(group.path, self.time, what, "displacement", ((3,), shape))
    command = Command(self.time, *(np.broadcast_to(x, shape).copy() for x in (first, last)), seconds=_duration(what, seconds))
    dynamics.command([mover], command)


def _commanded(sim: "Simulator", call: str, name: str) -> tuple[list[int], Pose]:
    """Return what moves by a command to an obstacle or a rigid body, and its present pose."""
    _refuse_foresight(sim, call)
    commands, one = sim._open().commands, sim.scene.collider(name)
    if isinstance(one, Obstacle):
        movers = [commands.obstacle(one)]
        return movers, commands.pose(movers[0], sim.time)
    if not isinstance(one, RigidBody):
        raise SceneError(f"{call}: body {name!r} is elastic: sim.set_displacement moves the nodes that body.move holds")
    movers = commands.moved_nodes(name)
    if not movers:
        raise SceneError(f"{call}: rigid body {name!r} is not held: call its move() before the Simulator is made")
    for mover in movers:
        commands.nodes(mover, f"{call}: rigid body {name!r}")
    return movers, commands.pose(movers[0], sim.time)


def _refuse_foresight(sim: "Simulator", call: str) -> None:
    """Refuse a command where other simulators take the same steps, ahead of this one or beside it."""
    if sim.settings.tolerance is not None:
        raise SimulationError(f"{call}: with a tolerance, steps are chosen ahead, and commands cannot be foreseen: give a path")
    if sim._estimator is not None:
        raise SimulationError(f"{call}: the twins of a run with error=True do not follow commands: give a path")


def refuse_commands(sim: "Simulator", what: str) -> None:
    """Refuse a run that has to foresee motion while anything follows a command. what: the argument that asks for it."""
    if commands := sim._host().commands:
        raise SimulationError(
            f"{what}: {commands.names()[0]!r} follows a command, which cannot be foreseen: give it a path, or call sim.reset()"
        )


def _duration(what: str, seconds: float | None) -> float | None:
    return None if seconds is None else checks.number(seconds, f"{what}: seconds", above=0.0, unit="s")
