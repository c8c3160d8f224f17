"""MuJoCo's flex on the works: the same vertices, tets and lumped masses as for all programs, undamped.

A flex of dim 3 with elasticity is St. Venant-Kirchhoff on linear tets, of which much is squeezed inside out when W2's cube
lands. Before version 4.0 it used twice the first Lamé parameter, and in 4.0.0 the solver "Newton" factorises the Hessian of a
sparse Jacobian wrongly (4.0.1 mends it), so these are refused. By "discrete" alone and by
MjSpec alone (`elastic3d`) there is a second law, which MuJoCo calls simplified stable neo-Hookean: SNH13 of works.semi_discrete,
to 1e-13. Every free node is a body of the node's mass with three slide joints, every fixed node belongs to the world. All that
a work does not need is switched off.

Elasticity is integrated in two ways (MuJoCo's own names); `implicit` and `implicitfast` refuse a flex with elasticity:
* explicitly by `Euler` (v first, then x with the new v) and `RK4`. Euler's path is of first order in dt only because of
  its start: begun with the velocity of half a step before, v = -a(0) dt/2, the same steps are leapfrog, of second
  order. That costs a user one line and is listed as "euler_staggered";
* implicitly by `discrete`: (M + dt^2 K) a = f - dt K v, one linear solve a step, K kept positive. Without
  constraints, the same iterative solve runs whichever of its solvers is named (equal paths and times were measured).

Contact, where W2 to W4 have it:
* rows of the constraint solver, a spring and damper with friction, whose time constant `solref` may not be below two steps of
  "euler" (nor one of "discrete"). Newton's method is faster in explicit steps, CG in implicit ones of tets;
* `passive`, a penalty that "discrete" integrates implicitly, with no friction and of a stiffness that MuJoCo sets from dt;
* `ipc`, by MuJoCo's words for flexes of dim 2 only; one row shows what it does for tets.
All vertices of a flex meet the ground, also inner ones; two flexes meet by triangles, `radius` [m] thick.
"""

import warnings

import numpy as np

from taisoft.errors import SimulationError
from taisoft.machine import require

from ..exact_path import POISSON, SAMPLE
from ..works.references import MUJOCO, NEWTON, Model, masses
from ..works.scenes import Body, Work
from .session import Session, Setting

NAME, MODEL = "MuJoCo", MUJOCO
NEO_HOOKEAN = NEWTON  # the same law and masses as Newton's vertex block descent
INTEGRATORS = {  # MuJoCo's constants
    "euler": "EULER",
    "euler_staggered": "EULER",
    "rk4": "RK4",
    "discrete": "DISCRETE",
    "implicitfast": "IMPLICITFAST",
}
# For each mesh of the beam the smallest number of steps within 10 ms that is stable for 1 s, (Euler, RK4): one fewer diverges.
STABLE_STEPS = {(12, 3, 3): (2, 2), (24, 6, 6): (5, 3), (48, 12, 12): (11, 7)}
STIFF_STEPS = {1e8: (20, 15), 1e9: (62, 45)}  # of the coarse beam, by Young's modulus [Pa]: about the least that both bear
# Relative tolerance of the implicit step's linear solve. From 1e-8 (MuJoCo's default) to 1e-4 the error of the path
# changes by less than 1e-3 of itself at dt = 10 ms, and 1e-4 is a sixth to a third faster; 1e-3 begins to show.
TOLERANCE = 1e-4
ITERATIONS = 400  # of the implicit step: 100, the default, end before TOLERANCE in contact
RADIUS = 1e-4  # of a flex [m] where no work needs more; surfaces of two rest twice that far apart
SWITCHED_OFF = (
    "CONSTRAINT EQUALITY FRICTIONLOSS LIMIT CONTACT DAMPER CLAMPCTRL WARMSTART ACTUATION REFSAFE SENSOR MIDPHASE "
    "EULERDAMP AUTORESET ISLAND"
).split()
CONTACT = ("CONSTRAINT", "CONTACT", "MIDPHASE", "WARMSTART", "REFSAFE", "ISLAND")  # what contact needs of SWITCHED_OFF
INERTIA = 0  # the warning of a nearly singular matrix, harmless for thin flexes
FALSE_ALARM = "flex '.*' is not rigid and has no equality constraints or passive forces"  # it counts no elasticity


