"""Write a Scene and its `solver` dict to a scene file; `read_scene` restores every number bit for bit.

Selections made by Python functions are written as ids. A mesh from `box_mesh`, `sheet_mesh` or `ball_mesh` is written as its
arguments, any other mesh as a Gmsh file beside the scene file. Paths must be KeyFrames: functions of time cannot be stored. Nor
can rotating key frames that were bound to other nodes or another obstacle, whose pivot they keep.
"""

import warnings
from numbers import Real
from pathlib import Path

import numpy as np

from taisoft.errors import OutputError, SceneError, reworded
from taisoft.files import write_bytes
from taisoft.mesh.files import write_mesh
from taisoft.mesh.surface_mesh import SurfaceMesh
from taisoft.mesh.tet_mesh import TetMesh
from taisoft.scene import checks
from taisoft.scene.body import QUADRATURE_DEGREES, Body
from taisoft.scene.checks import SOLVER_CHECKS, check_solver
from taisoft.scene.fibres import directions
from taisoft.scene.key_frames import ShapePath
from taisoft.scene.laws import SHIPPED
from taisoft.scene.loads import SHIPPED_LOADS
from taisoft.scene.material import MODULI, Material
from taisoft.scene.obstacles import Obstacle
from taisoft.scene.rigid import RigidBody
from taisoft.scene.scene import Scene
from taisoft.scene.toml import NONE_TEXT, SCENE_KEYS, SHAPES, SURFACE_KEYS
from taisoft.scene.toml_calls import calls_of, connection_tables, stored
from taisoft.scene.toml_look import look_of, look_tables
from taisoft.scene.toml_values import fields_of, toml_of

FOREIGN_PATH = "rotates along a path made for {}, which a file cannot store: pass the ts.KeyFrames themselves"


def write_scene(path, scene: Scene, solver: dict | None = None, overwrite: bool = False) -> list[Path]:
    """Write a scene as TOML, with its meshes beside it as NAME_mesh0.msh and so on; return the files, the TOML first.

    path: a name that ends in .toml. solver: arguments of Simulator, seconds and fps. overwrite: replace existing files. Raises
    SceneError for content that cannot be stored, before any file is written, and OutputError. Files are written atomically,
    the TOML last. Warns of a mesh whose only region, 0, is not stored, and of laws that must be registered before it is read.
    """
    file = Path(path)
    if file.suffix != ".toml":
        raise SceneError(f"{file}: a scene file's name must end in .toml")
    if not isinstance(scene, Scene):
        raise SceneError(f"{file}: write_scene needs a Scene, not {type(scene).__name__}")
    if not scene.bodies:
        raise SceneError(f"{file}: the scene holds no body")
    own = {f"law {law!r}" for body in scene.bodies for law in body.composition.laws} - {f"law {law.name!r}" for law in SHIPPED}
    own |= {f"load {one.kind!r}" for body in scene.bodies for one in body.loads if one.kind not in SHIPPED_LOADS}
    for what in sorted(own):
        warnings.warn(f"{file}: register {what} before ts.read_scene: the command line does not know it", stacklevel=2)
    meshes: dict[str, TetMesh] = {}
    text = toml_of(_document(scene, solver or {}, file.stem, meshes))
    try:
        data = text.encode("utf-8")
    except UnicodeEncodeError as error:
        raise SceneError(f"{file}: {text[error.start]!r} in a name is not a character of Unicode") from None
    with_regions = {}
    for name, mesh in meshes.items():
        with_regions[name] = _keeps_regions(scene, mesh)
    files = [file, *(file.with_name(name) for name in meshes)]
    for one in files:
        if one.exists() and not overwrite:
            raise OutputError(f"{one}: the file exists, and overwrite is not set")
    for name, mesh in meshes.items():
        write_mesh(file.with_name(name), mesh, with_regions[name])
    write_bytes(file, data)
    return files


def _keeps_regions(scene: Scene, mesh: TetMesh) -> bool:
    """Return whether a mesh file can hold the regions of a mesh. Raises SceneError if it cannot and a body uses them."""
    if mesh.regions is None or mesh.regions.any():
        return True
    rule = "its mesh has no region but 0, which its file cannot tell from none"
    bodies = [body for body in scene.bodies if body.mesh is mesh]
    for body in bodies:
        if body.composition.has_regions:
            raise SceneError(f"body {body.name!r}: {rule}: use another number")
    warnings.warn(f"body {bodies[0].name!r}: {rule}, and which is not stored", UserWarning, stacklevel=3)
    return False


def _document(scene: Scene, solver: dict, stem: str, meshes: dict[str, TetMesh]) -> dict:
    """Return the file's tables. Meshes that need a file are added to `meshes`, file name -> mesh."""
    for placed in scene.robots:
        raise SceneError(f"robot {placed.name!r}: a scene file cannot hold robots: keep the scene as a Python file")
    materials: dict[Material, str] = {}
    elastic = [body for body in scene.bodies if not isinstance(body, RigidBody)]
    for body in elastic:
        for material in body.composition.materials.values():
            materials.setdefault(material, f"material{len(materials)}")
    order = [one.name for one in scene.colliders]
    present = (pair for pair in scene.contact_pairs if pair <= set(order))  # bodies may have been removed since
    contacts = []
    for pair in sorted(sorted(order.index(name) for name in pair) for pair in present):
        names = [order[pair[0]], order[pair[-1]]]
        numbers = zip(SURFACE_KEYS, scene.contact_pairs[frozenset(names)])
        contacts.append({"between": names} | {key: value for key, value in numbers if value is not None})
    read = [body.name for body in (*elastic, *scene.rigid_bodies)]  # in the order in which `read_scene` adds them
    return {
        **{key: getattr(scene, key) for key in SCENE_KEYS},
        **look_tables(scene),
        **({"body_order": order[: len(read)]} if read != order[: len(read)] else {}),
        "collision": fields_of(scene.collision),
        "solver": _solver(solver),
        "materials": {name: _material(material) for material, name in materials.items()},
        "bodies": {body.name: _body(body, materials, stem, meshes) for body in elastic},
        "rigid_bodies": {body.name: _rigid_body(body, stem, meshes) for body in scene.rigid_bodies},
        "obstacles": {obstacle.name: _obstacle(obstacle) for obstacle in scene.obstacles},
        "contacts": contacts,
        **connection_tables(scene),
    }


