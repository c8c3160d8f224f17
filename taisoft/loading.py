"""Loads that change while a simulator runs: forces and tractions of the scene, and a pull, whose force is added to them."""

from taisoft.access import StateAccess
from taisoft.dynamics.drag_spring import Drag, DragSpring
from taisoft.errors import SimulationError
from taisoft.scene.changes import change_load


class Loading(StateAccess):
    """Run-time changes of a simulator's loads; `Simulator` adds building and stepping."""

    _drag_spring: DragSpring | None = None

    def set_force(self, body: str, index: int, value) -> None:
        """Change a force that `body.add_force` has added, from the next step on.

        index: counted from 0 in the order added to this body. value: (3,) the total, or (k,3) for each of its k nodes [N]. Raises
        SceneError where there is no such force, or for a value outside the rules.
        """
        self._set_load("force", body, index, value)

    def set_traction(self, body: str, index: int, value) -> None:
        """Change a traction that `body.add_traction` has added, from the next step on; index and errors as of `set_force`.

        value: (3,) per reference area [Pa].
        """
        self._set_load("traction", body, index, value)

    def _set_load(self, kind: str, body: str, index: int, value) -> None:
        self._open_simulation()
        change_load(self.scene.bodies[self._index(body)], kind, index, value)
        self._changes += 1
        self._upload_loads()
        self._loads_changed()

    def _upload_loads(self) -> None:
        """The loads of the scene as it is now to the device, under those of a pull."""
        self._simulation.loads = None
        if self._drag_spring is not None:
            self._drag_spring.upload()
        else:
            self._simulation.upload_loads()

    def drag(self, body: str, nodes, weights, target, stiffness: float) -> None:
        """Pull a point of a body towards target (3,) [m] by a damped spring, in place of what was pulled before.

        The point is the mean of nodes (k,) by weights (k,), which are made to sum to 1; stiffness [N/m]. The force is taken at
        the start of every step; `taisoft.dynamics.drag_spring` limits stiffness and force, and `dragged` holds both. Raises
        SimulationError unless the Simulator was made with draggable=True, SceneError for what is no point of the body.
        """
        self._open_simulation()
        if self._drag_spring is None:
            raise SimulationError("bodies can be pulled only where the Simulator was made with draggable=True")
        self._drag_spring.take(self._index(body), nodes, weights, target, stiffness)

    def release(self) -> None:
        """End the pull; does nothing where nothing is pulled."""
        self._open_simulation()
        if self._drag_spring is not None and self._drag_spring.release():
            self._changes += 1
            self._loads_changed()

    @property
    def draggable(self) -> bool:
        """Whether `pull` can be called."""
        return self._drag_spring is not None

    @property
    def dragged(self) -> Drag | None:
        """What is pulled now, with the point [m] and the force [N] of the last step's start; None where nothing is."""
        return self._drag_spring.drag if self._drag_spring is not None else None

    @property
    def _driven(self) -> bool:
        """Whether something else than the scene's own forces does work now: a drag, prescribed nodes, obstacles that move."""
        moving = self._contact is not None and any(obstacle.path is not None for obstacle in self.scene.obstacles)
        return moving or self.dragged is not None or not all(self._kept_simulation().dirichlet.released())

    def _loads_changed(self) -> None:
        """Explicit steps may rest on an acceleration with the old ones."""
        if self.settings.explicit:
            self._stepper.numbers_changed()
