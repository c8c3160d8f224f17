"""Read and write what the methods of a body were given: lists of tables such as [[bodies.NAME.fix]], one for each call."""

import numpy as np

from taisoft.errors import SceneError
from taisoft.scene import checks
from taisoft.scene.body import Body
from taisoft.scene.key_frames import KeyFrames, NodePath
from taisoft.scene.obstacles import HalfSpace
from taisoft.scene.rigid import RigidBody
from taisoft.scene.tables import Table, arguments_of, value_text
from taisoft.scene.toml_values import frames_of, nodes_of

METHODS = {
    "fix": "fix",
    "move": "move",
    "traction": "add_traction",
    "force": "add_force",
    "pressure": "add_pressure",
    "cavity": "add_cavity",
    "activate": "activate",
}
OF_RIGID = ("fix", "move", "force")
ON_TRIANGLES = ("traction", "pressure", "cavity")  # methods that choose surface triangles, not nodes
VARYING = ("pressure", "volume", "activation")  # arguments that may be key frames, besides the one named like the list


def call_methods(body: Body, table: Table) -> None:
    """Call the methods of a body with the tables in its lists; a rigid body's may lack nodes. Raises SceneError."""
    for key in (key for key in METHODS if key in table.known):
        items, method = "triangles" if key in ON_TRIANGLES else "nodes", getattr(body, METHODS[key])
        known, required = ([items if k == "where" else k for k in keys] for keys in arguments_of(method))
        required = [k for k in required if k != items or not isinstance(body, RigidBody)]
        for one in table.listed(key, known, required):
            extra = {}
            if items in known:
                extra["where"] = selection(one, items) if items in one else None
            if "path" in one:
                extra["path"] = one.made("path", KeyFrames, "key frames: ")
            for argument in (key, *VARYING):
                if argument in known and isinstance(one.values.get(argument), dict):  # a load that varies
                    extra[argument] = one.made(argument, KeyFrames, "key frames: ")
            others = [k for k in known if k not in (items, *extra)]
            one.make(method, f"{body._label()}: {METHODS[key]}: ", keys=others, **extra)


def selection(table: Table, key: str):
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


def constraint_tables(body: Body, foreign: str) -> dict[str, list[dict]]:
    """Return the lists fix and move of a body. Raises SceneError for a path that a file cannot store.

    foreign: what is wrong with a path with rotations that was made for other start positions.
    """
    table = {"fix": [], "move": []}
    for c in body.constraints:
        entry = nodes_of(body, c.nodes) | {"axes": "".join(np.array(list("xyz"))[c.axes])}
        if c.path is None:
            table["fix"].append(entry)
            continue
        frames = frames_of(c.path, NodePath, f"{body._label()}: moves")
        own = np.array_equal(c.path.starts, body.rest_positions[c.nodes] + body.position)
        if not own and "rotations" in frames:  # without rotations the start does not matter
            raise SceneError(f"{body._label()}: {foreign}")
        table["move"].append(entry | {"path": frames})
    return table
