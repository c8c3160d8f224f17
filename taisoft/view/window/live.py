"""A simulation that follows the clock while a window in another process shows and changes it.

The simulated time is due at speed times the wall time since an anchor. Steps are taken as they become due, never earlier. A
simulation that falls behind drops what it cannot make up: the anchor moves, so that it never runs faster than asked afterwards.
Between two steps, or batches of explicit ones no longer than a picture, the commands of the window are carried out, and the
state is sent if the window has taken the previous one, or if its step has used a drag. So the simulation never waits for the
window, and the window for a step only a moment, while a body is dragged.

So that it keeps up, an implicit step gets a budget of wall time (`Simulator.budget`): SHARE of the dt / speed in which it is due,
DRAG_SHARE while a body is dragged, less what a state sent after it takes, but at least LEAST_SHARE. Single steps have none, nor
have those as fast as possible and those after the user has switched it off; one that the simulator has of its own counts instead.
"""

import math
import time
import warnings
from contextlib import contextmanager
from functools import partial

from taisoft.errors import SimulationError, TaisoftError
from taisoft.records import StepReport
from taisoft.running import timed_advance
from taisoft.view.window.controls import Controls
from taisoft.view.window.timing import Note

BATCH = 1.0 / 60.0  # longest wall time of a batch of explicit steps [s]
ARREARS = 0.05  # of simulated time at unit speed that a simulation makes up [s]
SPEED_WINDOW = 0.5  # wall time over which speeds are measured [s]
SHARE, DRAG_SHARE, LEAST_SHARE = 0.8, 0.4, 0.2  # see above
SLOW = 1.1  # wall time over simulated time above which the solver counts as too slow
MAX_SPEED = 16.0
PATIENCE = 1.0  # longest wait for the window before what takes long [s]
IDLE = 0.25  # longest wait for a command [s]
REPEAT = 0.2  # time between two states while nothing changes [s]


