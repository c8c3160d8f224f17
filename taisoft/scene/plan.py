"""What a simulator models of a scene, and what may change while it runs.

The plan lists which features a scene needs, and why. Disabled features allocate no memory and launch no kernels. Numbers of
features that are enabled may change at run time, in the simulator's own copy of the scene.
"""

from collections.abc import Iterator
from dataclasses import dataclass, field, replace

from taisoft.attributes import thawed
from taisoft.errors import SceneError
from taisoft.scene import checks
from taisoft.scene.body import NEARLY_INCOMPRESSIBLE, Body
from taisoft.scene.collision import has_sharp_edges
from taisoft.scene.connections import check_tendon
from taisoft.scene.laws import LAWS
from taisoft.scene.loads import DEAD, FOLLOWER, LOAD_KINDS
from taisoft.scene.material import FIBRE_NUMBERS
from taisoft.scene.obstacles import Box, MeshObstacle
from taisoft.scene.rigid import RigidBody
from taisoft.scene.scene import Scene

OF_RATES = ("mass_damping", "stiffness_damping", "spring_damping", "rigid_damping", "consistent_mass", "viscosity", "sleeping")
CHANGEABLE = ("mass_damping", "stiffness_damping", *FIBRE_NUMBERS)  # numbers of a material, besides `Composition.tet_numbers`


# feature, the names of what asks for it or whether it is modelled, why, with {} for these names, and why not
Row = tuple[str, list[str] | bool, str, str]


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
    rows = [
        *_of_bodies(scene),
        *_of_loads(scene, draggable),
        *_of_steps(scene, explicit, multistep, sleep, scene.pushes(self_collision)),
        *_of_contacts(scene, self_collision),
    ]
    for feature, on, why, why_not in rows:
        names = _shorten(on) if isinstance(on, list) else ""
        plan.entries.append({"feature": feature, "on": bool(on), "why": why.replace("{}", names) if on else why_not})
    return plan


def _of_bodies(scene: Scene) -> Iterator[Row]:
    """Elasticity: what the tets of bodies are made of."""
    bodies = scene.bodies
    for law in (one for one in LAWS if LAWS[one].is_classic or any(one in b.composition.laws for b in bodies)):
        yield f"law:{law}", [b.name for b in bodies if law in b.composition.laws], "used by {}", "no body uses it"
    varies = "young, poisson or a parameter may differ between the tets of {}"
    by_tet = [b.name for b in bodies if b.composition.elastic_by_tet]
    yield "elasticity_by_tet", by_tet, varies, "every body has one young and one poisson"
    floors = [b.name for b in bodies if b.composition.has_volume_floor]
    yield "volume_floor", floors, "material of {}", "every volume_floor is 0"
    fibres = [b.name for b in bodies if b.fibres is not None]
    yield "fibres", fibres, "material and directions of {}", "no material has fibres"
    viscous = [b.name for b in bodies if b.composition.branches.shape[1]]
    yield "viscosity", viscous, "Maxwell branches of {}", "no material has branches"
    reasons = []
    for given, why in (("auto", f"a poisson of at least {NEARLY_INCOMPRESSIBLE} in linear tets of"), ("mean", "requested for")):
        if names := [b.name for b in bodies if (b.given_dilatation, b.dilatation) == (given, "mean")]:
            reasons.append(f"{why} {_shorten(names)}")
    yield "mean_dilatation", bool(reasons), "; ".join(reasons), "every body has local dilatation"
    for damping in ("mass_damping", "stiffness_damping"):
        damped = [b.name for b in bodies if getattr(b.composition.first, damping) > 0.0]
        yield damping, damped, "material of {}", f"every {damping} is 0"
    quadratic = [b.name for b in bodies if b.order == 2]
    yield "quadratic_tets", quadratic, "bodies of order 2: {}", "every body is of order 1"


def _of_loads(scene: Scene, draggable: bool) -> Iterator[Row]:
    """What acts on bodies, holds them and connects them."""
    bodies = scene.bodies
    loaded = [b.name for b in bodies if any(load.feature == DEAD for load in b.loads)]
    why = "tractions or forces on {}" if loaded else "bodies can be dragged"
    yield "loads", loaded or draggable, why, "no traction and no force"
    pressed = [b.name for b in bodies if any(load.feature == FOLLOWER for load in b.loads)]
    yield "pressure", pressed, "on {}", "no surface is under pressure"
    varied = [b.name for b in bodies if any(load.path for load in (*b.loads, *b.activations))]
    varied += [t.name for t in scene.tendons if t.path]
    varied += [one.name for one in scene.connections if scene.moves(one) and one.name not in varied]
    yield "load_paths", varied, "on {}", "every load is constant"
    constraints = {b.name: scene.constraints(b) for b in bodies}
    fixed = [name for name, own in constraints.items() if any(c.path is None for c in own)]
    yield "fixed_nodes", fixed, "on {}", "no node is fixed"
    moved = [name for name, own in constraints.items() if any(c.path is not None for c in own)]
    yield "moving_nodes", moved, "paths on {}", "no node follows a path"
    connected = [one.name for one in scene.connections if one not in scene.exact_attachments]
    yield "springs", connected, "{}", "no spring, tendon or attachment by springs"
    dependent = [one.name for one in scene.dependent_attachments]
    dependent += [b.name for b in bodies if b.nodes.embedded is not None]
    yield "dependent_nodes", dependent, "{}", "no node is attached exactly, and no surface embedded"
    damped = [one.name for one in scene.connections if one.damping > 0.0]
    yield "spring_damping", damped, "{}", "no spring or attachment is damped"
    yield "rigid_bodies", [body.name for body in scene.rigid_bodies], "{}", "every body is elastic"


