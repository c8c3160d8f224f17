"""Which settings are worth having: the front of speed against error, and the cheapest one that is good enough."""

import math
from collections.abc import Sequence

Point = tuple[float, float]  # time, error; smaller is better in both


def dominates(a: Point, b: Point) -> bool:
    """Whether a is as good as b in both and better in one."""
    return a[0] <= b[0] and a[1] <= b[1] and a != b


def front(points: Sequence[Point]) -> list[int]:
    """Indices of the points that no other dominates, by rising time. Equal points are all on it or none; nan is never."""
    known = [k for k, p in enumerate(points) if not any(map(math.isnan, p))]
    found: list[int] = []
    least = math.inf
    for k in sorted(known, key=lambda k: points[k]):
        if points[k][1] < least or (found and points[k] == points[found[-1]]):
            found.append(k)
            least = min(least, points[k][1])
    return found


def cheapest(points: Sequence[Point], tolerance: float) -> int | None:
    """Index of the point of least time whose error is at most the tolerance, of equal times the more exact; None if none is."""
    good = [k for k in front(points) if points[k][1] <= tolerance]
    return good[0] if good else None


def nearest(points: Sequence[Point]) -> int | None:
    """Index of the point of least error, of equal ones the fastest; None without points."""
    found = front(points)
    return next(k for k in found if points[k][1] == points[found[-1]][1]) if found else None
