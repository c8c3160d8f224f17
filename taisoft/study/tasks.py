"""The plan of a study: every combination with its refusal, the frames, and the references. Made in a child process.

A reference runs the same mesh in f64 with small second-order steps; a second run with twice the step estimates its own error.
With quadratic elements, implicit steps use a consistent mass and explicit ones a lumped mass (see `fem.reference`): they solve
different equations, so each kind gets its own reference. With several meshes or orders, the finest one's reference also gives
the error in space of all runs.
"""

import itertools
import math
from collections.abc import Callable, Iterable
from dataclasses import asdict
from fractions import Fraction
from functools import cache

from taisoft.dynamics.schemes import EXPLICIT, INTEGRATORS
from taisoft.errors import SceneError, TaisoftError, reworded
from taisoft.estimation.first_choice import STABLE_FRACTION
from taisoft.estimation.order import nominal_order
from taisoft.scene import checks
from taisoft.scene.scene import Scene
from taisoft.settings import WITH_MULTIPLIERS, check_settings, kept_by_multipliers
from taisoft.stability import stable_dt
from taisoft.study import AXES, DEFAULTS, Setting, mesh_name, simulator_arguments

IMPLICIT_DEFAULT = ("implicit_euler", "bdf2")
DT_FACTORS = {False: (2.0, 1.0, 0.5, 0.25), True: (0.5, 1.0, 4.0, 8.0, 16.0)}  # of the scene's dt; key: explicit integrator
FIRST_AXES = ("refine", "order", "arch", "precision", "integrator", "contact_solver")  # of a table, those that vary slowest
MAX_FRAMES = 48  # at which runs are compared
MIN_FRAMES = 4
MAX_DENOMINATOR = 10_000  # of the ratio of two time steps; above it they have no common multiple
DT_RATIO = 8  # the study's smallest dt over the reference's
EXPLICIT_DT_RATIO = 16  # explicit references may use steps this many times smaller than requested: they are cheap

Variant = Callable[[int, int | None], Scene]  # (refine, order) -> scene


def complete(given: dict[str, list], solver: dict) -> dict[str, list]:
    """Return all axes: as given, else from the scene's solver dict; dt and integrator default to several around the scene's."""
    own = DEFAULTS | {"dt": 1 / 60, "integrator": "implicit_euler"} | solver
    axes = {key: [own[key]] for key in AXES}
    axes["integrator"] = list(dict.fromkeys([own["integrator"], *IMPLICIT_DEFAULT]))
    axes["dt"] = [factor * own["dt"] for factor in DT_FACTORS[own["integrator"] in EXPLICIT]]
    return axes | given


def expand(axes: dict[str, list]) -> list[Setting]:
    """Return the product of all axes, the last one varying fastest, dt from large to small."""
    axes = axes | {"dt": sorted(axes["dt"], reverse=True)}
    keys = [*FIRST_AXES, *(key for key in AXES if key not in FIRST_AXES and key != "dt"), "dt"]
    return [Setting(**dict(zip(keys, values))) for values in itertools.product(*(axes[key] for key in keys))]


