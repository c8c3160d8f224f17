"""Bodies and obstacles in USD: `/World/<name>` with a surface, its material, and a body's tets.

`primvars:normals` are those of the pictures (`smoothing.py`): per vertex where a surface is smooth everywhere, else faceVarying
with indices, since a vertex on an edge has several. Subsets are GeomSubsets of the family materialBind, each bound to a material
of its own, which looks like that of the body until somebody changes it.
"""

import re

import numpy as np

from taisoft.mesh.texture import split_uvs, subsets_of
from taisoft.mesh.topology import opposite_half_edges
from taisoft.mesh.usd_content import NAME
from taisoft.output.appearance import ObstacleSurface, compact_surface, linear_rgb, obstacle_colour
from taisoft.output.smoothing import smoothing_groups, vertex_normals
from taisoft.scene.obstacles import HalfSpace, MeshObstacle
from taisoft.scene.rigid import RigidBody

ROOT = "/World"
STRESS, IMPULSE, ERROR = (f"primvars:{name}" for name in ("vonMisesStress", "contactImpulse", "estimatedError"))
VELOCITIES, NORMALS = "velocities", "primvars:normals"
PARTS = ("surface", "tets", "material")  # of a body or an obstacle
MAX_NAME = 64  # characters of a prim name; the full name is stored as display name


def prim_names(names: list[str]) -> list[str]:
    """Return legal, distinct USD prim names for names of bodies and obstacles, in order.

    Characters other than ASCII letters, digits and underscores become underscores (UTF-8 identifiers are new in USD, and
    many readers reject them). A leading digit gets an underscore before it; a repeated name gets a number appended.
    """
    legal: list[str] = []
    for name in names:
        base = re.sub(r"[^A-Za-z0-9_]", "_", name)[:MAX_NAME] or "body"
        base = f"_{base}" if base[0].isdigit() else base
        candidate, count = base, 1
        while candidate in legal:
            candidate, count = f"{base}_{count}", count + 1
        legal.append(candidate)
    return legal


class Track:
    """A prim with time-varying points and numbers at them.

    gprim: the defined prim; nodes: indices of its points in arrays over the nodes of all bodies; fields: names of attributes;
    weights: (v,k) of those nodes, if its points are sums of them; triangles: (t,3) of its points, to which rest (v,3) [m] gives
    normals. Paths are built once, since building them at every frame would cost as much as setting the values.
    """

    def __init__(self, gprim, nodes=slice(None), fields: tuple[str, ...] = (), weights=None, rest=None, triangles=None):
        from pxr import Sdf, UsdGeom, Vt

        self._nodes, self._weights, self._corners = nodes, weights, triangles
        self.points, self._extent = gprim.GetPointsAttr().GetPath(), gprim.GetExtentAttr().GetPath()
        self._fields = [(name, gprim.GetPath().AppendProperty(name)) for name in fields]
        if triangles is None:
            return
        self._normals = gprim.GetPath().AppendProperty(NORMALS)
        self._split, self._corners = smoothing_groups(rest, triangles)
        smooth = len(self._split) == len(rest)
        if smooth:
            self._split, self._corners = slice(None), triangles
        interpolation = UsdGeom.Tokens.vertex if smooth else UsdGeom.Tokens.faceVarying
        primvar = UsdGeom.PrimvarsAPI(gprim).CreatePrimvar("normals", Sdf.ValueTypeNames.Normal3fArray, interpolation)
        primvar.Set(self._normals_at(rest))
        if not smooth:
            primvar.SetIndices(Vt.IntArray.FromNumpy(self._corners.astype(np.int32).ravel()))

    def _normals_at(self, x: np.ndarray):
        from pxr import Vt

        return Vt.Vec3fArray.FromNumpy(vertex_normals(x[self._split], self._corners).astype(np.float32))

    def samples(self, points: np.ndarray, fields: dict[str, np.ndarray]) -> list[tuple]:
        """Return (path, value) of each attribute. points: (n,3) [m]; fields: by name, (n,) or (n,3)."""
        from pxr import Vt

        x = self._own(points)
        single = x.astype(np.float32)
        found = [(self.points, Vt.Vec3fArray.FromNumpy(single)), (self._extent, Vt.Vec3fArray.FromNumpy(extent_of(single)))]
        if self._corners is not None:
            found.append((self._normals, self._normals_at(x)))
        for name, path in self._fields:
            values = self._own(fields[name]).astype(np.float32, copy=False)
            found.append((path, (Vt.FloatArray if values.ndim == 1 else Vt.Vec3fArray).FromNumpy(values)))
        return found

    def _own(self, values: np.ndarray) -> np.ndarray:
        own = values[self._nodes]
        return own if self._weights is None else self._weights @ own


