"""Make the meshes of a scene file: from a shape with the arguments of its function, from a file, or from its own numbers."""

import functools
import re
from collections.abc import Callable
from pathlib import Path

from taisoft.errors import MeshError
from taisoft.mesh.files import WRITERS, read_mesh
from taisoft.mesh.shapes import ball_mesh, box_mesh, cylinder_mesh, sheet_mesh
from taisoft.mesh.surface_mesh import FORMATS, SurfaceMesh, read_surface
from taisoft.mesh.tet_mesh import TetMesh
from taisoft.mesh.usd import USD_FORMATS, read_usd_prim
from taisoft.scene import checks
from taisoft.scene.tables import Table, arguments_of, value_text

MESHES = {"box": box_mesh, "sheet": sheet_mesh, "ball": ball_mesh, "cylinder": cylinder_mesh}
STANDALONE = (*WRITERS, ".node", ".ele", ".inp", ".bdf", ".nas", ".fem")  # their readers open no other files


def mesh_of(table: Table, allow_outside: bool) -> TetMesh:
    """Return the mesh of a body's table, made from a shape or read from a file."""
    shapes = {key: arguments_of(function) for key, function in MESHES.items()}
    of_shapes = [key for known, _ in shapes.values() for key in known]
    mesh = table.table("mesh", list(dict.fromkeys(["shape", *_keys_of(read_mesh), *_keys_of(read_usd_prim), *of_shapes])))
    if ("shape" in mesh) == ("file" in mesh):
        raise mesh.error("", "must have either a shape or a file")
    if "file" in mesh:
        return _read(table, mesh, allow_outside)
    shape = kind_of(mesh, MESHES)
    known, required = shapes[shape]
    mesh = table.table("mesh", ["shape", *known], required)
    return mesh.make(MESHES[shape], "box_mesh: ", f"{shape}_mesh: ", keys=known)


def _keys_of(reader: Callable) -> list[str]:
    """Return the keys of a mesh that a function reads from a file."""
    return ["file", *arguments_of(reader, "path", "alone")[0]]


def _read(table: Table, mesh: Table, allow_outside: bool) -> TetMesh:
    """Return the mesh of a body's table, read from a mesh file or a USD stage."""
    if Path(str(mesh.values["file"])).suffix.lower() in USD_FORMATS:
        mesh = table.table("mesh", _keys_of(read_usd_prim))
        path = _mesh_path(mesh, allow_outside, USD_FORMATS)
        return mesh.make(read_usd_prim, keys=mesh.known[1:], path=path, alone=not allow_outside)
    mesh = table.table("mesh", _keys_of(read_mesh))
    path = _mesh_path(mesh, allow_outside, STANDALONE)
    if "fix_orientation" in mesh:
        with mesh.located_errors():
            checks.flag(mesh.values["fix_orientation"], "fix_orientation")
    return mesh.make(_without_quotes(read_mesh), keys=mesh.known[1:], path=path)


def solid_of(table: Table, allow_outside: bool) -> TetMesh | SurfaceMesh:
    """Return the mesh of a rigid body's table: as `mesh_of`, or a surface, as `surface_of`."""
    values = table.values["mesh"]
    name = values.get("file") if isinstance(values, dict) else None
    is_surface = isinstance(name, str) and Path(name).suffix.lower() in FORMATS
    if isinstance(values, dict) and ("vertices" in values or is_surface):
        return surface_of(table, "mesh", allow_outside)
    return mesh_of(table, allow_outside)


def surface_of(table: Table, key: str, allow_outside: bool) -> SurfaceMesh:
    """Return the surface under a key, which has a file or vertices and triangles."""
    if isinstance(table.values[key], dict) and "file" in table.values[key]:
        mesh = table.table(key, ["file", *arguments_of(read_surface, "path")[0]])
        return mesh.make(_without_quotes(read_surface), keys=mesh.known[1:], path=_mesh_path(mesh, allow_outside, FORMATS))
    mesh = table.table(key, ["vertices", "triangles"], ["vertices", "triangles"])
    return mesh.make(SurfaceMesh, "surface: ")


def _without_quotes(reader: Callable) -> Callable:
    """Return a reader whose refusals do not quote the file: a scene file may name any, also a confidential one."""

    @functools.wraps(reader)
    def read(**arguments):
        try:
            return reader(**arguments)
        except MeshError as error:
            raise MeshError(re.sub(r", not (['\"]).*", "", str(error))) from None

    return read


def _mesh_path(mesh: Table, allow_outside: bool, formats: tuple[str, ...]) -> Path:
    """Return the mesh file's path. Without allow_outside it must lie in the scene file's folder, with links resolved.

    formats: endings of files that name no others, or whose reader refuses those that do.
    """
    name = mesh.values["file"]
    if not isinstance(name, str) or not name or "\0" in name:
        raise mesh.error("file", f"must be a file's name, not {value_text(name)}")
    folder = mesh.file.parent
    path = folder / name
    if allow_outside:
        return path
    remedy = "--allow-outside (allow_outside=True) lifts this"
    if path.suffix.lower() not in formats:
        raise mesh.error("file", f"must be one of {', '.join(formats)}, since other formats can name further files; {remedy}")
    pair = [path.with_suffix(ending) for ending in (".node", ".ele")] if path.suffix.lower() in (".node", ".ele") else [path]
    try:
        inside = all(one.resolve().is_relative_to(folder.resolve()) for one in pair)
    except (OSError, RuntimeError) as error:  # such as circular links
        raise mesh.error("file", f"cannot be resolved: {getattr(error, 'strerror', None) or error}") from None
    if Path(name).is_absolute() or ".." in Path(name).parts or not inside:
        raise mesh.error("file", f"must lie inside the scene file's folder, without '..' or a link out of it; {remedy}")
    return path


def kind_of(table: Table, kinds: dict) -> str:
    """Return the value of `shape`, one of the kinds."""
    if "shape" not in table:
        raise table.error("shape", "is missing")
    with table.located_errors():
        return checks.choice(table.values["shape"], "shape", tuple(kinds))
