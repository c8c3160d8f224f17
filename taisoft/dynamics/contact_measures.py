"""What is measured of the contacts found by a search: penetration, crossing triangles, closing speed."""

from dataclasses import dataclass, field

import numpy as np

from taisoft.collision.detector import Detection
from taisoft.collision.intersections import CROSSED, CROSSING_DEPTH, CROSSINGS, DEPTH_OVER_EDGE
from taisoft.dynamics.ccd_limits import MAX_CLOSING, SPEED, WHICH, measure_closing

DEEP_PENETRATION = 0.02  # of the finer side's mean surface edge: penetration reported as a problem
DEEP_CROSSING = CROSSED  # of the same: depth of crossing triangles above which an implicit step is repeated in smaller substeps
NOTICEABLE_PENETRATION = 1e-3  # of the same: penetration above which the path of an implicit substep is searched


@dataclass(frozen=True)
class Crossing:
    """How deep triangles cross and colliders lie inside each other at the last search."""

    depth: float = 0.0  # [m]
    relative: float = 0.0  # over the finer side's mean surface edge
    n_pairs: int = 0  # of crossing triangles
    inside: list[tuple[str, str, float]] = field(default_factory=list)  # colliders inside each other, and depth [m]


class ContactMeasures:
    """Measures of the contacts of a detection's last search."""

    def __init__(self, detection: Detection):
        self.detection = detection
        self._closing = np.zeros(5)  # result of `measure_closing`
        self._dt: float | None = None  # [s] that it was computed for; None: outdated

    def forget(self) -> None:
        """Discard the measures, before another search."""
        self._dt = None

    def closing(self, dt: float) -> np.ndarray:
        """Return the result of `measure_closing` for a step of dt [s]."""
        d = self.detection
        if self._dt != dt:
            measure_closing(d.surface, d.shapes, d.buffer.data, d.kept, d.counts.contacts, dt, self._closing)
            self._dt = dt
        return self._closing

    def crossing(self) -> Crossing:
        """Measure crossing triangles and contained colliders."""
        crossings, edges = self.detection.crossings(), self.detection.edges
        depth, relative, inside = float(crossings[CROSSING_DEPTH]), float(crossings[DEPTH_OVER_EDGE]), {}
        for one in self.detection.contained():
            pair = min(one.a, one.b), max(one.a, one.b)
            inside[pair] = max(inside.get(pair, 0.0), one.depth)
            # a piece thinner than an edge counts as deep if its middle is half as deep in the other as in itself
            scale = min(edges[one.a], edges[one.b], 0.5 * one.room / DEEP_PENETRATION if one.room > 0.0 else np.inf)
            depth, relative = max(depth, one.depth), max(relative, one.depth / scale)
        names = [c.name for c in self.detection.scene.colliders]
        return Crossing(depth, relative, int(crossings[CROSSINGS]), [(names[a], names[b], d) for (a, b), d in inside.items()])

    def deep_from(self, a: int, b: int) -> float:
        """Return the penetration [m] of two colliders above which a step counts as deep."""
        return DEEP_PENETRATION * float(min(self.detection.edges[a], self.detection.edges[b]))

    def describe_fast_closing(self, dt: float, searched_dt: float, substeps: int = 1) -> str:
        """Return a sentence that names the two colliders closing too fast for a step of dt, their speed, the thickness of the
        thinner one, and a sufficient dt. searched_dt: of the last search; substeps: maximum number per step."""
        closing, d = self.closing(searched_dt), self.detection
        a, b = d.buffer.data.body[d.kept[int(closing[WHICH])]]
        names = [d.scene.colliders[k].name for k in (a, b)]
        thin, speed = float(min(d.thickness[a], d.thickness[b])), float(closing[SPEED])
        cut = f"even in {substeps} substeps " if substeps > 1 else ""
        return (
            f"'{names[0]}' and '{names[1]}' close at {speed:.3g} m/s, {speed * dt:.3g} m in a step of {dt:.3g} s, "
            f"and the thinner of them is {thin:.3g} m thick, so {cut}they could pass each other unseen: take dt <= "
            f"{substeps * MAX_CLOSING * thin / speed:.3g} s"
        )
