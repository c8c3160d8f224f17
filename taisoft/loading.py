"""Run-time changes of loads: the scene's forces and tractions, and the drag spring, whose force is added to them."""

from taisoft.access import StateAccess
from taisoft.dynamics.drag_spring import Drag, DragSpring
from taisoft.errors import SimulationError
from taisoft.scene.plan import change_load


class Loading(StateAccess):
    """Run-time changes of a simulator's loads; `Simulator` adds construction and stepping."""

    _drag_spring: DragSpring | None = None

    def set_force(self, body: str, index: int, value) -> None:
        """Change a force added by `body.add_force`, from the next step on.

        index: from 0 in the order added to this body. value: total (3,), or (k,3) with one row per node [N].
        Raises SceneError if there is no such force or the value is invalid.
        """
        self._set_load("force", body, index, value)

    def set_traction(self, body: str, index: int, value) -> None:
        """Change a traction added by `body.add_traction`, from the next step on; index and errors as for `set_force`.

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
        """Copy the scene's present loads, plus the force of the drag spring, to the device."""
        self._simulation.loads = None
        if self._drag_spring is not None:
            self._drag_spring.upload()
        else:
            self._simulation.upload_loads()

    def drag(self, body: str, nodes, weights, target, stiffness: float) -> None:
        """Pull a point of a body towards target (3,) [m] by a damped spring; replaces an earlier drag.

        The point is the mean of nodes (k,) with weights (k,), which are normalized to sum to 1; stiffness [N/m]. The force is
        evaluated at the start of every step. `taisoft.dynamics.drag_spring` limits stiffness and force; `dragged` holds both.
        Raises SimulationError unless the Simulator was made with draggable=True, SceneError for an invalid point of the body.
        """
        self._open_simulation()
        if self._drag_spring is None:
            raise SimulationError("bodies can be dragged only if the Simulator was made with draggable=True")
        self._drag_spring.take(self._index(body), nodes, weights, target, stiffness)

    def release(self) -> None:
        """End the drag; does nothing if nothing is dragged."""
        self._open_simulation()
        if self._drag_spring is not None and self._drag_spring.release():
            self._changes += 1
            self._loads_changed()

    @property
    def draggable(self) -> bool:
        """Whether `drag` can be called."""
        return self._drag_spring is not None

    @property
    def dragged(self) -> Drag | None:
        """The present drag, with its point [m] and force [N] at the start of the last step; None if nothing is dragged."""
        return self._drag_spring.drag if self._drag_spring is not None else None

    @property
    def _driven(self) -> bool:
        """Whether anything but the scene's own forces does work now: a drag, prescribed nodes or moving obstacles."""
        moving = self._contact is not None and any(obstacle.path is not None for obstacle in self.scene.obstacles)
        return moving or self.dragged is not None or not all(self._host_simulation().dirichlet.released())

    def _loads_changed(self) -> None:
        """Invalidate the acceleration that an explicit stepper keeps, which was computed with the old loads."""
        if self.settings.explicit:
            self._stepper.numbers_changed()
