"""Read and write what methods of bodies and scenes were given: a table for each call, whose keys are the method's arguments.

Lists such as [[bodies.NAME.fix]] hold the calls of a body; tables such as [springs.NAME] those of the scene.
"""

from collections.abc import Callable
from dataclasses import dataclass
from functools import cache

import numpy as np

from taisoft.errors import SceneError
from taisoft.scene import checks
from taisoft.scene.body import Body
from taisoft.scene.connection_records import Attachment, Point
from taisoft.scene.key_frames import KeyFrames, NodePath
from taisoft.scene.loads import LOAD_KINDS, BodyLoad
from taisoft.scene.obstacles import HalfSpace
from taisoft.scene.rigid import RigidBody
from taisoft.scene.scene import Scene
from taisoft.scene.tables import Table, arguments_of, key_path, value_text
from taisoft.scene.toml_values import fields_of, ids_of, nodes_of


@dataclass(frozen=True)
class Call:
    """How a file holds the calls of a method. key: of their tables; items: what the argument `where` is called."""

    key: str
    method: str
    items: str = "nodes"
    varying: tuple[str, ...] = ()  #: arguments that may be key frames, besides `path`
    points: tuple[str, ...] = ()  #: arguments that are points of bodies or obstacles

    def arguments(self, owner: Body | Scene) -> tuple[list[str], list[str]]:
        """Return the keys of a table, and those that it must have."""
        function = LOAD_KINDS[self.key].of if self.method == "add_load" else getattr(owner, self.method)
        excluded = ("body", "what") if isinstance(owner, Body) else ("name",)
        known, required = arguments_of(function, *excluded)
        is_optional = isinstance(owner, RigidBody)  # nodes: without them its centre of mass
        required = [key for key in required if key != "where" or not is_optional]
        return tuple([self.items if key == "where" else key for key in keys] for keys in (known, required))


OF_RIGID = ("fix", "move", "force")
CONNECTIONS = {
    "springs": Call("springs", "add_spring", points=("a", "b")),
    "tendons": Call("tendons", "add_tendon", varying=("force", "length"), points=("points",)),
    "attachments": Call("attachments", "attach"),
}


def body_calls() -> dict[str, Call]:
    """Return the calls of bodies by key, those of all kinds of loads included."""
    return _calls_with(tuple(LOAD_KINDS))


@cache
def _calls_with(kinds: tuple[str, ...]) -> dict[str, Call]:
    calls = [Call("fix", "fix"), Call("move", "move"), Call("activate", "activate", varying=("activation",))]
    for kind in kinds:
        load = LOAD_KINDS[kind]
        of_value, _ = arguments_of(load.of, "body", "what", "where", *load.own)
        calls.insert(-1, Call(kind, "add_load", load.items, tuple(of_value)))
    return {one.key: one for one in calls}


def call_methods(body: Body, table: Table) -> None:
    """Call the methods of a body with the tables in its lists. Raises SceneError."""
    for key, call in body_calls().items():
        if key not in table:
            continue
        first = () if call.method != "add_load" else (key,)
        name = f"add_{key}" if first else call.method
        for one in table.listed(key, *call.arguments(body)):
            _make(body, call, one, f"{body._label()}: {name}: ", first=first)


def add_connections(scene: Scene, tables: Table) -> None:
    """Add the connections in the tables of a file. Raises SceneError."""
    for key, call in CONNECTIONS.items():
        parent, item = tables.named(key), key[:-1]
        for name in parent.known:
            table = parent.table(name, *call.arguments(scene))
            _make(scene, call, table, f"{item} {name!r}: ", f"scene: {item} ", name=name)


def _make(owner: Body | Scene, call: Call, table: Table, *prefixes: str, first: tuple = (), **named) -> None:
    """Call a method with the values of a table. first, named: further arguments."""
    made = dict(named)
    if call.items in table.known:
        made["where"] = selection(table, call.items) if call.items in table else None
    for key, value in table.values.items():
        if key in call.points:
            made[key] = _point(table, key, value) if key != "points" else _points(table, key)
        elif key == "path" or (key in call.varying and isinstance(value, dict)):
            made[key] = table.made(key, KeyFrames, "key frames: ")
    keys = [key for key in table.known if key not in (call.items, *made)]
    method = getattr(owner, call.method)
    table.make(lambda **values: method(*first, **values), *prefixes, keys=keys, **made)


