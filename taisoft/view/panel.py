"""Sliders and buttons of the panel. Sliders change run-time data, so nothing is recompiled.

They set dt, gravity along its initial direction, Young's modulus of one body or of all, friction of all pairs, and the strength
of a drag. GGUI identifies a slider by the part of its label after ###, so the part before can show the value while it moves.
"""

import itertools
import math
import textwrap

import numpy as np

from taisoft.dynamics.schemes import EXPLICIT, INTEGRATORS
from taisoft.errors import SimulationError, TaisoftError
from taisoft.settings import contact_solvers
from taisoft.stability import stable_dt
from taisoft.view.colouring import TITLES, Colouring
from taisoft.view.layers import Layers
from taisoft.view.plots import PLOTS, Plots

SAFETY = 0.95  # upper end of the dt slider of explicit integrators, as a fraction of the stable dt
MAX_DT = 0.1  # upper end of the dt slider of implicit integrators [s]
MIN_DT = 0.01  # lower end of the dt slider, in units of the initial dt
YOUNG_DECADES = 2.0  # range of Young's modulus to either side of the initial one
EARTH = 9.81  # reference for the gravity slider of a scene without gravity [m/s^2]
MAX_GRAVITY = 3.0  # in units of the initial gravity
MAX_FRICTION = 1.5
STRENGTH_DECADES = (-0.5, 2.5)  # of the drag force over the body's weight, for a displacement as long as the body's diagonal
COLUMNS = 46  # characters that fit the panel's width
HELP = (
    "Left drag: drag a body, or turn",
    "Ctrl + left: turn",
    "Right: zoom, middle: pan",
    "Space: pause, S or Right: step",
    "R: restart, V: colour, P: record, Esc: quit",
    "W, C, T, F: wires, contacts, tractions, fixed",
    "G: plots over time",
)


