"""Plan which features a scene needs, and why. Disabled features allocate no memory and launch no kernels."""

from dataclasses import dataclass, field

from taisoft.scene.collision import has_sharp_edges
from taisoft.scene.obstacles import Box, MeshObstacle
from taisoft.scene.scene import LAWS, Scene


@dataclass
class Plan:
    """Enabled and disabled features. entries: dicts {"feature", "on", "why"} in a fixed order."""

    entries: list[dict] = field(default_factory=list)

    @property
    def on(self) -> dict[str, bool]:
        """Map each feature to whether it is modelled."""
        return {e["feature"]: e["on"] for e in self.entries}

    def why(self, feature: str) -> str:
        """Return why a feature is or is not modelled."""
        return next(e["why"] for e in self.entries if e["feature"] == feature)

    def add(self, feature: str, on: bool, why: str, why_not: str) -> None:
        """Add a feature with the reason for its state."""
        self.entries.append({"feature": feature, "on": bool(on), "why": why if on else why_not})


def _shorten(names: list[str]) -> str:
    return ", ".join(names[:3]) + (f" and {len(names) - 3} more" if len(names) > 3 else "")


def make_plan(scene: Scene, explicit: bool, multistep: bool, self_collision: bool = False, draggable: bool = False) -> Plan:
    """Plan the features for a scene, the kind of integrator, self-collision, and draggable bodies."""
    plan = Plan()
    laws = {name: [b.name for b in scene.bodies if b.material.law == name] for name in LAWS}
    for law, names in laws.items():
        plan.add(f"law:{law}", bool(names), f"used by {_shorten(names)}", "no body uses it")

    def bodies(test) -> list[str]:
        return [b.name for b in scene.bodies if test(b)]

    quadratic = bodies(lambda b: b.order == 2)
    plan.add("quadratic_tets", bool(quadratic), f"bodies of order 2: {_shorten(quadratic)}", "every body is of order 1")
    plan.add(
        "consistent_weight",
        bool(quadratic) and not explicit,
        "gravity on quadratic tets acts as int rho N g dV",
        "explicit steps take gravity as an acceleration" if quadratic else "on linear tets it is the lumped mass",
    )
    plan.add(
        "consistent_mass",
        bool(quadratic) and not explicit,
        f"quadratic tets of {_shorten(quadratic)} in implicit steps",
        "explicit steps need a diagonal mass" if quadratic else "the mass of linear tets is lumped",
    )
    loaded = bodies(lambda b: b.tractions or b.forces)
    why = f"tractions or forces on {_shorten(loaded)}" if loaded else "bodies can be dragged"
    plan.add("loads", bool(loaded) or draggable, why, "no traction and no force")
    fixed = bodies(lambda b: any(c.path is None for c in b.constraints))
    plan.add("fixed_nodes", bool(fixed), f"on {_shorten(fixed)}", "no node is fixed")
    moved = bodies(lambda b: any(c.path is not None for c in b.constraints))
    plan.add("moving_nodes", bool(moved), f"paths on {_shorten(moved)}", "no node follows a path")
    dragged = bodies(lambda b: b.material.mass_damping > 0)
    plan.add("mass_damping", bool(dragged), f"material of {_shorten(dragged)}", "every mass_damping is 0")
    viscous = bodies(lambda b: b.material.stiffness_damping > 0)
    plan.add("stiffness_damping", bool(viscous), f"material of {_shorten(viscous)}", "every stiffness_damping is 0")
    plan.add("assembled_stiffness", not explicit, "implicit steps solve linear systems", "explicit steps need forces only")
    plan.add("past_states", multistep, "the integrator uses the two previous steps", "a one-step integrator")
    plan.add(
        "inversion_handling",
        not explicit,
        "directions of negative curvature lead out of inverted tets",
        "explicit steps need forces only, and every law defines them for inverted tets too",
    )
    _add_collision(plan, scene, self_collision)
    return plan


def _add_collision(plan: Plan, scene: Scene, self_collision: bool) -> None:
    """Plan contact detection: a body takes part only if another collider has triangles that can hit it."""
    obstacles = scene.obstacles
    plan.add("obstacles", bool(obstacles), _shorten([o.name for o in obstacles]), "the scene has none")
    with_triangles = len(scene.bodies) + sum(o.shape.surface() is not None for o in obstacles)
    hit = scene.bodies if with_triangles > 1 else []
    modes: dict[str, list[str]] = {"distance_field": [], "proximity": []}
    for body in hit:
        modes[body.contact_mode].append(body.name if body.collision == "auto" else f"{body.name} (requested)")
    modes["proximity"] += [f"{o.name} (triangles)" for o in obstacles if isinstance(o.shape, MeshObstacle) and scene.bodies]
    modes["proximity"] += [f"{o.name} (edges)" for o in obstacles if isinstance(o.shape, Box) and scene.bodies]
    fields = [b for b in hit if b.contact_mode == "distance_field"]
    modes["proximity"] += [f"{b.name} (sharp edges)" for b in fields if has_sharp_edges(b.nodes)]
    if self_collision:
        modes["proximity"].append("every body (itself)")
    idle = "no triangles can hit a body" if not hit else "every body is hit by "
    fields, near = modes["distance_field"], modes["proximity"]
    plan.add("distance_fields", bool(fields), "hits " + ", ".join(fields), idle + ("proximity" if hit else ""))
    plan.add("proximity", bool(near), "hits " + ", ".join(near), idle + ("its distance field" if hit else ""))
    plan.add("self_collision", self_collision, "requested", "not requested")
    several = len(scene.colliders) > 1
    plan.add(
        "contact_forces",
        scene.pushes(self_collision),
        f"{_shorten([c.name for c in scene.colliders])} can touch" if several else "it can touch itself",
        "one body, and nothing that it could touch" if scene.contact_forces else "the scene's contact_forces are off",
    )
