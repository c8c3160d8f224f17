"""`taisoft info`, `tetrahedralize` and `scene`: describe a mesh file, fill a surface with tets, write a scene file."""

import math
import shlex
import warnings
from argparse import Namespace
from pathlib import Path

import numpy as np

from taisoft.cli import Signals, printed_warnings
from taisoft.cli.scene_file import load_scene
from taisoft.cli.units import MILLIMETRE, MILLIMETRES_ABOVE, longest_side, warn_millimetres
from taisoft.errors import MeshError, OutputError, SceneError
from taisoft.mesh.files import WRITERS, check_ending, read_mesh, write_mesh
from taisoft.mesh.placing import UP, place, underside
from taisoft.mesh.quality import edge_lengths, mean_ratio
from taisoft.mesh.surface_mesh import FORMATS, SurfaceMesh, read_surface, tetrahedralize
from taisoft.mesh.tet_mesh import TetMesh
from taisoft.mesh.topology import connected_pieces
from taisoft.mesh.usd import USD_FORMATS, read_usd
from taisoft.scene.material import Material
from taisoft.scene.scene import Scene
from taisoft.scene.toml_writer import write_scene

POOR_QUALITY = 0.1  # mean ratio below which a tet stiffens its surroundings and slows the solver noticeably
TINY_BELOW = 1e-3  # soft bodies under 1 mm are rare
DROP = 0.25  # over the body's height
RELATIVE_STIFFNESS = 100.0  # Young's modulus over the pressure under the body: it sags by about 1 %
DENSITY = 1000.0  # [kg/m^3]
GROUND = "ground"
MAX_REGIONS = 20  # listed by name
MAX_CAVITIES = 5  # listed by volume
PLACEMENT = ("up", "to", "scale", "rotate")  # options and arguments of `place`, without at
MESH_SUFFIXES = (*WRITERS, ".node", ".ele")


def info(arguments: Namespace) -> int:
    """Print counts, size, likely unit, quality and problems. Raises MeshError if the file is not a mesh."""
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", UserWarning)  # they are listed as problems below
        ending = Path(arguments.mesh).suffix.lower()
        if ending in FORMATS:
            found = {arguments.mesh: _describe_surface(read_surface(arguments.mesh, arguments.weld or 0.0), arguments.weld)}
        elif ending in USD_FORMATS:
            if arguments.weld is not None:
                raise MeshError(f"{arguments.mesh}: the meshes of a USD stage are not welded, so --weld is for other files")
            found = {f"{arguments.mesh}: {name}": describe(mesh) for name, mesh in read_usd(arguments.mesh).items()}
        else:
            found = {arguments.mesh: describe(read_mesh(arguments.mesh, weld=arguments.weld))}
    for title, lines in found.items():
        _print_lines(title, lines)
    return 0


def fill(arguments: Namespace) -> int:
    """Fill a surface with tets, write the mesh, print its properties. Bad arguments are refused before the mesher starts."""
    out = Path(arguments.out)
    check_ending(out)
    if out.exists() and not arguments.overwrite:
        raise OutputError(f"{out}: the file exists; --overwrite replaces it")
    if not out.parent.is_dir():
        raise OutputError(f"{out}: there is no folder {out.parent}")
    with Signals(), printed_warnings():
        surface = place(read_surface(arguments.surface, weld=arguments.weld), **_given(arguments, *PLACEMENT, "at"))
        mesh = tetrahedralize(surface, arguments.edge_length, arguments.envelope)
        write_mesh(out, mesh)
    _print_lines(out, describe(mesh))
    return 0


