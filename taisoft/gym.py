"""Environments for learning: a simulated scene behind gymnasium's interface. Reached as `ts.gym`; needs the extra `gym`."""

import math
from collections.abc import Callable, Sequence
from typing import Any

import numpy as np

from taisoft.cli.scene_file import load_scene
from taisoft.errors import MissingPackage, SceneError, SimulationError, value_text
from taisoft.machine import require
from taisoft.output.viewpoint import Viewpoint, framed_points
from taisoft.records import StepReport
from taisoft.scene import checks
from taisoft.scene.scene import Scene
from taisoft.settings import NAMES
from taisoft.simulator import Simulator
from taisoft.view.colouring import checked_colour
from taisoft.view.offscreen import Offscreen, checked_size

gymnasium = require("gymnasium", "ts.gym", "gym", MissingPackage)
Row = tuple[str, float, float, str]
REPORTED = ("time", "n_contacts", "max_penetration", "min_volume_ratio")  # of the last step's report, in the info


class Box(gymnasium.spaces.Box):
    """A box whose numbers have names and units.

    rows: (name, low, high, unit) of each number, such as ("left tendon", 0, 5, "N"); infinite limits are allowed. names, units:
    tuples of their texts. To gymnasium it is a `spaces.Box` of shape (len(rows),) in float32.
    Raises SceneError.
    """

    def __init__(self, rows: Sequence[Row], seed: int | np.random.Generator | None = None):
        for k, row in enumerate(rows):
            is_row = isinstance(row, (tuple, list)) and len(row) == 4 and isinstance(row[0], str) and isinstance(row[3], str)
            if not (is_row and all(isinstance(x, (int, float, np.number)) for x in row[1:3]) and row[1] <= row[2]):
                raise SceneError(
                    f"row {k} of a ts.gym.Box must be (name, low, high, unit) with low <= high, not {value_text(row)}"
                )
        self.names, lows, highs, self.units = zip(*rows) if len(rows) else ((), (), (), ())
        super().__init__(np.array(lows, np.float32), np.array(highs, np.float32), seed=seed)

    def __repr__(self) -> str:
        rows = zip(self.names, self.low.tolist(), self.high.tolist(), self.units)
        return f"Box({', '.join(f'{name}: {low:g} to {high:g} {unit}' for name, low, high, unit in rows)})"


