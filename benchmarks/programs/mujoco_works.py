"""MuJoCo's flex on the works: what mujoco_flex.py says of the beam, for several bodies, and with contact.

Its contact is a spring and damper, whose time constant `solref` may not be below two steps. All vertices of a flex meet the
ground, also inner ones; two flexes meet by triangles. St. Venant-Kirchhoff material, of which much is squeezed inside out when
W2's cube lands.
"""

import warnings
from time import perf_counter

import numpy as np

from taisoft.errors import SimulationError

from ..exact_path import SAMPLE
from ..works.references import MUJOCO, masses
from ..works.scenes import Work
from .mujoco_flex import FALSE_ALARM, STABLE_STEPS, SWITCHED_OFF, TOLERANCE, add_flex, import_mujoco, quiet_warnings
from .session import Setting, sampled

NAME, MODEL = "MuJoCo", MUJOCO
CONTACT = ("CONSTRAINT", "CONTACT", "MIDPHASE", "WARMSTART", "REFSAFE", "ISLAND")  # what contact needs of SWITCHED_OFF
INERTIA = 0  # the warning that a matrix is nearly singular, as those of thin flexes are: it goes on, and well
RADIUS = 1e-4  # of a flex [m]; surfaces rest that far apart
STIFF_STEPS = {1e8: (20, 15), 1e9: (62, 45)}  # of the coarse beam: about the least that Euler and RK4 bear


def problem() -> str:
    """Why it cannot be had."""
    try:
        import_mujoco()
    except SimulationError as error:
        return str(error)
    return ""


def settings(work: Work, arch: str = "cpu") -> list[Setting]:
    """Explicit steps at the largest stable dt and finer, implicit ones ("discrete"); with contact its time constants."""
    if work.cells is not None:
        return _of_beam(work)
    found = []
    thin = 5 if work.key == "W4" else 1  # its sheet
    for method, steps, constants in (
        ("euler_staggered", 4 * thin, (2, 4)), ("euler_staggered", 10 * thin, (2,)), ("discrete", 1, (2,)),
        ("discrete", 2, (2, 4)),
    ):  # fmt: skip
        found += [Setting(NAME, MODEL, method, steps, {"solref": constant * SAMPLE / steps}) for constant in constants]
    return found


def _of_beam(work: Work) -> list[Setting]:
    euler, rk4 = STIFF_STEPS[work.bodies[0].young] if work.stiff else STABLE_STEPS[work.cells]
    finer = (1,) if work.stiff else (1, 2, 4, 11)
    found = [Setting(NAME, MODEL, "euler_staggered", k * euler) for k in finer] + [Setting(NAME, MODEL, "rk4", rk4)]
    return found + [Setting(NAME, MODEL, "discrete", k) for k in (1, 4)]


class Run:
    """A Session."""

    unconverged = 0  # it does not tell

    def __init__(self, work: Work, setting: Setting) -> None:
        self.mujoco, self.work, self.setting = import_mujoco(), work, setting
        start = perf_counter()
        spec = self.mujoco.MjSpec()
        self._options(spec)
        self.free = np.concatenate([~body.fixed for body in work.bodies])
        mass, nodes = masses(work, MODEL), work.slices()
        if work.ground:
            turned = [np.sqrt(0.5), -np.sqrt(0.5), 0, 0]  # its normal is its z
            spec.worldbody.add_geom(
                type=self.mujoco.mjtGeom.mjGEOM_PLANE, size=[10, 10, 0.1], quat=turned, **self._contact()
            )
        for body in work.bodies:
            kg = mass[nodes[body.name]]
            add_flex(
                self.mujoco, spec, body.name, body.mesh.vertices, body.mesh.tets, kg, ~body.fixed, body.young, radius=RADIUS,
                **self._contact(),
            )  # fmt: skip
        with warnings.catch_warnings():
            warnings.filterwarnings("ignore", message=FALSE_ALARM.replace("beam", ".*"))
            self.model = spec.compile()
        self.build_seconds = perf_counter() - start

    def _options(self, spec) -> None:
        mujoco, method = self.mujoco, self.setting.method
        spec.option.timestep, spec.option.gravity = self.setting.dt, (0.0, -self.work.gravity, 0.0)
        spec.option.tolerance = TOLERANCE if not self.work.touches else 1e-8
        # Newton's method is faster in explicit steps with contact, and 20 to 40 times slower in implicit ones
        newton = self.work.touches and method != "discrete"
        spec.option.solver = mujoco.mjtSolver.mjSOL_NEWTON if newton else mujoco.mjtSolver.mjSOL_CG
        spec.option.cone = mujoco.mjtCone.mjCONE_ELLIPTIC
        names = {"rk4": "RK4", "discrete": "DISCRETE"}
        spec.option.integrator = getattr(mujoco.mjtIntegrator, "mjINT_" + names.get(method, "EULER"))
        off = [name for name in SWITCHED_OFF if not (self.work.touches and name in CONTACT)]
        spec.option.disableflags = sum(int(getattr(mujoco.mjtDisableBit, "mjDSBL_" + name)) for name in off)

    def _contact(self) -> dict:
        if not self.work.touches:
            return {"contype": 0, "conaffinity": 0}
        return {"friction": [self.work.friction, 0, 0], "solref": [self.setting.options["solref"], 1.0]}

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
