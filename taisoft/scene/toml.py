"""Read a scene file in TOML: return a Scene and its `solver` dict. Files hold data only; nothing in them is executed.

    up, gravity, allow_initial_overlap, contact_forces
    body_order                names of bodies and rigid bodies, in which nodes are numbered; by default bodies come first
    background                a colour, or two at the top and the bottom of pictures; a COLOUR is "#rrggbb" or sRGB numbers (3,)
    [[lights]]                Light                         [camera]               Camera
    [collision]               CollisionSettings
    [solver]                  arguments of Simulator, seconds, fps; "none" for Python's None
    [materials.NAME]          Material
    [bodies.NAME]             material (a name, or a table), mesh (below), and the arguments of Scene.add_body; curve is "smooth",
                              "straight", a shape = "sphere" or "capsule" with its arguments, or a surface (below)
    [bodies.NAME.materials]   instead of material: one for each region of the mesh, REGION = a name, or a table
    [[bodies.NAME.fix]]       nodes, axes                   [[bodies.NAME.move]]   nodes, path (KeyFrames), axes
    [[bodies.NAME.traction]]  triangles, traction [Pa]      [[bodies.NAME.force]]  nodes, force [N], or their KeyFrames
    [[bodies.NAME.pressure]]  triangles, pressure [Pa]      [[bodies.NAME.cavity]] triangles, pressure or volume, name
    [[bodies.NAME.KIND]]      the arguments of another kind of load, see `taisoft.scene.loads`
    [[bodies.NAME.activate]]  activation, or its KeyFrames, region
    [bodies.NAME.skin]        surface (below), contact
    [rigid_bodies.NAME]       mesh (below, or a surface), and the arguments of Scene.add_rigid_body
    [[rigid_bodies.NAME.fix]] axes, rotations               [[rigid_bodies.NAME.move]] path (KeyFrames), axes
    [[rigid_bodies.NAME.force]] nodes (vertices; without them the centre of mass), force [N], or its KeyFrames
    [obstacles.NAME]          shape and its arguments, friction, restitution, path (KeyFrames), colour, opacity; or
                              shape = "ground", height
    [[contacts]]              between = ["a", "b"], friction, restitution
    [springs.NAME]            a = ["body", POINT], b, and the other arguments of Scene.add_spring
    [tendons.NAME]            points = [["body", POINT], ...], force [N], or its KeyFrames
    [attachments.NAME]        a = "body", nodes, b = "body", and the other arguments of Scene.attach

A mesh is a shape with the arguments of its function, or a file with fix_orientation and weld; a surface is a file with weld, or
vertices and triangles. nodes and triangles are "all",
a list of ids, or a table box = { min, max } or half_space = { point, normal }, which selects nodes by rest position and
triangles by centroid, boundary included. POINT is a position or a node id. Keys and defaults are those of the Python functions.
"""

import re
import tomllib
import warnings
from collections.abc import Callable
from pathlib import Path

from taisoft.errors import SceneError
from taisoft.files import as_path
from taisoft.mesh.safe_reading import UTF16, utf16_head
from taisoft.mesh.surface_mesh import SurfaceMesh
from taisoft.mesh.tet_mesh import TetMesh
from taisoft.scene import checks
from taisoft.scene.body import Body
from taisoft.scene.collision import CollisionSettings
from taisoft.scene.curves import Curve
from taisoft.scene.key_frames import KeyFrames
from taisoft.scene.laws import LAWS
from taisoft.scene.material import Material
from taisoft.scene.obstacles import Box, Capsule, HalfSpace, MeshObstacle, Sphere
from taisoft.scene.scene import Scene
from taisoft.scene.tables import Table, arguments_of, check_values, value_text
from taisoft.scene.toml_calls import CONNECTIONS, OF_RIGID, add_connections, body_calls, call_methods
from taisoft.scene.toml_look import LOOK_KEYS, read_look
from taisoft.scene.toml_meshes import kind_of, mesh_of, solid_of, surface_of

SHAPES = {"half_space": HalfSpace, "sphere": Sphere, "box": Box, "capsule": Capsule, "mesh": MeshObstacle}
GROUND = "ground"  # a shape as well: a half-space whose normal is up
SCENE_KEYS = ("up", "gravity", "allow_initial_overlap", "contact_forces")  # attributes of a Scene at top level
TOP_KEYS = [
    *SCENE_KEYS,
    *LOOK_KEYS,
    *("body_order", "collision", "solver", "materials", "bodies", "rigid_bodies", "obstacles", "contacts"),
    *CONNECTIONS,
]
SURFACE_KEYS = ("friction", "restitution")
OBSTACLE_KEYS = [*SURFACE_KEYS, "colour", "opacity"]
NONE_TEXT = "none"


