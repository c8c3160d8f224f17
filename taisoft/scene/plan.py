"""What a simulator models of a scene, and what may change while it runs.

The plan lists which features a scene needs, and why. Disabled features allocate no memory and launch no kernels. Numbers of
features that are enabled may change at run time, in the simulator's own copy of the scene.
"""

from dataclasses import dataclass, field, replace

from taisoft.attributes import thawed
from taisoft.errors import SceneError
from taisoft.scene import checks
from taisoft.scene.body import NEARLY_INCOMPRESSIBLE, Body
from taisoft.scene.collision import has_sharp_edges
from taisoft.scene.connections import check_tendon
from taisoft.scene.laws import LAWS
from taisoft.scene.loads import DEAD, FOLLOWER, LOADS
from taisoft.scene.material import FIBRE_NUMBERS
from taisoft.scene.obstacles import Box, MeshObstacle
from taisoft.scene.rigid import RigidBody
from taisoft.scene.scene import Scene

OF_RATES = ("mass_damping", "stiffness_damping", "spring_damping", "rigid_damping", "consistent_mass", "viscosity", "sleeping")
CHANGEABLE = ("mass_damping", "stiffness_damping", *FIBRE_NUMBERS)  # numbers of a material, besides `Composition.tet_numbers`


@dataclass
class Plan:
    """Enabled and disabled features. entries: dicts {"feature", "on", "why"} in a fixed order."""

    entries: list[dict] = field(default_factory=list)

    def __repr__(self) -> str:
        return f"Plan(on: {', '.join(name for name, is_on in self.on.items() if is_on) or 'nothing'})"

    @property
    def on(self) -> dict[str, bool]:
        """Map each feature to whether it is modelled."""
        return {e["feature"]: e["on"] for e in self.entries}

    def why(self, feature: str) -> str:
        """Return why a feature is or is not modelled."""
        return next(e["why"] for e in self.entries if e["feature"] == feature)

    def without_rates(self) -> "Plan":
        """Return the plan of statics, which models nothing that depends on velocities."""
        static = {"on": False, "why": "statics has no velocities"}
        return Plan([one | static if one["feature"] in OF_RATES else one for one in self.entries])

    def add(self, feature: str, on: bool, why: str, why_not: str) -> None:
        """Add a feature with the reason for its state."""
        self.entries.append({"feature": feature, "on": bool(on), "why": why if on else why_not})

    def add_why(self, feature: str, why: str) -> None:
        """Add to the reason for a feature that is modelled."""
        next(e for e in self.entries if e["feature"] == feature)["why"] += f"; {why}"


def _shorten(names: list[str]) -> str:
    return ", ".join(names[:3]) + (f" and {len(names) - 3} more" if len(names) > 3 else "")


def never_resting(scene: Scene) -> list[str]:
    """Names of the bodies that never sleep: those with prescribed motion, loads along paths, Maxwell branches, volumes or lengths
    that are kept, or connections to obstacles that move. What touches or is connected to them is in their island."""
    restless = set()
    for body in scene.bodies:
        kept = any(cavity.given == "volume" for cavity in body.cavities)
        driven = any(one.path is not None for one in [*scene.constraints(body), *body.loads, *body.activations])
        if kept or driven or body.composition.branches.shape[1]:
            restless.add(body.name)
    for one in scene.tendons:
        if one.path is not None or one.is_inextensible:
            restless.update(one.owners)
    for one in scene.connections:
        if scene.moves(one):
            restless.update(one.owners)
    return [body.name for body in scene.bodies if body.name in restless]