def scene(arguments: Namespace) -> int:
    """Write the scene file and the files it needs, and print their names. Raises SceneError if no file can hold the scene."""
    path = Path(arguments.scene)
    with printed_warnings():
        placed = _given(arguments, *PLACEMENT)
        if path.suffix.lower() in (*MESH_SUFFIXES, *USD_FORMATS):
            meshes = read_usd(path) if path.suffix.lower() in USD_FORMATS else {path.stem: read_mesh(path)}
            placed_meshes = {name: place(mesh, **placed) for name, mesh in meshes.items()}
            warn_millimetres(placed_meshes)
            made, solver = _drop_scene(placed_meshes, arguments.at, arguments.order or 1, arguments.to or "y")
        elif placed or arguments.at is not None:
            options = ", ".join(f"--{name}" for name in (*PLACEMENT, "at"))
            raise SceneError(f"{arguments.scene}: {options} place a mesh, and this is a scene")
        elif arguments.order is not None:
            raise SceneError(f"{arguments.scene}: --order is for a mesh, and this is a scene with its own")
        else:
            made, solver = load_scene(arguments.scene, arguments.allow_outside)
    for written in write_scene(arguments.out, made, solver, arguments.overwrite):
        print(written)
    return 0


def _given(arguments: Namespace, *names: str) -> dict:
    """Return the options of these names that are given."""
    return {name: getattr(arguments, name) for name in names if getattr(arguments, name) is not None}


def describe(mesh: TetMesh) -> list[tuple[str, str]]:
    """Return (name, text) lines about a mesh; lengths in the file's own unit."""
    lengths = edge_lengths(mesh.vertices, mesh.tets)
    quality = mean_ratio(lengths, mesh.volumes)
    poor = np.count_nonzero(quality < POOR_QUALITY)
    counts = f"{mesh.n_verts} vertices, {mesh.n_tets} tets, {len(mesh.surface)} surface triangles, {_pieces(mesh.n_components)}"
    ratios = f"{quality.min():.3f} (tet {quality.argmin()}) to {quality.max():.3f}, median {np.median(quality):.3f}"
    return [
        *_size_lines(counts, mesh.vertices),
        ("volume", f"{mesh.volumes.sum():.6g}"),
        *_cavity_lines(mesh),
        *_region_lines(mesh),
        *([] if mesh.mid_edge is None else [("second order", "bodies with order=2 are curved by its mid-edge nodes")]),
        *([] if mesh.fibres is None else [("fibres", f"in {np.count_nonzero(mesh.fibres.any(axis=1))} tets")]),
        _edge_line(lengths),
        ("quality", f"mean ratio {ratios}; 1 is a regular tet, {poor} are below {POOR_QUALITY}"),
        *_problem_lines(mesh.warnings),
    ]


def _describe_surface(surface: SurfaceMesh, weld: float | None) -> list[tuple[str, str]]:
    """Return (name, text) lines about a surface, why it does not bound a solid, and how to fill it with tets."""
    a, b, c = np.moveaxis(surface.vertices[surface.triangles], 1, 0)
    lengths = np.concatenate([np.linalg.norm(p - q, axis=1) for p, q in ((a, b), (b, c), (c, a))])
    counts = f"{len(surface.vertices)} vertices, {len(surface.triangles)} triangles, {_pieces(surface.n_pieces)}; no tets"
    scale = MILLIMETRE.split() if longest_side(surface.vertices) > MILLIMETRES_ABOVE else []
    welded = [] if weld is None else ["--weld", f"{weld:g}"]
    command = shlex.join([surface.source, *welded, *scale, "--out", f"{Path(surface.source).stem}.msh"])
    return [
        *_size_lines(counts, surface.vertices),
        ("area", f"{surface.area:.6g}"),
        ("volume", f"{surface.volume:.6g}" if surface.closed else "none, it is open"),
        _edge_line(lengths),
        *_problem_lines([*surface.warnings, *surface.faults()]),
        ("next", f"fill it with tets: taisoft tetrahedralize {command}"),
    ]


def _region_lines(mesh: TetMesh) -> list[tuple[str, str]]:
    """Return a line about the regions, if there are any: the first MAX_REGIONS by name or number, with their tets."""
    counts = [f"{mesh.region_text(one)} of {np.count_nonzero(mesh.regions == one)} tets" for one in mesh.region_ids[:MAX_REGIONS]]
    others = len(mesh.region_ids) - len(counts)
    return [("regions", ", ".join(counts) + (f", and {others} more" if others else ""))] if counts else []