def _of_steps(scene: Scene, explicit: bool, multistep: bool, sleep: bool, pushes: bool) -> Iterator[Row]:
    """What the kind of steps asks for, or leaves out. pushes: whether there can be contact forces."""
    quadratic = [b.name for b in scene.bodies if b.order == 2]
    why_not = "explicit steps take gravity as an acceleration" if quadratic else "on linear tets it is the lumped mass"
    yield "consistent_weight", quadratic and not explicit, "gravity on quadratic tets acts as int rho N g dV", why_not
    why = f"quadratic tets of {_shorten(quadratic)} in implicit steps"
    why_not = "explicit steps need a diagonal mass" if quadratic else "the mass of linear tets is lumped"
    yield "consistent_mass", quadratic and not explicit, why, why_not
    rigid = [body.name for body in scene.rigid_bodies]
    why = f"implicit steps damp the strains that impacts leave in {_shorten(rigid)}"
    why_not = "explicit steps store no strain" if rigid and explicit else "no impact strains a rigid body"
    yield "rigid_damping", rigid and not explicit and pushes, why, why_not
    why_not = "implicit steps keep rigid bodies rigid by elasticity" if rigid else "every body is elastic"
    yield "rigid_motion", rigid and explicit, f"explicit steps move {_shorten(rigid)} as rigid bodies", why_not
    yield "assembled_stiffness", not explicit, "implicit steps solve linear systems", "explicit steps need forces only"
    yield "past_states", multistep, "the integrator uses the two previous steps", "a one-step integrator"
    why = "directions of negative curvature lead out of inverted tets"
    why_not = "explicit steps need forces only, and every law defines them for inverted tets too"
    yield "inversion_handling", not explicit, why, why_not
    restless = never_resting(scene)
    why = "implicit steps leave out bodies at rest" + (f", but for {_shorten(restless)}" if restless else "")
    off = "switched off, or steps follow a tolerance"
    why_not = off if not sleep else "explicit steps move everything" if explicit else "every body is driven"
    yield "sleeping", sleep and not explicit and len(restless) < len(scene.bodies), why, why_not


def _of_contacts(scene: Scene, self_collision: bool) -> Iterator[Row]:
    """Contact detection: a body takes part only if another collider has triangles that can hit it."""
    obstacles = scene.obstacles
    yield "obstacles", [one.name for one in obstacles], "{}", "the scene has none"
    with_triangles = len(scene.bodies) + sum(one.shape.surface() is not None for one in obstacles)
    hit = scene.bodies if with_triangles > 1 else ()
    modes: dict[str, list[str]] = {"distance_field": [], "proximity": []}
    for body in hit:
        modes[body.contact_mode].append(body.name if body.collision == "auto" else f"{body.name} (requested)")
    by_field, near = modes["distance_field"], modes["proximity"]
    near += [f"{one.name} (triangles)" for one in obstacles if isinstance(one.shape, MeshObstacle) and scene.bodies]
    near += [f"{one.name} (edges)" for one in obstacles if isinstance(one.shape, Box) and scene.bodies]
    near += [f"{b.name} (sharp edges)" for b in hit if b.contact_mode == "distance_field" and has_sharp_edges(b.nodes)]
    near += ["every body (itself)"] * self_collision
    idle = "no triangles can hit a body" if not hit else "every body is hit by "
    yield "distance_fields", bool(by_field), "hits " + ", ".join(by_field), idle + ("proximity" if hit else "")
    yield "proximity", bool(near), "hits " + ", ".join(near), idle + ("its distance field" if hit else "")
    meshes = [b.name for b in (scene.bodies if self_collision else hit) if b.contact_mode == "proximity"]
    n_meshes = len(meshes) + sum(isinstance(one.shape, MeshObstacle) for one in obstacles)
    meet = bool(meshes) and (self_collision or n_meshes > 1)
    yield "mortar", meet, f"mean gaps of {_shorten(meshes)} to meshes", "no two meshes hit by proximity can touch"
    yield "self_collision", self_collision, "requested", "not requested"
    colliders = [one.name for one in scene.colliders]
    why = f"{_shorten(colliders)} can touch" if len(colliders) > 1 else "it can touch itself"
    why_not = "one body, and nothing that it could touch" if scene.contact_forces else "the scene's contact_forces are off"
    yield "contact_forces", scene.pushes(self_collision), why, why_not


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
    """Set the value of a body's load `index` of a kind in LOAD_KINDS, counted from 0 in the order added; it replaces a path.

    value: (3,) [N], or (k,3) for the k nodes of a force; (3,) [Pa] for a traction; a number [Pa] for a pressure, or as
    given for a cavity. Raises SceneError.
    """
    what = f"body {body.name!r}: set_{checks.choice(kind, f'body {body.name!r}: set_load: kind', tuple(LOAD_KINDS))}"
    rows = [k for k, one in enumerate(body.loads) if one.kind == kind]
    if not rows:
        call = f"add_{kind}" if hasattr(body, f"add_{kind}") else f"add_load({kind!r}, ...)"
        raise SceneError(f"{what}: it has no {kind}: give it one of 0 by body.{call} before the Simulator is made")
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
