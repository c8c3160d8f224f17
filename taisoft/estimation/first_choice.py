"""Settings of a simulator with a tolerance, before its first run: what is likely to meet it, without trials."""

import dataclasses
import math

from taisoft.errors import SimulationError
from taisoft.estimation.costs import explicit_step, implicit_step
from taisoft.scene.scene import Scene
from taisoft.settings import Settings
from taisoft.stability import stable_dt

EXPLICIT, IMPLICIT = "velocity_verlet", "bdf2"
STABLE_FRACTION = 0.9  # of the stable step
LIKELY_FRAME = 1 / 60  # [s]; runs have their own
SOLVERS = {"newton_tolerance": (0.05, 2e-3), "contact_tolerance": (0.1, 5e-4)}  # over the tolerance, and at most
TIGHTEST = {"f32": 1e-4, "f64": 1e-7}  # tolerances above the errors of rounding


def settings_for(scene: Scene, settings: Settings) -> tuple[Settings, float | None]:
    """Settings with a tolerance, completed: those that are None, and the integrator and dt where the integrator is the default.

    Also return the stable step of an explicit integrator that was chosen [s], else None. Raises SimulationError for a tolerance
    that the precision cannot meet, or a contact solver that is given.
    """
    least = TIGHTEST[settings.precision]
    if settings.tolerance < least:
        instead = ", or precision='f64'" if settings.precision == "f32" else ""
        raise SimulationError(
            f"tolerance = {settings.tolerance:g}: in {settings.precision} it must be at least {least:g}{instead}"
        )
    if settings.contact_solver != "auto":
        given = settings.contact_solver
        raise SimulationError(f"contact_solver {given!r}: with a tolerance it must be 'auto', since run() chooses the integrator")
    found, limit = {}, None
    for name, (fraction, most) in SOLVERS.items():
        value, loosest = getattr(settings, name), min(most, fraction * settings.tolerance)
        if value is None:
            found[name] = loosest
        elif value > loosest * (1.0 + 1e-9):
            raise SimulationError(f"{name} = {value:g}: with tolerance = {settings.tolerance:g} it must be at most {loosest:g}")
    if settings.integrator == Settings.integrator:
        touches = scene.pushes(settings.self_collision)
        stable = stable_dt(scene, verlet=True)
        steps = stable_steps(stable, LIKELY_FRAME)
        if steps * explicit_step(scene, touches) <= implicit_step(scene, touches):
            found |= {"integrator": EXPLICIT, "dt": LIKELY_FRAME / steps}
            limit = stable
        else:
            found |= {"integrator": IMPLICIT, "dt": LIKELY_FRAME}
    return dataclasses.replace(settings, **found), limit


def stable_steps(limit: float, seconds: float) -> int:
    """Explicit steps in a time [s], at least. limit: the stable step [s], which may be infinite."""
    return max(1, math.ceil(seconds / (STABLE_FRACTION * limit) - 1e-9)) if math.isfinite(limit) else 1
