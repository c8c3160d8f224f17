"""Times of the live window: pictures per second, and how long a movement of the mouse takes to show its effect on a body.

The latency of a drag is the wall time from the last look at the mouse that did not see the movement, so an upper bound, until a
picture is shown of a state whose step has used it.
"""

import time
from collections import deque
from statistics import median

NOTE_SECONDS = 10.0  # for which a note is shown
KEPT = 20000  # pictures and drags
RECENT = 20  # of them, for the panel


class Note:
    """A sentence about the last action, shown for NOTE_SECONDS."""

    def __init__(self, text: str = ""):
        self.set(text)

    def set(self, text: str) -> None:
        """Replace the sentence; an empty one shows nothing."""
        self._text, self._since = text, time.perf_counter()

    @property
    def shown(self) -> list[str]:
        """The sentence, or nothing once its time is over."""
        return [self._text] if self._text and time.perf_counter() - self._since < NOTE_SECONDS else []


class Timing:
    """Times of pictures [s] and latencies of drags [s] of a window."""

    def __init__(self) -> None:
        self.pictures: deque[float] = deque(maxlen=KEPT)
        self.latencies: deque[float] = deque(maxlen=KEPT)
        self._polled = time.perf_counter()  # the last look at the mouse
        self._dragged: dict[int, float] = {}  # by request, when its movement may have begun
        self._asked: dict[int, float] = {}  # by request that no step has used yet, when it was made
        self._used = self._used_in_picture = 0  # last request that a step has used: before the latest state, the last picture

    def polled(self) -> None:
        """Note that the mouse was looked at."""
        self._polled = time.perf_counter()

    def dragged(self, request: int) -> None:
        """Note that the mouse has moved since the last look, which a request will tell the simulation."""
        self._dragged.setdefault(request, self._polled)
        self._asked.setdefault(request, time.perf_counter())

    def came(self, state: dict) -> None:
        """Note that a state has come."""
        self._used = state.get("drag_done", 0)
        self._asked = {request: begin for request, begin in self._asked.items() if request > self._used}

    def awaited(self, is_fast: bool) -> int:
        """Return the request whose effect the next picture awaits: the first one that no picture has shown.

        is_fast: whether a step takes less time than a picture; then the last one, which would have to wait for all of the next
        picture.
        """
        return max(self._asked, default=0) if is_fast else self._used_in_picture + 1

    def seconds_to_answer(self, request: int, limit: float) -> float:
        """Return for how long a picture may wait for a step that uses a request [s].

        limit: from the first request that no step has used.
        """
        if not self._asked or self._used >= request:
            return 0.0
        return max(0.0, min(self._asked.values()) + limit - time.perf_counter())

    def shown(self, state: dict) -> None:
        """Note that a picture of a state is shown."""
        now = time.perf_counter()
        self.pictures.append(now)
        self._used_in_picture = state.get("drag_done", 0)
        for request in [r for r in self._dragged if r <= state.get("drag_done", 0)]:
            self.latencies.append(now - self._dragged.pop(request))

    @staticmethod
    def _recent(times: deque[float]) -> list[float]:
        return [times[k] for k in range(-min(RECENT, len(times)), 0)]

    def pictures_per_second(self) -> float:
        """Return the rate of the recent pictures."""
        recent = self._recent(self.pictures)
        return (len(recent) - 1) / (recent[-1] - recent[0]) if len(recent) > 1 else 0.0

    def lines(self, state: dict) -> list[str]:
        """Return the speeds of the simulation and of the window as lines of text."""
        recent = self._recent(self.latencies)
        drag = f", drag after {1e3 * median(recent):.0f} ms" if recent else ""
        pictures = f"view     {self.pictures_per_second():10.0f} pictures/s{drag}"
        if "speed" not in state:
            return [pictures]
        asked = "" if state["asked_speed"] in (1.0, None) else f" (asked: {state['asked_speed']:g})"
        speed = f"speed    {state['speed']:10.2f} x real time{asked}, {state['steps_per_second']:.3g} steps/s"
        return [speed, f"solver   {state['on_budget'] or 'within its time'}", pictures]