def read_scene(path, allow_outside: bool = False) -> tuple[Scene, dict]:
    """Return the scene in a TOML file, and its `solver` dict: the given arguments of Simulator, seconds and fps.

    path: the file. allow_outside: allow mesh files outside its folder and in any format that meshio reads. Raises SceneError
    or MeshError with the file, the key path, and the rule. Warnings point to the line of the caller.
    """
    file = as_path(path, "read_scene", SceneError)
    found: list[warnings.WarningMessage] = []
    try:
        with warnings.catch_warnings(record=True) as found:
            warnings.simplefilter("always")
            return _read(Table(file, "", parsed(file), TOP_KEYS), allow_outside)
    finally:
        for warning in found:
            if issubclass(warning.category, UserWarning):
                warnings.warn(warning.message, stacklevel=2)


def _read(tables: Table, allow_outside: bool) -> tuple[Scene, dict]:
    scene, solver = tables.make(Scene, "scene: ", keys=["up", "gravity"]), {}
    for key in SCENE_KEYS[2:]:
        if key in tables:
            value = tables.checked(key)
            with tables.located_errors("scene: "):
                setattr(scene, key, value)
    if "collision" in tables:
        scene.collision = tables.made("collision", CollisionSettings, "collision settings: ")
    if "solver" in tables:
        solver = tables.table("solver", list(checks.SOLVER_CHECKS)).make(_solver)
    parent = tables.named("materials")
    materials = {name: _made_material(parent, name) for name in parent.known}
    bodies, rigid = tables.named("bodies"), tables.named("rigid_bodies")
    if not bodies.known and not rigid.known:
        raise tables.error("bodies", "must hold a table [bodies.NAME]" if "bodies" in tables else "is missing")
    known, _ = arguments_of(Scene.add_body, "name")
    meshes: dict[str, TetMesh | SurfaceMesh] = {}

    def shared(table: Table, make: Callable) -> TetMesh | SurfaceMesh:
        """Return the mesh of a body's table; bodies with equal mesh tables share one."""
        text = str(table.values["mesh"])
        if text not in meshes:
            meshes[text] = make(table, allow_outside)
        return meshes[text]

    calls = body_calls()
    for name in bodies.known:
        table = bodies.table(name, [*known, *calls, "materials", "skin"], ["mesh"])
        body = _add_body(scene, name, table, materials, shared(table, mesh_of), _curve(table, allow_outside))
        if "skin" in table:
            skin = table.table("skin", ["surface", "contact"], ["surface"])
            surface = surface_of(skin, "surface", allow_outside)
            skin.make(body.embed, f"body {name!r}: embed: ", keys=["contact"], surface=surface)
    for name in rigid.known:
        _add_rigid_body(scene, name, rigid, shared)
    if "body_order" in tables:
        order = tables.values["body_order"]
        if not isinstance(order, list) or sorted(map(str, order)) != sorted([*bodies.known, *rigid.known]):
            raise tables.error("body_order", "must list each name of bodies and rigid_bodies once")
        scene._hold("bodies", sorted(scene.bodies, key=lambda body: order.index(body.name)))
    obstacles = tables.named("obstacles")
    for name in obstacles.known:
        _add_obstacle(scene, name, obstacles)
    read_look(scene, tables)
    _set_contacts(scene, tables)
    add_connections(scene, tables)
    return scene, solver


def _solver(**values) -> dict:
    return checks.check_solver(**{key: None if value == NONE_TEXT else value for key, value in values.items()})


def parsed(file: Path) -> dict:
    """Return the file's tables. Raises SceneError with the line if the file cannot be read or is not TOML."""
    try:
        data = file.read_bytes()
        if utf16_head(data):
            raise SceneError(f"{file}: {UTF16}")
        text = data.decode("utf-8-sig").replace("\r\n", "\n")
    except (OSError, ValueError) as error:
        if isinstance(error, UnicodeDecodeError):
            raise SceneError(f"{file}: byte {error.start} is not UTF-8 text") from None
        raise SceneError(f"{file}: the file cannot be read: {getattr(error, 'strerror', None) or error}") from None
    try:
        tables = tomllib.loads(text)
        check_values(file, tables)
    except (ValueError, RecursionError) as error:
        message = "the file is nested too deeply" if isinstance(error, RecursionError) else " ".join(str(error).split())
        last = text.rstrip().count("\n") + 1
        message = message.replace("(at end of document)", f"(at line {last}, column 1)")
        message = re.sub(r"\((?:'[^']*',? ?)+\)", lambda keys: ".".join(re.findall(r"'([^']*)'", keys[0])), message)
        at = re.search(r" \(at line (\d+), column \d+\)$", message)
        raise SceneError(f"{file}, line {at[1]}: {message[: at.start()]}" if at else f"{file}: {message}") from None
    return tables


def _add_body(scene: Scene, name: str, table: Table, materials: dict[str, Material], mesh: TetMesh, curve: Curve | None) -> Body:
    if "material" in table and "materials" in table:
        raise table.error("", "must have either a material or materials, one for each region")
    if "materials" not in table:
        material = _material(table, "material", materials)
    else:
        regions = table.named("materials")
        material = {_region(mesh, key): _material(regions, key, materials) for key in regions.known}
    keys, _ = arguments_of(Scene.add_body, "name", "mesh", "material", "curve")
    made = {"mesh": mesh, "material": material, "name": name, "curve": curve}
    body = table.make(scene.add_body, f"body {name!r}: ", "scene: ", keys=keys, **made)
    call_methods(body, table)
    return body


