"""Where Newton's method starts, and how far a step goes: by the slope of the merit along it.

Contacts that open and close, and tets that turn, can raise |r| in one step and lower it in the next; the slope tells. A step that
ends on a steep rise is cut back by secants, one that ends on a steep fall is doubled.
"""

import math

from taisoft.dynamics.residual import AGAIN, STEP
from taisoft.dynamics.stage_system import StageSystem

FLAT, STEEP = 0.5, 0.3  # of the slope at its start: a rise that is too far; a fall on which a step is doubled
TRIES, LONGEST = 20, 1024.0  # of a step's length
FAR = 0.5  # |r| over scale at the first iterate above which another one is tried


def choose_start(system: StageSystem, r: float, scale: float) -> tuple[float, float, bool]:
    """Start from v = 0 if |r| is smaller there than at the first iterate, whose (|r|, scale) is given.

    Returns what holds then, and whether it is v = 0; y leads back to the first iterate in that case, which is a good first
    direction on the matrix formed at v = 0. Tets that swing many times in a step, as inverted ones do, are far from any balance
    where their motion goes on as it was. Statics keep their start.
    """
    if r <= FAR * scale or system.is_static:
        return r, scale, False
    system.set_direction_to_rest()
    trial = system.evaluate(STEP)
    if trial[0] < r or not math.isfinite(r):
        system.negate_direction()
        return *trial, True
    return *system.evaluate(AGAIN, 0.0), False


def search(system: StageSystem, enough: float) -> tuple[float, float, bool]:
    """Take the step as far as it helps: (|r|, scale, whether it did). enough: |r| that needs no further look."""
    r, scale = system.evaluate(STEP)
    length, low, at_low, high, at_high = 1.0, 0.0, system.slopes[0], math.inf, math.inf
    slope = at_low
    for _ in range(TRIES):
        rise = system.slopes[1]
        too_far = not rise <= -FLAT * slope  # also where it is not a number
        if r < enough or (slope < 0.0 and not too_far and (rise >= STEEP * slope or length >= min(0.4 * high, LONGEST))):
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
