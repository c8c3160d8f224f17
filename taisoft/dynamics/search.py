"""Search for the length of a Newton step, by slopes: |r| may rise meanwhile.

A step that ends on a steep rise of the merit function is shortened by secants, one that ends on a steep descent is doubled.
Nearly incompressible bodies with mean dilatation first try a curved step (`step_with_volumes`).
"""

import math

from taisoft.dynamics.stage import AGAIN, STEP
from taisoft.dynamics.stage_system import StageSystem

FLAT, STEEP = 0.5, 0.3  # of the initial slope: rise that shortens a step; descent that doubles it
TRIES, LONGEST = 20, 1024.0  # trial step lengths, and the longest


def search(system: StageSystem, acceptable: float) -> tuple[float, float, bool]:
    """Search the step length; return (|r|, scale, success). acceptable: |r| below which the slope is not checked.

    The straight step is searched if there is no curved one, or if that leaves more than `acceptable`.
    """
    if (found := system.step_with_volumes(acceptable)) is not None:
        return *found, True
    r, scale = system.evaluate(STEP)
    length, low, at_low, high, at_high = 1.0, 0.0, system.slopes[0], math.inf, math.inf
    slope = at_low
    for _ in range(TRIES):
        rise = system.slopes[1]
        too_far = not rise <= -FLAT * slope  # also if it is not a number
        if r < acceptable or (slope < 0.0 and not too_far and (rise >= STEEP * slope or length >= min(0.4 * high, LONGEST))):
            return r, scale, True
        if slope >= 0.0:
            break
        if too_far:
            high, at_high = length, rise
        else:
            low, at_low = length, rise
        if high == math.inf:
            length *= 2.0
        else:
            secant = at_low / (at_low - at_high) if math.isfinite(at_high) else 0.5
            length = low + (high - low) * min(max(secant, 0.1 if low == 0.0 else 0.4), 0.9)
        r, scale = system.evaluate(AGAIN, length)
    r, scale = system.evaluate(AGAIN, 0.0)
    return r, scale, False
