"""The numbers of a scene by name, such as "beam.young": what checkpoints hold and compare, and `taisoft run --set` sets."""

import dataclasses
import re
import reprlib
from collections.abc import Callable, Iterator
from functools import partial

import numpy as np

from taisoft.attributes import thawed
from taisoft.errors import SceneError
from taisoft.scene import checks
from taisoft.scene.body import Body
from taisoft.scene.body_loads import activate_fibres
from taisoft.scene.laws import LAWS
from taisoft.scene.material import FIBRE_NUMBERS, MODULI, Material
from taisoft.scene.plan import change_load, change_tendon
from taisoft.scene.rigid import RigidBody
from taisoft.scene.scene import Scene

Numbers = dict[str, float | list | np.ndarray | None]  # of a scene, by name
Entry = tuple[str, float | list | np.ndarray | None, Callable]  # name, value, and the call that sets it
NUMBERS = tuple(one.name for one in dataclasses.fields(Material) if one.name not in ("law", "parameters", "branches"))


def scene_numbers(scene: Scene) -> Numbers:
    """Return gravity, and all numbers of materials, loads, obstacles, connections, and pairs that have their own.

    Arrays are numbers by tet (m,), and forces per node (k,3). None: chosen by the Simulator, by region, or along a path.
    """
    found = {}
    for name, value, _ in _entries(scene):
        if name in found:
            raise SceneError(f"two numbers of the scene are called {name!r}: rename a body, a region or an obstacle")
        found[name] = value
    return found


def set_numbers(scene: Scene, numbers: Numbers) -> None:
    """Set numbers by name, also friction and restitution of any pair, "contact.a.b.friction", and looks. Raises SceneError.

    Looks are colour and opacity of bodies and obstacles, such as "ball.colour", and "scene.background". A number for a whole body
    replaces those by region and by tet, and that of a load its path.
    """
    calls = {known: assign for known, _, assign in _entries(scene)} | _looks(scene)
    for name, value in numbers.items():
        pair = re.fullmatch(r"contact\.(.+\..+)\.(friction|restitution)", name)
        if name in calls:
            calls[name](value)
        elif pair:
            _set_pair(scene, *pair.groups(), value)
        else:
            hint = checks.nearest(name, calls) or f"; it has {', '.join(list(calls)[:3])}{', ...' * (len(calls) > 3)}"
            raise SceneError(f"the scene has no number {name!r}{hint}")


def _entries(scene: Scene) -> Iterator[Entry]:
    yield "gravity", scene.gravity.tolist(), partial(setattr, scene, "gravity")
    for body in scene.bodies:
        own = (_of_rigid if isinstance(body, RigidBody) else _of_material)(body)
        yield from (one for one in own if body.fibres is not None or one[0].rpartition(".")[2] not in FIBRE_NUMBERS)
        yield from () if body.fibres is None else _of_fibres(body)
        for kind, i, load in body.numbered_loads:
            named = getattr(load, "name", None)
            value = load.value if load.value is None or load.value.ndim == 2 else load.value.tolist()
            yield f"{named}.{load.given}" if named else f"{body.name}.{kind}.{i}", value, partial(change_load, body, kind, i)
    for one in scene.tendons:
        value = None if one.value is None else float(one.value)
        yield f"{one.name}.{one.given}", value, partial(change_tendon, scene, one.given, one.name)
    exact = scene.exact_attachments
    for kind in ("obstacles", "springs", "tendons", "attachments"):
        for k, one in enumerate(getattr(scene, kind)):
            for name in one.numbers:
                if (value := vars(one).get(name)) is not None and one not in exact:
                    yield f"{one.name}.{name}", value, partial(_set_in, scene, kind, k, name)
    for names, pair in scene.contact_pairs.items():
        ends = f"{min(names)}.{max(names)}"
        for name, value in zip(("friction", "restitution"), pair):
            yield f"contact.{ends}.{name}", value, partial(_set_pair, scene, ends, name)


def _looks(scene: Scene) -> dict[str, Callable]:
    """Return the calls that set how a scene looks, by name; these are no numbers, so that checkpoints do not compare them."""
    calls = {"scene.background": partial(setattr, scene, "background")}
    for key in ("colour", "opacity"):
        calls |= {f"{body.name}.{key}": partial(setattr, body, key) for body in scene.bodies}
        calls |= {f"{one.name}.{key}": partial(_set_in, scene, "obstacles", k, key) for k, one in enumerate(scene.obstacles)}
    return calls


def _of_material(body: Body) -> Iterator[Entry]:
    composition = body.composition
    for region, material in composition.materials.items() if composition.has_regions else ():
        owner = f"{body.name}.{body.mesh.region_names.get(region, region)}"
        for name in (*LAWS[material.law].numbers, "density", "volume_floor"):
            yield f"{owner}.{name}", getattr(material, name), partial(_set_material, body, name, region)
    own = composition.tet_numbers  # young and poisson, parameters of laws, density
    for name in (*own, *(name for name in NUMBERS if name not in (*own, *MODULI))):
        has = [one for one in composition.materials.values() if name not in own or name in (*LAWS[one.law].numbers, "density")]
        by_region = {getattr(one, name) for one in has}
        value = composition.by_tet.get(name, by_region.pop() if len(by_region) == 1 else None)
        yield f"{body.name}.{name}", value, partial(_set_material, body, name, None)


def _of_fibres(body: Body) -> Iterator[Entry]:
    """Activations, and the numbers of the fibres of regions with their own material."""
    for region in (None, *body.mesh.region_ids):
        owner = body.name if region is None else f"{body.name}.{body.mesh.region_names.get(region, region)}"
        for name in FIBRE_NUMBERS if body.composition.has_regions and region is not None else ():
            value = getattr(body.composition.materials[region], name)
            yield f"{owner}.{name}", value, partial(_set_material, body, name, region)
        values = {None if one.value is None else float(one.value) for one in body.activations if region in (None, one.region)}
        value = values.pop() if len(values) == 1 else None
        yield f"{owner}.activation", value, partial(activate_fibres, body, region=region, what=f"body {body.name!r}: activate")


def _of_rigid(body: RigidBody) -> Iterator[Entry]:
    first = body.composition.first
    given = {"density": body.density, "friction": first.friction, "restitution": first.restitution, "young": body.given_young}
    for name, value in given.items():
        yield f"{body.name}.{name}", value, partial(_set_rigid, body, given, name)


def _set_material(body: Body, name: str, region: int | None, value) -> None:
    body._compose(body.composition.changed(f"body {body.name!r}", {name: value}, region))


def _set_rigid(body: RigidBody, given: dict, name: str, value) -> None:
    given[name] = value
    made = RigidBody(body.name, body.shape, position=body.position, **body.start_twist._asdict(), **given)
    with thawed(body):
        for key in ("_density", "inertia", "given_young", "_young", "composition"):
            setattr(body, key, getattr(made, key))


def _set_in(scene: Scene, kind: str, k: int, name: str, value) -> None:
    """Replace a number of an obstacle or a connection, which are records in a list of the scene."""
    scene._replace(kind, k, dataclasses.replace(getattr(scene, kind)[k], **{name: value}))


def _set_pair(scene: Scene, ends: str, name: str, value) -> None:
    """Set a number of a pair. ends: its names, with a dot between them."""
    first = max((one.name for one in scene.colliders if ends.startswith(f"{one.name}.")), key=len, default=ends.partition(".")[0])
    scene.set_contact(first, ends[len(first) + 1 :], **{name: value})


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
