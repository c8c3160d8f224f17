"""Empty contacts of a scene without possible contact. Replaces `ContactStep` at no cost."""

import numpy as np


class NoPaths:
    """`ContactPaths` where nothing can pass through anything."""

    held_back, none_cross, is_stuck = "", True, False

    def left_searched(self, x_start) -> bool:
        """Return whether the surface left the searched path."""
        return False

    def find(self, as_searched: bool = False) -> bool:
        """Return whether surfaces pass through each other."""
        return False


class NoContacts:
    """`ContactStep` with an empty list of contacts."""

    idle = True
    n_contacts, had_impact = 0, False
    relative_penetration = crossing = penetration = 0.0

    def __init__(self) -> None:
        self.flight, self.paths = np.zeros(0), NoPaths()

    def _nothing(self, *_arguments, **_named) -> None:
        """Do nothing."""

    forget = set_impulse_fraction = start_step = start_substep = end_substep = reset_substep = count_flight = restore = _nothing
    return_to_start = _nothing

    def begin(self, time: float, dt: float) -> int:
        """Return the number of contacts of a step of dt [s] from a time: 0."""
        return 0

    def snapshot(self) -> None:
        """Return no state."""

    def detect_impact(self, dt: float) -> bool:
        """Return whether surfaces meet."""
        return False

    detect_rebounds = detect_impact

    def measure_start(self, time: float, dt: float) -> tuple[float, float]:
        """Return the relative penetration before a step of dt, and the largest closing ratio in it."""
        return 0.0, 0.0

    def initial_crossing(self) -> float:
        """Return the relative depth of crossing triangles."""
        return 0.0

    def penetrates_deeper(self, time: float, dt: float, before: float) -> bool:
        """Return whether a substep leaves a new or deeper penetration."""
        return False

    def end(self, time: float, dt: float) -> float:
        """Return the deepest penetration [m] at the end of a substep."""
        return 0.0