def _solver(solver: dict) -> dict:
    plain = {}
    for key, value in solver.items():
        value = value.item() if isinstance(value, np.generic) else value
        plain[key] = float(value) if isinstance(value, Real) and not isinstance(value, int) else value
    for key in plain:
        checks.index(key, SOLVER_CHECKS, "solver: no setting")
    with reworded(SceneError, "solver: "):
        check_solver(**plain)
    for name, one in plain.get("quantities", {}).items():
        if callable(one):
            raise SceneError(f"solver: quantity {name!r} is a function, which a file cannot store: use a text")
    return {key: NONE_TEXT if value is None else value for key, value in plain.items()}


def _mesh_table(mesh: TetMesh | SurfaceMesh, stem: str, meshes: dict[str, TetMesh]) -> dict:
    """Return the table of a mesh: its recipe, or its file, which is added to `meshes`; of a surface its numbers."""
    if isinstance(mesh, SurfaceMesh):
        return {"vertices": mesh.vertices, "triangles": mesh.triangles}
    name = next((name for name, known in meshes.items() if known is mesh), None)
    if mesh.recipe is None and name is None:
        name = f"{stem}_mesh{len(meshes)}.msh"
        meshes[name] = mesh
    return {"file": name} if name else mesh.recipe


def _body(body: Body, materials: dict[Material, str], stem: str, meshes: dict[str, TetMesh]) -> dict:
    composition = body.composition
    names = {body.mesh.region_names.get(key, str(key)): materials[one] for key, one in composition.materials.items()}
    table = {"materials": names} if composition.has_regions else {"material": materials[composition.first]}
    table |= {"mesh": _mesh_table(body.mesh, stem, meshes)}
    own = {name: values for name, values in composition.by_tet.items() if name in composition.parameters}
    table |= {name: values for name, values in composition.by_tet.items() if name not in own} | (
        {"parameters": own} if own else {}
    )
    table |= {key: getattr(body, key) for key in ("position", "velocity", "order", "collision")} | look_of(body)
    # what was given, unless numbers have changed since so that it would be decided in another way
    table["dilatation"] = body.given_dilatation if body.dilatation == body.decided_dilatation else body.dilatation
    if body.quadrature_degree != QUADRATURE_DEGREES[body.order][0]:  # the default stays away, so that order can be edited
        table["quadrature_degree"] = body.quadrature_degree
    if body.curve is not None:
        shape = next((name for name, known in SHAPES.items() if known is type(body.curve)), None)
        of_shape = {"shape": shape} | fields_of(body.curve) if shape else body.curve
        table["curve"] = _mesh_table(body.curve, stem, meshes) if isinstance(body.curve, SurfaceMesh) else of_shape
    if body.velocity.ndim == 2:
        table["velocity"] = body.velocity[: body.nodes.n_elastic]
    if body.skin is not None:
        table["skin"] = {"surface": _mesh_table(body.skin.surface, stem, meshes), "contact": body.skin.contact}
    if body.fibres is not None and (
        body.mesh.fibres is None or not np.array_equal(body.fibres, directions("", body.mesh, body.mesh.fibres))
    ):
        table["fibres"] = body.fibres[0] if (body.fibres == body.fibres[0]).all() else body.fibres
    return table | calls_of(body, FOREIGN_PATH.format("nodes that start elsewhere"))


def _rigid_body(body: RigidBody, stem: str, meshes: dict[str, TetMesh]) -> dict:
    table, first = {"mesh": _mesh_table(body.shape, stem, meshes), "density": body.density}, body.composition.first
    linear, angular = body.start_twist
    table |= {"position": body.position, "velocity": linear, "angular_velocity": angular}
    table |= {"friction": first.friction, "restitution": first.restitution} | look_of(body)
    if body.given_young is not None:
        table["young"] = body.given_young
    return table | calls_of(body, "its position was set after its path with rotations: move it again")


def _material(material: Material) -> dict:
    """Return a material's numbers: of a law with parameters these, from which the moduli follow."""
    fields, own = fields_of(material), fields_of(material).pop("parameters")
    return {key: value for key, value in fields.items() if key != "parameters" and not (own and key in MODULI)} | own


def _obstacle(obstacle: Obstacle) -> dict:
    shape = obstacle.shape
    kind = next((name for name, known in SHAPES.items() if known is type(shape)), None)
    if kind is None:
        raise SceneError(f"obstacle {obstacle.name!r}: a file cannot store a {type(shape).__name__}")
    table = {"shape": kind} | fields_of(shape) | {key: getattr(obstacle, key) for key in SURFACE_KEYS} | look_of(obstacle)
    path, what = obstacle.given_path, f"obstacle {obstacle.name!r}"
    if path is None:
        return table
    frames = stored(path.frames if isinstance(path, ShapePath) else path, f"{what}: moves")
    own = np.array_equal(path.center, shape.pivot)
    if not own and {"rotations", "pivot"} <= frames.keys():  # otherwise the center does not matter
        raise SceneError(f"{what}: {FOREIGN_PATH.format('a shape with another center')}")
    return table | {"path": frames}
