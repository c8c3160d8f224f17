"""Vibrations of bodies in contact that implicit steps pass over.

A body that is set down, or begins to slide, vibrates; friction acts on the vibration, and what it takes from the motion stays.
Implicit steps above the period of the vibration damp it within a step or two, so that all pilots agree on a path without it:
their differences do not show this error. In `taisoft bench tolerance` it is 1.1 % of the path of a sliding cube and 0.9 % of
that of a squeezed ball, nearly whatever the step, until steps come near a fiftieth of the period.

Weak: the error is that of these two scenes. Friction that is set for pairs does not count.
"""

import math

import numpy as np

from taisoft.scene.rigid import RigidBody
from taisoft.scene.scene import Scene

RESOLVED = 50.0  # steps in a period that resolve it
ERROR = 0.012  # of a run with larger steps, over the largest excursion, at least


def shortest_period(scene: Scene) -> float:
    """Shortest of the periods with which bodies that have friction vibrate lengthwise [s]; infinite without any.

    A wave crosses a body of length l twice in a period: 2 l sqrt(density / young).
    """
    found = [math.inf]
    for body in scene.bodies:
        if not isinstance(body, RigidBody) and body.composition.first.friction > 0.0:
            length = float(np.ptp(body.rest_positions, axis=0).max())
            found.append(2.0 * length / body.composition.lowest_wave_speed)
    return min(found)


def are_passed_over(scene: Scene, dt: float) -> bool:
    """Whether implicit steps of dt [s] pass over vibrations of bodies that touch."""
    return RESOLVED * dt > shortest_period(scene)
