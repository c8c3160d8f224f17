"""Check of parts of steps: whether the way of a part is free, how deep it ends, and how long the next one may be.

Where nothing crosses, a way is free if no paths pass through each other, see `contact_paths`. Where surfaces cross already, it is
not free either if it ends deeper, met contacts that were unknown, or if contacts close too fast along it.
"""

from taisoft.collision.intersections import CROSSED
from taisoft.dynamics.contact_measures import DEEP_PENETRATION, DEPTH, RELATIVE_PENETRATION, Crossing
from taisoft.dynamics.contact_paths import ContactPaths
from taisoft.dynamics.contact_search import ContactSearch
from taisoft.dynamics.part_length import PARTS
from taisoft.dynamics.simulation_state import SimulationState
from taisoft.dynamics.state import StepState
from taisoft.errors import SimulationError

MAX_PASSAGES = 8  # repetitions of a part with what its way meets
FREE, MET, BLOCKED = range(3)  # ways: nothing passes; contacts were met that are known now; they are known, but do not help


class PartCheck:
    """Check the parts of one simulation's steps. explicit: whether these are explicit."""

    MAX_CLOSING_RATIO = 2.0  # along the way of a part, where surfaces cross: its speed was not known when the step was cut
    LEAST_DEEP = 1.0 / 16.0  # of a step: parts up to this long are kept even if they lead deeper
    WORSENING = 1.1  # growth of an existing penetration that counts as a new one

    def __init__(self, simulation: SimulationState, search: ContactSearch, paths: ContactPaths, explicit: bool):
        self._simulation, self._search, self._paths, self._explicit = simulation, search, paths, explicit
        self.penetration = 0.0  # at the end of the last step [m],
        self.relative_penetration = 0.0  # and over the finer side's mean surface edge
        self.crossing: float | None = None  # depth of crossing triangles over the finer side's edge; None: not measured
        self.last_crossing = Crossing()  # at the end of the last step
        self._measured: tuple[int, float, float] | None = None  # search, time and dt of the last end that was measured
        self._is_fast = False  # whether contacts closed too fast on the way that was last certified

    def snapshot(self) -> dict:
        """Return what was measured at the end of the last step."""
        return {"penetration": self.penetration, "relative_penetration": self.relative_penetration}

    def restore(self, kept: dict) -> None:
        """Restore a `snapshot`; an empty one, that of a start."""
        self.penetration, self.relative_penetration = (float(kept.get(name, 0.0)) for name in self.snapshot())
        self.crossing, self.last_crossing = 0.0 if self._paths.none_cross else None, Crossing()

    @property
    def is_deep(self) -> bool:
        """Whether the last step ended with a deep penetration."""
        return self.relative_penetration > DEEP_PENETRATION

    def start_step(self, time: float, dt: float) -> None:
        """Begin a step of dt from a time. Penetration that exists there is not new."""
        self.relative_penetration, self._dt = 0.0, dt
        if not (self._explicit and self.crossing is not None and self._paths.none_cross):  # where it limits nothing
            self._search.find(time, dt)
            relative = float(self._search.measures.closing[RELATIVE_PENETRATION])
            if self.crossing is None:
                self.measure_crossings()
                self._paths.exempt_crossing()
            self.relative_penetration = max(relative, self.crossing)
        self._deepest, self._most_crossed = DEEP_PENETRATION, CROSSED
        self._raise_limits()

    def _raise_limits(self) -> None:
        """Raise the limits above which a penetration or crossing is new to WORSENING times the present ones."""
        self._deepest = max(self._deepest, self.WORSENING * self.relative_penetration)
        self._most_crossed = max(self._most_crossed, self.WORSENING * self.crossing)

    def most_units(self, time: float, dt: float, units: int) -> int:
        """Return the length of the next part of a step of dt, in units of dt / PARTS: the given one, or where surfaces cross, one
        in which no contact closes further than its ratio allows. Raise SimulationError if the shortest part is too long."""
        if self._paths.none_cross:
            return units
        self._search.find(time, units / PARTS * dt)
        most = int(units / max(1.0, self._search.measures.closing_ratio))
        self._is_fast = most == 0
        self.refuse_fast_closing(dt)
        return most

    def certify(self, time: float, dt: float, start: StepState) -> int:
        """Return what the way from a start to the present state is, in a part of dt [s] from a time: FREE, MET or BLOCKED.
        From the start, `search_along` of the paths then finds what it met. Where it left what was searched, it is searched."""
        paths, search, self._is_fast = self._paths, self._search, False
        known = set() if paths.none_cross else search.found_features()
        if not self._explicit:
            has_left, passes = paths.find_unless_left(start.x)
        else:  # they seldom leave what was searched, and are many; a search that serves several may have been before the start
            has_left = search.n > 0
            passes = not has_left and paths.find()
        if has_left or paths.uncovered:
            paths.search_way(time, dt, start)
            passes = paths.find(as_searched=True)
        elif passes and self._explicit:
            paths.keep_path(start.x)
        if passes:
            return BLOCKED if paths.is_stuck else MET
        if paths.none_cross or self._explicit:
            return FREE
        if has_left:
            found = search.found_features()
            if not known.issuperset(found):
                return MET
            self._is_fast, known = search.measures.closing_ratio > self.MAX_CLOSING_RATIO, found
        if self._is_fast:
            return BLOCKED
        self.end(time + dt, dt)
        is_deep = self.relative_penetration > self._deepest or self.crossing > self._most_crossed
        if not is_deep or dt <= self.LEAST_DEEP * self._dt:
            return FREE
        paths.search_way(time, dt, start)
        return BLOCKED if known.issuperset(search.found_features()) else MET

    def refuse_fast_closing(self, dt: float) -> None:
        """Raise SimulationError if contacts closed too fast on the way that was last certified, in a step of dt."""
        if self._is_fast:
            number = self._simulation.step_count + 1
            raise SimulationError(f"step {number}: {self._search.measures.describe_fast_closing(dt, PARTS)}")

    def end_part(self, time: float, dt: float) -> None:
        """End a part of a step at a time, from which the next one of dt is searched, see `end`."""
        self.end(time, dt)
        self._raise_limits()

    def end(self, time: float, dt: float) -> None:
        """Measure how deep bodies are in each other at a time, the end of a step or a part of dt. The search there is reused."""
        search, has_paths = self._search, self._simulation.has_paths
        if search.far.is_known:
            self.penetration = self.relative_penetration = 0.0
            return
        if self._measured == (search.n_searches, time, dt):
            return
        search.discard()
        self._paths.use_active()
        try:
            search.find(time, dt)
        except SimulationError:
            if not has_paths:
                raise
            search.find_anew(time, 0.0)  # a path ends here; the next step reports it
        closing = search.measures.closing
        self.penetration, self.relative_penetration = float(closing[DEPTH]), float(closing[RELATIVE_PENETRATION])
        if not self._explicit:
            depth, relative = self.measure_crossings()
            self.penetration = max(self.penetration, depth)
            self.relative_penetration = max(self.relative_penetration, relative)
        if has_paths:
            search.discard()
        self._measured = search.n_searches, time, dt

    def measure_crossings(self) -> tuple[float, float]:
        """Return how deep things cross at the last search [m], and over the finer side's mean surface edge. Set `crossing` and
        `last_crossing`. If none crossed before, none do: their paths were checked."""
        self.last_crossing = found = Crossing() if self._paths.none_cross else self._search.measures.crossing()
        self.crossing = found.relative
        return found.depth, found.relative
