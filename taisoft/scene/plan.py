"""The plan: which features a scene needs, and why. What is off allocates nothing and launches nothing."""

from dataclasses import dataclass, field

from taisoft.scene.collision import has_sharp_edges
from taisoft.scene.obstacles import Box, MeshObstacle
from taisoft.scene.scene import LAWS, Scene


@dataclass
class Plan:
    """entries: dicts {"feature", "on", "why"}, in a fixed order; `on[feature]` looks one up."""

    entries: list[dict] = field(default_factory=list)

    @property
    def on(self) -> dict[str, bool]:
        """feature -> whether it is modelled."""
        return {e["feature"]: e["on"] for e in self.entries}

    def why(self, feature: str) -> str:
        """Why a feature is modelled, or why it is not."""
        return next(e["why"] for e in self.entries if e["feature"] == feature)

    def add(self, feature: str, on: bool, why: str, why_not: str) -> None:
        """Decide one feature."""
        self.entries.append({"feature": feature, "on": bool(on), "why": why if on else why_not})


def _named(names: list[str]) -> str:
    return ", ".join(names[:3]) + (f" and {len(names) - 3} more" if len(names) > 3 else "")


def make_plan(
    scene: Scene, explicit: bool, multistep: bool, self_collision: bool = False, draggable: bool = False
) -> Plan:
    """Decide from the scene, the kind of integrator, and whether bodies may touch themselves or are to be pulled."""
    plan = Plan()
    laws = {name: [b.name for b in scene.bodies if b.material.law == name] for name in LAWS}
    for law, names in laws.items():
        plan.add(f"law:{law}", bool(names), f"used by {_named(names)}", "no body uses it")

    def bodies(test) -> list[str]:
        return [b.name for b in scene.bodies if test(b)]

    quadratic = bodies(lambda b: b.order == 2)
    plan.add("quadratic_tets", bool(quadratic), f"bodies of order 2: {_named(quadratic)}", "every body is of order 1")
    plan.add(
        "consistent_weight", bool(quadratic) and not explicit, "gravity on quadratic tets acts as int rho N g dV",
        "explicit steps take gravity as an acceleration" if quadratic else "on linear tets it is the lumped mass",
    )  # fmt: skip
    plan.add(
        "consistent_mass", bool(quadratic) and not explicit, f"quadratic tets of {_named(quadratic)} in implicit steps",
        "explicit steps need a diagonal mass" if quadratic else "the mass of linear tets is lumped",
    )  # fmt: skip
    loaded = bodies(lambda b: b.tractions or b.forces)
    why = f"tractions or forces on {_named(loaded)}" if loaded else "bodies are to be pulled"
    plan.add("loads", bool(loaded) or draggable, why, "no traction and no force")
    fixed = bodies(lambda b: any(c.path is None for c in b.constraints))
    plan.add("fixed_nodes", bool(fixed), f"on {_named(fixed)}", "no node is fixed")
    moved = bodies(lambda b: any(c.path is not None for c in b.constraints))
    plan.add("moving_nodes", bool(moved), f"paths on {_named(moved)}", "no node follows a path")
    dragged = bodies(lambda b: b.material.mass_damping > 0)
    plan.add("mass_damping", bool(dragged), f"material of {_named(dragged)}", "every mass_damping is 0")
    viscous = bodies(lambda b: b.material.stiffness_damping > 0)
    plan.add("stiffness_damping", bool(viscous), f"material of {_named(viscous)}", "every stiffness_damping is 0")
    plan.add(
        "assembled_stiffness", not explicit, "implicit steps solve linear systems", "explicit steps need forces only"
    )
    plan.add("past_states", multistep, "the integrator looks back two steps", "a one-step integrator")
    plan.add(
        "inversion_handling", not explicit, "directions of negative curvature lead out of inverted tets",
        "explicit steps need forces only, which every law gives for inverted tets too",
    )  # fmt: skip
    _add_collision(plan, scene, self_collision)
    return plan


def _add_collision(plan: Plan, scene: Scene, self_collision: bool) -> None:
    """Decide how contacts are found: a body counts only where another collider has triangles that could hit it."""
    obstacles = scene.obstacles
    plan.add("obstacles", bool(obstacles), _named([o.name for o in obstacles]), "the scene has none")
    with_triangles = len(scene.bodies) + sum(o.shape.surface() is not None for o in obstacles)
    hit = scene.bodies if with_triangles > 1 else []
    modes: dict[str, list[str]] = {"distance_field": [], "proximity": []}
    for body in hit:
        modes[body.contact_mode].append(body.name if body.collision == "auto" else f"{body.name} (asked for)")
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
    plan.add("self_collision", self_collision, "asked for", "not asked for")
    several = len(scene.colliders) > 1
    plan.add(
        "contact_forces", scene.pushes(self_collision),
        f"{_named([c.name for c in scene.colliders])} can touch" if several else "it can touch itself",
        "one body, and nothing that it could touch" if scene.contact_forces else "the scene's contact_forces are off",
    )  # fmt: skip