def _cavity_lines(mesh: TetMesh) -> list[tuple[str, str]]:
    """Return a line about the cavities, if there are any: the first MAX_CAVITIES, by volume and middle."""
    n, part = connected_pieces(mesh.surface, mesh.n_verts)
    corners = mesh.vertices[mesh.surface]
    volumes = -np.bincount(part[mesh.surface[:, 0]], np.linalg.det(corners - corners[0, 0]), n) / 6.0
    found = np.flatnonzero(volumes > 0.0)  # their normals point inward
    texts = [f"{volumes[k]:.6g} around {_triple(mesh.vertices[part == k].mean(axis=0))}" for k in found[:MAX_CAVITIES]]
    others = len(found) - len(texts)
    return [("cavities", ", ".join(texts) + (f", and {others} more" if others else ""))] if texts else []


def _pieces(number: int) -> str:
    return "1 piece" if number == 1 else f"{number} pieces"


def _size_lines(counts: str, vertices: np.ndarray) -> list[tuple[str, str]]:
    """Return counts, extent along each axis, and a guess of the unit; taisoft itself reads every file as metres, y up."""
    low, high = vertices.min(axis=0), vertices.max(axis=0)
    extents = [f"{axis} {h - l:.5g} ({l:.5g} to {h:.5g})" for axis, l, h in zip("xyz", low, high)]
    longest = longest_side(vertices)
    unit = f"metres, probably (longest side {longest:.4g} m)"
    if longest > MILLIMETRES_ABOVE:
        unit = f"read as metres, the longest side is {longest:.4g} m; probably millimetres: {MILLIMETRE}"
    elif longest < TINY_BELOW:
        unit = f"read as metres, the longest side is {longest:.4g} m; very small: is the file scaled?"
    up = "y is taken for up; tetrahedralize and scene have --up, --to, --scale, --rotate and --at"
    return [("counts", counts), ("extent", ", ".join(extents)), ("axes", up), ("unit", unit)]


def _edge_line(lengths: np.ndarray) -> tuple[str, str]:
    return "edges", f"{lengths.min():.4g} to {lengths.max():.4g}, median {np.median(lengths):.4g}"


def _problem_lines(texts: list[str]) -> list[tuple[str, str]]:
    return [("" if i else "problems", text) for i, text in enumerate(texts or ["none"])]


def _triple(values: np.ndarray) -> str:
    return "(" + ", ".join(f"{value:.5g}" for value in values) + ")"


def _print_lines(title, lines: list[tuple[str, str]]) -> None:
    print(title)
    for name, text in lines:
        print(f"  {name:<10} {text}")


def _drop_scene(meshes: dict[str, TetMesh], at: list[float] | None, order: int, up: str) -> tuple[Scene, dict]:
    """Return a scene in which meshes, of rubber with stiffness scaled to their size, fall on the ground; and its solver dict.

    meshes: by name, as they stand to each other. at: (3,) [m], where the middle of their underside starts; None: above the
    ground. order: of the elements. up: axis that points up.
    """
    made = Scene(up=up)
    vertices = np.concatenate([mesh.vertices for mesh in meshes.values()])
    heights = vertices @ UP[up]
    height = float(np.ptp(heights))
    position = (DROP * height - heights.min()) * UP[up] + 0.0 if at is None else at - underside(vertices, up)
    young = float(f"{RELATIVE_STIFFNESS * DENSITY * 9.81 * height:.0e}")  # one digit
    rubber = Material(young=young, poisson=0.4, density=DENSITY, friction=0.5)
    for name, mesh in meshes.items():
        made.add_body(mesh, rubber, name="body" if name == GROUND else name, position=position, order=order)
    made.add_ground(friction=0.5, name=GROUND)
    fall = math.sqrt(2.0 * DROP * height / 9.81)  # [s]
    fps = 50.0 if fall > 0.05 else float(np.ceil(2.5 / fall))
    return made, {"dt": 0.5 / fps, "seconds": 100.0 / fps, "fps": fps}
