"""Empty contacts of a scene without possible contact. Replaces `ContactStep` and its `paths` at no cost."""


class NoContacts:
    """`ContactStep` with an empty list of contacts, of which nothing passes through anything."""

    idle, none_cross = True, True
    n_contacts, had_impact, held_back = 0, False, ""
    relative_penetration = crossing = penetration = 0.0

    def __init__(self) -> None:
        self.paths = self

    def _nothing(self, *_arguments, **_named) -> int:
        """Do nothing, find nothing, measure 0."""
        return 0

    forget = discard = discard_search = restore = snapshot = start_step = start_substep = end_substep = _nothing
    begin = end = initial_crossing = set_impulse_fraction = count_flight = _nothing
    detect_impact = detect_rebounds = penetrates_deeper = left_searched = find = _nothing

    def measure_start(self, time: float, dt: float) -> tuple[float, float]:
        """Return the relative penetration before a step of dt, and the largest closing ratio in it."""
        return 0.0, 0.0
