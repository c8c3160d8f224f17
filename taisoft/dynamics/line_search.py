"""Start and step length of Newton's method, by the slope of the merit function along a step.

Opening and closing contacts, and tets that invert, can increase |r| in one step and decrease it in the next, so the slope
decides. A step that ends on a steep rise is shortened by secants, one that ends on a steep descent is doubled.
"""

import math

from taisoft.dynamics.residual import AGAIN, STEP
from taisoft.dynamics.stage_system import StageSystem

FLAT, STEEP = 0.5, 0.3  # of the initial slope: rise that shortens a step; descent that doubles it
TRIES, LONGEST = 20, 1024.0  # trial step lengths, and the longest
FAR = 0.5  # |r| over scale at the first iterate above which v = 0 is tried


def choose_start(system: StageSystem, r: float, scale: float) -> tuple[float, float, bool]:
    """Start from v = 0 if |r| is smaller there than at the first iterate, whose (|r|, scale) is given.

    Return (|r|, scale) there, and whether it is v = 0; then y points back to the first iterate, a good first direction on the
    matrix formed at v = 0. If tets oscillate many times in a step, as inverted ones do, continuing their motion is far from
    balance. Statics keeps its start.
    """
    if r <= FAR * scale or system.is_static:
        return r, scale, False
    system.set_direction_to_rest()
    trial = system.evaluate(STEP)
    if trial[0] < r or not math.isfinite(r):
        system.negate_direction()
        return *trial, True
    return *system.evaluate(AGAIN, 0.0), False


def search(system: StageSystem, acceptable: float) -> tuple[float, float, bool]:
    """Search the step length; return (|r|, scale, success). acceptable: |r| below which the slope is not checked."""
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
