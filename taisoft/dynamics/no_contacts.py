"""Empty contacts of a scene without possible contact. Replaces `ContactStep` and its parts at no cost."""


class NoContacts:
    """`ContactStep` with an empty list of contacts, of which nothing passes through anything."""

    idle, none_cross = True, True
    n_contacts, had_impact, held_back = 0, False, ""

    def __init__(self) -> None:
        self.search = self.paths = self.check = self

    def _nothing(self, *_arguments, **_named) -> int:
        """Do nothing, find nothing, measure 0."""
        return 0

    forget = discard = discard_impulses = restore = snapshot = start_step = start_substep = end_part = _nothing
    begin = set_impulse_fraction = certify = refuse_fast_closing = detect_impact = detect_rebounds = find = _nothing

    def most_units(self, time: float, dt: float, units: int) -> int:
        """Return `units`: nothing limits the length of a part."""
        return units
