"""What the live window changes in a simulation: dt, gravity, materials, friction, solver, and the drag with the mouse.

All of them but the solver are run-time data, so nothing is recompiled. Young's modulus and density are multiplied by a factor,
so that regions and tets keep their ratios.
"""

import itertools

import numpy as np

from taisoft.dynamics.drag_spring import EARTH
from taisoft.dynamics.schemes import EXPLICIT
from taisoft.errors import SimulationError
from taisoft.mesh.placing import UP
from taisoft.scene.rigid import RigidBody
from taisoft.settings import contact_solvers
from taisoft.stability import stable_dt

SAFETY = 0.95  # upper end of dt of explicit integrators, as a fraction of the stable dt
MAX_DT = 0.1  # upper end of dt of implicit integrators [s]
MIN_DT = 0.01  # lower end of dt, in units of the initial dt
RATIOS = {"young": 100.0, "density": 10.0}  # between the initial value and either end of its range
MAX_GRAVITY = 3.0  # in units of the initial gravity
HALVINGS = 20  # of dt for a stiffer or lighter body, at most


class Controls:
    """Changes of a simulator by the window, and the values that the window shows.

    Each method is carried out between two steps and raises a TaisoftError, with nothing changed, for what is impossible.
    """

    def __init__(self, sim):
        self._sim, scene = sim, sim.scene
        self._requested_dt = self._initial_dt = sim.dt
        g = np.asarray(scene.gravity, dtype=float)
        self._g = float(np.linalg.norm(g))
        self._max_g = MAX_GRAVITY * (self._g or EARTH)
        self._g_direction = g / self._g if self._g else 0.0 - UP[scene.up]
        elastic = [body for body in scene.bodies if not isinstance(body, RigidBody)]
        self._names = [body.name for body in scene.bodies]
        self._initial = {what: {body.name: getattr(body, what) for body in elastic} for what in RATIOS}
        self._stiffnesses = {body.name: body.composition.stiffnesses for body in elastic}
        self._factors = {what: dict.fromkeys(self._initial[what], 1.0) for what in RATIOS}
        self._pairs = touching_pairs(sim)
        self._frictions: list[float] | None = None  # of the pairs; None if unknown
        self._held: tuple | None = None  # body, nodes and weights of the present drag

    def values(self) -> dict:
        """Return the present values, as plain data for the panel."""
        sim, drag = self._sim, self._sim.dragged
        if self._frictions is None:
            self._frictions = [sim.scene.contact_numbers(*pair)[0] for pair in self._pairs]
        settings = sim.settings
        return {
            "dt": sim.dt,
            "dt_ends": self._dt_ends(),
            "gravity": self._g,
            "max_gravity": self._max_g,
            **{what: [self._range(what, name) for name in self._names] for what in RATIOS},
            "friction": self._frictions,
            "draggable": sim.draggable,
            "drag": None if drag is None else (float(np.linalg.norm(drag.force)), float(drag.max_force)),
            "integrator": settings.integrator,
            "contact_solver": settings.contact_solver,
        }

    def _range(self, what: str, name: str) -> tuple[float, float, float, float] | None:
        """Return the least and the largest value of a number of a body, and the ends of the largest; None if it is rigid."""
        if name not in self._initial[what]:
            return None
        initial, factor, ratio = self._initial[what][name], self._factors[what][name], RATIOS[what]
        least, largest = float(np.min(initial)), float(np.max(initial))
        return factor * least, factor * largest, largest / ratio, largest * ratio

    def _dt_ends(self) -> tuple[float, float]:
        sim = self._sim
        highest = max(sim.dt, SAFETY * sim.stable_dt) if sim.settings.explicit else MAX_DT
        return min(MIN_DT * self._initial_dt, sim.dt), max(highest, sim.dt)

    # --- numbers ------------------------------------------------------------------------------------------------------

    def set_dt(self, dt: float) -> None:
        """Set dt [s], or the largest stable one if that is smaller."""
        self._requested_dt = dt
        self._restore_dt()

    def _restore_dt(self) -> None:
        sim = self._sim
        sim.dt = min(self._requested_dt, SAFETY * sim.stable_dt) if sim.settings.explicit else self._requested_dt

    def set_gravity(self, size: float) -> None:
        """Set gravity [m/s^2] along its initial direction, else downwards."""
        self._sim.set_gravity(size * self._g_direction)
        self._g = size

    def set_number(self, what: str, names: list[str], value: float) -> None:
        """Set young or density of elastic bodies: the largest of the first one's to a value, the others by the same factor.

        It multiplies the initial values, for young all stiffnesses of a law. An explicit dt is lowered if it would not be stable;
        the requested one is restored as soon as it is.
        """
        sim, factor = self._sim, value / float(np.max(self._initial[what][names[0]]))
        for name in names:
            initial = {what: self._initial[what][name]} if what != "young" else self._stiffnesses[name]
            numbers = {number: value * factor for number, value in initial.items()}
            for k in range(HALVINGS):
                try:
                    sim.set_material(name, **numbers)
                    break
                except SimulationError:
                    if k == HALVINGS - 1:
                        raise
                    sim.dt = 0.5 * sim.dt
            self._factors[what][name] = factor
        self._restore_dt()

    def set_friction(self, k: int | None, friction: float) -> None:
        """Set the friction of a pair, or of all for None."""
        for pair in self._pairs if k is None else [self._pairs[k]]:
            self._sim.set_contact(*pair, friction=friction)
        self._frictions = None

    # --- drag ---------------------------------------------------------------------------------------------------------

    def begin_drag(self, body: str, nodes, weights) -> None:
        """Begin a drag at these nodes (k,) of a body, weighted by (k,), which `drag` moves."""
        own = self._sim.scene.body(body)
        rest = np.asarray(own.rest_positions)
        self._held = (body, np.asarray(nodes), np.asarray(weights), np.linalg.norm(np.ptp(rest, axis=0)))

    def drag(self, target, strength: float) -> None:
        """Drag towards target (3,) [m]. strength: force over the body's weight, for a displacement as long as its diagonal."""
        if self._held is None:
            return
        body, nodes, weights, diagonal = self._held
        self._sim.drag(body, nodes, weights, target, strength * self._sim.scene.body(body).mass * EARTH / diagonal)

    def release(self) -> None:
        """End the drag."""
        self._held = None
        self._sim.release()

    # --- solver -------------------------------------------------------------------------------------------------------

    def rebuild(self, integrator: str, contact_solver: str) -> str:
        """Switch to an integrator and contact solver, with the requested dt or the largest stable one; return a sentence."""
        sim, dt = self._sim, self._requested_dt
        if contact_solver not in contact_solvers(integrator):
            contact_solver = "auto"
        if integrator in EXPLICIT:
            dt = min(dt, SAFETY * stable_dt(sim.scene, integrator == "velocity_verlet"))
        sim.rebuild(dt=dt, integrator=integrator, contact_solver=contact_solver)
        lowered = f"; dt is {dt:.3g} s, since {self._requested_dt:.3g} s is not stable" if dt < self._requested_dt else ""
        return f"{integrator} is in use{lowered}"


def touching_pairs(sim) -> list[tuple[str, str]]:
    """Return the names of the pairs between which there is friction."""
    bodies = [body.name for body in sim.scene.bodies]
    if not sim.plan.on["contact_forces"]:
        return []
    names = [collider.name for collider in sim.scene.colliders]
    pairs = [pair for pair in itertools.combinations(names, 2) if pair[0] in bodies]
    return pairs + ([(name, name) for name in bodies] if sim.settings.self_collision else [])
