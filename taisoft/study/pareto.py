"""The Pareto front of time against error, and the cheapest point within a tolerance."""

import math
from collections.abc import Sequence

Point = tuple[float, float]  # time, error; smaller is better in both


def dominates(a: Point, b: Point) -> bool:
    """Return whether a is at lowest as good as b in both and better in one."""
    return a[0] <= b[0] and a[1] <= b[1] and a != b


def front(points: Sequence[Point]) -> list[int]:
    """Return indices of the points that no other dominates, by rising time. Equal points are all included or none; nan never."""
    known = [k for k, p in enumerate(points) if not any(map(math.isnan, p))]
    found: list[int] = []
    lowest = math.inf
    for k in sorted(known, key=lambda k: points[k]):
        if points[k][1] < lowest or (found and points[k] == points[found[-1]]):
            found.append(k)
            lowest = min(lowest, points[k][1])
    return found


def cheapest(points: Sequence[Point], tolerance: float) -> int | None:
    """Return the index of the fastest point within the tolerance, the more exact at equal times; None if there is none."""
    good = [k for k in front(points) if points[k][1] <= tolerance]
    return good[0] if good else None


def nearest(points: Sequence[Point]) -> int | None:
    """Return the index of the point of least error, the fastest of equal ones; None without points."""
    found = front(points)
    return next(k for k in found if points[k][1] == points[found[-1]][1]) if found else None
