"""Settings of a simulation: names, defaults and allowed values, checked before anything is allocated."""

import dataclasses

from taisoft.attributes import guarded_record
from taisoft.contact import SOLVERS as EXPLICIT_CONTACT
from taisoft.dynamics.schemes import CHOICES, EXPLICIT, STATIC, is_multistep, takes_contacts
from taisoft.errors import SceneError, SimulationError, reworded
from taisoft.scene import checks
from taisoft.scene.holding import check_held
from taisoft.scene.plan import Plan, make_plan
from taisoft.scene.scene import Scene

IMPLICIT_CONTACT = ("augmented_lagrangian",)
# Integrators that can keep the volume of a cavity or the length of a tendon: others fix the forces before the end of a step
WITH_MULTIPLIERS = ("implicit_euler", "bdf2")
CONTACT_SOLVERS = ("auto", *EXPLICIT_CONTACT, *IMPLICIT_CONTACT)


@guarded_record("settings", "call sim.rebuild({name}=...)", eq=True)
class Settings:
    """Arguments of a Simulator besides the scene; tolerances are relative, None is the default or adaptive."""

    dt: float = 1 / 60  # [s]
    integrator: str = "implicit_euler"
    contact_solver: str = "auto"
    self_collision: bool = False
    precision: str = "f32"
    arch: str = "cpu"
    allow_unstable: bool = False
    newton_tolerance: float | None = None
    linear_tolerance: float | None = None
    contact_tolerance: float | None = None
    draggable: bool = False
    tolerance: float | None = None  # of a run's positions, over the largest excursion
    ramp: float | None = None  # [s] in which constant loads and gravity grow from 0; of statics only
    budget: float | None = None  # [s] of wall time for an implicit step in time
    sleep: bool = True  # whether implicit steps leave out bodies at rest; not with a tolerance

    @property
    def explicit(self) -> bool:
        """Whether the integrator is explicit."""
        return self.integrator in EXPLICIT

    @property
    def sleeps(self) -> bool:
        """Whether bodies may sleep where the integrator and the scene allow it."""
        return self.sleep and self.tolerance is None

    @property
    def static(self) -> bool:
        """Whether steps are load steps, without inertia."""
        return self.integrator == STATIC


NAMES = tuple(field.name for field in dataclasses.fields(Settings))
TOLERANCES = ("newton_tolerance", "linear_tolerance", "contact_tolerance")
FIXED = ("dt", "budget", "precision", "arch")  # settings that `Simulator.rebuild` is not for: assigned, or never changed


def check_settings(scene: Scene, **given) -> Settings:
    """Check every argument of a Simulator. Raises SceneError or SimulationError."""
    checks.instance(scene, "scene", Scene)
    if not scene.bodies:
        raise SceneError("the scene holds no body")
    scene.check()
    settings = Settings(**given | {"dt": check_dt(given.get("dt", Settings.dt))})
    with reworded(SceneError, raised=SimulationError):
        checks.check_solver(**dataclasses.asdict(settings))
        checks.choice(settings.integrator, "integrator", CHOICES)
        checks.choice(settings.contact_solver, "contact_solver", CONTACT_SOLVERS)
    given = {name: value for name in (*TOLERANCES, "tolerance") if (value := getattr(settings, name)) is not None}
    settings = dataclasses.replace(settings, **{name: float(value) for name, value in given.items()})
    _check_contact_solver(settings, scene.pushes(settings.self_collision))
    _check_multipliers(settings, scene)
    if settings.tolerance is not None:
        refuse_robots(scene, "tolerance")
    return _check_static(check_budget(settings), scene)


def refuse_robots(scene: Scene, what: str) -> None:
    """Raise SimulationError if there are robots, where motion has to be known ahead. what: what asks for that."""
    for robot in scene.robots:
        raise SimulationError(f"{what}: the motion of robot {robot.name!r} depends on forces and is not known ahead")


def plan_of(scene: Scene, integrator: str, self_collision: bool, draggable: bool, sleep: bool = True) -> Plan:
    """Return the plan of a scene under an integrator, with the laws and the damping that its rigid bodies take on in a run."""
    plan = make_plan(scene.snapshot(), integrator in EXPLICIT, is_multistep(integrator), self_collision, draggable, sleep)
    return plan.without_rates() if integrator == STATIC else plan


def contact_solvers(integrator: str) -> tuple[str, ...]:
    """Return the contact solvers that an integrator supports, besides "auto"."""
    return () if not takes_contacts(integrator) else EXPLICIT_CONTACT if integrator in EXPLICIT else IMPLICIT_CONTACT


def check_dt(dt) -> float:
    """Return dt as a float; SimulationError unless it is a finite number above 0."""
    return checks.number(dt, "dt", above=0.0, unit="s", error=SimulationError)


def check_budget(settings: Settings) -> Settings:
    """Return the settings with the budget as a float. Raises SimulationError unless it is at least 0, and without a tolerance."""
    if settings.budget is None:
        return settings
    if settings.tolerance is not None:
        raise SimulationError("a budget ends steps at any error, and a tolerance bounds the error: take one of them")
    return dataclasses.replace(
        settings, budget=checks.number(settings.budget, "budget", minimum=0.0, unit="s", error=SimulationError)
    )


def kept_by_multipliers(scene: Scene) -> list[str]:
    """Describe what only integrators in WITH_MULTIPLIERS keep: given volumes of cavities, and lengths of inextensible tendons."""
    cavities = [cavity for body in scene.bodies for cavity in body.cavities if cavity.given == "volume"]
    tendons = [tendon for tendon in scene.tendons if tendon.is_inextensible]
    return [f"cavity {one.name!r} of given volume" for one in cavities] + [
        f"tendon {one.name!r} of given length without a stiffness" for one in tendons
    ]


def _check_static(settings: Settings, scene: Scene) -> Settings:
    """Return the settings with the ramp of statics. Raises SceneError or SimulationError."""
    if not settings.static:
        if settings.ramp is not None:
            raise SimulationError(f"ramp needs integrator {STATIC!r}")
        return settings
    if settings.tolerance is not None:
        raise SimulationError(f"tolerance chooses steps in time, and integrator {STATIC!r} takes load steps: use error=True")
    refuse_robots(scene, f"integrator {STATIC!r}")
    if not scene.pushes(settings.self_collision):
        check_held(scene)
    return dataclasses.replace(settings, ramp=float(settings.ramp or settings.dt))


def _check_multipliers(settings: Settings, scene: Scene) -> None:
    """Raise SimulationError unless the integrator can keep given volumes and lengths."""
    given = kept_by_multipliers(scene)
    if given and (settings.integrator not in (*WITH_MULTIPLIERS, STATIC) or settings.tolerance is not None):
        instead = " or ".join(WITH_MULTIPLIERS)
        raise SimulationError(f"{given[0]} needs integrator {instead}, without a tolerance of the run")


def _check_contact_solver(settings: Settings, touching: bool) -> None:
    """Raise SimulationError unless the integrator supports the contact solver. touching: whether anything can touch."""
    integrator, solver = settings.integrator, settings.contact_solver
    supported = contact_solvers(integrator)
    if touching and not supported:
        raise SimulationError(
            f"{integrator} does not support contacts: its stage lies in the middle of the step, where a contact condition that "
            "holds at the end need not hold; use bdf2, which is also second-order, or implicit_euler"
        )
    if solver not in ("auto", *supported):
        instead = " or ".join(("'auto'", *supported))
        raise SimulationError(f"contact_solver {solver!r} does not fit {integrator}: use {instead}")
