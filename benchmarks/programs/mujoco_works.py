"""MuJoCo's flex on the works: what mujoco_flex.py says of the beam, for several bodies, with contact and with a second law.

Laws: St. Venant and Kirchhoff's, of which much is squeezed inside out when W2's cube lands; and, by "discrete" alone and by
MjSpec alone (`elastic3d`), one that MuJoCo calls simplified stable neo-Hookean: SNH13 of works.semi_discrete, to 1e-13.

Contact, where W2 to W4 have it:

* rows of the constraint solver, a spring and damper with friction, whose time constant `solref` may not be below two steps of
  "euler" (nor one of "discrete"). Newton's method is faster in explicit steps, CG in implicit ones of tets;
* `passive`, a penalty that "discrete" integrates implicitly, with no friction and of a stiffness that MuJoCo sets from dt;
* `ipc`, by MuJoCo's words for flexes of dim 2 only; one row shows what it does for tets.

All vertices of a flex meet the ground, also inner ones; two flexes meet by triangles, `radius` [m] thick.
"""

import warnings
from time import perf_counter

import numpy as np

from taisoft.errors import SimulationError

from ..exact_path import SAMPLE
from ..works.references import MUJOCO, NEWTON, Model, masses
from ..works.scenes import Work
from .mujoco_flex import FALSE_ALARM, STABLE_STEPS, SWITCHED_OFF, TOLERANCE, add_flex, import_mujoco, quiet_warnings
from .session import Setting, sampled

NAME, MODEL = "MuJoCo", MUJOCO
NEO_HOOKEAN = NEWTON  # the same law and masses as Newton's vertex block descent
CONTACT = ("CONSTRAINT", "CONTACT", "MIDPHASE", "WARMSTART", "REFSAFE", "ISLAND")  # what contact needs of SWITCHED_OFF
INERTIA = 0  # the warning that a matrix is nearly singular, as those of thin flexes are: it goes on, and well
ITERATIONS = 400  # of the implicit step: 100, the default, end before TOLERANCE in contact
RADIUS = 1e-4  # of a flex [m] where no work needs more; surfaces of two rest twice that far apart
STIFF_STEPS = {1e8: (20, 15), 1e9: (62, 45)}  # of the coarse beam: about the least that Euler and RK4 bear
INTEGRATORS = {"rk4": "RK4", "discrete": "DISCRETE", "implicitfast": "IMPLICITFAST"}  # others are EULER


def problem() -> str:
    """Why it cannot be had."""
    try:
        import_mujoco()
    except SimulationError as error:
        return str(error)
    return ""


def settings(work: Work, arch: str = "cpu") -> list[Setting]:
    """Explicit steps at the largest stable dt and finer, implicit ones ("discrete"); with contact rows and passive ones."""
    if work.cells is not None:
        return _of_beam(work)
    if work.kind == "path":
        explicit, thick, alike = ((4, 4), (10, 2)), {1: RADIUS, 2: RADIUS, 4: RADIUS, 10: RADIUS}, 4
    elif work.ground:
        explicit, thick, alike = ((10, 2),), {1: 5e-4, 4: 5e-4, 8: 5e-4, 10: 5e-4}, 4
    else:
        explicit, thick, alike = ((20, 2),), {1: 2.5e-3, 3: 2.5e-3, 4: 2.5e-3, 10: 1e-3}, 4
    rows = (1, 2, 4) if work.kind == "path" else (4, 10)
    found = [_rows(MODEL, "euler_staggered", steps, constant, RADIUS) for steps, constant in explicit]
    found.append(_rows(MODEL, "discrete", 2, 2, RADIUS))
    found += [_rows(NEO_HOOKEAN, "discrete", steps, 1, thick[steps]) for steps in rows]
    found += [_passive(NEO_HOOKEAN, steps, radius) for steps, radius in thick.items()]
    found.append(_passive(MODEL, alike, thick[alike]))
    if work.key == "W4":
        found.append(_rows(NEO_HOOKEAN, "discrete", alike, 1, thick[alike], {"solver": "Newton"}))
        found.append(Setting(NAME, NEO_HOOKEAN, "discrete", alike, {"ipc": True, "radius": thick[alike]}))
    return found


def _rows(model: Model, method: str, steps: int, constant: float, radius: float, more: dict | None = None) -> Setting:
    """constant: the time constant in steps."""
    return Setting(NAME, model, method, steps, {"solref": constant * SAMPLE / steps, "radius": radius} | (more or {}))


def _passive(model: Model, steps: int, radius: float) -> Setting:
    return Setting(NAME, model, "discrete", steps, {"passive": True, "radius": radius})