def frame_time(steps: Iterable[float], seconds: float) -> tuple[float, int]:
    """Return the time between two frames [s], a multiple of every time step [s], and the number of frames.

    The last frame is near `seconds` [s]. Raises SceneError if the steps have no common multiple that leaves MIN_FRAMES frames.
    """
    steps = sorted(set(steps))
    ratios = [Fraction(step / steps[0]).limit_denominator(MAX_DENOMINATOR) for step in steps]
    listed = ", ".join(f"{step:.6g}" for step in steps)
    if any(abs(float(ratio) * steps[0] - step) > 1e-9 * step for step, ratio in zip(steps, ratios)):
        raise SceneError(f"the steps {listed} s have no common multiple: use steps that are multiples of one another")
    common = steps[0] * math.lcm(*(r.numerator for r in ratios)) / math.gcd(*(r.denominator for r in ratios))
    if common > seconds / MIN_FRAMES * (1.0 + 1e-9):
        raise SceneError(
            f"the steps {listed} s coincide only every {common:.6g} s, less than {MIN_FRAMES} times in {seconds:g} s: use steps "
            "that are multiples of one another, or a larger --seconds"
        )
    every = math.ceil(seconds / common / MAX_FRAMES - 1e-9)
    # prefer a multiple near this one whose last frame is at `seconds`
    whole = round(seconds / common)
    every = next((k for k in range(every, 2 * every + 1) if whole % k == 0 and whole // k >= MIN_FRAMES), every)
    return every * common, max(1, round(seconds / (every * common)))


class Planner:
    """Plans the runs of a scene's variants; scenes and stability limits are computed once. A mesh is (refine, order).

    request: the fields of a `Request`.
    """

    def __init__(self, variant: Variant, solver: dict, request: dict):
        self._variant, self._solver, self._request = variant, solver, request
        self._scenes: dict[tuple, Scene | str] = {}
        self._limit = cache(lambda mesh, integrator: stable_dt(self._scene(mesh), integrator == "velocity_verlet"))
        self._notes: list[str] = []
        # all other entries of the solver dict apply to every run
        left_out = (*AXES, "seconds", "fps", "quantities", "draggable", "tolerance")
        self.fixed = {key: value for key, value in solver.items() if key not in left_out}

    def plan(self) -> dict:
        """Return the plan of the study as plain data. Raises SceneError if nothing can be run."""
        base = self._scene((0, None))
        refused = {one: self.refusal(one) for one in expand(complete(self._request["axes"], self._solver))}
        settings = [one for one, why in refused.items() if not why]
        plan = {
            "fixed": self.fixed,
            "cases": [{"setting": asdict(one), "refused": why} for one, why in refused.items()],
            "touching": self._touches(base),
            "frame": None,
            "frames": 0,
            "references": [],
            "space": None,
            "notes": self._notes,
        }
        if settings:
            target = self._request["reference_dt"] or min(s.dt for s in settings) / DT_RATIO
            seconds = self._request["seconds"] or self._solver.get("seconds", 1.0)
            frame, frames = frame_time([*(s.dt for s in settings), 2.0 * target], seconds)
            plan |= {"frame": frame, "frames": frames} | self._references(settings, target, frame)
        return plan

    def refusal(self, setting: Setting) -> str:
        """Return why a setting cannot be run, or an empty text."""
        try:
            self._check(self._scene(setting.mesh), setting)
        except TaisoftError as error:
            return str(error)
        if setting.integrator not in EXPLICIT or self.fixed.get("allow_unstable"):
            return ""
        limit = self._limit(setting.mesh, setting.integrator)
        if setting.dt <= limit:
            return ""
        return f"dt = {setting.dt:.3g} s is above the stability limit of {setting.integrator}, {limit:.3g} s"

    def _references(self, settings: list[Setting], target: float, frame: float) -> dict:
        """Return the references of the settings' meshes, and the index of the one for errors in space, or None."""
        extra = self._request["reference_refine"]
        groups = list(dict.fromkeys((setting.mesh, self._kind(setting)) for setting in settings))
        space = None
        if extra or len({mesh for mesh, _ in groups}) > 1:
            finest = max(refine for (refine, _), _ in groups) + extra
            order = max((order for (_, order), _ in groups), key=lambda order: order or 0)
            kinds = [kind for (_, o), kind in groups if o == order]
            group = (finest, order), "implicit" if "implicit" in kinds else kinds[0]
            groups = list(dict.fromkeys([*groups, group]))
            space = groups.index(group)
        return {"references": [self._reference(mesh, kind, target, frame) for mesh, kind in groups], "space": space}

    def _kind(self, setting: Setting) -> str:
        """Return what distinguishes settings on one mesh that solve different equations in time."""
        quadratic = any(body.order == 2 for body in self._scene(setting.mesh).bodies)
        return "" if not quadratic else "explicit" if setting.integrator in EXPLICIT else "implicit"

    def _reference(self, mesh: tuple, kind: str, target: float, frame: float) -> dict:
        """Return a setting with its steps per frame, an even number. Errors name it: the user may not have requested it."""
        refine, order = mesh
        with reworded(TaisoftError, f"the reference ({mesh_name({'refine': refine, 'order': order})}): ", raised=SceneError):
            scene = self._scene(mesh)
            integrator = self._integrator(scene, mesh, kind, target)
            steps = 2 * math.ceil(frame / target / 2 - 1e-9)
            if integrator in EXPLICIT:
                limit = STABLE_FRACTION * self._limit(mesh, integrator)
                if 2.0 * target > limit and self._request["reference_dt"]:
                    raise SceneError(
                        f"--reference-dt {target:g}: the reference is also run with twice the step, and {integrator} allows at "
                        f"most {limit:.3g} s"
                    )
                steps = max(steps, 2 * math.ceil(frame / limit))
            setting = Setting(frame / steps, integrator, order, refine, "f64")
            self._check(scene, setting)
        order_in_time = nominal_order(integrator, scene, self._touches(scene))
        return {"setting": asdict(setting), "kind": kind, "order_in_time": order_in_time, "steps": steps}

    def _integrator(self, scene: Scene, mesh: tuple, kind: str, target: float) -> str:
        requested = self._request["reference_integrator"]
        given = kept_by_multipliers(scene)
        if requested is not None:
            checks.choice(requested, "--reference-integrator", INTEGRATORS)
            if given and requested not in WITH_MULTIPLIERS:
                rule = f"{given[0]} needs {' or '.join(WITH_MULTIPLIERS)}"
                raise SceneError(f"--reference-integrator {requested}: {rule}")
            if not kind or (kind == "explicit") == (requested in EXPLICIT):
                return requested
            instead = "velocity_verlet" if kind == "explicit" else "bdf2"
            self._notes.append(
                f"{kind} steps of quadratic tets use the reference {instead}, because {requested} has another mass matrix"
            )
            return instead
        if kind == "explicit":
            return "velocity_verlet"
        if given or self._touches(scene):
            return "bdf2"
        limit = STABLE_FRACTION * self._limit(mesh, "velocity_verlet")
        return "velocity_verlet" if not kind and limit > 2.0 * target / EXPLICIT_DT_RATIO else "implicit_midpoint"

    def _check(self, scene: Scene, setting: Setting) -> None:
        check_settings(scene, **simulator_arguments(asdict(setting)), **self.fixed)

    def _touches(self, scene: Scene) -> bool:
        return scene.pushes(self.fixed.get("self_collision", False))

    def _scene(self, mesh: tuple) -> Scene:
        """Return the scene with a mesh. Raises SceneError if it cannot be built, which is tried once."""
        if mesh not in self._scenes:
            try:
                self._scenes[mesh] = self._variant(*mesh)
            except TaisoftError as error:
                self._scenes[mesh] = str(error)
        scene = self._scenes[mesh]
        if isinstance(scene, str):
            raise SceneError(scene)
        return scene
