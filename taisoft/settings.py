"""Settings of a simulation, checked before anything is allocated."""

import difflib
from dataclasses import dataclass

import numpy as np

from taisoft.attributes import guarded_record
from taisoft.contact import SOLVERS
from taisoft.dynamics import EXPLICIT, INTEGRATORS, scheme_of
from taisoft.errors import SceneError, SimulationError
from taisoft.scene import checks
from taisoft.scene.checks import MAX_TOLERANCE
from taisoft.scene.plan import Plan, make_plan
from taisoft.scene.scene import Scene

EXPLICIT_CONTACT = SOLVERS
IMPLICIT_CONTACT = ("augmented_lagrangian",)


@guarded_record("settings", "call sim.rebuild({name}=...)")
@dataclass(frozen=True)
class Settings:
    """Requested settings of a Simulator; tolerances are relative, None is adaptive."""

    dt: float  # [s]
    integrator: str
    precision: str
    arch: str
    allow_unstable: bool
    self_collision: bool
    newton_tolerance: float | None
    linear_tolerance: float | None
    contact_solver: str
    contact_tolerance: float | None
    draggable: bool = False

    @property
    def explicit(self) -> bool:
        """Whether the integrator is explicit."""
        return self.integrator in EXPLICIT


def plan_of(scene: Scene, integrator: str, self_collision: bool, draggable: bool) -> Plan:
    """Return the plan of a scene under an integrator."""
    explicit = integrator in EXPLICIT
    return make_plan(scene, explicit, not explicit and scheme_of(integrator).before > 0.0, self_collision, draggable)


def check_dt(dt) -> float:
    """Return dt as a float; SimulationError unless it is a finite number above 0."""
    return check_positive("dt", dt, "s")


def check_positive(name: str, value, unit: str) -> float:
    """Return value as a float; SimulationError unless it is a finite number above 0."""
    try:
        return checks.number(value, name, above=0.0, unit=unit)
    except SceneError as error:
        raise SimulationError(str(error)) from None


def check_count(name: str, value) -> int:
    """Return value as an int; SimulationError unless it is an integer of at least 1."""
    if isinstance(value, (bool, np.bool_)) or not isinstance(value, (int, np.integer)) or value < 1:
        raise SimulationError(f"{name} must be an integer of at least 1, not {value!r}")
    return int(value)


def _check_tolerance(name: str, value) -> None:
    if value is None:
        return
    below = MAX_TOLERANCE.get(name, 1.0)
    if isinstance(value, bool) or not isinstance(value, (int, float)) or not 0.0 < value < below:
        raise SimulationError(f"{name} = {value!r}: it must lie between 0 and {below:g}, or be None for an adaptive one")


def contact_solvers(integrator: str) -> tuple[str, ...]:
    """Return the contact solvers that an integrator supports, besides "auto"."""
    return EXPLICIT_CONTACT if integrator in EXPLICIT else () if integrator == "implicit_midpoint" else IMPLICIT_CONTACT


def _check_contact_solver(integrator: str, solver: str, touching: bool) -> None:
    """Raise SimulationError unless the integrator supports the contact solver. touching: whether anything can touch."""
    supported = contact_solvers(integrator)
    known = ("auto", *EXPLICIT_CONTACT, *IMPLICIT_CONTACT)
    if solver not in known:
        near = difflib.get_close_matches(str(solver), known, 1)
        hint = f" (did you mean '{near[0]}'?)" if near else ""
        raise SimulationError(f"contact_solver {solver!r} is unknown{hint}: it must be one of {', '.join(known)}")
    if touching and not supported:
        raise SimulationError(
            f"{integrator} does not support contacts: its stage lies in the middle of the step, where a contact condition that "
            "holds at the end need not hold; use bdf2, which is also second-order, or implicit_euler"
        )
    if solver != "auto" and solver not in supported:
        instead = " or ".join(("'auto'", *supported))
        raise SimulationError(f"contact_solver {solver!r} does not fit {integrator}: use {instead}")


def check_settings(
    scene: Scene,
    dt,
    integrator,
    contact_solver,
    self_collision,
    precision,
    arch,
    allow_unstable,
    newton_tolerance,
    linear_tolerance,
    contact_tolerance,
    draggable,
) -> Settings:
    """Check every argument of a Simulator. Raises SceneError or SimulationError."""
    if not isinstance(scene, Scene):
        raise SceneError(f"scene must be a Scene, not {type(scene).__name__}")
    if not scene.bodies:
        raise SceneError("the scene holds no body")
    scene.check()
    if integrator not in INTEGRATORS:
        near = difflib.get_close_matches(str(integrator), INTEGRATORS, 1)
        hint = f" (did you mean '{near[0]}'?)" if near else ""
        raise SimulationError(f"integrator {integrator!r} is unknown{hint}: it must be one of {', '.join(INTEGRATORS)}")
    if not isinstance(self_collision, bool):
        raise SimulationError(f"self_collision = {self_collision!r}: it must be True or False")
    _check_tolerance("contact_tolerance", contact_tolerance)
    _check_contact_solver(integrator, contact_solver, scene.pushes(self_collision))
    if not isinstance(allow_unstable, bool):
        raise SimulationError(f"allow_unstable = {allow_unstable!r}: it must be True or False")
    if not isinstance(draggable, bool):
        raise SimulationError(f"draggable = {draggable!r}: it must be True or False")
    _check_tolerance("newton_tolerance", newton_tolerance)
    _check_tolerance("linear_tolerance", linear_tolerance)
    if precision not in ("f32", "f64"):
        raise SimulationError(f"precision {precision!r} is unknown: it must be 'f32' or 'f64'")
    if arch not in ("cpu", "cuda"):
        raise SimulationError(f"arch {arch!r} is unknown: it must be 'cpu' or 'cuda'")
    return Settings(
        check_dt(dt),
        integrator,
        precision,
        arch,
        allow_unstable,
        self_collision,
        newton_tolerance,
        linear_tolerance,
        contact_solver,
        contact_tolerance,
        draggable,
    )