def _of_beam(work: Work) -> list[Setting]:
    euler, rk4 = STIFF_STEPS[work.bodies[0].young] if work.stiff else STABLE_STEPS[work.cells]
    large = work.tets > 10_000
    finer = (1,) if work.stiff or large else (1, 2, 4, 11)
    found = [Setting(NAME, MODEL, "euler_staggered", k * euler) for k in finer] + [Setting(NAME, MODEL, "rk4", rk4)]
    implicit = (1,) if large else (1, 4)
    found += [Setting(NAME, model, "discrete", k) for model in (MODEL, NEO_HOOKEAN) for k in implicit]
    if work.cells == min(STABLE_STEPS) and not work.stiff:
        found.append(Setting(NAME, MODEL, "implicitfast", 1))  # it is refused: the page says in which words
    return found


class Run:
    """A Session."""

    unconverged = 0  # it does not tell

    def __init__(self, work: Work, setting: Setting) -> None:
        self.mujoco, self.work, self.setting = import_mujoco(), work, setting
        start = perf_counter()
        spec = self.mujoco.MjSpec()
        self._options(spec)
        self.free = np.concatenate([~body.fixed for body in work.bodies])
        mass, nodes = masses(work, setting.model), work.slices()
        contact = self._contact()
        if work.ground:
            turned = [np.sqrt(0.5), -np.sqrt(0.5), 0, 0]  # its normal is its z
            spec.worldbody.add_geom(type=self.mujoco.mjtGeom.mjGEOM_PLANE, size=[10, 10, 0.1], quat=turned, **contact)
        of_flex = {"radius": setting.options.get("radius", RADIUS), "passive": int(setting.options.get("passive", False))}
        for body in work.bodies:
            kg = mass[nodes[body.name]]
            add_flex(
                self.mujoco,
                spec,
                body.name,
                body.mesh.vertices,
                body.mesh.tets,
                kg,
                ~body.fixed,
                body.young,
                elastic3d=int(setting.model == NEO_HOOKEAN),
                **of_flex,
                **contact,
            )
        with warnings.catch_warnings():
            warnings.filterwarnings("ignore", message=FALSE_ALARM.replace("beam", ".*"))
            self.model = spec.compile()
        self.build_seconds = perf_counter() - start

    def _options(self, spec) -> None:
        mujoco, method, options = self.mujoco, self.setting.method, self.setting.options
        spec.option.timestep, spec.option.gravity = self.setting.dt, (0.0, -self.work.gravity, 0.0)
        explicit = method not in ("discrete", "implicitfast")
        spec.option.tolerance = 1e-8 if self.work.touches and explicit else TOLERANCE
        if not explicit:
            spec.option.iterations = ITERATIONS
        solver = options.get("solver", "Newton" if self.work.touches and explicit else "CG")
        spec.option.solver = getattr(mujoco.mjtSolver, f"mjSOL_{solver.upper()}")
        spec.option.cone = mujoco.mjtCone.mjCONE_ELLIPTIC
        spec.option.integrator = getattr(mujoco.mjtIntegrator, "mjINT_" + INTEGRATORS.get(method, "EULER"))
        off = [name for name in SWITCHED_OFF if not (self.work.touches and name in CONTACT)]
        spec.option.disableflags = sum(int(getattr(mujoco.mjtDisableBit, "mjDSBL_" + name)) for name in off)
        if options.get("ipc"):
            spec.option.enableflags = int(mujoco.mjtEnableBit.mjENBL_IPC)

    def _contact(self) -> dict:
        if not self.work.touches:
            return {"contype": 0, "conaffinity": 0}
        rows = {"solref": [self.setting.options["solref"], 1.0]} if "solref" in self.setting.options else {}
        return {"friction": [self.work.friction, 0, 0]} | rows

    def run(self, follow: bool) -> tuple[np.ndarray | None, float]:
        mujoco, start, data = self.mujoco, self.work.start, self.mujoco.MjData(self.model)
        if self.setting.method == "euler_staggered":
            data.qvel[1::3] = self.work.gravity * self.setting.dt / 2  # -a(0) dt/2: at rest gravity alone accelerates

        def positions() -> np.ndarray:
            told = [mujoco.mjtWarning(k).name for k, one in enumerate(data.warning) if one.number and k != INERTIA]
            if told:
                raise SimulationError(f"{NAME} gives up before t = {data.time:.2f} s: {', '.join(told)}")
            now = start.copy()
            now[self.free] += data.qpos.reshape(-1, 3)
            return now

        with quiet_warnings(mujoco):
            steps = self.setting.steps
            return sampled(self.work, NAME, follow, lambda: mujoco.mj_step(self.model, data, nstep=steps), positions)

    def close(self) -> None:
        """Nothing is held."""


def start(work: Work, setting: Setting) -> Run:
    """Ready to run."""
    return Run(work, setting)