class LiveRun:
    """Drives sim by the clock and by the window's commands.

    window: a `WindowProcess`, or what has its `receive`, `publish` and `closed`; speed: simulated over wall time, infinite for as
    fast as possible. note: about the start; budget: whether implicit steps get one, see above; problem: why the run paused, a
    sentence or empty.
    """

    def __init__(self, sim, window, paused: bool = False, speed: float = 1.0, note: str = "", budget: bool = True):
        self.sim, self.paused, self.speed = sim, paused, speed
        self.problem, self._note = "", Note(note)
        self._window, self._controls = window, Controls(sim)
        self._own_budget, self._sending = sim.settings.budget, 0.0  # the latter: a state [s]
        self._is_budgeted = budget or self._own_budget is not None
        self._last_speed = 1.0  # before it was unbound
        self._is_warm = False  # whether no step has to compile anything, see `Simulator.warm_up`
        self._published = -math.inf  # wall time of the last published state
        self._changed = True  # since that
        # of the last drag: its number, the last one that a step has used, and that in the last published state
        self._drag_request = self._drag_done = self._drag_published = 0
        self._measured = {"speed": 0.0, "steps_per_second": 0.0, "cost": 0.0, "on_budget": ""}
        self._start_measuring()

    def run(self) -> None:
        """Run until the window is closed."""
        try:
            with self._noted_warnings():
                while not self._window.closed:
                    self.turn()
        finally:
            self.sim.budget = self._own_budget

    def turn(self) -> None:
        """Wait until a step is due or a command comes; carry out commands, take the steps, and publish the state."""
        for number, commands in self._window.receive(self._seconds_to_wait()):
            self._carry_out(number, commands)
        if not self.paused and self._due() >= self.sim.dt * (1.0 - 1e-9):
            self._advance()
        self._measure()
        self._publish()

    # --- time ---------------------------------------------------------------------------------------------------------

    def _due(self) -> float:
        """Return the simulated time that steps have to cover by now [s]."""
        if math.isinf(self.speed):
            return math.inf
        return self._anchor[1] + self.speed * (time.perf_counter() - self._anchor[0]) - self.sim.time

    def _set_anchor(self, due: float = 0.0) -> None:
        """Let `due` [s] of simulated time be due now."""
        self._anchor = (time.perf_counter(), self.sim.time + due)

    def _seconds_to_wait(self) -> float:
        if self.paused:
            return IDLE
        if math.isinf(self.speed):
            return 0.0
        return min(IDLE, max(0.0, (self.sim.dt - self._due()) / self.speed))

    def _advance(self) -> None:
        """Take the steps that are due; in explicit steps no more in one launch than a picture has time for."""
        dt = self.sim.dt
        if not self._is_warm:
            self._publish(PATIENCE)
        cost = self._measured["cost"] * dt
        n = 1.0 if cost == 0.0 else min(self._due() / dt + 1e-9, BATCH / cost + 0.5)
        self.guarded(lambda: self._take(max(1, int(n))))
        behind = 0.0 if math.isinf(self.speed) else self._due()
        if behind > max(ARREARS * self.speed, 2.0 * dt):
            self._set_anchor(dt)

    def _budget(self) -> float | None:
        """Return the wall time of the next step [s], see above; None: any."""
        is_due = self._is_warm and not (self.paused or math.isinf(self.speed))
        if not self._is_budgeted or self._own_budget is not None:
            return self._own_budget if self._is_budgeted else None
        if not (is_due and self.sim.settings.tolerance is None):
            return None
        due, share = self.sim.dt / self.speed, SHARE if self.sim.dragged is None else DRAG_SHARE
        return max(LEAST_SHARE * due, share * due - self._sending * min(1.0, due / BATCH))

    def _take(self, n: int) -> None:
        if not self._is_warm:
            self.sim.warm_up()
            self._is_warm = True
            self._start_measuring()
        self.sim.budget = self._budget()
        timed_advance(self.sim, n, self._after_step)
        self._drag_done = self._drag_request

    def _after_step(self, report: StepReport, seconds: float) -> None:
        self._changed = True
        self._spent[0] += seconds
        self._spent[1] += report.steps * self.sim.dt
        self._measured["cost"] = self._measured["cost"] or seconds / (report.steps * self.sim.dt)
        self._residuals += [report.residual] if report.on_budget else []
        if len(report.problems) > report.on_budget:  # besides the first one, which the status tells
            self._note.set(report.problems[-1])

    def _start_measuring(self) -> None:
        self._mark = (time.perf_counter(), self.sim.time, self.sim.step_count)
        self._spent = [0.0, 0.0]  # wall and simulated time of the steps since the mark [s],
        self._residuals: list[float] = []  # and the residuals of those that ended on budget
        self._set_anchor()

    def _measure(self) -> None:
        """Measure speeds over the last SPEED_WINDOW, and the cost of the steps: wall over simulated time."""
        now, found = time.perf_counter(), self._measured
        elapsed = now - self._mark[0]
        if elapsed < SPEED_WINDOW:
            return
        found["speed"] = (self.sim.time - self._mark[1]) / elapsed
        found["steps_per_second"] = (self.sim.step_count - self._mark[2]) / elapsed
        if self._spent[1] > 0.0:
            found["cost"] = self._spent[0] / self._spent[1]
        n, cut = self.sim.step_count - self._mark[2], self._residuals
        found["on_budget"] = f"on budget: {len(cut)} of {n} steps, residual {max(cut):.1g}" if cut else ""
        self._mark, self._spent, self._residuals = (now, self.sim.time, self.sim.step_count), [0.0, 0.0], []

    # --- commands -----------------------------------------------------------------------------------------------------

    def _carry_out(self, number: int, commands: list) -> None:
        """Carry out the commands [name, argument, ...] of a request."""
        for name, *arguments in commands:
            self._changed = True
            own = getattr(self, f"_on_{name}", None)
            if own is not None:
                own(*arguments)
            else:
                self.guarded(partial(getattr(self._controls, name), *arguments))
            if name == "drag":
                self._drag_request = number

    def _on_pause(self) -> None:
        self.paused = not self.paused
        self.problem = ""
        self._start_measuring()

    def _on_step(self) -> None:
        self.paused = True
        self.guarded(lambda: self._take(1))

    def _on_reset(self) -> None:
        self.sim.reset()
        self.problem = ""
        self._start_measuring()

    def _on_faster(self) -> None:
        self._set_speed(2.0 * self.speed)

    def _on_slower(self) -> None:
        self._set_speed(0.5 * self.speed)

    def _on_unbound(self) -> None:
        self._set_speed(self._last_speed if math.isinf(self.speed) else math.inf)

    def _on_budget(self) -> None:
        self._is_budgeted = not self._is_budgeted

    def _set_speed(self, speed: float) -> None:
        if not math.isinf(self.speed):
            self._last_speed = self.speed
            speed = speed if math.isinf(speed) else min(max(speed, 1.0 / MAX_SPEED), MAX_SPEED)
        self.speed = speed
        self._set_anchor()

    def _on_rebuild(self, integrator: str, contact_solver: str) -> None:
        """Switch the solver; the note is shown while that compiles."""
        self._note.set(f"compiling {integrator}, for some seconds")
        self._publish(PATIENCE)
        self._changed = True
        try:
            self._note.set(self._controls.rebuild(integrator, contact_solver))
        except TaisoftError as error:
            self._note.set(str(error))
            return
        self._is_warm, self.problem = False, ""
        self._measured["cost"] = 0.0
        self._start_measuring()

    def guarded(self, call) -> None:
        """Call a function. If it raises a TaisoftError, pause and set `problem`."""
        try:
            call()
        except TaisoftError as error:
            self.problem = f"failed: {error}" if isinstance(error, SimulationError) else str(error)
            self.paused = self._changed = True

    @contextmanager
    def _noted_warnings(self):
        """Show warnings of the simulation as notes too."""
        before = warnings.showwarning

        def show(message, *arguments, **named) -> None:
            self._note.set(f"warning: {message}")
            before(message, *arguments, **named)

        warnings.showwarning = show
        try:
            yield
        finally:
            warnings.showwarning = before

    # --- state --------------------------------------------------------------------------------------------------------

    def _publish(self, patience: float = 0.0) -> None:
        """Publish the state if it changed and the window has taken the previous one; patience: how long to wait for room [s].

        While a drag waits for a step, the next state is that after the step, which is not kept for the window to take another.
        """
        age = time.perf_counter() - self._published
        # the window would be drawing an earlier state when a step has used its drag
        awaited = not self.paused and self._drag_request > self._drag_done
        due = age > REPEAT or (self._changed and not awaited)
        is_answer = self._drag_done > self._drag_published and self._window.has_room
        if not due or not (self._window.ready or is_answer or patience):
            return
        begin = time.perf_counter()
        self._window.publish(self.sim, self.panel_state(), patience)
        self._published, self._changed, self._drag_published = time.perf_counter(), False, self._drag_done
        self._sending = 0.0 if patience else self._published - begin  # without waiting for the window

    def panel_state(self) -> dict:
        """Return what the panel shows besides the state."""
        return {
            "controls": self._controls.values(),
            "paused": self.paused,
            "asked_speed": None if math.isinf(self.speed) else self.speed,
            "status": self._status(),
            "budget": self._is_budgeted,
            "messages": [*([self.problem] if self.problem else []), *self._note.shown],
            "drag_done": self._drag_done,
            **self._measured,
        }

    def _status(self) -> str:
        if self.paused:
            return "paused"
        if not self._is_warm:
            return "compiling the next step, for some seconds"
        cost = 0.0 if math.isinf(self.speed) else self._measured["cost"] * self.speed
        return f"running; the solver needs {cost:.1f} times as long" if cost > SLOW else "running"
