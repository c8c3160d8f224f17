"""The panel's sliders and buttons: what they change is run-time data, so nothing is compiled anew.

dt, gravity along its first direction, Young's modulus of one body or of all, friction of all pairs, and the pull's strength.
GGUI keeps a slider by the part of its label behind ###, so the part before it can tell the value while the slider moves.
"""

import itertools
import math
import textwrap

import numpy as np

from taisoft.dynamics import EXPLICIT, INTEGRATORS
from taisoft.errors import SimulationError, TaisoftError
from taisoft.settings import contact_solvers
from taisoft.stability import stable_dt
from taisoft.view.colouring import TITLES, Colouring
from taisoft.view.layers import Layers
from taisoft.view.plots import PLOTS, Plots

SAFE = 0.95  # of an explicit integrator's limit, where its slider of dt ends
LONGEST = 0.1  # [s], an implicit one's
SHORTEST = 0.01  # times the first dt
SPAN = 2.0  # decades of Young's modulus either way
EARTH = 9.81  # [m/s^2], of a scene without gravity, to begin its slider with
STRONGEST = 3.0  # gravity, in units of the first
FRICTION = 1.5
STRENGTHS = (-0.5, 2.5)  # decades: weights of the body for a pull as long as it is
COLUMNS = 46  # characters that fit the panel's width
HELP = (
    "Left drag: pull a body, or turn", "Ctrl + left: turn", "Right: zoom, middle: shift", "Space: pause, S or Right: step",
    "R: restart, V: colour, P: record, Esc: quit", "W, C, T, F: wires, contacts, tractions, fixed",
    "G: plots over time",
)  # fmt: skip


