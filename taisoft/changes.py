"""Changes of a running simulation by its user: each function is a method of `Simulator`, whose class body lists them."""

import dataclasses
import warnings
from typing import TYPE_CHECKING

from taisoft.attributes import thawed
from taisoft.errors import SceneError, SimulationError
from taisoft.queries import body_index, check_rows, nodes_of
from taisoft.scene.body_loads import activate_fibres
from taisoft.scene.connections import check_exact
from taisoft.scene.plan import CHANGEABLE, change_load, change_material, change_tendon
from taisoft.settings import FIXED, NAMES, check_budget, check_dt

if TYPE_CHECKING:
    from taisoft.simulator import Simulator

INSTEAD = {  # what to do instead of assigning to an attribute that a simulator has or might be expected to have
    **{name: f"call sim.set_material(body, {name}=...)" for name in CHANGEABLE},
    **dict.fromkeys(("activation", "activations"), "call sim.set_activation(body, value)"),
    **{name: f"call sim.set_contact(name_a, name_b, {name}=...)" for name in ("friction", "restitution")},
    **{name: f"call sim.set_state({name}=...)" for name in ("positions", "velocities")},
    **{name: f"call sim.rebuild({name}=...)" for name in NAMES if name not in FIXED},
    **dict.fromkeys(("force", "forces"), "call sim.set_force(body, index, value)"),
    **dict.fromkeys(("traction", "tractions"), "call sim.set_traction(body, index, value)"),
    "tension": "call sim.set_tension(name, force)",
    "tendons": "call sim.set_tension(name, force) or sim.set_length(name, length)",
    "length": "call sim.set_length(name, length)",
    **dict.fromkeys(("pressure", "pressures"), "call sim.set_pressure(body, index, value)"),
    **dict.fromkeys(("time", "step_count"), "call sim.reset() to go back to the start"),
    **dict.fromkeys(("arch", "precision"), "make a new Simulator"),
    **dict.fromkeys(("cavity", "cavities"), "call sim.set_cavity(name, value)"),
    "gravity": "call sim.set_gravity(gravity)",
    "material": "call sim.set_material(body, young=...)",
    **dict.fromkeys(("pose", "poses"), "call sim.set_pose(name, translation, rotation)"),
    **dict.fromkeys(("displacement", "displacements"), "call sim.set_displacement(body, index, value)"),
    "scene": "make a new Simulator of the other scene",
    "settings": "call sim.rebuild(integrator=...)",
    "plan": "it follows from the scene and the settings",
    "stable_dt": "it follows from the scene; set sim.dt",
    "dragged": "call sim.drag(...) or sim.release()",
}


def dt(self: "Simulator") -> float:
    """Time step [s]; a new value takes effect with the next step."""
    return self._dynamics.dt


def set_dt(self: "Simulator", value: float) -> None:
    """Set dt."""
    value = check_dt(value)
    if value == self.dt:
        return
    check_stability(self, value, stacklevel=4)
    self._host().set_dt(value)


def budget(self: "Simulator") -> float | None:
    """Wall time for an implicit step in time [s], None: any; a new value takes effect with the next step."""
    return self.settings.budget


def set_budget(self: "Simulator", value: float | None) -> None:
    """Set the budget."""
    self.__dict__["settings"] = check_budget(dataclasses.replace(self.settings, budget=value))
    self._host().state.budget = self.settings.budget


def check_stability(sim: "Simulator", dt: float, stacklevel: int = 3) -> None:
    """Refuse a dt [s] above the limit of an explicit integrator, or warn if the settings allow it."""
    settings = sim.settings
    if not settings.explicit or dt <= sim.stable_dt:
        return
    limit = sim.stable_dt
    text = f"dt = {dt:.3g} s is above the estimated stability limit of {limit:.3g} s of {settings.integrator}"
    if not settings.allow_unstable:
        raise SimulationError(f"{text}: take a smaller dt (0.7 of the limit is {0.7 * limit:.3g} s) or allow_unstable=True")
    warnings.warn(text, stacklevel=stacklevel)


def reset(self: "Simulator") -> None:
    """Restore the scene's initial state and its paths, without commands; changed numbers (dt, gravity, materials, loads) stay.

    Compiles nothing.
    """
    self._open().reset()


def set_state(self: "Simulator", positions=None, velocities=None, body: str | None = None) -> None:
    """Set positions [m] and velocities [m/s], (n_nodes, 3) each. Velocities on constrained axes become 0.

    Nodes that are attached exactly follow the other body's. Maxwell branches are strained at once, as by a sudden motion. Copies
    arrays; compiles nothing.
    """
    dynamics, rows = self._open(), nodes_of(self, body)
    for name, value in (("positions", positions), ("velocities", velocities)):
        if value is not None:
            check_rows(self, name, value, rows)
    x, v = dynamics.state.state()
    if positions is not None:
        x[rows] = positions
    if velocities is not None:
        v[rows] = velocities
        v[dynamics.state.dirichlet.constrained()] = 0.0
    dynamics.state.set_state(x, v)
    dynamics.state.move_branches(0.0)
    dynamics.state_changed()


def set_gravity(self: "Simulator", gravity) -> None:
    """Change gravity (3,) [m/s^2]. Recomputes the rounding floor of the residual; compiles nothing."""
    dynamics = self._open()
    with thawed(self.scene):
        self.scene.gravity = gravity
    dynamics.state.upload_gravity()
    dynamics.numbers_changed()