def _add_rigid_body(scene: Scene, name: str, bodies: Table, shared: Callable) -> None:
    """Add the rigid body in a table of `bodies`. shared: (table, what makes it) -> its mesh."""
    known, _ = arguments_of(Scene.add_rigid_body, "name", "mesh")
    table = bodies.table(name, [*known, "mesh", *OF_RIGID], ["mesh"])
    mesh = shared(table, solid_of)
    call_methods(table.make(scene.add_rigid_body, f"rigid body {name!r}: ", "scene: ", keys=known, mesh=mesh, name=name), table)


def _curve(table: Table, allow_outside: bool) -> Curve | None:
    """Return what the edges of a body follow: a word, a shape with its arguments, or a surface."""
    value = table.values.get("curve")
    if not isinstance(value, dict):
        return value
    if "shape" not in value:
        return surface_of(table, "curve", allow_outside)
    shapes = {name: SHAPES[name] for name in ("sphere", "capsule")}
    known = [key for shape in shapes.values() for key in arguments_of(shape)[0]]
    kind = kind_of(table.table("curve", ["shape", *known]), shapes)
    keys, required = arguments_of(shapes[kind])
    return table.table("curve", ["shape", *keys], required).make(shapes[kind], f"{kind}: ", keys=keys)


def _made_material(table: Table, key: str) -> Material:
    """Return the material of the table under a key, which has the parameters of its law, too."""
    given, known = table.values[key], [name for name in arguments_of(Material)[0] if name != "parameters"]
    law = LAWS.get(str(given.get("law"))) if isinstance(given, dict) else None
    if isinstance(given, dict) and isinstance(given.get("law"), str) and law is None:
        own = "; one's own is registered in Python, by ts.register_law, before ts.read_scene"
        raise table.error(
            key, f"law {value_text(given['law'])} is none of {', '.join(LAWS)}{checks.nearest(given['law'], LAWS)}{own}"
        )
    return table.table(key, known + list(law.parameters if law else ())).make(Material, "material: ")


def _material(table: Table, key: str, materials: dict[str, Material]) -> Material:
    """Return the material under a key: the name of one, or a table."""
    if key not in table:
        raise table.error(key, "is missing")
    name = table.values[key]
    if not isinstance(name, str):
        return _made_material(table, key)
    if name not in materials:
        raise table.error(key, f"{value_text(name)} is not among the materials{checks.nearest(name, materials)}")
    return materials[name]


def _region(mesh: TetMesh, key: str) -> str | int:
    """Return the name of a region, or its id if the text is no name but a whole number as `write_scene` writes it."""
    is_id = key not in mesh.region_names.values() and re.fullmatch(r"0|-?[1-9][0-9]{0,9}", key)
    return int(key) if is_id else key


def _add_obstacle(scene: Scene, name: str, obstacles: Table) -> None:
    others, ground = (arguments_of(add, "name")[0] for add in (Scene.add_obstacle, Scene.add_ground))
    known = list(dict.fromkeys([*others, *ground, *(key for shape in SHAPES.values() for key in arguments_of(shape)[0])]))
    kind = kind_of(obstacles.table(name, known), SHAPES | {GROUND: None})
    if kind == GROUND:
        table = obstacles.table(name, ["shape", *ground])
        table.make(scene.add_ground, f"obstacle {name!r}: ", "scene: ", "ground: ", keys=ground, name=name)
        return
    keys, required = arguments_of(SHAPES[kind])
    table = obstacles.table(name, [key for key in known if key in keys or key in others], required)
    made = {"shape": table.make(SHAPES[kind], f"{SHAPES[kind].word}: ", keys=keys), "name": name}
    if "path" in table:
        made["path"] = table.made("path", KeyFrames, "key frames: ")
    table.make(scene.add_obstacle, f"obstacle {name!r}: ", "scene: ", "key frames: ", keys=OBSTACLE_KEYS, **made)


def _set_contacts(scene: Scene, tables: Table) -> None:
    """Set friction and restitution of pairs, each pair once."""
    for table in tables.listed("contacts", ["between", *SURFACE_KEYS], ["between"]):
        pair = table.values["between"]
        if not isinstance(pair, list) or len(pair) != 2 or not all(isinstance(name, str) for name in pair):
            raise table.error("between", "must be a list of two names")
        if frozenset(pair) in scene.contact_pairs:
            raise table.error("between", f"names {value_text(pair[0])} and {value_text(pair[1])}, which an earlier table did")
        prefix = f"scene: contact of {pair[0]!r} and {pair[1]!r}: "
        table.make(scene.set_contact, prefix, "scene: ", keys=list(SURFACE_KEYS), name_a=pair[0], name_b=pair[1])
