"""The panel of the live window: texts, buttons and sliders, which become commands for the simulation's process.

GGUI shows a slider's number with three decimals, so its unit is one in which that is neither large nor small. What may change by
decades has a range around its value, which moves when the mouse is released. The simulation answers a change with its next state;
until then a slider keeps the value that was set.
"""

import math
import textwrap
from collections.abc import Callable

from taisoft.dynamics.schemes import CHOICES, SCHEMES, STATIC
from taisoft.settings import contact_solvers
from taisoft.view.choices import COLOURS
from taisoft.view.colouring import Colouring, following
from taisoft.view.layers import Layers
from taisoft.view.window.keys import KEYS

MAX_FRICTION = 1.5
STRENGTHS = (0.3, 300.0)  # of the drag force over the body's weight, for a displacement as long as the body's diagonal
COLUMNS = 52  # characters that fit the panel's width
MAX_PAIRS = 12  # with a slider of their own
TITLE = {"young": "E", "density": "rho"}
UNIT = {"young": "Pa", "density": "kg/m3"}
PREFIXES = {1e9: "G", 1e6: "M", 1e3: "k", 1.0: "", 1e-3: "m", 1e-6: "u"}
PREFIXED = ("Pa", "s")  # units
LEAST = 0.01  # lower end of a range that moves, over its upper end


class Requests:
    """Commands for the simulation, in the order given, of which a later one replaces an earlier one with the same key.

    number: of the last request that was sent.
    """

    def __init__(self) -> None:
        self.number = 0
        self._commands: dict[str, list] = {}

    def add(self, name: str, *arguments, key: str | None = None) -> None:
        """Add a command. key: by default its own, so that it replaces none."""
        key = key or f"{name} {len(self._commands)}"
        self._commands.pop(key, None)
        self._commands[key] = [name, *arguments]

    @property
    def next_number(self) -> int:
        """Number of the request that will hold the commands added now."""
        return self.number + 1

    def take(self) -> list:
        """Return the commands and count the request, unless there are none."""
        commands, self._commands = list(self._commands.values()), {}
        self.number += bool(commands)
        return commands


