"""Read and write the springs, tendons and attachments of a scene file."""

from taisoft.errors import SceneError
from taisoft.scene.connection_records import Point
from taisoft.scene.key_frames import KeyFrames
from taisoft.scene.scene import Scene
from taisoft.scene.tables import Table, arguments_of, key_path
from taisoft.scene.toml_methods import selection
from taisoft.scene.toml_values import load_value, nodes_of

CONNECTIONS = {"springs": "add_spring", "tendons": "add_tendon", "attachments": "attach"}  # key at top level -> method


def add_connections(scene: Scene, tables: Table) -> None:
    """Add the connections in the tables of a file. Raises SceneError."""
    for kind, call in CONNECTIONS.items():
        parent, item, method = tables.named(kind), kind[:-1], getattr(scene, call)
        known, required = arguments_of(method, "name")
        known, required = (["nodes" if key == "where" else key for key in keys] for keys in (known, required))
        for name in parent.known:
            table = parent.table(name, known, required)
            points = {} if kind == "attachments" else {key: table.values[key] for key in ("a", "b", "points") if key in table}
            extra = {key: _points(table, key) if key == "points" else _point(table, key, at) for key, at in points.items()}
            if kind == "attachments":
                extra |= {"where": selection(table, "nodes")}
            else:  # a tension or a length may vary
                varied = [key for key in ("force", "length") if isinstance(table.values.get(key), dict)]
                extra |= {key: table.made(key, KeyFrames, "key frames: ") for key in varied}
            keys = [key for key in known if key not in (*extra, "nodes")]
            table.make(method, f"{item} {name!r}: ", f"scene: {item} ", keys=keys, name=name, **extra)


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


def connection_tables(scene: Scene) -> dict:
    """Return the tables of a scene's connections. Raises SceneError for a tendon along a function."""
    springs, tendons, attachments = {}, {}, {}
    for one in scene.springs:
        springs[one.name] = dict(zip("ab", map(_pair, one.points))) | {"stiffness": one.stiffness, "damping": one.damping}
        if one.rest_length is not None:
            springs[one.name]["rest_length"] = one.rest_length
    for one in scene.tendons:
        given = {one.given: load_value(one, f"tendon {one.name!r}")}
        stiffness = {} if one.stiffness is None else {"stiffness": one.stiffness}
        tendons[one.name] = {"points": [_pair(point) for point in one.points]} | given | stiffness
    for one in scene.attachments:
        nodes = nodes_of(scene.body(one.a), one.nodes)
        springs_of = {} if one.stiffness is None else {"stiffness": one.stiffness, "damping": one.damping}
        attachments[one.name] = {"a": one.a, **nodes, "b": one.b} | springs_of
    return {"springs": springs, "tendons": tendons, "attachments": attachments}


def _pair(point: Point) -> list:
    return [point.owner, point.position.tolist()]
