"""Read and write the rigid bodies of a scene file."""

from collections.abc import Callable

from taisoft.mesh.surface_mesh import SurfaceMesh
from taisoft.mesh.tet_mesh import TetMesh
from taisoft.scene.rigid import FRAME, RigidBody
from taisoft.scene.scene import Scene
from taisoft.scene.tables import Table, arguments_of
from taisoft.scene.toml_look import look_of
from taisoft.scene.toml_meshes import solid_of
from taisoft.scene.toml_methods import call_methods, constraint_tables

METHODS = {"fix": RigidBody.fix, "move": RigidBody.move, "force": RigidBody.add_force}


def add_rigid_body(scene: Scene, name: str, bodies: Table, selection: Callable, shared: Callable) -> None:
    """Add the rigid body in a table of `bodies`. selection: (table, key) -> what chooses vertices; shared: (table, what makes it)
    -> its mesh. Raises SceneError."""
    known, _ = arguments_of(Scene.add_rigid_body, "name", "mesh")
    table = bodies.table(name, [*known, "mesh", *METHODS], ["mesh"])
    mesh = shared(table, solid_of)
    body = table.make(scene.add_rigid_body, f"rigid body {name!r}: ", "scene: ", keys=known, mesh=mesh, name=name)
    call_methods(body, table, f"rigid body {name!r}", METHODS, lambda _: "nodes", selection, optional=True)


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
    table |= {"friction": first.friction, "restitution": first.restitution} | look_of(body)
    if body.given_young is not None:
        table["young"] = body.given_young
    foreign = "its position was set after its path with rotations: move it again"
    table |= constraint_tables(body, f"rigid body {body.name!r}", lambda _: {}, foreign, fields) | {"force": []}
    for one in body.forces:
        at = {} if one.nodes.max() < FRAME else {"nodes": one.nodes - FRAME}
        table["force"].append(at | {"force": load(body, one)})
    return table