def make_plan(
    scene: Scene, explicit: bool, multistep: bool, self_collision: bool = False, draggable: bool = False, sleep: bool = True
) -> Plan:
    """Plan the features for a scene, the kind of integrator, self-collision, draggable bodies, and those that may sleep."""
    plan = Plan()

    def add_if_any(feature: str, test, why: str, why_not: str) -> None:
        names = [b.name for b in scene.bodies if test(b)]
        plan.add(feature, bool(names), f"{why} {_shorten(names)}", why_not)

    for law in (one for one in LAWS if LAWS[one].is_classic or any(one in b.composition.laws for b in scene.bodies)):
        add_if_any(f"law:{law}", lambda b, law=law: law in b.composition.laws, "used by", "no body uses it")
    add_if_any(
        "elasticity_by_tet",
        lambda b: b.composition.elastic_by_tet,
        "young, poisson or a parameter may differ between the tets of",
        "every body has one young and one poisson",
    )
    add_if_any("volume_floor", lambda b: b.composition.has_volume_floor, "material of", "every volume_floor is 0")
    add_if_any("fibres", lambda b: b.fibres is not None, "material and directions of", "no material has fibres")
    add_if_any("viscosity", lambda b: b.composition.branches.shape[1], "Maxwell branches of", "no material has branches")
    reasons = []
    for given, why in (("auto", f"a poisson of at least {NEARLY_INCOMPRESSIBLE} in linear tets of"), ("mean", "requested for")):
        if names := [b.name for b in scene.bodies if (b.given_dilatation, b.dilatation) == (given, "mean")]:
            reasons.append(f"{why} {_shorten(names)}")
    plan.add("mean_dilatation", bool(reasons), "; ".join(reasons), "every body has local dilatation")
    quadratic = [b.name for b in scene.bodies if b.order == 2]
    add_if_any("quadratic_tets", lambda b: b.order == 2, "bodies of order 2:", "every body is of order 1")
    plan.add(
        "consistent_weight",
        quadratic and not explicit,
        "gravity on quadratic tets acts as int rho N g dV",
        "explicit steps take gravity as an acceleration" if quadratic else "on linear tets it is the lumped mass",
    )
    plan.add(
        "consistent_mass",
        quadratic and not explicit,
        f"quadratic tets of {_shorten(quadratic)} in implicit steps",
        "explicit steps need a diagonal mass" if quadratic else "the mass of linear tets is lumped",
    )
    loaded = [b.name for b in scene.bodies if any(load.feature == DEAD for load in b.loads)]
    why = f"tractions or forces on {_shorten(loaded)}" if loaded else "bodies can be dragged"
    plan.add("loads", loaded or draggable, why, "no traction and no force")
    pressed = [b.name for b in scene.bodies if any(load.feature == FOLLOWER for load in b.loads)]
    plan.add("pressure", pressed, f"on {_shorten(pressed)}", "no surface is under pressure")
    varied = [b.name for b in scene.bodies if any(load.path for load in (*b.loads, *b.activations))] + [
        t.name for t in scene.tendons if t.path
    ]
    varied += [one.name for one in scene.connections if scene.moves(one) and one.name not in varied]
    plan.add("load_paths", varied, f"on {_shorten(varied)}", "every load is constant")
    fixes, moves = ((lambda b, m=m: any((c.path is not None) == m for c in scene.constraints(b))) for m in (False, True))
    add_if_any("fixed_nodes", fixes, "on", "no node is fixed")
    add_if_any("moving_nodes", moves, "paths on", "no node follows a path")
    for damping in ("mass_damping", "stiffness_damping"):
        add_if_any(damping, lambda b, d=damping: getattr(b.composition.first, d) > 0, "material of", f"every {damping} is 0")
    exact = [one.name for one in scene.dependent_attachments]
    connected = [one.name for one in scene.connections if one not in scene.exact_attachments]
    plan.add("springs", connected, _shorten(connected), "no spring, tendon or attachment by springs")
    embedded = [body.name for body in scene.bodies if body.nodes.embedded is not None]
    why_not = "no node is attached exactly, and no surface embedded"
    plan.add("dependent_nodes", exact or embedded, _shorten(exact + embedded), why_not)
    rigid = [body.name for body in scene.rigid_bodies]
    plan.add("rigid_bodies", rigid, _shorten(rigid), "every body is elastic")
    plan.add(
        "rigid_damping",
        rigid and not explicit and scene.pushes(self_collision),
        f"implicit steps damp the strains that impacts leave in {_shorten(rigid)}",
        "explicit steps store no strain" if rigid and explicit else "no impact strains a rigid body",
    )
    why_not = "implicit steps keep rigid bodies rigid by elasticity" if rigid else "every body is elastic"
    plan.add("rigid_motion", rigid and explicit, f"explicit steps move {_shorten(rigid)} as rigid bodies", why_not)
    damped = [one.name for one in scene.connections if one.damping > 0.0]
    plan.add("spring_damping", damped, _shorten(damped), "no spring or attachment is damped")
    plan.add("assembled_stiffness", not explicit, "implicit steps solve linear systems", "explicit steps need forces only")
    plan.add("past_states", multistep, "the integrator uses the two previous steps", "a one-step integrator")
    plan.add(
        "inversion_handling",
        not explicit,
        "directions of negative curvature lead out of inverted tets",
        "explicit steps need forces only, and every law defines them for inverted tets too",
    )
    restless = never_resting(scene)
    why_not = (
        "switched off, or steps follow a tolerance"
        if not sleep
        else "explicit steps move everything"
        if explicit
        else "every body is driven"
    )
    plan.add(
        "sleeping",
        sleep and not explicit and len(restless) < len(scene.bodies),
        "implicit steps leave out bodies at rest" + (f", but for {_shorten(restless)}" if restless else ""),
        why_not,
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
    meshes = [b.name for b in (scene.bodies if self_collision else hit) if b.contact_mode == "proximity"]
    n_meshes = len(meshes) + sum(isinstance(o.shape, MeshObstacle) for o in obstacles)
    meet = bool(meshes) and (self_collision or n_meshes > 1)
    plan.add("mortar", meet, f"mean gaps of {_shorten(meshes)} to meshes", "no two meshes hit by proximity can touch")
    plan.add("self_collision", self_collision, "requested", "not requested")
    several = len(scene.colliders) > 1
    plan.add(
        "contact_forces",
        scene.pushes(self_collision),
        f"{_shorten([c.name for c in scene.colliders])} can touch" if several else "it can touch itself",
        "one body, and nothing that it could touch" if scene.contact_forces else "the scene's contact_forces are off",
    )


def change_material(body: Body, numbers: dict, on: dict[str, bool], region: int | str | None = None) -> None:
    """Replace numbers of a body's material, or of one of its regions; young, poisson and density may be (m,).

    Laws cannot change at run time, nor what is compiled out: damping, and elasticity that differs from tet to tet. on: the plan's
    switches. Warnings point to the line of the caller's caller. Raises SceneError.
    """
    what = f"body {body.name!r}"
    if isinstance(body, RigidBody):
        raise SceneError(f"rigid body {body.name!r}: its numbers cannot change: add another one before the Simulator is made")
    changeable = (*body.composition.tet_numbers, *CHANGEABLE)
    for name in numbers:
        if name not in changeable:
            hint = checks.nearest(name, changeable)
            raise SceneError(f"{what}: {name} cannot change while it runs{hint}; {', '.join(changeable)} can")
    composition = body.composition.changed(what, numbers, region)
    composition.check_fibres(what)
    for name in numbers:
        if name in on and not on[name] and getattr(composition.first, name) != 0.0:
            rule = "was 0 everywhere at the start and is not modelled; start with a small value to change it later"
            raise SceneError(f"{what}: {name} {rule}")
    if composition.elastic_by_tet and not on["elasticity_by_tet"]:
        raise SceneError(
            f"{what}: {' and '.join(body.composition.tet_numbers[:-1])} cannot differ between tets, since those of no body did "
            "at the start: give them by tet to add_body"
        )
    with thawed(body):
        body.composition = composition
    if numbers.keys() & {"poisson", *body.composition.parameters}:
        body.warn_locking(stacklevel=3)


def change_load(body: Body, kind: str, index: int, value) -> None:
    """Set the value of a body's load `index` of a kind in LOADS, counted from 0 in the order added; it replaces a path.

    value: (3,) [N], or (k,3) for the k nodes of a force; (3,) [Pa] for a traction; a number [Pa] for a pressure, or as
    given for a cavity. Raises SceneError.
    """
    what = f"body {body.name!r}: set_{checks.choice(kind, f'body {body.name!r}: set_load: kind', tuple(LOADS))}"
    rows = [k for k, one in enumerate(body.loads) if one.kind == kind]
    if not rows:
        raise SceneError(f"{what}: it has no {kind}: give it one of 0 by body.add_{kind} before the Simulator is made")
    row = rows[checks.whole(index, f"{what}: index", range(len(rows)))]
    old = body.loads[row]
    new = replace(old, value=checks.array(value, f"{what}: {kind} {index}", old.shapes), path=None, path_shape=None)
    new.check_value(what)
    body._replace("loads", row, new)


def change_tendon(scene: Scene, given: str, name: str, value) -> None:
    """Set the tension [N] or the length [m] of a tendon; it replaces a path. given: which of the two. Raises SceneError."""
    names, calls = [tendon.name for tendon in scene.tendons], {"force": "set_tension", "length": "set_length"}
    index, what = checks.index(name, names, f"{calls[given]}: no tendon"), f"tendon {name!r}"
    old = scene.tendons[index]
    if old.given != given:
        raise SceneError(f"{calls[given]}: {what} has a given {old.given}: call {calls[old.given]}")
    new = replace(old, value=checks.array(value, f"{what}: {given}", ((),)), path=None, path_shape=None)
    check_tendon(new, new.value, what)
    scene._replace("tendons", index, new)
