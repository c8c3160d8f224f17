"""Read and write what the methods of a body were given: lists of tables such as [[bodies.NAME.fix]], one for each call."""

from collections.abc import Callable

import numpy as np

from taisoft.errors import SceneError
from taisoft.scene.body import Body
from taisoft.scene.key_frames import KeyFrames, NodePath
from taisoft.scene.tables import Table, arguments_of

VARYING = ("pressure", "volume", "activation")  # arguments that may be key frames, besides the one named like the list


def call_methods(
    body: Body,
    table: Table,
    label: str,
    methods: dict[str, Callable],
    items_of: Callable,
    selection: Callable,
    optional: bool = False,
) -> None:
    """Call the methods of a body with the tables in its lists. label: of the body in messages; methods: by the list's name.

    items_of: the list's name -> what the argument `where` is called in the file; selection: (table, that) -> what it chooses.
    optional: whether it may be missing, which chooses None. Raises SceneError.
    """
    for key, method in methods.items():
        items = items_of(key)
        known, required = ([items if k == "where" else k for k in keys] for keys in arguments_of(method))
        for one in table.listed(key, known, [k for k in required if not (optional and k == items)]):
            extra = {}
            if items in known:
                extra["where"] = selection(one, items) if items in one else None
            if "path" in one:
                extra["path"] = one.made("path", KeyFrames, "key frames: ")
            for argument in (key, *VARYING):
                if argument in known and isinstance(one.values.get(argument), dict):  # a load that varies
                    extra[argument] = one.made(argument, KeyFrames, "key frames: ")
            others = [k for k in known if k not in (items, *extra)]
            one.make(getattr(body, method.__name__), f"{label}: {method.__name__}: ", keys=others, **extra)


def constraint_tables(body: Body, label: str, nodes_of: Callable, foreign: str, fields: Callable) -> dict[str, list[dict]]:
    """Return the lists fix and move of a body. label: of the body in messages; nodes_of: constraint -> its entry of nodes.

    foreign: what is wrong with a path with rotations that was made for other start positions; fields: of records, as the file's
    writer stores them. Raises SceneError for a path that a file cannot store.
    """
    table = {"fix": [], "move": []}
    for c in body.constraints:
        entry = nodes_of(c) | {"axes": "".join(np.array(list("xyz"))[c.axes])}
        if c.path is None:
            table["fix"].append(entry)
        elif isinstance(c.path, NodePath):
            own = np.array_equal(c.path.starts, body.rest_positions[c.nodes] + body.position)
            if not own and c.path.frames.rotations is not None:  # without rotations the start does not matter
                raise SceneError(f"{label}: {foreign}")
            table["move"].append(entry | {"path": fields(c.path.frames)})
        else:
            raise SceneError(f"{label}: moves along a function, which a file cannot store: use ts.KeyFrames")
    return table
