"""What a study will run: every combination with its refusal, the frames, and the references. Asked in a child process.

A reference is the same mesh in f64 with small steps of second order; its own error is told by another run of twice the step.
Implicit steps have a consistent mass where elements are quadratic and explicit ones a lumped one (see `taisoft.mass`): there
the two solve different equations and get a reference each. Where there are several meshes or orders, the finest one's
reference is also what all are compared with for their error in space.
"""

import math
from collections.abc import Callable
from dataclasses import asdict

from taisoft.dynamics import EXPLICIT, INTEGRATORS
from taisoft.errors import SceneError, TaisoftError
from taisoft.scene.scene import Scene
from taisoft.settings import check_settings
from taisoft.stability import stable_dt
from taisoft.study.grid import AXES, Setting, cases, complete, expand, frame_time, mesh_name

FINER = 8  # the study's smallest dt over the reference's
LIMIT_SHARE = 0.9  # of the stable step, for a reference's coarser run
SMALLEST_SHARE = 16  # explicit references may take steps that are so much smaller than those asked for: they are quick

SECOND_ORDER = ("velocity_verlet", "bdf2", "implicit_midpoint")

Variant = Callable[[int, int | None], Scene]  # (refine, order) -> scene


def make_plan(variant: Variant, solver: dict, request: dict) -> dict:
    """The plan of a study as plain data. ask: see `Ask`. Raises SceneError where nothing can be run."""
    return Planner(variant, solver, request).plan()


