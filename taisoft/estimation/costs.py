"""What steps cost, from counts: a rough model, so that reruns choose alike on every machine.

Its times are those of one core (`taisoft bench scaling`, `taisoft bench tolerance`). Only their ratios matter, and only where
explicit and implicit steps compete.
"""

from taisoft.records import StepReport
from taisoft.scene.scene import Scene

COUNTS = ("newton_iterations", "linear_iterations", "contact_iterations")  # of which `implicit_step` knows the costs

EXPLICIT_STEP, CONTACT_STEP, BODY_CONTACTS = 5.0, 250.0, 100.0  # [us] of an explicit step; of contacts, more with each body
PATH_STEP = 90.0  # [us] of a prescribed path, or a moving obstacle, in a step
EXPLICIT_TET, QUADRATIC = 0.025, 4.0  # [us] of a linear tet in an explicit step; a quadratic one costs as many
IMPLICIT_STEP, NEWTON, NEWTON_TET = 150.0, 40.0, 0.15  # [us] of a step and of an iteration
LINEAR, LINEAR_TET, MULTIPLIERS = 12.0, 0.008, 150.0  # [us] of an iteration of conjugate gradients and of a multiplier update
SHOWN = 1 / 3  # part of a pilot whose steps cost as much on average as all of its steps, or nearly
LEAST = {False: (2.0, 4.0, 0.0), True: (2.5, 6.0, 4.0)}  # iterations of an implicit step, at least; key: whether bodies touch


def elements(scene: Scene) -> float:
    """Number of tets, the quadratic ones weighted."""
    return sum(body.mesh.n_tets * (QUADRATIC if body.order == 2 else 1.0) for body in scene.bodies)


def explicit_step(scene: Scene, touches: bool) -> float:
    """Cost of an explicit step [us]."""
    return EXPLICIT_STEP + EXPLICIT_TET * elements(scene) + surroundings(scene, touches)


def surroundings(scene: Scene, touches: bool) -> float:
    """Cost of the search for contacts and of paths, in a step of either kind [us]."""
    cost = PATH_STEP * sum(c.path is not None for body in scene.bodies for c in body.constraints)
    if touches:
        cost += CONTACT_STEP + BODY_CONTACTS * (len(scene.bodies) - 1)
        cost += PATH_STEP * sum(obstacle.path is not None for obstacle in scene.obstacles)
    return cost


def implicit_step(scene: Scene, touches: bool, counts: list[float] | None = None) -> float:
    """Cost of an implicit step [us]. counts: iterations of Newton, conjugate gradients and multipliers; None: the fewest."""
    newton, linear, multipliers = counts or LEAST[touches]
    m = elements(scene)
    step = IMPLICIT_STEP + newton * (NEWTON + NEWTON_TET * m) + linear * (LINEAR + LINEAR_TET * m)
    return step + multipliers * MULTIPLIERS + surroundings(scene, touches)


class Spent(Exception):
    """A `Budget` is spent."""


class Budget:
    """Ends a pilot of implicit steps that cost more on average than a limit [us]. Pass `add` to its run as on_step.

    steps: of the pilot. They may cost the limit times their number, or times the part SHOWN of all of them if that is more.
    """

    def __init__(self, scene: Scene, touches: bool, limit: float, steps: float):
        self._scene, self._touches, self._limit, self._steps = scene, touches, limit, steps
        self._cost, self._taken = 0.0, 0  # [us], steps

    def add(self, report: StepReport, _seconds: float) -> None:
        """Count a step. Raises Spent if the limit is exceeded."""
        self._cost += implicit_step(self._scene, self._touches, [getattr(report, name) for name in COUNTS])
        self._taken += 1
        if self._cost > self._limit * max(self._taken, SHOWN * self._steps):
            raise Spent
