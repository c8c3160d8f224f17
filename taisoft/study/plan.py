"""The plan of a study: every combination with its refusal, the frames, and the references. Made in a child process.

A reference runs the same mesh in f64 with small second-order steps; a second run with twice the step estimates its own error.
With quadratic elements, implicit steps use a consistent mass and explicit ones a lumped mass (see `fem.reference`): they solve
different equations, so each kind gets its own reference. With several meshes or orders, the finest one's reference also gives
the error in space of all runs.
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

DT_RATIO = 8  # the study's smallest dt over the reference's
STABLE_FRACTION = 0.9  # of the stable step, for a reference's coarser run
EXPLICIT_DT_RATIO = 16  # explicit references may use steps this many times smaller than requested: they are cheap

SECOND_ORDER = ("velocity_verlet", "bdf2", "implicit_midpoint")

Variant = Callable[[int, int | None], Scene]  # (refine, order) -> scene


def make_plan(variant: Variant, solver: dict, request: dict) -> dict:
    """Return the plan of a study as plain data. request: see `Request.for_plan`. Raises SceneError if nothing can be run."""
    return Planner(variant, solver, request).plan()


class Planner:
    """Plans the runs of a scene's variants; scenes and stability limits are computed once."""

    def __init__(self, variant: Variant, solver: dict, request: dict):
        self._variant, self._solver, self._request = variant, solver, request
        self._scenes: dict[tuple, Scene | str] = {}
        self._limits: dict[tuple, float] = {}
        self._notes: list[str] = []
        # all other entries of the solver dict apply to every run
        left_out = (*AXES, "seconds", "fps", "draggable")
        self.fixed = {key: value for key, value in solver.items() if key not in left_out}
        self.self_collision = self.fixed.get("self_collision", False)

    def plan(self) -> dict:
        """Return the plan; see `make_plan`."""
        base = self._scene(0, None)
        axes = complete(self._request["axes"], self._solver, EXPLICIT)
        found = cases(expand(axes), self.refusal, self.unused)
        settings = [case.setting for case in found if not case.refused]
        seconds = self._request["seconds"] or self._solver.get("seconds", 1.0)
        plan = {
            "fixed": self.fixed,
            "seconds": seconds,
            "cases": [{"setting": asdict(case.setting), "refused": case.refused} for case in found],
            "touching": base.pushes(self.self_collision),
            "names": [body.name for body in base.bodies],
            "frame": None,
            "frames": 0,
            "references": [],
            "space": None,
            "notes": self._notes,
        }
        if settings:
            target = self._request["reference_dt"] or min(s.dt for s in settings) / DT_RATIO
            frame, frames = frame_time([*(s.dt for s in settings), 2.0 * target], seconds)
            plan |= {"frame": frame, "frames": frames} | self._references(settings, target, frame)
        return plan

    def refusal(self, setting: Setting) -> str:
        """Return why a setting cannot be run, or an empty text."""
        scene = self._scene_or_reason(*setting.mesh)
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
        """Return the axes that a setting does not use, and why."""
        unused_axes = {}
        if setting.integrator in EXPLICIT:
            unused_axes |= dict.fromkeys(("newton_tolerance", "linear_tolerance"), f"{setting.integrator} solves no equations")
        if not self._scene(*setting.mesh).pushes(self.self_collision):
            unused_axes |= dict.fromkeys(("contact_solver", "contact_tolerance"), "nothing can come into contact in this scene")
        return unused_axes

    def _references(self, settings: list[Setting], target: float, frame: float) -> dict:
        """Return the references of the settings' meshes, and the index of the one for errors in space, or None."""
        extra = self._request["reference_refine"]
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
        """Return a key shared by settings that solve the same equations in time."""
        scene = self._scene(*setting.mesh)
        quadratic = any(body.order == 2 for body in scene.bodies)
        kind = "" if not quadratic else "explicit" if setting.integrator in EXPLICIT else "implicit"
        return *setting.mesh, kind

    def _reference(self, refine: int, order: int | None, kind: str, target: float, frame: float) -> dict:
        """Return one reference as plain data. Raises SceneError naming it, because the user may not have requested it."""
        try:
            return self._reference_on(refine, order, kind, target, frame)
        except TaisoftError as error:
            raise SceneError(f"the reference ({mesh_name({'refine': refine, 'order': order})}): {error}") from error

    def _reference_on(self, refine: int, order: int | None, kind: str, target: float, frame: float) -> dict:
        """Return a setting with its steps per frame, an even number."""
        scene = self._scene(refine, order)
        integrator = self._integrator(scene, refine, order, kind, target)
        steps = 2 * math.ceil(frame / target / 2 - 1e-9)
        if integrator in EXPLICIT:
            limit = STABLE_FRACTION * self._limit(refine, order, integrator)
            if 2.0 * target > limit and self._request["reference_dt"]:
                raise SceneError(
                    f"--reference-dt {target:g}: the reference is also run with twice the step, and {integrator} allows at most "
                    f"{limit:.3g} s"
                )
            steps = max(steps, 2 * math.ceil(frame / limit))
        setting = Setting(frame / steps, integrator, order, refine, "f64")
        self._check(scene, setting)
        order_in_time = 2 if integrator in SECOND_ORDER and self._is_smooth(scene) else 1
        return {"setting": asdict(setting), "kind": kind, "order_in_time": order_in_time, "steps": steps}

    def _is_smooth(self, scene: Scene) -> bool:
        """Return whether methods keep their order: not with contacts, velocity-dependent forces, or paths, which may jump."""
        materials = [body.material for body in scene.bodies]
        prescribed = any(c.path is not None for body in scene.bodies for c in body.constraints)
        damped = any(material.mass_damping or material.stiffness_damping for material in materials)
        return not (prescribed or damped or scene.pushes(self.self_collision))

    def _integrator(self, scene: Scene, refine: int, order: int | None, kind: str, target: float) -> str:
        requested = self._request["reference_integrator"]
        if requested is not None:
            if requested not in INTEGRATORS:
                raise SceneError(f"--reference-integrator {requested}: it must be one of {', '.join(INTEGRATORS)}")
            if kind and (kind == "explicit") != (requested in EXPLICIT):
                instead = "velocity_verlet" if kind == "explicit" else "bdf2"
                self._notes.append(
                    f"{kind} steps of quadratic tets use the reference {instead}, because {requested} has another mass matrix"
                )
                return instead
            return requested
        if kind == "explicit":
            return "velocity_verlet"
        if scene.pushes(self.self_collision):
            return "bdf2"
        limit = STABLE_FRACTION * self._limit(refine, order, "velocity_verlet")
        return "velocity_verlet" if not kind and limit > 2.0 * target / EXPLICIT_DT_RATIO else "implicit_midpoint"

    def _check(self, scene: Scene, setting: Setting) -> None:
        defaults = {"self_collision": False, "allow_unstable": False, "draggable": False} | self.fixed
        check_settings(scene, **setting.simulator(), **defaults)

    def _limit(self, refine: int, order: int | None, integrator: str) -> float:
        key = (refine, order, integrator)
        if key not in self._limits:
            self._limits[key] = stable_dt(self._scene(refine, order), integrator == "velocity_verlet")
        return self._limits[key]

    def _scene(self, refine: int, order: int | None) -> Scene:
        scene = self._scene_or_reason(refine, order)
        if isinstance(scene, str):
            raise SceneError(scene)
        return scene

    def _scene_or_reason(self, refine: int, order: int | None) -> Scene | str:
        """Return the scene, or why it cannot be built."""
        if (refine, order) not in self._scenes:
            try:
                self._scenes[refine, order] = self._variant(refine, order)
            except TaisoftError as error:
                self._scenes[refine, order] = str(error)
        return self._scenes[refine, order]
