"""What changes a simulation in the live window: the panel's sliders and buttons, and dragging a body with the mouse.

Sliders change run-time data, so nothing is recompiled. They set dt, gravity along its initial direction, Young's modulus of one
body or of all, friction of all pairs, and the strength of a drag. GGUI identifies a slider by the part of its label after ###, so
the part before can show the value while it moves.

A drag acts on a patch of nodes around the nearest surface triangle on the cursor's ray, rather than on the triangle. So its force
is spread over enough mass for a stiff spring, and does not crush the tets at the point. The patch is measured at rest, so that it
does not grow while the body is stretched.
"""

import itertools
import math
import textwrap
from dataclasses import dataclass

import numpy as np

from taisoft.dynamics.drag_spring import EARTH
from taisoft.dynamics.schemes import EXPLICIT, INTEGRATORS
from taisoft.errors import SimulationError, TaisoftError
from taisoft.output.camera import Camera
from taisoft.settings import contact_solvers
from taisoft.stability import stable_dt
from taisoft.view.colouring import TITLES, Colouring, following
from taisoft.view.plots import PLOTS, Plots
from taisoft.view.scene_view import Layers

SAFETY = 0.95  # upper end of the dt slider of explicit integrators, as a fraction of the stable dt
MAX_DT = 0.1  # upper end of the dt slider of implicit integrators [s]
MIN_DT = 0.01  # lower end of the dt slider, in units of the initial dt
YOUNG_DECADES = 2.0  # range of Young's modulus to either side of the initial one
MAX_GRAVITY = 3.0  # in units of the initial gravity
MAX_FRICTION = 1.5
STRENGTH_DECADES = (-0.5, 2.5)  # of the drag force over the body's weight, for a displacement as long as the body's diagonal
COLUMNS = 46  # characters that fit the panel's width
PATCH = 0.1  # radius in units of the diagonal of the body's bounding box at rest
MIN_NODES = 4  # with fewer nodes in the patch, only the triangle's corners are dragged
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
        self._young = {body.name: body.young for body in scene.bodies}  # initial values [Pa], floats or (m,)
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
            force = "no body is dragged"
            if drag is not None:
                force = f"drag force {np.linalg.norm(drag.force):.3g} N of at most {drag.max_force:.3g}"
            gui.text(force)
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
            self._integrator = following(INTEGRATORS, self._integrator)
        solvers = ("auto", *contact_solvers(self._integrator))
        if self._solver not in solvers:
            self._solver = "auto"
        if self._sim.plan.on["contact_forces"] and len(solvers) > 2:
            if gui.button(f"contacts: {self._solver}###contact solver"):
                self._solver = following(solvers, self._solver)
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
        low, high = (f"{end(young):.3g}" for end in (np.min, np.max))
        text = low if low == high else f"{low} to {high}"
        exponent = gui.slider_float(f"E {text} Pa###young", present, -YOUNG_DECADES, YOUNG_DECADES)
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


def changed(new: float, old: float) -> bool:
    """Return whether a slider was moved, beyond GGUI's rounding to single precision."""
    return abs(new - old) > 1e-5 * max(1.0, abs(old))


@dataclass(frozen=True)
class Hit:
    """A point (3,) [m] on a body's surface, in the triangle of nodes (3,) with barycentric weights (3,)."""

    body: int
    nodes: np.ndarray
    weights: np.ndarray
    point: np.ndarray


def nearest_hit(origin: np.ndarray, direction: np.ndarray, x: np.ndarray, triangles: np.ndarray) -> tuple[int, np.ndarray] | None:
    """Return the first triangle hit by a ray from origin, and the point's barycentric weights (3,); None if there is no hit.

    triangles: (t,3); x: their vertices (n,3). Triangles are hit from both sides. Source: Moeller and Trumbore 1997.
    """
    a, b, c = (x[triangles[:, k]] for k in range(3))
    e, f = b - a, c - a
    p = np.cross(direction, f)
    with np.errstate(divide="ignore", invalid="ignore", over="ignore"):
        inverse = 1.0 / np.einsum("ti,ti->t", e, p)
        s = origin - a
        u = np.einsum("ti,ti->t", s, p) * inverse
        q = np.cross(s, e)
        v = q @ direction * inverse
        t_ray = np.einsum("ti,ti->t", f, q) * inverse
        is_hit = (u >= 0) & (v >= 0) & (u + v <= 1) & (t_ray > 0) & np.isfinite(t_ray)
    if not is_hit.any():
        return None
    t = int(np.argmin(np.where(is_hit, t_ray, np.inf)))
    return t, np.array([1 - u[t] - v[t], u[t], v[t]])


def pick(sim, camera: Camera, cursor: tuple[float, float], size: tuple[int, int]) -> Hit | None:
    """Return the point of a body under the cursor, or None.

    cursor: in [0, 1] from the window's lower left corner; size: (width, height) of the window.
    """
    direction, best, distance = camera.ray(cursor, size), None, np.inf
    for k, body in enumerate(sim.scene.bodies):
        x, surface = sim.positions(body.name), np.asarray(body.nodes.surface)
        found = nearest_hit(camera.position, direction, x, surface)
        if found is None:
            continue
        point = found[1] @ x[surface[found[0]]]
        depth = float(np.linalg.norm(point - camera.position))
        if depth < distance:
            best, distance = Hit(k, surface[found[0]], found[1], point), depth
    return best


class MouseDrag:
    """A mouse drag of a hit point towards the cursor, in the plane through the point that is parallel to the picture."""

    def __init__(self, sim, hit: Hit):
        body = sim.scene.bodies[hit.body]
        self.body = body.name
        rest = np.asarray(body.rest_positions)
        self._diagonal = float(np.linalg.norm(rest.max(axis=0) - rest.min(axis=0)))
        self._mass = body.mass
        self.nodes, self.weights = _patch(rest, hit, PATCH * self._diagonal)
        self._plane = hit.point
        self._offset = self.weights @ sim.positions(body.name)[self.nodes] - hit.point

    def drag(self, sim, camera: Camera, cursor: tuple[float, float], size: tuple[int, int], strength: float) -> None:
        """Drag the point towards the cursor.

        strength: force over the body's weight, for a displacement as long as the diagonal of its bounding box.
        """
        ray, forward = camera.ray(cursor, size), camera.forward
        self.target = camera.position + ray * ((self._plane - camera.position) @ forward / (ray @ forward))
        stiffness = strength * self._mass * EARTH / self._diagonal
        sim.drag(self.body, self.nodes, self.weights, self.target + self._offset, stiffness)

    def line(self, sim) -> np.ndarray:
        """Return the line from the dragged point to the cursor's, (2,3) [m]."""
        return np.array([self.weights @ sim.positions(self.body)[self.nodes] - self._offset, self.target])


def _patch(rest: np.ndarray, hit: Hit, radius: float) -> tuple[np.ndarray, np.ndarray]:
    distance = np.linalg.norm(rest - hit.weights @ rest[hit.nodes], axis=1) / radius
    nodes = np.flatnonzero(distance < 1.0)
    if len(nodes) < MIN_NODES:
        return hit.nodes, hit.weights
    weights = (1.0 - distance[nodes] ** 2) ** 2
    return nodes, weights / weights.sum()
