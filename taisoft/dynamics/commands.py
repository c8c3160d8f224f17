"""Motions that the user commands between two steps: what moves by them, when they end, and their way into checkpoints.

A command replaces the path of an obstacle, or of nodes that are moved, until `reset`. One without a duration ends with the steps
that the next call of `advance` asks for: an implicit step, or a number of explicit ones.
"""

import dataclasses
from collections.abc import Iterator

import numpy as np

from taisoft.dynamics.dirichlet import DirichletConditions, MovedNodes
from taisoft.errors import SceneError
from taisoft.scene import checks
from taisoft.scene.commands import Command
from taisoft.scene.obstacles import Obstacle
from taisoft.scene.rigid import FRAME, Pose, PosePath, RigidBody
from taisoft.scene.scene import Scene


class Commands:
    """The commands that a scene's obstacles and moved nodes follow at present. The scene is the simulator's own copy."""

    def __init__(self, scene: Scene, dirichlet: DirichletConditions):
        self._scene, self._dirichlet = scene, dirichlet
        self._movers: list[Obstacle | MovedNodes] = [*scene.obstacles, *dirichlet.groups]
        self._followed: dict[int, Command] = {}  # by mover

    def __iter__(self) -> Iterator[str]:
        """The names of what follows commands."""
        return (self._movers[k].name for k in self._followed)

    def obstacle(self, obstacle: Obstacle) -> int:
        """Return the mover that an obstacle is. Raises SceneError if what is attached to it was taken to be at rest."""
        for one in self._scene.connections:
            if obstacle.name in one.owners and obstacle.path is None:
                raise SceneError(
                    f"obstacle {obstacle.name!r}: {type(one).__name__.lower()} {one.name!r} holds on to it, so that it can be "
                    "commanded only if it has a path at the start, such as ts.KeyFrames((0,), translations=[(0, 0, 0)])"
                )
        return next(k for k, one in enumerate(self._movers) if one is obstacle)

    def moved_nodes(self, name: str) -> list[int]:
        """Return the movers that are nodes held by `move` of a body, in the order added."""
        return [k for k, one in enumerate(self._movers) if isinstance(one, MovedNodes) and one.of_move and one.name == name]

    def displacement(self, mover: int, time: float, what: str) -> np.ndarray:
        """Return the displacements (k,3) [m] of nodes that are still held. Raises SceneError."""
        group = self._movers[mover]
        shapes = ((3,), (len(group.nodes), 3))
        released = self._dirichlet.released[mover - len(self._scene.obstacles)]
        found = None if released else checks.path_value(group.path, time, what, "displacement", shapes)
        if found is None:
            raise SceneError(f"{what}: its path has released it, and it moves freely")
        return np.broadcast_to(found, shapes[1]).copy()

    def pose(self, mover: int, time: float, what: str) -> Pose:
        """Return the pose of an obstacle, or of a rigid body that is still held, without the rounding of its nodes' positions."""
        one = self._movers[mover]
        if isinstance(one, Obstacle):
            return Pose(*one.pose(time))
        body, displacement = self._body(one), self.displacement(mover, time, what)
        if isinstance(one.path, PosePath):
            return Pose(*one.path.pose(time))
        if (displacement == displacement[0]).all():
            return Pose(displacement[0], np.eye(3))
        return body.pose(body.rest_positions[:FRAME] + body.position + displacement)

    def follow(self, mover: int, command: Command) -> None:
        """Let a mover follow a command from now on."""
        self._followed[mover] = command
        one = self._movers[mover]
        if isinstance(one, Obstacle):
            checks.store(one, path=command)
        elif isinstance(body := self._body(one), RigidBody):
            one.path = PosePath(command, body.mesh.vertices[:FRAME] - body.centre, f"rigid body {one.name!r}")
        else:
            one.path = command

    def begin(self, first: float, last: float) -> dict[int, Command]:
        """Let the steps that begin now carry out what is pending, and return that; first, last [s]: when these steps end."""
        pending = {mover: command for mover, command in self._followed.items() if command.is_pending}
        for mover, command in pending.items():
            self.follow(mover, command.until(last if command.seconds is None else max(command.begin + command.seconds, first)))
        return pending

    def undo(self, pending: dict[int, Command]) -> None:
        """Undo `begin`, after a failure."""
        for mover, command in pending.items():
            self.follow(mover, command)

    def reset(self) -> None:
        """Forget all commands: what followed them follows its path again."""
        for mover in self._followed:
            one = self._movers[mover]
            checks.store(one, path=one.given_path)
        self._followed = {}

    def snapshot(self) -> dict:
        """Return the commands for a checkpoint."""
        return {str(mover): dataclasses.asdict(command) for mover, command in self._followed.items()}

    def restore(self, kept: dict) -> None:
        """Restore a `snapshot`."""
        self.reset()
        for mover, command in kept.items():
            self.follow(int(mover), Command(**command))

    def continue_from(self, other: "Commands") -> None:
        """Take over the commands of another instance of the same scene."""
        for mover, command in other._followed.items():
            self.follow(mover, command)

    def _body(self, group: MovedNodes):
        return self._scene.body(group.name)
