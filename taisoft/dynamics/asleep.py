"""Contacts of sleeping bodies: no part of the problems of steps, but kept for queries, and for the step in which they wake."""

import numpy as np

from taisoft.dynamics.readout import ContactRows, Pairs, join_sides, rows_of, sum_pairs
from taisoft.ranges import owners

Rows = dict[str, np.ndarray]  # of `read_rows`
Sides = tuple[np.ndarray, np.ndarray]  # nodes and weights of `Renewal.sides`


def select(rows: Rows, chosen: np.ndarray) -> Rows:
    """Return the chosen (k,) bool of k contacts."""
    of_entry = chosen[owners(rows["arity"])]
    return {name: values[of_entry if name in ("node", "weight") else chosen] for name, values in rows.items()}


def join(first: Rows, second: Rows) -> Rows:
    """Return the contacts of both."""
    return {name: np.concatenate([first[name], second[name]]) for name in first}


class AsleepContacts:
    """rows: with forces [N] in place of impulses; sides: before dependent nodes were replaced, None if there are none."""

    def __init__(self, rows: Rows, sides: Sides | None):
        self.rows, self.sides = rows, sides

    def __len__(self) -> int:
        return len(self.rows.get("gap", ()))

    @classmethod
    def taken(cls, rows: Rows, sides: Sides | None, chosen: np.ndarray, time: float) -> "AsleepContacts":
        """Return chosen (k,) bool of contacts whose impulses act for a time [s]."""
        found = select(rows, chosen)
        found |= {"r": found["r"] / time, "impact_impulse": 0.0 * found["impact_impulse"]}
        return cls(found, sides and tuple(side[chosen] for side in sides))

    def split(self, chosen: np.ndarray) -> tuple["AsleepContacts", "AsleepContacts"]:
        """Return the chosen contacts (k,) bool, and the others."""
        both = chosen, ~chosen
        sides = (self.sides and tuple(side[which] for side in self.sides) for which in both)
        return tuple(AsleepContacts(select(self.rows, which), own) for which, own in zip(both, sides))

    def joined(self, other: "AsleepContacts") -> "AsleepContacts":
        """Return these contacts and others."""
        if not other:
            return self
        return AsleepContacts(join(self.rows, other.rows), self.sides and join_sides(self.sides, other.sides))

    def after(self, time: float) -> Rows:
        """Return the contacts with the impulses of a time [s]."""
        return self.rows | {"r": time * self.rows["r"]}

    def contacts(self, time: float, own: bool) -> ContactRows:
        """Return the contacts as `rows_of`, with the impulses of a time [s]. own: with `sides`, if there are any."""
        return rows_of(self.after(time), 1.0, self.sides if own else None)

    def pairs(self, time: float, x: np.ndarray) -> Pairs:
        """Return the sums of `sum_pairs` in a time [s]. x: (n_nodes, 3) [m]."""
        return sum_pairs(self.contacts(time, own=True), np.zeros((len(self), 3)), x, None)


NONE_ASLEEP = AsleepContacts({}, None)
