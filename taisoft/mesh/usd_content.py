"""The meshes in a USD stage, as arrays in metres with y up. Runs in the child process of `safe_reading`, without SciPy.

Taken are prims of the types TetMesh and Mesh in the stage's default state: points by their default value, else by their first
time sample, and the transforms at the earliest time. Where taisoft wrote the stage, a body is the TetMesh below a prim with its
name, and obstacles are left out. Meshes of purpose guide or proxy are left out, too. Of subdivision surfaces the control mesh is
taken.
"""

import re

import numpy as np

from taisoft.errors import MeshError

NAME = "taisoft:name"  # custom data of a body or an obstacle: its name
MAX_PRIMS = 10_000
Y_UP_FROM_Z_UP = np.array([[1.0, 0.0, 0.0], [0.0, 0.0, -1.0], [0.0, 1.0, 0.0]])  # x @ this: (x, y, z) -> (x, z, -y)


def usd_message(error: Exception) -> str:
    """Return the message of a USD error, whose text is a list of source locations, each with a quoted message."""
    lines = [line.strip() for line in str(error).splitlines() if line.strip()]
    return re.sub(r"^Error in '.*' at line \d+ in file \S+ : '(.*)'$", r"\1", lines[-1]) if lines else type(error).__name__


def read_stage(path: str, alone: bool = False) -> dict:
    """Return `meshes` of a stage, each a name, a path, points (n,3) and cells (m,4) tets or (m,3) triangles, and `notes`.

    alone: refuse a stage that names further files, without opening these. Raises MeshError if the stage cannot be read or a mesh
    is inconsistent.
    """
    try:
        from pxr import Usd, UsdGeom, UsdUtils

        if alone and any(others := UsdUtils.ExtractExternalReferences(path)):
            raise MeshError(f"it names a further file, {next(other[0] for other in others if other)!r}")
        stage = Usd.Stage.Open(path)
        broken = stage.GetCompositionErrors()
        if broken:
            part = re.search(r"@(.+?)@", str(broken[0]))
            raise MeshError(f"its part {part[1]!r} cannot be opened" if part else "it is inconsistent")
        found, notes = _meshes(stage, Usd, UsdGeom)
        to_metres = UsdGeom.GetStageMetersPerUnit(stage)
        turn = Y_UP_FROM_Z_UP if UsdGeom.GetStageUpAxis(stage) == UsdGeom.Tokens.z else None
    except MeshError:
        raise
    except Exception as error:
        raise MeshError(_why_unreadable(error)) from None
    turned = ((*names, points if turn is None else points @ turn, cells) for *names, points, cells in found)
    return {"meshes": [(*names, to_metres * points, cells) for *names, points, cells in turned], "notes": notes}


def _why_unreadable(error: Exception) -> str:
    """Return the reason without the file's name and content, which the messages of USD repeat."""
    line, message = re.search(r":(\d+):\d+: parse error", str(error)), usd_message(error)
    if line:
        return f"line {line[1]} cannot be parsed"
    return "it is damaged, or of another format" if message.startswith("Failed to open layer") else message


def _meshes(stage, Usd, UsdGeom) -> tuple[list[tuple[str, str, np.ndarray, np.ndarray]], list[str]]:
    """Return name, path, points and cells of each mesh, and notes about what is left out."""
    transforms = UsdGeom.XformCache(Usd.TimeCode.EarliestTime())
    found, notes, bodies, obstacles = [], [], set(), []
    prims = [prim for prim in Usd.PrimRange(stage.GetPseudoRoot(), Usd.TraverseInstanceProxies()) if prim.IsA(UsdGeom.PointBased)]
    prims = [prim for prim in prims if prim.IsA(UsdGeom.TetMesh) or prim.IsA(UsdGeom.Mesh)]
    if len(prims) > MAX_PRIMS:
        raise MeshError(f"it holds {len(prims)} meshes, more than {MAX_PRIMS}")
    for prim in prims:
        if prim.IsA(UsdGeom.TetMesh):
            bodies.add(prim.GetParent().GetPath())
    for prim in prims:
        parent = prim.GetParent()
        name, is_tets = parent.GetCustomDataByKey(NAME), prim.IsA(UsdGeom.TetMesh)
        if name is not None and not is_tets:
            if parent.GetPath() not in bodies:
                obstacles.append(name)
            continue
        if not is_tets and UsdGeom.Imageable(prim).ComputePurpose() in (UsdGeom.Tokens.guide, UsdGeom.Tokens.proxy):
            continue
        cells = _tets(prim, UsdGeom) if is_tets else _triangles(prim, UsdGeom, notes)
        points = _value(UsdGeom.PointBased(prim).GetPointsAttr(), Usd)
        if points is None or cells is None or not len(points) or not len(cells):
            notes.append(f"{prim.GetPath()} has no points or no cells and is left out")
            continue
        matrix = np.array(transforms.GetLocalToWorldTransform(prim))
        if not np.array_equal(matrix, np.eye(4)):
            points = points @ matrix[:3, :3] + matrix[3, :3]
        left_handed = UsdGeom.Gprim(prim).GetOrientationAttr().Get() == UsdGeom.Tokens.leftHanded
        if left_handed != (np.linalg.det(matrix[:3, :3]) < 0.0):
            cells = cells[:, [0, 2, 1, *range(3, cells.shape[1])]]
        found.append((name or prim.GetName(), str(prim.GetPath()), points, cells))
    if obstacles:
        notes.append(f"obstacles are left out: {', '.join(obstacles)}")
    return found, notes


def _value(attribute, Usd) -> np.ndarray | None:
    value = attribute.Get()
    value = attribute.Get(Usd.TimeCode.EarliestTime()) if value is None else value
    return None if value is None else np.array(value, dtype=np.float64)


def _tets(prim, UsdGeom) -> np.ndarray | None:
    attribute = UsdGeom.TetMesh(prim).GetTetVertexIndicesAttr()
    times = attribute.GetTimeSamples()
    value = attribute.Get(times[0]) if attribute.Get() is None and times else attribute.Get()
    return None if value is None else np.array(value, dtype=np.int64).reshape(-1, 4)


def _triangles(prim, UsdGeom, notes: list[str]) -> np.ndarray | None:
    """Return the faces as triangles, fans around each face's first corner."""
    mesh = UsdGeom.Mesh(prim)
    counts, corners = mesh.GetFaceVertexCountsAttr().Get(), mesh.GetFaceVertexIndicesAttr().Get()
    if counts is None or corners is None:
        return None
    counts, corners = np.array(counts, dtype=np.int64), np.array(corners, dtype=np.int64)
    if len(counts) == 0 or counts.min() < 3 or counts.sum() != len(corners):
        raise MeshError(f"{prim.GetPath()}: faceVertexCounts and faceVertexIndices do not fit together")
    if mesh.GetSubdivisionSchemeAttr().Get() != UsdGeom.Tokens.none and mesh.GetSubdivisionSchemeAttr().IsAuthored():
        notes.append(f"{prim.GetPath()} is a subdivision surface, of which the control mesh is taken")
    first = np.cumsum(counts) - counts
    triangles = [
        np.stack([corners[at], corners[at + k], corners[at + k + 1]], axis=1)
        for k in range(1, counts.max() - 1)
        for at in (first[counts > k + 1],)
    ]
    return np.concatenate(triangles)