def load():
    """The package. Raises SimulationError where it is absent or too old."""
    mujoco = require("mujoco", "the comparison with MuJoCo", "peers", SimulationError)
    if tuple(int(part) for part in mujoco.__version__.split(".")[:3]) < (4, 0, 1):
        raise SimulationError(
            f"mujoco {mujoco.__version__} solves by a wrong Hessian, or doubles the first Lamé parameter of a 3D flex: "
            "version 4.0.1 of mujoco-core or later is needed"
        )
    return mujoco


def settings(work: Work, arch: str = "cpu") -> list[Setting]:
    """Explicit steps at the largest stable dt and finer, implicit ones ("discrete"); with contact rows and passive contact."""
    if work.cells is not None:
        return _of_beam(work)
    if work.kind == "path":
        explicit, rows, thick = ((4, 4), (10, 2)), (1, 2, 4), {1: RADIUS, 2: RADIUS, 4: RADIUS, 10: RADIUS}
    elif work.ground:
        explicit, rows, thick = ((10, 2),), (4, 10), {1: 5e-4, 4: 5e-4, 8: 5e-4, 10: 5e-4}
    else:
        explicit, rows, thick = ((20, 2),), (4, 10), {1: 2.5e-3, 3: 2.5e-3, 4: 2.5e-3, 10: 1e-3}
    found = [_rows(MODEL, "euler_staggered", steps, constant, RADIUS) for steps, constant in explicit]
    found.append(_rows(MODEL, "discrete", 2, 2, RADIUS))
    found += [_rows(NEO_HOOKEAN, "discrete", steps, 1, thick[steps]) for steps in rows]
    found += [_passive(NEO_HOOKEAN, steps, radius) for steps, radius in thick.items()]
    found.append(_passive(MODEL, 4, thick[4]))
    if work.key == "W4":
        found.append(_rows(NEO_HOOKEAN, "discrete", 4, 1, thick[4], solver="Newton"))
        found.append(Setting(NAME, NEO_HOOKEAN, "discrete", 4, {"ipc": True, "radius": thick[4]}))
    return found


def _rows(model: Model, method: str, steps: int, constant: float, radius: float, **more) -> Setting:
    """constant: the time constant in steps."""
    return Setting(NAME, model, method, steps, {"solref": constant * SAMPLE / steps, "radius": radius} | more)


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
        found.append(Setting(NAME, MODEL, "implicitfast", 1))  # refused; the page shows the message
    return found