class Panel:
    """Panel of a window that changes a simulation. Rarely used choices are in sections, of which one is open at a time.

    bodies: names; pairs: of names, of those that can touch; colouring, layers: what is drawn; requests: get the commands.
    chosen: name of the body whose material the sliders change, the last one dragged.
    """

    def __init__(self, bodies: list[str], pairs: list, colouring: Colouring, layers: Layers, requests: Requests):
        self._bodies, self._pairs, self._colouring, self._layers = bodies, pairs, colouring, layers
        self._requests = requests
        self.pressed: set[str] = set()
        self.chosen, self._all_bodies = bodies[0], len(bodies) > 1
        self._open_section = "keys and mouse"
        self._solver: tuple[str, str] | None = None  # chosen integrator and contact solver; None: those in use
        self._strength = 10.0
        self._set: dict[str, tuple[float, int]] = {}  # by slider, a value set and the number of its request
        self._ranges: dict[str, tuple[float, float, str, float]] = {}  # by slider, as from `range_about`
        self._held = False
        self._state: dict = {}

    @property
    def strength(self) -> float:
        """Drag force over the body's weight, for a displacement as long as the body's diagonal; 0 if nothing can be dragged."""
        return self._strength if self._state.get("controls", {}).get("draggable") else 0.0

    def draw(self, gui, state: dict, held: bool = False) -> None:
        """Declare buttons and sliders in a GGUI sub-window, and request their changes. held: whether the mouse holds one."""
        self.pressed.clear()
        self._held = held
        self._state, values = state, state["controls"]
        names = {"pause": "run" if state["paused"] else "pause", "step": "step", "reset": "restart", "unbound": "real time"}
        if state["asked_speed"] is not None:
            names["unbound"] = "as fast as possible"
        if values["integrator"] in SCHEMES and values["integrator"] != STATIC:
            names["budget"] = "solve steps to the end" if state["budget"] else "keep up with the clock"
        for action, text in names.items():
            if gui.button(f"{text}###{action}"):
                self.pressed.add(action)
        self._slider(gui, "dt", "dt", values["dt"], values["dt_ends"], "set_dt", unit="s")
        self._slider(gui, "gravity", "g", values["gravity"], (0.0, values["max_gravity"]), "set_gravity", unit="m/s2")
        self._materials(gui, values)
        if self._pairs:
            least, largest = min(values["friction"]), max(values["friction"])
            self._slider(gui, "friction", "mu", largest, (0.0, MAX_FRICTION), "set_friction", None, least=least)
        if values["draggable"]:
            self._strength = self._slider(gui, "pull", "drag", self._strength, STRENGTHS, unit="weights")
            force = values["drag"]
            text = "no body is dragged" if force is None else f"drag force {force[0]:.3g} N of at most {force[1]:.3g}"
            gui.text(text)
        if gui.button(f"colour: {COLOURS[self._colouring.kind].title}###colour"):
            self._colouring.choose_next()
        for text, colour in self._colouring.legend():
            gui.text(text, color=tuple(colour))
        self._sections(gui)

    # --- sliders ------------------------------------------------------------------------------------------------------

    def _slider(self, gui, name: str, text: str, value: float, limits, *command, unit="", least: float | None = None) -> float:
        """Declare a slider, and request its change: a command and its arguments, of which the last is the new value.

        least: of several values, of which this is the largest. Returns the value shown: the one set until the simulation answers.
        """
        if name in self._set and self._set[name][1] <= self._state["answered"]:
            del self._set[name]
        present = self._set[name][0] if name in self._set else value
        if not self._held or name not in self._ranges:
            self._ranges[name] = range_about(present, limits, unit)
        low, high, shown_unit, scale = self._ranges[name]
        label = text + (f" [{shown_unit}]" if unit else "")
        if least is not None and f"{least:.4g}" != f"{value:.4g}":
            label += f" {least / scale:.3g} to {value / scale:.3g}"
        shown, ends = present / scale, (min(low, present) / scale, max(high, present) / scale)
        new = gui.slider_float(f"{label}###{name}", shown, *ends)
        if not changed(new, shown):
            return present
        new = min(max(scale * new, limits[0]), max(limits[1], present))  # GGUI lets one type a number
        if command:
            self._set[name] = (new, self._requests.next_number)
            self._requests.add(*command, new, key=name)
        return new

    def _materials(self, gui, values: dict) -> None:
        """Declare sliders of Young's modulus and density, of the chosen body or of all; they show those of the first one."""
        if len(self._bodies) > 1 and gui.button(("all bodies" if self._all_bodies else self.chosen) + "###which"):
            self._all_bodies = not self._all_bodies
        shown = dict.fromkeys([self.chosen, *(self._bodies if self._all_bodies else ())])
        for what, title in TITLE.items():
            ranges = dict(zip(self._bodies, values[what]))
            if names := [name for name in shown if ranges[name] is not None]:  # rigid bodies have none
                least, largest, *limits = ranges[names[0]]
                command, more = ("set_number", what, names), {"unit": UNIT[what], "least": least}
                self._slider(gui, f"{what} of {names[0]}", title, largest, limits, *command, **more)

    # --- sections -----------------------------------------------------------------------------------------------------

    def _sections(self, gui) -> None:
        sections: dict[str, Callable] = {"friction of pairs": self._choose_frictions} if self._pairs else {}
        sections |= {"solver": self._choose_solver, "layers": self._choose_layers}
        sections["keys and mouse"] = _write_help
        for name, section in sections.items():
            is_open = gui.checkbox(name, self._open_section == name)
            if is_open != (self._open_section == name):
                self._open_section = name if is_open else ""
            if is_open:
                section(gui)

    def _choose_frictions(self, gui) -> None:
        """Declare a slider for each pair, of the friction in use."""
        frictions = self._state["controls"]["friction"]
        for k, (pair, friction) in enumerate(zip(self._pairs[:MAX_PAIRS], frictions)):
            self._slider(gui, f"friction {k}", f"{pair[0]}, {pair[1]}", friction, (0.0, MAX_FRICTION), "set_friction", k)
        if len(self._pairs) > MAX_PAIRS:
            gui.text(f"and {len(self._pairs) - MAX_PAIRS} more pairs")

    def _choose_layers(self, gui) -> None:
        shown = self._layers.shown
        for name in shown:
            shown[name] = gui.checkbox(name.replace("_", " "), shown[name])

    def _choose_solver(self, gui) -> None:
        """Declare two buttons that cycle through the choices, and one that applies them, which compiles for seconds."""
        values = self._state["controls"]
        present = (values["integrator"], values["contact_solver"])
        integrator, solver = self._solver or present
        if gui.button(f"integrator: {integrator}###integrator"):
            integrator = following(CHOICES, integrator)
        solvers = ("auto", *contact_solvers(integrator))
        if solver not in solvers:
            solver = "auto"
        if self._pairs and len(solvers) > 2 and gui.button(f"contacts: {solver}###contact solver"):
            solver = following(solvers, solver)
        self._solver = (integrator, solver)
        if self._solver == present:
            self._solver = None
            gui.text("in use")
        elif gui.button("use this: compiles for some seconds###use"):
            self._requests.add("rebuild", integrator, solver, key="rebuild")


def range_about(value: float, limits: tuple[float, float], unit: str) -> tuple[float, float, str, float]:
    """Return the ends of a slider, its unit with a prefix, and how many of the given units that is.

    Limits from 0 on are the ends. Else the upper end is the next of 1, 2 or 5 times a power of ten above twice the value.
    """
    if limits[0] <= 0.0:
        return *limits, unit, 1.0
    power = 10.0 ** math.floor(math.log10(2.0 * value))
    high = min(next(k * power for k in (1, 2, 5, 10) if k * power > (2.0 - 1e-9) * value), limits[1])
    scale = next((one for one in PREFIXES if one <= (1.0 + 1e-9) * value), min(PREFIXES)) if unit in PREFIXED else 1.0
    return max(LEAST * high, limits[0]), high, PREFIXES[scale] + unit, scale


def changed(new: float, old: float) -> bool:
    """Return whether a slider was moved, beyond GGUI's rounding to single precision."""
    return abs(new - old) > 1e-5 * max(1.0, abs(old))


def wrapped(gui, line: str) -> None:
    """Write a line of text, broken where the panel ends."""
    for piece in textwrap.wrap(line, COLUMNS) or [""]:
        gui.text(piece)


def _write_help(gui) -> None:
    wrapped(gui, "Left: drag a body, or turn; Ctrl + left: turn")
    wrapped(gui, "Right: zoom, middle: shift")
    wrapped(gui, ", ".join(f"{key.label}: {key.help}" for key in KEYS))