def extent_of(points: np.ndarray) -> np.ndarray:
    """Return the smallest and largest coordinates of points (n,3), (2,3) float32."""
    return np.array([points.min(axis=0), points.max(axis=0)], dtype=np.float32)


def _define_material(stage, path: str, colour, opacity: float):
    """Define a preview material. colour: a Gf.Vec3f, linear."""
    from pxr import Sdf, UsdShade

    material, shader = UsdShade.Material.Define(stage, path), UsdShade.Shader.Define(stage, f"{path}/shader")
    shader.CreateIdAttr("UsdPreviewSurface")
    shader.CreateInput("diffuseColor", Sdf.ValueTypeNames.Color3f).Set(colour)
    for name, value in (("roughness", 0.6), ("opacity", opacity)):
        shader.CreateInput(name, Sdf.ValueTypeNames.Float).Set(value)
    material.CreateSurfaceOutput().ConnectToSource(shader.CreateOutput("surface", Sdf.ValueTypeNames.Token))
    return material


def _define_surface(stage, one, legal_name: str, srgb: np.ndarray, triangles: np.ndarray, uvs=None, subsets=None):
    """Define the prim of a body or an obstacle with material and surface; return its path, surface and a finishing function.

    uvs, subsets: of the triangles (t,3). The function gives a gprim its points (n,3) [m], the colour and the material.
    """
    from pxr import Gf, Sdf, UsdGeom, UsdShade, Vt

    path = f"{ROOT}/{legal_name}"
    prim = UsdGeom.Xform.Define(stage, path).GetPrim()
    prim.SetDisplayName(one.name)
    prim.SetCustomDataByKey(NAME, one.name)
    colour = Gf.Vec3f(*linear_rgb(srgb).tolist())
    material = _define_material(stage, f"{path}/material", colour, one.opacity)

    surface = UsdGeom.Mesh.Define(stage, f"{path}/surface")
    surface.CreateFaceVertexCountsAttr(Vt.IntArray.FromNumpy(np.full(len(triangles), 3, dtype=np.int32)))
    surface.CreateFaceVertexIndicesAttr(Vt.IntArray.FromNumpy(triangles.ravel().astype(np.int32)))
    surface.CreateSubdivisionSchemeAttr(UsdGeom.Tokens.none)
    surface.CreateVelocitiesAttr()
    if uvs is not None:
        kind = Sdf.ValueTypeNames.TexCoord2fArray
        primvar = UsdGeom.PrimvarsAPI(surface).CreatePrimvar("st", kind, UsdGeom.Tokens.faceVarying)
        values, indices = np.unique(uvs.reshape(-1, 2).astype(np.float32), axis=0, return_inverse=True)
        primvar.Set(Vt.Vec2fArray.FromNumpy(values))
        primvar.SetIndices(Vt.IntArray.FromNumpy(indices.ravel().astype(np.int32)))
    for (name, ids), legal in zip((subsets or {}).items(), prim_names([*PARTS, *(subsets or {})])[len(PARTS) :]):
        binding = UsdShade.MaterialBindingAPI.Apply(surface.GetPrim())
        subset = binding.CreateMaterialBindSubset(legal, Vt.IntArray.FromNumpy(ids.astype(np.int32))).GetPrim()
        subset.SetDisplayName(name)
        own = _define_material(stage, f"{path}/{legal}", colour, one.opacity)
        UsdShade.MaterialBindingAPI.Apply(subset).Bind(own)

    def finish(gprim, points: np.ndarray) -> None:
        single = np.ascontiguousarray(points, dtype=np.float32)
        gprim.CreatePointsAttr(Vt.Vec3fArray.FromNumpy(single))
        gprim.CreateExtentAttr(Vt.Vec3fArray.FromNumpy(extent_of(single)))
        gprim.CreateDisplayColorAttr([colour])
        gprim.CreateDisplayOpacityAttr([one.opacity])
        UsdShade.MaterialBindingAPI.Apply(gprim.GetPrim()).Bind(material)

    return path, surface, finish