def set_material(self: "Simulator", body: str, region: int | str | None = None, **numbers) -> None:
    """Change numbers of a body's material (young and poisson or parameters of the law, density, damping, fibres); the law stays.

    Without a region they hold for all tets; those of the law and the density may also be (m,), the former only if they were
    given by tet or by region when the Simulator was made. With a region, given by name or id, they change there only; damping
    cannot.
    Copies arrays and recomputes the rounding floor of the residual and the stable dt; compiles nothing.
    """
    dynamics, changed = self._open(), self.scene.bodies[body_index(self, body)]
    old, old_limit = changed.composition, self._stable_dt
    change_material(changed, numbers, self.plan.on, region)
    self._stable_dt = None
    try:
        check_exact(self.scene)
        check_stability(self, self.dt)
    except (SceneError, SimulationError):
        with thawed(changed):
            changed.composition, self._stable_dt = old, old_limit
        raise
    dynamics.state.upload_material("density" in numbers)
    if "density" in numbers:  # total forces are spread by mass
        dynamics.state.loads_changed()
    dynamics.numbers_changed()


def set_contact(
    self: "Simulator", name_a: str, name_b: str, friction: float | None = None, restitution: float | None = None
) -> None:
    """Change the friction or restitution between two bodies, or a body and an obstacle; see `Scene.set_contact`."""
    dynamics = self._open()
    with thawed(self.scene):
        self.scene.set_contact(name_a, name_b, friction=friction, restitution=restitution)
    dynamics.changes += 1
    dynamics.stepper.wake()
    if dynamics.contact is not None:
        dynamics.contact.numbers_changed()


def set_load(self: "Simulator", body: str, kind: str, index: int, value) -> None:
    """Change the value of a load added by `body.add_load`, or by the call for its kind, from the next step on.

    index: from 0 in the order in which loads of this kind were added to the body. value: as given there; it replaces a path.
    Raises SceneError if there is no such load or the value is invalid.
    """
    dynamics, changed = self._open(), self.scene.bodies[body_index(self, body)]
    change_load(changed, kind, index, value)
    dynamics.loads_changed(changed.name)


def set_force(self: "Simulator", body: str, index: int, value) -> None:
    """Change a force added by `body.add_force`; index and errors as for `set_load`.

    value: total (3,), or (k,3) with one row per node [N]; it replaces a path.
    """
    self.set_load(body, "force", index, value)


def set_traction(self: "Simulator", body: str, index: int, value) -> None:
    """Change a traction added by `body.add_traction`; index and errors as for `set_load`.

    value: (3,) per reference area [Pa]; it replaces a path.
    """
    self.set_load(body, "traction", index, value)


def set_tension(self: "Simulator", name: str, value: float) -> None:
    """Change the tension [N] of a tendon of given force, from the next step on; it replaces a path. `stable_dt` stays.

    Raises SceneError.
    """
    _set_tendon(self, "force", name, value)


def set_length(self: "Simulator", name: str, value: float) -> None:
    """Change the length at rest [m] of a tendon of given length, from the next step on; it replaces a path.

    Raises SceneError.
    """
    _set_tendon(self, "length", name, value)


def _set_tendon(sim: "Simulator", given: str, name: str, value: float) -> None:
    dynamics = sim._open()
    change_tendon(sim.scene, given, name, value)
    dynamics.loads_changed(*next(tendon for tendon in sim.scene.tendons if tendon.name == name).owners)


def set_pressure(self: "Simulator", body: str, index: int, value: float) -> None:
    """Change a pressure added by `body.add_pressure`; index and errors as for `set_load`.

    value: a number [Pa]; it replaces a path.
    """
    self.set_load(body, "pressure", index, value)


def set_cavity(self: "Simulator", name: str, value: float) -> None:
    """Change the pressure [Pa] in a cavity, or its volume [m^3], whichever was given, from the next step on; replaces a path.

    Raises SceneError if there is no cavity of this name or the value is invalid.
    """
    body, cavity = self.scene.cavity(name)
    self.set_load(body.name, "cavity", body.cavities.index(cavity), value)


def set_activation(self: "Simulator", body: str, value: float, region: int | str | None = None) -> None:
    """Change the activation, from 0 to 1, of a body's fibres, or of those in one region of its mesh, from the next step on.

    It replaces a path. Raises SceneError if the body has no fibres, or the region or the value is invalid.
    """
    dynamics, changed = self._open(), self.scene.bodies[body_index(self, body)]
    what = f"body {changed.name!r}: set_activation"
    if callable(value):
        raise SceneError(f"{what}: it must be a number: give body.activate a path before the Simulator is made")
    activate_fibres(changed, value, region, what)
    dynamics.loads_changed(changed.name)


def drag(self: "Simulator", body: str, nodes, weights, target, stiffness: float) -> None:
    """Pull a point of a body towards target (3,) [m] by a damped spring; replaces an earlier drag.

    The point is the mean of nodes (k,) with weights (k,), which are normalized to sum to 1; stiffness [N/m]. The force is
    evaluated at the start of every step. `taisoft.dynamics.drag_spring` limits stiffness and force; `dragged` holds both.
    Raises SimulationError unless the Simulator was made with draggable=True, SceneError for an invalid point of the body.
    """
    spring = self._open().drag_spring
    if spring is None:
        raise SimulationError("bodies can be dragged only if the Simulator was made with draggable=True")
    spring.take(body_index(self, body), nodes, weights, target, stiffness)


def release(self: "Simulator") -> None:
    """End the drag; does nothing if nothing is dragged."""
    self._open().end_drag()