def _points(table: Table, key: str) -> list:
    if not isinstance(table.values[key], list):
        raise table.error(key, 'must be a list of points ["NAME", POINT]')
    return [_point(table, key, value, f"[{k}]") for k, value in enumerate(table.values[key])]


def _point(table: Table, key: str, value, entry: str = "") -> tuple:
    """Return the name and the point of a list of the two. entry: where it is in the key's value."""
    if not isinstance(value, list) or len(value) != 2 or not isinstance(value[0], str):
        place = f"{table.file}: {key_path(table.place, key)}{entry}"
        raise SceneError(f'{place} must be ["NAME", POINT], a body or an obstacle, and a position or a node id')
    return value[0], value[1]


def selection(table: Table, key: str) -> Callable | list:
    """Return ids, or a function of points (n,3) that returns a bool mask (n,) and also works on another mesh."""
    value = table.values[key]
    if value == "all":
        return lambda X: np.ones(len(X), dtype=bool)
    if isinstance(value, list):
        if not all(isinstance(entry, int) and not isinstance(entry, bool) for entry in value):
            raise table.error(key, "must be a list of whole numbers, the ids")
        return value
    if not isinstance(value, dict) or len(value) != 1:
        raise table.error(key, f'must be "all", a list of ids, or a table with one of box, half_space, not {value_text(value)}')
    choice = table.table(key, ["box", "half_space"])
    if "box" in choice:
        box = choice.table("box", ["min", "max"], ["min", "max"])
        corners = {end: box.checked(end) for end in ("min", "max")}
        with box.located_errors():
            low, high = (checks.vector(value, end) for end, value in corners.items())
        if not (low <= high).all():
            raise box.error("min", "must not exceed max")
        return lambda X: ((X >= low) & (X <= high)).all(axis=1)
    half = choice.made("half_space", HalfSpace, "half-space: ")
    return lambda X: (X - half.point) @ half.normal <= 0.0


def calls_of(body: Body, foreign: str) -> dict[str, list[dict]]:
    """Return the lists of a body's calls. Raises SceneError for a path that a file cannot store.

    foreign: what is wrong with a path with rotations that was made for other start positions.
    """
    what, found = body._label(), {key: [] for key in body_calls()}
    for one in body.constraints:
        entry = nodes_of(body, one.nodes) | {"axes": "".join(np.array(list("xyz"))[one.axes])}
        if one.path is None:
            found["fix"].append(entry)
            continue
        frames = stored(one.path.frames if isinstance(one.path, NodePath) else one.path, f"{what}: moves")
        own = np.array_equal(one.path.starts, body.rest_positions[one.nodes] + body.position)
        if not own and "rotations" in frames:  # without rotations the start does not matter
            raise SceneError(f"{what}: {foreign}")
        found["move"].append(entry | {"path": frames})
    for load in body.loads:
        found[load.kind].append(_entry(load, what, body))
    for one in body.activations:
        if one.path is not None or one.value != 0.0:
            region = {} if one.region is None else {"region": body.mesh.region_names.get(one.region, one.region)}
            found["activate"].append(region | {one.given: stored(one.given_value, f"{what}: has an activation")})
    return found


def connection_tables(scene: Scene) -> dict[str, dict]:
    """Return the tables of a scene's connections. Raises SceneError for a tendon along a function."""
    return {
        key: {
            one.name: _entry(one, f"{key[:-1]} {one.name!r}", scene.body(one.a) if isinstance(one, Attachment) else None)
            for one in getattr(scene, key)
        }
        for key in CONNECTIONS
    }


def _entry(one, what: str, body: Body | None) -> dict:
    """Return the table of a call that made a load or a connection. body: whose nodes or triangles `where` chose."""
    table = {}
    for key, value in one.arguments.items():
        if key != "where":
            table |= {} if value is None else {key: stored(value, f"{what}: has a {key}")}
        elif isinstance(one, BodyLoad) and one.items == "triangles":
            table["triangles"] = ids_of(value, len(body.mesh.surface))
        else:
            table |= nodes_of(body, value)
    return table


def stored(value, what: str):
    """Return an argument as a file holds it. what: start of the message if it is a function. Raises SceneError."""
    if isinstance(value, KeyFrames):
        return fields_of(value)
    if callable(value):
        raise SceneError(f"{what} along a function, which a file cannot store: use ts.KeyFrames")
    if isinstance(value, Point):
        return [value.owner, value.position.tolist()]
    if isinstance(value, tuple):
        return [stored(one, what) for one in value]
    return value.item() if isinstance(value, (np.ndarray, np.generic)) and not value.ndim else value
