"""The contacts of a scene in which nothing can touch: none, at no cost. It stands in for `ContactStep` in implicit steps."""

import numpy as np


class NoContacts:
    """As `ContactStep`, with an empty list of contacts."""

    idle = True
    n_contacts, met = 0, False
    relative_penetration = crossing = penetration = 0.0

    def __init__(self) -> None:
        self.flight = np.zeros(0)

    def _nothing(self, *_arguments, **_named) -> None:
        """What needs no doing."""

    forget = acts = start_step = start_substep = end_substep = start_again = count_flight = restore = _nothing

    def begin(self, time: float, dt: float) -> int:
        """Contacts of a step of dt [s] from a time."""
        return 0

    def snapshot(self) -> None:
        """What the next step rests on: nothing."""

    def meets(self, dt: float) -> bool:
        """Whether surfaces come together."""
        return False

    rebounds = meets

    def look(self, time: float, dt: float) -> tuple[float, float]:
        """Penetration before a step of dt, and how far contacts close in it, over what they may."""
        return 0.0, 0.0

    def crossing_before(self) -> float:
        """How deep triangles cross."""
        return 0.0

    def left_searched_path(self, x_start) -> bool:
        """Whether the surface went where nobody had looked."""
        return False

    def penetrates_anew(self, time: float, dt: float, before: float) -> bool:
        """Whether a substep ends with something newly in each other."""
        return False

    def end(self, time: float, dt: float) -> float:
        """The deepest penetration at the end of a substep."""
        return 0.0