class Run(Session):
    """Degrees of freedom 3 i, 3 i + 1, 3 i + 2 of `model` are x, y, z of the i-th free node."""

    def build(self) -> None:
        self.mujoco = mujoco = load()
        work, options = self.work, self.setting.options
        spec = mujoco.MjSpec()
        self._set_options(spec)
        contact = {"contype": 0, "conaffinity": 0}
        if work.touches:
            contact = {"friction": [work.friction, 0, 0]}
            if "solref" in options:
                contact["solref"] = [options["solref"], 1.0]
        if work.ground:
            turned = [np.sqrt(0.5), -np.sqrt(0.5), 0, 0]  # its normal is its z
            spec.worldbody.add_geom(type=mujoco.mjtGeom.mjGEOM_PLANE, size=[10, 10, 0.1], quat=turned, **contact)
        contact |= {"radius": options.get("radius", RADIUS), "passive": int(options.get("passive", False))}
        mass, nodes = masses(work, self.setting.model), work.slices()
        for body in work.bodies:
            self._add_flex(spec, body, mass[nodes[body.name]], contact)
        with warnings.catch_warnings():
            warnings.filterwarnings("ignore", message=FALSE_ALARM)
            self.model = spec.compile()

    def _set_options(self, spec) -> None:
        mujoco, method, options = self.mujoco, self.setting.method, self.setting.options
        spec.option.timestep, spec.option.gravity = self.setting.dt, (0.0, -self.work.gravity, 0.0)
        explicit = method not in ("discrete", "implicitfast")
        spec.option.tolerance = 1e-8 if self.work.touches and explicit else TOLERANCE
        if not explicit:
            spec.option.iterations = ITERATIONS
        solver = options.get("solver", "Newton" if self.work.touches and explicit else "CG")
        spec.option.solver = getattr(mujoco.mjtSolver, f"mjSOL_{solver.upper()}")
        spec.option.cone = mujoco.mjtCone.mjCONE_ELLIPTIC
        spec.option.integrator = getattr(mujoco.mjtIntegrator, "mjINT_" + INTEGRATORS[method])
        off = [name for name in SWITCHED_OFF if not (self.work.touches and name in CONTACT)]
        spec.option.disableflags = sum(int(getattr(mujoco.mjtDisableBit, "mjDSBL_" + name)) for name in off)
        if options.get("ipc"):
            spec.option.enableflags = int(mujoco.mjtEnableBit.mjENBL_IPC)

    def _add_flex(self, spec, body: Body, mass: np.ndarray, contact: dict) -> None:
        """Add a body with three slide joints for every free node, with its mass (n,) [kg], and the flex on them."""
        mujoco, owners = self.mujoco, []
        for node, (position, kg, fixed) in enumerate(zip(body.mesh.vertices, mass, body.fixed)):
            owners.append("world" if fixed else f"{body.name} {node}")
            if not fixed:
                # A body must have an inertia; without a rotation it plays no part.
                inertial = {"mass": kg, "inertia": [kg * 1e-3] * 3, "explicitinertial": True}
                made = spec.worldbody.add_body(name=owners[-1], pos=position, **inertial)
                for axis in np.eye(3):
                    made.add_joint(type=mujoco.mjtJoint.mjJNT_SLIDE, axis=axis)
        law = {"young": body.young, "poisson": POISSON, "damping": 0.0, "elastic3d": int(self.setting.model == NEO_HOOKEAN)}
        flex = spec.add_flex(name=body.name, dim=3, **law, **contact)
        flex.selfcollide = mujoco.mjtFlexSelf.mjFLEXSELF_NONE
        flex.vertbody = owners
        flex.vert = np.where(body.fixed[:, None], body.mesh.vertices, 0.0).ravel()  # in the frame of the owner
        flex.elem = body.mesh.tets.ravel().astype(int)

    def run(self, follow: bool) -> tuple[np.ndarray | None, float]:
        # warnings are read from the data: keep MuJoCo from printing them and from writing a log file
        self.mujoco.set_mju_user_warning(lambda message: None)
        try:
            return super().run(follow)
        finally:
            self.mujoco.set_mju_user_warning(None)

    def reset(self) -> None:
        self.data = self.mujoco.MjData(self.model)
        if self.setting.method == "euler_staggered":
            self.data.qvel[1::3] = self.work.gravity * self.setting.dt / 2  # -a(0) dt/2: at rest gravity alone accelerates

    def step(self) -> None:
        self.mujoco.mj_step(self.model, self.data, nstep=self.setting.steps)

    def positions(self) -> np.ndarray:
        data = self.data
        found = [self.mujoco.mjtWarning(k).name for k, one in enumerate(data.warning) if one.number and k != INERTIA]
        if found:
            raise SimulationError(f"{NAME} gives up before t = {data.time:.2f} s: {', '.join(found)}")
        now = self.work.start.copy()
        now[self.free] += data.qpos.reshape(-1, 3)
        return now