class Panel:
    """Panel of the live window. Rarely used choices are in sections, of which one is open at a time.

    sim: changed by the sliders; loop: carries out the buttons' actions (`pressed`) and shows errors; colouring, layers, plots:
    what is drawn. chosen: name of the body whose Young's modulus the slider changes, the last one dragged; strength: of a drag,
    0 if dragging is off.
    """

    def __init__(self, sim, loop, colouring: Colouring, layers: Layers, plots: Plots):
        self._sim, self._loop, self._colouring, self._layers, self._plots = sim, loop, colouring, layers, plots
        self.pressed: set[str] = set()
        scene = sim.scene
        self.chosen = scene.bodies[0].name
        self._all_bodies = len(scene.bodies) > 1
        self._open_section = "keys and mouse"
        self._integrator, self._solver = sim.settings.integrator, sim.settings.contact_solver  # chosen, not always in use
        self._requested_dt = self._initial_dt = sim.dt
        g = np.asarray(scene.gravity, dtype=float)
        self._g = float(np.linalg.norm(g))
        self._max_g = MAX_GRAVITY * (self._g or EARTH)
        self._g_direction = g / self._g if self._g else np.array([0.0, -1.0, 0.0])
        self._young = {body.name: body.material.young for body in scene.bodies}  # initial values [Pa]
        self._young_exponent = dict.fromkeys(self._young, 0.0)  # decades
        self._pairs = self._contact_pairs()
        self._friction = scene.contact_numbers(*self._pairs[0])[0] if self._pairs else 0.0
        self._strength = 1.0  # decades

    @property
    def strength(self) -> float:
        """Drag force over the body's weight, for a displacement as long as the body's diagonal."""
        return 10.0**self._strength if self._sim.draggable else 0.0

    def _contact_pairs(self) -> list[tuple[str, str]]:
        """Return the names of the pairs whose friction the slider sets."""
        sim, bodies = self._sim, {body.name for body in self._sim.scene.bodies}
        if not sim.plan.on["contact_forces"]:
            return []
        names = [collider.name for collider in sim.scene.colliders]
        pairs = [pair for pair in itertools.combinations(names, 2) if bodies & set(pair)]
        return pairs + ([(name, name) for name in bodies] if sim.settings.self_collision else [])

    def draw(self, gui) -> None:
        """Declare buttons and sliders in a GGUI sub-window, and apply their changes."""
        self.pressed.clear()
        names = {"pause": "run" if self._loop.paused else "pause", "step": "step", "reset": "restart"}
        names["record"] = "record" if self._loop.folder is None else "stop recording"
        for action, text in names.items():
            if gui.button(f"{text}###{action}"):
                self.pressed.add(action)
        self._dt_slider(gui)
        g = gui.slider_float(f"gravity {self._g:.3g}###gravity", self._g, 0.0, self._max_g)
        if changed(g, self._g):
            self._g = g
            self._loop.guarded(lambda: self._sim.set_gravity(g * self._g_direction))
        self._young_slider(gui)
        if self._pairs:
            friction = gui.slider_float(f"friction {self._friction:.2f}###friction", self._friction, 0.0, MAX_FRICTION)
            if changed(friction, self._friction):
                self._friction = friction
                for pair in self._pairs:
                    self._sim.set_contact(*pair, friction=friction)
        if self._sim.draggable:
            self._strength = gui.slider_float(f"drag {self.strength:.3g} weights###pull", self._strength, *STRENGTH_DECADES)
            drag = self._sim.dragged
            force, max_force = (np.linalg.norm(drag.force), drag.max_force) if drag is not None else (0.0, 0.0)
            gui.text(f"drag force {force:.3g} N of at most {max_force:.3g}" if drag is not None else "no body is dragged")
        if gui.button(f"colour: {TITLES[self._colouring.kind]}###colour"):
            self._colouring.choose_next()
        for text, colour in self._colouring.legend():
            gui.text(text, color=tuple(colour))
        self._sections(gui)
        for line in self._loop.lines():
            for piece in textwrap.wrap(line, COLUMNS) or [""]:
                gui.text(piece)

    # --- sections -----------------------------------------------------------------------------------------------------

    def _sections(self, gui) -> None:
        sections = {"solver": self._choose_solver, "layers": self._choose_layers, "plots": self._choose_plots}
        for name in (*sections, "keys and mouse"):
            is_open = gui.checkbox(name, self._open_section == name)
            if is_open != (self._open_section == name):
                self._open_section = name if is_open else ""
            if is_open and name in sections:
                sections[name](gui)
        for line in HELP if self._open_section == "keys and mouse" else ():
            gui.text(line)

    def _choose_layers(self, gui) -> None:
        shown = self._layers.shown
        for name in shown:
            shown[name] = gui.checkbox(name.replace("_", " "), shown[name])

    def _choose_plots(self, gui) -> None:
        shown = self._plots.shown
        for name in self._plots.available():
            shown[name] = gui.checkbox(f"{PLOTS[name].title}###plot {name}", shown[name])

    def _choose_solver(self, gui) -> None:
        """Declare two buttons that cycle through the choices, and one that applies them, which compiles for seconds."""
        if gui.button(f"integrator: {self._integrator}###integrator"):
            self._integrator = _next(INTEGRATORS, self._integrator)
        solvers = ("auto", *contact_solvers(self._integrator))
        if self._solver not in solvers:
            self._solver = "auto"
        if self._sim.plan.on["contact_forces"] and len(solvers) > 2:
            if gui.button(f"contacts: {self._solver}###contact solver"):
                self._solver = _next(solvers, self._solver)
        present = self._sim.settings
        if (self._integrator, self._solver) == (present.integrator, present.contact_solver):
            gui.text("in use")
        elif gui.button("use this: compiles for some seconds###use"):
            self._loop.request_rebuild(self._rebuild, f"compiling {self._integrator}, for some seconds")

    def _rebuild(self) -> bool:
        """Switch to the chosen integrator and contact solver, with the requested dt or the largest stable one."""
        sim, loop, dt = self._sim, self._loop, self._requested_dt
        chosen = {"integrator": self._integrator, "contact_solver": self._solver}
        if self._integrator in EXPLICIT:
            dt = min(dt, SAFETY * stable_dt(sim.scene, self._integrator == "velocity_verlet"))
        try:
            sim.rebuild(dt=dt, **chosen)
        except TaisoftError as error:
            loop.note = str(error)
            self._integrator, self._solver = sim.settings.integrator, sim.settings.contact_solver
            return False
        lowered = f"; dt is {dt:.3g} s, since {self._requested_dt:.3g} s is not stable" if dt < self._requested_dt else ""
        loop.note = f"{self._integrator} is in use{lowered}"
        return True

    # --- sliders ------------------------------------------------------------------------------------------------------

    def _dt_slider(self, gui) -> None:
        sim = self._sim
        max_dt = MAX_DT
        if sim.settings.explicit:
            max_dt = max(sim.dt, SAFETY * sim.stable_dt)
        ends = math.log10(min(MIN_DT * self._initial_dt, sim.dt)), math.log10(max(max_dt, sim.dt))
        present = math.log10(sim.dt)
        exponent = gui.slider_float(f"dt {sim.dt:.3g} s###dt", present, *ends)
        if changed(exponent, present):
            self._requested_dt = 10.0**exponent
            self._loop.guarded(self._set_dt)

    def _set_dt(self) -> None:
        """Set the requested dt, or the largest stable one if that is smaller."""
        sim = self._sim
        sim.dt = min(self._requested_dt, SAFETY * sim.stable_dt) if sim.settings.explicit else self._requested_dt

    def _young_slider(self, gui) -> None:
        if len(self._young) > 1 and gui.button(("all bodies" if self._all_bodies else self.chosen) + "###which"):
            self._all_bodies = not self._all_bodies
        present = self._young_exponent[self.chosen]
        young = self._young[self.chosen] * 10.0**present
        exponent = gui.slider_float(f"E {young:.3g} Pa###young", present, -YOUNG_DECADES, YOUNG_DECADES)
        if changed(exponent, present):
            for name in self._young if self._all_bodies else (self.chosen,):
                if self._loop.guarded(lambda name=name: self._set_young(name, exponent)):
                    self._young_exponent[name] = exponent

    def _set_young(self, name: str, exponent: float) -> None:
        """Set Young's modulus, lowering an explicit dt if a stiffer body requires it, or restoring the requested one."""
        sim = self._sim
        young = self._young[name] * 10.0**exponent
        for _ in range(20):
            try:
                sim.set_material(name, young=young)
                break
            except SimulationError:
                sim.dt = 0.5 * sim.dt
        self._set_dt()


def _next(names: tuple[str, ...], name: str) -> str:
    """Return the name after this one, cyclically."""
    return names[(names.index(name) + 1) % len(names)]


def changed(new: float, old: float) -> bool:
    """Return whether a slider was moved, beyond GGUI's rounding to single precision."""
    return abs(new - old) > 1e-5 * max(1.0, abs(old))