class Env(gymnasium.Env):
    """An environment made of a scene and functions of its simulator.

    scene: a Scene, a function that returns one, or a SCENE of the command line: a demo, a .toml or a .py file, whose solver dict
    then counts unless `solver` says otherwise. action(sim, a): applies an action, before the steps, by sim.set_tension, set_pose,
    set_force, ... observation(sim): an array. reward(sim): a number. terminated(sim): whether the episode has ended; None: it
    does not. start(sim, rng): called by `reset` at the initial state, to vary it (sim.set_state, set_material, ...); rng is the
    environment's generator. action_space, observation_space: `Box` of this module or any space of gymnasium; without the latter,
    an unbounded one of the observation's shape in float32. frame_skip: simulator steps of dt in a step. solver: arguments of the
    Simulator. render_mode: None or "rgb_array". size: of pictures, width and height [pixels]; colour: as of `sim.picture`;
    view (k,3): points that pictures show [m], such as two corners; None: the bodies at the start. The camera does not move.

    `sim` is the simulator. Same seed and actions give the same bits. What functions set by sim.set_... (tensions, materials)
    stays set over a reset, as by `sim.reset`: let `start` set whatever `action` does not set in each step.
    An episode has no limit of its own: wrap in gymnasium.wrappers.TimeLimit.

    info has "time" [s], "degraded", the number of steps since the reset whose report has problems, "failed", "problems",
    sentences about this step, and n_contacts, max_penetration and min_volume_ratio of its last `StepReport`. If the simulation
    fails, "failed" is True and the episode has terminated: observation and reward are those of the last good state, and `reset`
    must be called.

    In vectors of processes, which share compiled kernels on disk, each process should use one thread: set TAISOFT_THREADS=1
    before the processes start, else all of them compete for all cores. Processes may be forked, except on a GPU.

    Raises SceneError for arguments, actions, observations and rewards that break a rule, and the errors of `Simulator`.
    """

    sim: Simulator

    def __init__(
        self,
        scene: Scene | Callable[[], Scene] | str,
        action: Callable[[Simulator, Any], None],
        observation: Callable[[Simulator], Any],
        reward: Callable[[Simulator], float],
        terminated: Callable[[Simulator], bool] | None = None,
        *,
        action_space: "gymnasium.Space",
        observation_space: "gymnasium.Space | None" = None,
        frame_skip: int = 1,
        start: Callable[[Simulator, np.random.Generator], None] | None = None,
        solver: dict[str, Any] | None = None,
        render_mode: str | None = None,
        size: tuple[int, int] = (320, 240),
        colour: str = "body",
        view: Any = None,
    ):
        given = {"action": action, "observation": observation, "reward": reward, "terminated": terminated, "start": start}
        for name, function in given.items():
            if not (callable(function) or (function is None and name in ("terminated", "start"))):
                raise SceneError(f"{name} must be a function of the simulator, not {value_text(function)}")
        for name, space in (("action_space", action_space), ("observation_space", observation_space)):
            if not (isinstance(space, gymnasium.Space) or (space is None and name == "observation_space")):
                raise SceneError(f"{name} must be a ts.gym.Box or another space of gymnasium, not {value_text(space)}")
        self._apply, self._observe, self._reward, self._terminated, self._start = given.values()
        self.frame_skip = checks.whole(frame_skip, "frame_skip")
        self.render_mode = render_mode if render_mode is None else checks.choice(render_mode, "render_mode", ("rgb_array",))
        self._size, self._colour = checked_size(size), checked_colour(colour)
        self._drawing: Offscreen | None = None
        self._view = None if view is None else checks.array(view, "view", ((*np.shape(view)[:1], 3),))
        self._degraded, self._is_running = 0, False
        self.action_space, self._acts_by = action_space, _box(action_space)
        made, settings = _made(scene)
        self.sim = Simulator(made, **settings | (solver or {}))
        self.metadata = {"render_modes": ["rgb_array"], "render_fps": 1.0 / (self.frame_skip * self.sim.dt)}
        try:
            if observation_space is None:
                observation_space = gymnasium.spaces.Box(-np.inf, np.inf, np.shape(observation(self.sim)), np.float32)
            self.observation_space, self._sensed_by = observation_space, _box(observation_space)
            self._observation()
        except BaseException:
            self.close()
            raise

    def reset(self, *, seed: int | None = None, options: dict[str, Any] | None = None) -> tuple[Any, dict[str, Any]]:
        """Return to the scene's initial state, call `start`, and return the observation and the info. options: ignored."""
        super().reset(seed=seed)
        self.sim.reset()
        self._degraded, self._is_running, self._drawing = 0, False, None  # the scale of colours starts anew, too
        if self._start is not None:
            self._start(self.sim, self.np_random)
        observation, self._is_running = self._observation(), True
        return observation, self._info([], None)

    def step(self, action) -> tuple[Any, float, bool, bool, dict[str, Any]]:
        """Apply an action and take `frame_skip` steps; return observation, reward, terminated, truncated (False), info.

        Raises SceneError for an action outside the action space, gymnasium's ResetNeeded after a failure and before `reset`.
        """
        if not self._is_running:
            raise gymnasium.error.ResetNeeded("call reset() before step(): no episode is running, or the simulation has failed")
        sim, left = self.sim, self.frame_skip
        self._apply(sim, self._checked(action))
        problems: list[str] = []
        report: StepReport | None = None
        try:
            while left:
                report = sim.advance(left)
                left -= report.steps
                if report.problems:
                    problems += report.problems
                    self._degraded += report.steps
        except SimulationError as error:
            problems.append(str(error))
            self._is_running = False
        reward = self._reward(sim)
        try:
            reward = float(reward)
        except (TypeError, ValueError):
            raise SceneError(f"reward: it returned {value_text(reward)}, a number is needed") from None
        if not math.isfinite(reward):
            raise SceneError(f"reward: it returned {reward} at t = {sim.time:.6g} s, a finite number is needed")
        ended = not self._is_running or (self._terminated is not None and bool(self._terminated(sim)))
        return self._observation(), reward, ended, False, self._info(problems, report)

    def render(self) -> np.ndarray | None:
        """Return a picture of the present state, uint8 (height, width, 3), first row on top; None without render_mode."""
        if self.render_mode is None:
            return None
        if self._drawing is None:
            scene = self.sim.scene
            camera = Viewpoint.framing(framed_points(scene) if self._view is None else self._view, self._size, up=scene.up)
            self._drawing = Offscreen(scene, self._size, camera, self._colour)
        return self._drawing.image(self.sim)

    def close(self) -> None:
        """Release memory; a second call does nothing."""
        self._is_running = False
        self.sim.close()
        if self._drawing is not None:
            self._drawing.close()

    def _info(self, problems: list[str], report: StepReport | None) -> dict[str, Any]:
        own = {"degraded": self._degraded, "failed": not self._is_running, "problems": problems}
        report = StepReport(self.sim.time) if report is None else report  # before the first step, and if it failed
        return own | {name: getattr(report, name) for name in REPORTED}

    def _checked(self, action):
        """Return an action in the space's type. Raises SceneError if it lies outside of the space."""
        space = self.action_space
        if self._acts_by is None:
            if not space.contains(action):
                raise SceneError(f"the action {value_text(action)} is not in {space}")
            return action
        found, (_, _, low, high) = _cast(action, self._acts_by, "an action"), self._acts_by
        if 0 in ((found >= low) & (found <= high)).tobytes():  # where code is cold, `all` takes three times as long
            raise SceneError(_outside(found, space))
        return found

    def _observation(self):
        """Return the observation in the space's type. Raises SceneError unless it is finite and of the space's shape."""
        found = self._observe(self.sim)
        if self._sensed_by is None:
            return found
        numbers = _cast(found, self._sensed_by, "an observation")
        if not (math.isfinite(np.vdot(numbers, numbers)) or np.isfinite(numbers).all()):  # the former is fast
            at = _label(self.observation_space, np.argwhere(~np.isfinite(numbers))[0])
            raise SceneError(f"observation: {at} is not finite at t = {self.sim.time:.6g} s")
        return numbers


