"""Read and write the rigid bodies of a scene file."""

from collections.abc import Callable

import numpy as np

from taisoft.errors import SceneError
from taisoft.mesh.surface_mesh import SurfaceMesh
from taisoft.mesh.tet_mesh import TetMesh
from taisoft.scene.key_frames import KeyFrames, NodePath
from taisoft.scene.rigid import FRAME, RigidBody
from taisoft.scene.scene import Scene
from taisoft.scene.tables import Table, arguments_of
from taisoft.scene.toml_meshes import solid_of

NUMBERS = ("position", "friction", "restitution")
METHODS = {"fix": RigidBody.fix, "move": RigidBody.move, "force": RigidBody.add_force}


def add_rigid_body(scene: Scene, name: str, bodies: Table, selection: Callable, allow_outside: bool) -> None:
    """Add the rigid body in a table of `bodies`. selection: (table, key) -> what chooses vertices. Raises SceneError."""
    known, _ = arguments_of(Scene.add_rigid_body, "name", "mesh")
    table = bodies.table(name, [*known, "mesh", *METHODS], ["mesh"])
    mesh = solid_of(table, allow_outside)
    body = table.make(scene.add_rigid_body, f"rigid body {name!r}: ", "scene: ", keys=known, mesh=mesh, name=name)
    for key, method in METHODS.items():
        known, required = (["nodes" if k == "where" else k for k in keys] for keys in arguments_of(method))
        for one in table.listed(key, known, [k for k in required if k != "nodes"]):
            extra = {"where": selection(one, "nodes") if "nodes" in one else None} if key == "force" else {}
            for argument in ("path", "force"):
                if argument in known and isinstance(one.values.get(argument), dict):
                    extra[argument] = one.made(argument, KeyFrames, "key frames: ")
            others = [k for k in known if k not in ("nodes", *extra)]
            one.make(getattr(body, method.__name__), f"rigid body {name!r}: {method.__name__}: ", keys=others, **extra)


def surface_table(surface: SurfaceMesh) -> dict:
    """Return the table of a surface."""
    return {"vertices": surface.vertices, "triangles": surface.triangles}


def rigid_table(body: RigidBody, file_of: Callable[[TetMesh], dict], fields: Callable, load: Callable) -> dict:
    """Return the table of a rigid body. file_of: mesh -> its table; fields, load: of records, as the file's writer stores them.

    Raises SceneError for what a file cannot store.
    """
    table = {"mesh": file_of(body.shape) if isinstance(body.shape, TetMesh) else surface_table(body.shape)}
    linear, angular = body.start_twist
    first = body.composition.first
    table |= {"density": body.density, "position": body.position, "velocity": linear, "angular_velocity": angular}
    table |= {"friction": first.friction, "restitution": first.restitution, "fix": [], "move": [], "force": []}
    if body.given_young is not None:
        table["young"] = body.given_young
    for c in body.constraints:
        axes = {"axes": "".join(np.array(list("xyz"))[c.axes])}
        if c.path is None:
            table["fix"].append(axes)
        elif isinstance(c.path, NodePath):
            own = np.array_equal(c.path.starts, body.mesh.vertices + body.position)
            if not own and c.path.frames.rotations is not None:  # without rotations the start does not matter
                raise SceneError(f"rigid body {body.name!r}: its position was set after its path with rotations: move it again")
            table["move"].append(axes | {"path": fields(c.path.frames)})
        else:
            raise SceneError(f"rigid body {body.name!r}: moves along a function, which a file cannot store: use ts.KeyFrames")
    for one in body.forces:
        at = {} if one.nodes.max() < FRAME else {"nodes": one.nodes - FRAME}
        table["force"].append(at | {"force": load(body, one)})
    return table