def define_obstacle(stage, shown: ObstacleSurface, legal_name: str, eye: np.ndarray) -> Track:
    """Define an obstacle's surface at its initial pose. eye: position of the camera (3,) [m]."""
    from pxr import UsdGeom

    one, x = shown.obstacle, shown.at(0.0)
    _, surface, finish = _define_surface(stage, one, legal_name, obstacle_colour(one), shown.triangles)
    finish(surface, x)
    if isinstance(one.shape, MeshObstacle) and (opposite_half_edges(shown.triangles) < 0).any():
        surface.CreateDoubleSidedAttr(True)
    if isinstance(one.shape, HalfSpace):
        a, b, c = x[shown.triangles[0]]
        if np.cross(b - a, c - a) @ (eye - a) <= 0.0:
            surface.CreatePurposeAttr(UsdGeom.Tokens.guide)
    return Track(surface, fields=(VELOCITIES,), rest=x, triangles=shown.triangles)


def _texture(body) -> tuple[np.ndarray | None, dict[str, np.ndarray]]:
    """Return UVs (t,3,2), or None, and subsets of the triangles that are shown of a body."""
    surface = body.surface if isinstance(body, RigidBody) else None if body.skin is None else body.skin.surface
    if surface is not None:
        return surface.uvs, surface.subsets
    uvs, subsets = body.mesh.surface_uvs, body.mesh.surface_subsets
    if body.order == 1:
        return uvs, subsets
    parents = np.repeat(np.arange(len(body.mesh.surface)), 4)
    return None if uvs is None else split_uvs(uvs), subsets_of(subsets, parents)


def define_body(stage, body, legal_name: str, srgb: np.ndarray, first: int, touching: bool, errors: bool) -> list[Track]:
    """Define a body's surface, tets and primvars. first: index of its first node among the nodes of all bodies."""
    from pxr import Sdf, UsdGeom, Vt

    skin = body.riding_skin
    nodes, local = compact_surface(body.nodes.surface if skin is None else skin.surface.triangles)
    path, surface, finish = _define_surface(stage, body, legal_name, srgb, local, *_texture(body))
    shown = [surface]
    if not isinstance(body, RigidBody):
        tets = UsdGeom.TetMesh.Define(stage, f"{path}/tets")
        tets.CreateTetVertexIndicesAttr(Vt.Vec4iArray.FromNumpy(np.ascontiguousarray(body.nodes.tets, dtype=np.int32)))
        faces = np.ascontiguousarray(body.nodes.boundary, dtype=np.int32)
        tets.CreateSurfaceFaceVertexIndicesAttr(Vt.Vec3iArray.FromNumpy(faces))
        tets.CreatePurposeAttr(UsdGeom.Tokens.guide)
        shown.append(tets)

    def define_primvar(gprim, name: str, kind, meaning: str) -> None:
        primvar = UsdGeom.PrimvarsAPI(gprim).CreatePrimvar(name.removeprefix("primvars:"), kind, UsdGeom.Tokens.vertex)
        primvar.GetAttr().SetDocumentation(meaning)

    scalars, vectors = Sdf.ValueTypeNames.FloatArray, Sdf.ValueTypeNames.Vector3fArray
    start = body.rest_positions + body.position  # readers find the rest shape in the default value
    own = start[nodes] if skin is None else skin.surface.vertices[nodes] + body.position
    for gprim, x in zip(shown, (own, start)):
        finish(gprim, x)
        define_primvar(gprim, STRESS, scalars, "von Mises equivalent of the mean Cauchy stress at the node [Pa]")
        if errors:
            define_primvar(gprim, ERROR, scalars, "estimated error of the node's position [m], -1 where unknown")
    touching = touching and skin is None and body.nodes.embedded is None  # impulses act on the nodes of tets
    if touching:
        define_primvar(surface, IMPULSE, vectors, "impulse of the contacts of the last step on the node [N s]")
    all_nodes, fields = slice(first, first + body.n_nodes), (STRESS, ERROR) if errors else (STRESS,)
    of_surface = (*fields, VELOCITIES, *((IMPULSE,) if touching else ()))
    where = (first + nodes, of_surface) if skin is None else (all_nodes, of_surface, skin.weights[nodes])
    track = Track(surface, *where, rest=own, triangles=local)
    return [track, *(Track(tets, all_nodes, fields) for tets in shown[1:])]
