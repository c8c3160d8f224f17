"""What steps cost, from counts: a rough model, so that reruns choose alike on every machine.

Its times are those of one core (`taisoft bench scaling`, `taisoft bench tolerance`). Only their ratios matter, and only where
explicit and implicit steps compete.
"""

from collections.abc import Callable

from taisoft.records import StepReport
from taisoft.scene.scene import Scene

COUNTS = ("newton_iterations", "linear_iterations", "contact_iterations")  # of which `implicit_step` knows the costs

EXPLICIT_STEP, CONTACT_STEP, BODY_CONTACTS = 5.0, 250.0, 100.0  # [us] of an explicit step; of contacts, more with each body
PATH_STEP = 90.0  # [us] of a prescribed path, or a moving obstacle, in a step
EXPLICIT_TET, QUADRATIC = 0.025, 4.0  # [us] of a linear tet in an explicit step; a quadratic one costs as many
IMPLICIT_STEP, NEWTON, NEWTON_TET = 150.0, 40.0, 0.15  # [us] of a step and of an iteration
LINEAR, LINEAR_TET, MULTIPLIERS = 12.0, 0.008, 150.0  # [us] of an iteration of conjugate gradients and of a multiplier update
SHOWN = 1 / 3  # part of a trial whose steps cost as much on average as all of its steps, or nearly
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
    """A `budget` is spent."""


def budget(scene: Scene, touches: bool, limit: float, steps: float) -> Callable[[StepReport, float], None]:
    """Return an `on_step` of a trial of implicit steps that raises Spent if they cost more on average than a limit [us].

    steps: of the trial. They may cost the limit times their number, or times the part SHOWN of all of them if that is more.
    """
    cost, taken = 0.0, 0  # [us], steps

    def add(report: StepReport, _seconds: float) -> None:
        nonlocal cost, taken
        cost += implicit_step(scene, touches, [getattr(report, name) for name in COUNTS])
        taken += 1
        if cost > limit * max(taken, SHOWN * steps):
            raise Spent

    return add