class Planner:
    """A scene's variants with what is asked of them, each found out once."""

    def __init__(self, variant: Variant, solver: dict, request: dict):
        self._variant, self._solver, self._ask = variant, solver, request
        self._scenes: dict[tuple, Scene | str] = {}
        self._limits: dict[tuple, float] = {}
        self._notes: list[str] = []
        # what is no axis of the study and no argument of the run holds for all runs
        left_out = (*AXES, "seconds", "fps", "draggable")
        self.fixed = {key: value for key, value in solver.items() if key not in left_out}
        self.self_collision = self.fixed.get("self_collision", False)

    def plan(self) -> dict:
        """See `make_plan`."""
        base = self._scene(0, None)
        axes = complete(self._ask["axes"], self._solver, EXPLICIT)
        found = cases(expand(axes), self.refusal, self.unused)
        settings = [case.setting for case in found if not case.refused]
        seconds = self._ask["seconds"] or self._solver.get("seconds", 1.0)
        plan = {
            "fixed": self.fixed, "seconds": seconds,
            "cases": [{"setting": asdict(case.setting), "refused": case.refused} for case in found],
            "touching": base.pushes(self.self_collision), "names": [body.name for body in base.bodies],
            "frame": None, "frames": 0, "references": [], "space": None, "notes": self._notes,
        }  # fmt: skip
        if settings:
            target = self._ask["reference_dt"] or min(s.dt for s in settings) / FINER
            frame, frames = frame_time([*(s.dt for s in settings), 2.0 * target], seconds)
            plan |= {"frame": frame, "frames": frames} | self._references(settings, target, frame)
        return plan

    def refusal(self, setting: Setting) -> str:
        """Why a setting cannot be run, in a sentence, or an empty text."""
        scene = self._try(*setting.mesh)
        if isinstance(scene, str):
            return scene
        try:
            self._check(scene, setting)
        except TaisoftError as error:
            return str(error)
        if setting.integrator not in EXPLICIT or self.fixed.get("allow_unstable"):
            return ""
        limit = self._limit(*setting.mesh, setting.integrator)
        if setting.dt <= limit:
            return ""
        return f"dt = {setting.dt:.3g} s is above the stability limit of {setting.integrator}, {limit:.3g} s"

    def unused(self, setting: Setting) -> dict[str, str]:
        """Axes that a setting does not use, and why."""
        idle = {}
        if setting.integrator in EXPLICIT:
            idle |= dict.fromkeys(("newton_tolerance", "linear_tolerance"), f"{setting.integrator} solves no equations")
        if not self._scene(*setting.mesh).pushes(self.self_collision):
            idle |= dict.fromkeys(("contact_solver", "contact_tolerance"), "nothing can touch in this scene")
        return idle

    def _references(self, settings: list[Setting], target: float, frame: float) -> dict:
        """The references of the settings' meshes, and the number of the one for errors in space, or None."""
        extra = self._ask["reference_refine"]
        groups = list(dict.fromkeys(self._group(setting) for setting in settings))
        space = None
        if extra or len({(refine, order) for refine, order, _ in groups}) > 1:
            finest = max(refine for refine, _, _ in groups) + extra
            order = max((order for _, order, _ in groups), key=lambda order: order or 0)
            kinds = [kind for _, o, kind in groups if o == order]
            group = (finest, order, "implicit" if "implicit" in kinds else kinds[0])
            groups = list(dict.fromkeys([*groups, group]))
            space = groups.index(group)
        return {"references": [self._reference(*group, target, frame) for group in groups], "space": space}

    def _group(self, setting: Setting) -> tuple[int, int | None, str]:
        """Which settings solve the same equations in time."""
        scene = self._scene(*setting.mesh)
        quadratic = any(body.order == 2 for body in scene.bodies)
        kind = "" if not quadratic else "explicit" if setting.integrator in EXPLICIT else "implicit"
        return *setting.mesh, kind

    def _reference(self, refine: int, order: int | None, kind: str, target: float, frame: float) -> dict:
        """One reference, as plain data. Raises SceneError, naming it, where it cannot be: nobody need have asked for it."""
        try:
            return self._reference_on(refine, order, kind, target, frame)
        except TaisoftError as error:
            raise SceneError(f"the reference ({mesh_name({'refine': refine, 'order': order})}): {error}") from error

    def _reference_on(self, refine: int, order: int | None, kind: str, target: float, frame: float) -> dict:
        """A setting with its steps per frame, an even number."""
        scene = self._scene(refine, order)
        integrator = self._integrator(scene, refine, order, kind, target)
        steps = 2 * math.ceil(frame / target / 2 - 1e-9)
        if integrator in EXPLICIT:
            limit = LIMIT_SHARE * self._limit(refine, order, integrator)
            if 2.0 * target > limit and self._ask["reference_dt"]:
                raise SceneError(
                    f"--reference-dt {target:g}: the reference is also run with twice the step, and {integrator} takes at most "
                    f"{limit:.3g} s there"
                )
            steps = max(steps, 2 * math.ceil(frame / limit))
        setting = Setting(frame / steps, integrator, order, refine, "f64")
        self._check(scene, setting)
        order_in_time = 2 if integrator in SECOND_ORDER and self._is_smooth(scene) else 1
        return {"setting": asdict(setting), "kind": kind, "order_in_time": order_in_time, "steps": steps}

    def _is_smooth(self, scene: Scene) -> bool:
        """Whether methods keep their order: not with contacts, forces that depend on velocities, or paths, which may jump."""
        materials = [body.material for body in scene.bodies]
        led = any(c.path is not None for body in scene.bodies for c in body.constraints)
        damped = any(material.mass_damping or material.stiffness_damping for material in materials)
        return not (led or damped or scene.pushes(self.self_collision))

    def _integrator(self, scene: Scene, refine: int, order: int | None, kind: str, target: float) -> str:
        requested = self._ask["reference_integrator"]
        if requested is not None:
            if requested not in INTEGRATORS:
                raise SceneError(f"--reference-integrator {requested}: it must be one of {', '.join(INTEGRATORS)}")
            if kind and (kind == "explicit") != (requested in EXPLICIT):
                instead = "velocity_verlet" if kind == "explicit" else "bdf2"
                self._notes.append(
                    f"the {kind} steps of quadratic tets have the reference {instead}, since {requested} has another mass matrix"
                )
                return instead
            return requested
        if kind == "explicit":
            return "velocity_verlet"
        if scene.pushes(self.self_collision):
            return "bdf2"
        limit = LIMIT_SHARE * self._limit(refine, order, "velocity_verlet")
        return "velocity_verlet" if not kind and limit > 2.0 * target / SMALLEST_SHARE else "implicit_midpoint"

    def _check(self, scene: Scene, setting: Setting) -> None:
        more = {"self_collision": False, "allow_unstable": False, "draggable": False} | self.fixed
        check_settings(scene, **setting.simulator(), **more)

    def _limit(self, refine: int, order: int | None, integrator: str) -> float:
        key = (refine, order, integrator)
        if key not in self._limits:
            self._limits[key] = stable_dt(self._scene(refine, order), integrator == "velocity_verlet")
        return self._limits[key]

    def _scene(self, refine: int, order: int | None) -> Scene:
        scene = self._try(refine, order)
        if isinstance(scene, str):
            raise SceneError(scene)
        return scene

    def _try(self, refine: int, order: int | None) -> Scene | str:
        """The scene, or why there is none."""
        if (refine, order) not in self._scenes:
            try:
                self._scenes[refine, order] = self._variant(refine, order)
            except TaisoftError as error:
                self._scenes[refine, order] = str(error)
        return self._scenes[refine, order]