class Panel:
    """sim: what the sliders change; loop: what the buttons ask (by `pressed`), and who is told what could not be changed;
    colouring: what the bodies' colours mean; layers: what is drawn beside them; plots: over time. What is chosen once in a while
    is in sections, of which one is open at a time.

    chosen: name of the body whose Young's modulus moves, the one pulled last; strength: of a pull, 0 where none can be.
    """

    def __init__(self, sim, loop, colouring: Colouring, layers: Layers, plots: Plots):
        self._sim, self._loop, self._colouring, self._layers, self._plots = sim, loop, colouring, layers, plots
        self.pressed: set[str] = set()
        scene = sim.scene
        self.chosen = scene.bodies[0].name
        self._all = len(scene.bodies) > 1
        self._open = "keys and mouse"
        self._integrator, self._solver = sim.settings.integrator, sim.settings.contact_solver  # chosen, in use or not
        self._wanted = self._first = sim.dt
        g = np.asarray(scene.gravity, dtype=float)
        self._g = float(np.linalg.norm(g))
        self._most_g = STRONGEST * (self._g or EARTH)
        self._down = g / self._g if self._g else np.array([0.0, -1.0, 0.0])
        self._young = {body.name: body.material.young for body in scene.bodies}  # at the start
        self._factor = dict.fromkeys(self._young, 0.0)  # decades
        self._pairs = self._touching()
        self._friction = scene.contact_numbers(*self._pairs[0])[0] if self._pairs else 0.0
        self._strength = 1.0  # decades

    @property
    def strength(self) -> float:
        """Weights of the body that a pull as long as the body's diagonal has."""
        return 10.0**self._strength if self._sim.draggable else 0.0

    def _touching(self) -> list[tuple[str, str]]:
        """Names of the pairs that the slider of friction is about."""
        sim, bodies = self._sim, {body.name for body in self._sim.scene.bodies}
        if not sim.plan.on["contact_forces"]:
            return []
        names = [collider.name for collider in sim.scene.colliders]
        pairs = [pair for pair in itertools.combinations(names, 2) if bodies & set(pair)]
        return pairs + ([(name, name) for name in bodies] if sim.settings.self_collision else [])

    def draw(self, gui) -> None:
        """Declare buttons and sliders in a GGUI sub-window, and do what was asked."""
        self.pressed.clear()
        names = {"pause": "run" if self._loop.paused else "pause", "step": "step", "reset": "restart"}
        names["record"] = "record" if self._loop.folder is None else "stop recording"
        for action, text in names.items():
            if gui.button(f"{text}###{action}"):
                self.pressed.add(action)
        self._dt_slider(gui)
        g = gui.slider_float(f"gravity {self._g:.3g}###gravity", self._g, 0.0, self._most_g)
        if changed(g, self._g):
            self._g = g
            self._loop.guarded(lambda: self._sim.set_gravity(g * self._down))
        self._young_slider(gui)
        if self._pairs:
            friction = gui.slider_float(f"friction {self._friction:.2f}###friction", self._friction, 0.0, FRICTION)
            if changed(friction, self._friction):
                self._friction = friction
                for pair in self._pairs:
                    self._sim.set_contact(*pair, friction=friction)
        if self._sim.draggable:
            self._strength = gui.slider_float(f"pull {self.strength:.3g} weights###pull", self._strength, *STRENGTHS)
            drag = self._sim.dragged
            force, most = (np.linalg.norm(drag.force), drag.max_force) if drag is not None else (0.0, 0.0)
            gui.text(f"pulling with {force:.3g} N of at most {most:.3g}" if drag is not None else "nothing is pulled")
        if gui.button(f"colour: {TITLES[self._colouring.kind]}###colour"):
            self._colouring.choose_next()
        for text, colour in self._colouring.legend():
            gui.text(text, color=tuple(colour))
        self._sections(gui)
        for line in self._loop.lines():
            for piece in textwrap.wrap(line, COLUMNS) or [""]:
                gui.text(piece)

    # --- what is chosen once in a while -------------------------------------------------------------------------------

    def _sections(self, gui) -> None:
        drawn = {"solver": self._choose_solver, "layers": self._choose_layers, "plots": self._choose_plots}
        for name in (*drawn, "keys and mouse"):
            is_open = gui.checkbox(name, self._open == name)
            if is_open != (self._open == name):
                self._open = name if is_open else ""
            if is_open and name in drawn:
                drawn[name](gui)
        for line in HELP if self._open == "keys and mouse" else ():
            gui.text(line)

    def _choose_layers(self, gui) -> None:
        shown = self._layers.shown
        for name in shown:
            shown[name] = gui.checkbox(name.replace("_", " "), shown[name])

    def _choose_plots(self, gui) -> None:
        shown = self._plots.shown
        for name in self._plots.offered():
            shown[name] = gui.checkbox(f"{PLOTS[name].title}###plot {name}", shown[name])

    def _choose_solver(self, gui) -> None:
        """Two buttons that go through what there is, and one that takes what was chosen: it compiles for seconds."""
        if gui.button(f"integrator: {self._integrator}###integrator"):
            self._integrator = _next(INTEGRATORS, self._integrator)
        solvers = ("auto", *contact_solvers(self._integrator))
        if self._solver not in solvers:
            self._solver = "auto"
        if self._sim.plan.on["contact_forces"] and len(solvers) > 2:
            if gui.button(f"contacts: {self._solver}###contact solver"):
                self._solver = _next(solvers, self._solver)
        now = self._sim.settings
        if (self._integrator, self._solver) == (now.integrator, now.contact_solver):
            gui.text("in use")
        elif gui.button("use this: compiles for some seconds###use"):
            self._loop.ask(self._rebuild, f"{self._integrator} is built and compiled, for some seconds")

    def _rebuild(self) -> bool:
        """The integrator and contact solver that were chosen, with the dt asked for or the largest that is stable."""
        sim, loop, dt = self._sim, self._loop, self._wanted
        chosen = {"integrator": self._integrator, "contact_solver": self._solver}
        if self._integrator in EXPLICIT:
            dt = min(dt, SAFE * stable_dt(sim.scene, self._integrator == "velocity_verlet"))
        try:
            sim.rebuild(dt=dt, **chosen)
        except TaisoftError as error:
            loop.note = str(error)
            self._integrator, self._solver = sim.settings.integrator, sim.settings.contact_solver
            return False
        lowered = f"; dt is {dt:.3g} s, since {self._wanted:.3g} s is not stable" if dt < self._wanted else ""
        loop.note = f"{self._integrator} is in use{lowered}"
        return True

    # --- sliders ------------------------------------------------------------------------------------------------------

    def _dt_slider(self, gui) -> None:
        sim = self._sim
        most = LONGEST
        if sim.settings.explicit:
            most = max(sim.dt, SAFE * sim.stable_dt)
        ends = math.log10(min(SHORTEST * self._first, sim.dt)), math.log10(max(most, sim.dt))
        now = math.log10(sim.dt)
        asked = gui.slider_float(f"dt {sim.dt:.3g} s###dt", now, *ends)
        if changed(asked, now):
            self._wanted = 10.0**asked
            self._loop.guarded(self._set_dt)

    def _set_dt(self) -> None:
        """The dt that was asked for, or the largest that is stable."""
        sim = self._sim
        sim.dt = min(self._wanted, SAFE * sim.stable_dt) if sim.settings.explicit else self._wanted

    def _young_slider(self, gui) -> None:
        if len(self._young) > 1 and gui.button(("all bodies" if self._all else self.chosen) + "###which"):
            self._all = not self._all
        now = self._factor[self.chosen]
        young = self._young[self.chosen] * 10.0**now
        asked = gui.slider_float(f"E {young:.3g} Pa###young", now, -SPAN, SPAN)
        if changed(asked, now):
            for name in self._young if self._all else (self.chosen,):
                if self._loop.guarded(lambda name=name: self._set_young(name, asked)):
                    self._factor[name] = asked

    def _set_young(self, name: str, factor: float) -> None:
        """A stiffer body needs a smaller dt in explicit steps, a softer one gives the dt asked for back."""
        sim = self._sim
        young = self._young[name] * 10.0**factor
        for _ in range(20):
            try:
                sim.set_material(name, young=young)
                break
            except SimulationError:
                sim.dt = 0.5 * sim.dt
        self._set_dt()


def _next(names: tuple[str, ...], name: str) -> str:
    """The name after this one, and the first after the last."""
    return names[(names.index(name) + 1) % len(names)]


def changed(new: float, old: float) -> bool:
    """Whether a slider was moved: GGUI rounds what it is given to single precision."""
    return abs(new - old) > 1e-5 * max(1.0, abs(old))