def _cast(values, box: tuple, what: str) -> np.ndarray:
    """Return values as an array of the type and shape of a `_box`. Raises SceneError, also where integers would change."""
    shape, dtype, _, _ = box
    try:
        found = np.array(values, dtype)
    except (TypeError, ValueError, OverflowError):
        found = None
    if found is None or (dtype.kind in "iu" and not np.array_equal(found, values)):
        raise SceneError(f"{what} must be numbers of type {dtype} and shape {shape}, not {value_text(values)}")
    if found.shape != shape:
        raise SceneError(f"{what} must have shape {shape}, not {found.shape}")
    return found


def _box(space: "gymnasium.Space") -> tuple | None:
    """Return shape, type and limits of a box, at hand for every step; None for other spaces."""
    return (space.shape, space.dtype, space.low, space.high) if isinstance(space, gymnasium.spaces.Box) else None


def _made(scene) -> tuple[Scene, dict[str, Any]]:
    """Return a scene that is given in one of three ways, and the settings that a file has with it."""
    if isinstance(scene, str):
        made, settings = load_scene(scene)
        return made, {name: value for name, value in settings.items() if name in NAMES}
    return scene() if callable(scene) else scene, {}


def _outside(action: np.ndarray, space: "gymnasium.spaces.Box") -> str:
    """Describe the first number of an action that lies outside of a space."""
    at = tuple(np.argwhere(~((action >= space.low) & (action <= space.high)))[0])
    unit = f" {space.units[at[0]]}" if isinstance(space, Box) else ""
    limits = f"{space.low[at]:g} to {space.high[at]:g}{unit}"
    return (
        f"action: {_label(space, at)} is {action[at]:g}{unit}, outside of {limits}: gymnasium.wrappers.ClipAction clips actions"
    )


def _label(space: "gymnasium.spaces.Box", at) -> str:
    """Return the name of a space's number, or its index."""
    if isinstance(space, Box):
        return f"{at[0]} ({space.names[at[0]]!r})"
    return f"number {', '.join(map(str, at))}"
