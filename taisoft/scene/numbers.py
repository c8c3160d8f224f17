"""The numbers of a scene by name, such as "beam.young": what checkpoints compare, and what `taisoft run --set` changes."""

import dataclasses
import reprlib
from collections.abc import Callable, Iterator
from functools import partial

import numpy as np

from taisoft.attributes import thawed
from taisoft.errors import SceneError
from taisoft.scene import checks
from taisoft.scene.body import Body
from taisoft.scene.composition import BY_TET, OF_THE_BODY
from taisoft.scene.plan import LOADS, change_load, change_tendon
from taisoft.scene.rigid import RigidBody
from taisoft.scene.scene import Scene

Numbers = dict[str, float | list | np.ndarray | None]  # of a scene, by name
Entry = tuple[str, float | list | np.ndarray | None, Callable | None]  # name, value, and the call that sets it, if there is one
LIMITS = {  # of the numbers of obstacles and connections
    "friction": {"minimum": 0.0},
    "restitution": {"minimum": 0.0, "maximum": 1.0},
    "stiffness": {"above": 0.0, "unit": "N/m"},
    "rest_length": {"minimum": 0.0, "unit": "m"},
    "damping": {"minimum": 0.0, "unit": "N s/m"},
}


def scene_numbers(scene: Scene) -> Numbers:
    """Return all numbers of a scene that --set may change, and those by tet (m,). Forces per node are arrays (k,3)."""
    return {name: value for name, value, _ in _entries(scene)}


def set_number(scene: Scene, name: str, value) -> None:
    """Set one of the `scene_numbers` of a scene, or friction or restitution of a pair: "contact.a.b.friction".

    Material numbers replace those by tet. Raises SceneError.
    """
    calls = {known: assign for known, _, assign in _entries(scene) if assign is not None}
    kind, *pair = name.split(".")
    if name in calls:
        calls[name](value)
    elif kind == "contact" and len(pair) == 3 and pair[2] in ("friction", "restitution"):
        scene.set_contact(*pair[:2], **{pair[2]: value})
    else:
        hint = checks.nearest(name, calls) or f"; there are {', '.join(list(calls)[:3])} and {len(calls) - 3} more"
        raise SceneError(f"the scene has no number {name!r}{hint}")


def _entries(scene: Scene) -> Iterator[Entry]:
    yield "gravity", scene.gravity.tolist(), partial(setattr, scene, "gravity")
    for body in scene.bodies:
        yield from (_of_rigid if isinstance(body, RigidBody) else _of_material)(body)
        for name, values in body.composition.by_tet.items():
            yield f"{body.name}.{name} by tet", values, None
        for kind, loads in LOADS.items():
            for i, load in enumerate(getattr(body, loads)):
                if load.path is None:
                    name = f"{load.name}.{load.given}" if kind == "cavity" else f"{body.name}.{kind}.{i}"
                    value = load.value if load.value.ndim == 2 else load.value.tolist()
                    yield name, value, partial(change_load, body, kind, i)
    for one in scene.tendons:
        if one.path is None:
            yield f"{one.name}.{one.given}", float(one.value), partial(change_tendon, scene, one.given, one.name)
    exact = scene.exact_attachments
    for items in (scene.obstacles, scene.springs, scene.tendons, scene.attachments):
        for k, one in enumerate(items):
            for name in (field.name for field in dataclasses.fields(one) if field.name in LIMITS and one not in exact):
                if getattr(one, name) is not None:
                    yield f"{one.name}.{name}", getattr(one, name), partial(_set_in, items, k, name)
    for names, pair in scene.contact_pairs.items():
        a, b = min(names), max(names)
        for name, value in zip(("friction", "restitution"), pair):
            yield f"contact.{a}.{b}.{name}", value, lambda value, a=a, b=b, name=name: scene.set_contact(a, b, **{name: value})


def _of_material(body: Body) -> Iterator[Entry]:
    """Numbers of a body's material or, by region, of its materials."""
    for region, material in body.composition.materials.items():
        for name, value in dataclasses.asdict(material).items():
            if name == "law":
                continue
            whole = region is None or name in OF_THE_BODY
            owner = body.name if whole else f"{body.name}.{body.mesh.region_names.get(region, region)}"
            settable = whole or name in BY_TET
            yield f"{owner}.{name}", value, partial(_set_material, body, name, None if whole else region) if settable else None


def _of_rigid(body: RigidBody) -> Iterator[Entry]:
    first = body.composition.first
    given = {"density": body.density, "friction": first.friction, "restitution": first.restitution, "young": body.given_young}
    for name, value in given.items():
        yield f"{body.name}.{name}", value, partial(_set_rigid, body, given, name)


def _set_material(body: Body, name: str, region: int | None, value) -> None:
    body._compose(body.composition.changed(f"body {body.name!r}", {name: value}, region))


def _set_rigid(body: RigidBody, given: dict, name: str, value) -> None:
    made = RigidBody(body.name, body.shape, position=body.position, **body.start_twist._asdict(), **given | {name: value})
    with thawed(body):
        for key in ("_density", "inertia", "given_young", "_young", "composition"):
            setattr(body, key, getattr(made, key))


def _set_in(items: list, k: int, name: str, value) -> None:
    """Replace a number of an obstacle or a connection, which are records."""
    value = checks.number(value, f"{items[k].name!r}: {name}", **LIMITS[name])
    list.__setitem__(items, k, dataclasses.replace(items[k], **{name: value}))


def first_difference(before: Numbers, now: Numbers) -> str:
    """Return a sentence about the first difference between two scenes' numbers; "" if there is none."""
    for name in before | now:
        old, new = before.get(name), now.get(name)
        if isinstance(old, np.ndarray) == isinstance(new, np.ndarray) and np.array_equal(old, new):
            continue
        if isinstance(old, np.ndarray) and isinstance(new, np.ndarray) and old.shape == new.shape:
            row = int(np.argmax((old != new).reshape(len(old), -1).any(axis=1)))
            name, old, new = f"{name}, {'row' if old.ndim == 2 else 'tet'} {row}", old[row], new[row]
        old, new = (value.tolist() if isinstance(value, (np.ndarray, np.generic)) else value for value in (old, new))
        old, new = ("not set" if value is None else reprlib.repr(value) for value in (old, new))
        return f"{name} is {new} in this scene and was {old} at the start of the saved run"
    return ""
