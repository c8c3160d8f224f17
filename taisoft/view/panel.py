"""The panel of the live window: texts, buttons and sliders, which become commands for the simulation's process.

GGUI identifies a slider by the part of its label after ###, so the part before shows the value in its unit. The number in that
of dt, Young's modulus and density is the decimal logarithm of that value. The simulation answers a change with its next state;
until then a slider keeps the value that was set.
"""

import math
import textwrap
from collections.abc import Callable

from taisoft.dynamics.schemes import CHOICES
from taisoft.settings import contact_solvers
from taisoft.view.colouring import TITLES, Colouring, following
from taisoft.view.controls import DECADES
from taisoft.view.keys import KEYS
from taisoft.view.scene_view import Layers

MAX_FRICTION = 1.5
STRENGTH_DECADES = (-0.5, 2.5)  # of the drag force over the body's weight, for a displacement as long as the body's diagonal
COLUMNS = 52  # characters that fit the panel's width
MAX_PAIRS = 12  # with a slider of their own
TITLE = {"young": "E", "density": "rho"}
UNIT = {"young": "Pa", "density": "kg/m3"}


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
        self._strength = 1.0  # decades
        self._set: dict[str, tuple[float, int]] = {}  # by slider, a value set and the number of its request
        self._state: dict = {}

    @property
    def strength(self) -> float:
        """Drag force over the body's weight, for a displacement as long as the body's diagonal; 0 if nothing can be dragged."""
        return 10.0**self._strength if self._state.get("controls", {}).get("draggable") else 0.0

    def draw(self, gui, state: dict) -> None:
        """Declare buttons and sliders in a GGUI sub-window, and request their changes."""
        self.pressed.clear()
        self._state, values = state, state["controls"]
        names = {"pause": "run" if state["paused"] else "pause", "step": "step", "reset": "restart", "unbound": "real time"}
        if state["asked_speed"] is not None:
            names["unbound"] = "as fast as possible"
        for action, text in names.items():
            if gui.button(f"{text}###{action}"):
                self.pressed.add(action)
        dt, ends = self._present("dt", math.log10(values["dt"])), map(math.log10, values["dt_ends"])
        self._slider(gui, "dt", f"dt {values['dt']:.3g} s", dt, ends, "set_dt", convert=lambda new: 10.0**new)
        g = self._present("gravity", values["gravity"])
        self._slider(gui, "gravity", f"g {g:.3g} m/s2", g, (0.0, values["max_gravity"]), "set_gravity")
        self._materials(gui, values)
        if self._pairs:
            self._all_frictions(gui, values["friction"])
        if values["draggable"]:
            self._strength = gui.slider_float(f"drag {self.strength:.3g} weights###pull", self._strength, *STRENGTH_DECADES)
            force = values["drag"]
            text = "no body is dragged" if force is None else f"drag force {force[0]:.3g} N of at most {force[1]:.3g}"
            gui.text(text)
        if gui.button(f"colour: {TITLES[self._colouring.kind]}###colour"):
            self._colouring.choose_next()
        for text, colour in self._colouring.legend():
            gui.text(text, color=tuple(colour))
        self._sections(gui)

    # --- sliders ------------------------------------------------------------------------------------------------------

    def _present(self, key: str, value: float) -> float:
        """Return a slider's value: the one set until the simulation has answered."""
        if key in self._set and self._set[key][1] <= self._state["answered"]:
            del self._set[key]
        return self._set[key][0] if key in self._set else value

    def _slider(self, gui, name: str, label: str, present: float, ends, *command, of: str = "", convert=float) -> None:
        """Declare a slider, and request its change: a command and its arguments, of which the converted new value is the last.

        of: what the value belongs to, if that changes; its key is name + of.
        """
        low, high = ends
        new = gui.slider_float(f"{label}###{name}", present, low, max(high, present))
        if changed(new, present):
            self._set[name + of] = (new, self._requests.next_number)
            self._requests.add(*command, convert(new), key=name + of)

    def _materials(self, gui, values: dict) -> None:
        """Declare sliders of Young's modulus and density, of the chosen body or of all."""
        if len(self._bodies) > 1 and gui.button(("all bodies" if self._all_bodies else self.chosen) + "###which"):
            self._all_bodies = not self._all_bodies
        shown = [self.chosen, *(self._bodies if self._all_bodies else ())]
        for what in DECADES:
            ranges = dict(zip(self._bodies, values[what]))
            if known := [name for name in shown if ranges[name] is not None]:  # rigid bodies have none
                self._material(gui, what, known, *ranges[known[0]])

    def _material(self, gui, what: str, names: list[str], low: float, high: float, exponent: float) -> None:
        """Declare a slider of a number of bodies, which shows that of the first."""
        text = f"{low:.4g}" if f"{low:.4g}" == f"{high:.4g}" else f"{low:.3g} to {high:.3g}"
        initial, of = math.log10(high) - exponent, f" of {names[0]}"
        present, ends = self._present(what + of, math.log10(high)), (initial - DECADES[what], initial + DECADES[what])
        command = "set_number", what, [one for one in self._bodies if one in names]
        label = f"{TITLE[what]} {text} {UNIT[what]}"
        self._slider(gui, what, label, present, ends, *command, of=of, convert=lambda new: new - initial)

    def _all_frictions(self, gui, frictions: list[float]) -> None:
        """Declare a slider that sets the friction of all pairs; it shows the largest one."""
        low, high = f"{min(frictions):.2f}", f"{max(frictions):.2f}"
        present, label = self._present("friction", max(frictions)), f"mu {low if low == high else f'{low}-{high}'}"
        self._slider(gui, "friction", label, present, (0.0, MAX_FRICTION), "set_friction", None)

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
            name = f"friction {k}"
            present = self._present(name, friction)
            self._slider(gui, name, f"{present:.2f} {pair[0]}, {pair[1]}", present, (0.0, MAX_FRICTION), "set_friction", k)
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
