"""Static problems: on the tabulated meshes the linear tets must give the tabulated value; the converged one is told.

`linear_tet_error_curve` of a problem's file holds what a correct code gives on the same mesh. The error against the
converged value is the mesh's own (linear tets lock in bending), so it has no limit here.
"""

from collections.abc import Callable
from dataclasses import dataclass
from functools import partial

import numpy as np

import taisoft as ts
from taisoft.scene.scene import Body
from taisoft.static import StaticResult

from .record import SAME_MESH, Case, face, label, material, near, nearest, order, scene, small

TOLERANCE = 1e-9  # of |residual| / |load|: far below what the reference is good to


@dataclass(frozen=True)
class Problem:
    """A static problem that is compared on its tabulated meshes."""

    name: str
    build: Callable[[dict, str, tuple], ts.Scene]  # (reference, law, cells) -> scene of one body
    # what is read, its key among the values converged in space, how; the first is tabulated on the meshes too
    reads: tuple[tuple[str, str, Callable[[Body, StaticResult], float]], ...]
    meshes: tuple[str, ...]  # cells of the tabulated meshes
    counts: dict[str, int]  # law -> how many of them are run
    quick: tuple[str, ...]  # laws whose coarsest mesh the tests run
    tolerance: float = TOLERANCE

    def cases(self):
        """Cases in the order of laws and meshes."""
        for law, count in self.counts.items():
            for k, mesh in enumerate(self.meshes[:count]):
                yield Case(self.name, law, mesh, partial(self.solve, law, k), k > 0 or law not in self.quick)

    def solve(self, law: str, k: int, reference: dict, arch: str):
        """Solve on the k-th tabulated mesh."""
        curve = reference["notes"]["linear_tet_error_curve"]
        row = (curve if isinstance(curve, list) else curve[law])[k]
        if label(row["cells"]) != self.meshes[k]:
            raise ValueError(f"{self.name}: mesh {k} of the reference is {label(row['cells'])}, not {self.meshes[k]}")
        s = self.build(reference, law, tuple(row["cells"]))
        result = ts.solve_static(s, tolerance=self.tolerance, arch=arch)
        yield small("residual / load", result.residual, self.tolerance)
        value = reference["value"].get(law, reference["value"])
        for i, (quantity, key, read) in enumerate(self.reads):
            measured = read(s.bodies[0], result)
            if i == 0:
                yield near(f"{quantity}, same mesh", measured, row["value"], SAME_MESH)
            if value.get(key) is not None:
                yield near(f"{quantity}, converged in space", measured, value[key])


def _box(reference: dict, cells) -> ts.TetMesh:
    """The problem's box, centred at the origin or starting at x = 0."""
    size = reference["geometry"]["box"]
    center = (size[0] / 2, 0.0, 0.0) if "x_from" in reference["geometry"] else (0.0, 0.0, 0.0)
    return ts.box_mesh(cells, size, center)


def _displacement(body: Body, result: StaticResult, nodes: np.ndarray, axis: int = 1) -> float:
    """Mean displacement of some nodes along an axis [m]."""
    return float((result.positions(body.name) - body.rest_positions)[nodes, axis].mean())


def _at(point, axis: int = 1) -> Callable[[Body, StaticResult], float]:
    """Reads the displacement of the node nearest to a point; the mean of several that are equally near."""
    return lambda body, result: _displacement(body, result, nearest(body.rest_positions, point), axis)


def _through_thickness(x: float, z: float) -> Callable[[Body, StaticResult], float]:
    """Reads the mean vertical displacement of the nodes nearest to the vertical line through (x, z)."""
    return lambda body, result: _displacement(body, result, nearest(body.rest_positions[:, [0, 2]], (x, z)))


def _end_face(body: Body, result: StaticResult) -> float:
    """Mean vertical displacement of the nodes at x = 1 [m]."""
    return _displacement(body, result, face(0, 1.0)(body.rest_positions))


def hanging_beam(reference: dict, law: str, cells) -> ts.Scene:
    """Cantilever under its own weight."""
    s = scene(gravity=True)
    s.add_body(_box(reference, cells), material(reference, law)).fix(face(0, -2.0))
    return s


def mid_traction_beam(reference: dict, law: str, cells) -> ts.Scene:
    """Beam clamped at both ends, a patch of its bottom pushed up."""
    s = scene()
    beam = s.add_body(_box(reference, cells), material(reference, law))
    beam.fix(lambda X: np.abs(np.abs(X[:, 0]) - 2.0) < 1e-9)
    beam.add_traction(lambda C: (np.abs(C[:, 1] + 0.05) < 1e-9) & (np.abs(C[:, 0]) < 0.05), (0.0, 2000.0, 0.0))
    return s


def cook_panel(cells, reference: dict) -> ts.TetMesh:
    """Unit square grid mapped bilinearly to the tapered panel."""
    flat = ts.box_mesh(cells, (1, 1, reference["geometry"]["thickness_z"]), (0.5, 0.5, 0.0))
    u, v, z = flat.vertices.T
    corners = np.array(reference["geometry"]["corner_points_xy"], float)
    weights = np.stack([(1 - u) * (1 - v), u * (1 - v), u * v, (1 - u) * v])
    return ts.TetMesh(np.column_stack([weights.T @ corners, z]), flat.tets)


def cook_membrane(reference: dict, law: str, cells) -> ts.Scene:
    """Tapered panel, clamped on the left, pulled up on the right."""
    s = scene()
    panel = s.add_body(cook_panel(cells, reference), material(reference, law, density=1.0))
    panel.fix(face(0, 0.0))
    panel.add_traction(face(0, 48.0), (0.0, 6.25, 0.0))
    return s


def cantilever(reference: dict, law: str, cells) -> ts.Scene:
    """Slender cantilever, 0.01 N of shear spread over its end face."""
    s = scene()
    beam = s.add_body(_box(reference, cells), material(reference, law))
    beam.fix(face(0, 0.0))
    _, height, width = reference["geometry"]["box"]
    beam.add_traction(face(0, 1.0), (0.0, 0.01 / (height * width), 0.0))
    return s


def soft_sheet(reference: dict, law: str, cells) -> ts.Scene:
    """Thin sheet held along two opposite sides."""
    s = scene(gravity=True)
    half = reference["geometry"]["box"][0] / 2
    s.add_body(_box(reference, cells), material(reference, law)).fix(lambda X: np.abs(np.abs(X[:, 0]) - half) < 1e-9)
    return s


def twisted_bar(reference: dict, law: str, cells) -> ts.Scene:
    """Thick bar, one end face clamped, the other turned by 90 degrees about x."""
    s = scene()
    bar = s.add_body(_box(reference, cells), material(reference, law, density=1.0))
    bar.fix(face(0, -2.0))
    end = face(0, 2.0)(bar.rest_positions)
    _, y, z = bar.rest_positions[end].T
    way = np.column_stack([np.zeros_like(y), -z - y, y - z])
    bar.move(end, lambda t: way)
    return s


def _turned_face(body: Body, result: StaticResult) -> tuple[np.ndarray, np.ndarray]:
    """Positions [m] and reactions [N] of the turned face's nodes."""
    end = face(0, 2.0)(body.rest_positions)
    return result.positions(body.name)[end], result.reactions(body.name)[end]


def _torque(body: Body, result: StaticResult) -> float:
    """Torque on the turned face about x [N m]."""
    return float(np.cross(*_turned_face(body, result))[:, 0].sum())


def _axial_force(body: Body, result: StaticResult) -> float:
    """Force on the turned face along x [N], positive in tension."""
    return float(_turned_face(body, result)[1][:, 0].sum())


_TIP = (("uy of the tip [m]", "uy_tip", _at((2, 0, 0))), ("ux of the tip [m]", "ux_tip", _at((2, 0, 0), axis=0)))
PROBLEMS = (
    Problem(
        "hanging_beam_E1e6", hanging_beam, _TIP, ("11x2x2", "22x4x4", "44x8x8"), {"SNH": 3, "COR": 3, "SVK": 2}, quick=("SNH",)
    ),
    Problem("hanging_beam_E2e6", hanging_beam, _TIP, ("11x2x2", "22x4x4", "44x8x8"), {"SNH": 3, "SVK": 2}, quick=("SVK",)),
    Problem(
        "mid_traction_beam",
        mid_traction_beam,
        (
            ("uy of the centre [m]", "uy_centre", _at((0, 0, 0))),
            ("uy of the centre's top [m]", "uy_top_centre", _at((0, 0.05, 0))),
        ),
        ("80x2x2", "160x4x4"),
        {"SNH": 2, "SVK": 1, "COR": 1},
        quick=("SNH",),
    ),
    Problem(
        "cook_membrane_3d",
        cook_membrane,
        (("uy of the right face's middle", "uy_mid", _at((48, 52, 0))),),
        ("8x8x2", "16x16x4", "32x32x8"),
        {"SVK": 2, "COR": 2, "SNH": 3},
        quick=("SVK",),
    ),
    Problem(  # its load is tiny: 1e-7 of it is the rounding of the stress on the finest mesh
        "cantilever_small",
        cantilever,
        (("mean uy of the end face [m]", "fe3d", _end_face),),
        ("20x2x2", "40x4x4", "80x8x8"),
        {"SVK": 3, "COR": 1, "SNH": 1},
        quick=("SVK",),
        tolerance=3e-7,
    ),
    Problem(
        "soft_sheet_self_weight",
        soft_sheet,
        (
            ("uy of the centre [m]", "uy_centre", _through_thickness(0, 0)),
            ("uy of the free edge's middle [m]", "uy_free_edge_middle", _through_thickness(0, 2)),
        ),
        ("19x1x9", "38x2x18"),
        {"SNH": 2, "SVK": 2},
        quick=("SNH",),
    ),
    Problem(
        "twist_bar_90deg",
        twisted_bar,
        (
            ("torque [N m]", "torque", _torque),
            ("axial force [N]", "axial_force", _axial_force),
            ("energy [J]", "energy", lambda body, result: result.elastic),
        ),
        ("8x2x2", "16x4x4"),
        {"SNH": 2, "COR": 2, "SVK": 2},
        quick=("SVK",),
    ),
)


def _mean_by_area(body: Body, result: StaticResult, choice) -> float:
    """Vertical displacement, averaged over the area of a face of the surface [m]."""
    X, surface = body.rest_positions, body.mesh.surface
    triangles = surface[choice(X)[surface].all(axis=1)]
    a, b, c = X[triangles].transpose(1, 0, 2)
    area = np.linalg.norm(np.cross(b - a, c - a), axis=1)
    way = (result.positions(body.name) - X)[:, 1]
    return float(np.average(way[triangles].mean(axis=1), weights=area))


def column(law: str, reference: dict, arch: str):
    """Columns of three mesh widths in one scene: exact base force, second-order displacement of the top."""
    s = scene(gravity=True)
    width, height, depth = reference["geometry"]["box"]
    for n in (2, 4, 8):
        mesh = ts.box_mesh((n // 2, n, n // 2), (width, height, depth), (0.0, height / 2, 0.0))
        s.add_body(mesh, material(reference, law), name=f"h = 1/{n} m").fix(face(1, 0.0))
    result = ts.solve_static(s, tolerance=1e-12, arch=arch)
    value, errors = reference["value"], []
    for body in s.bodies:
        pushed = result.reactions(body.name)[:, 1].sum()
        way = _mean_by_area(body, result, face(1, height))
        top = near(f"uy of the top, {body.name} [m]", way, value["uy_top"][law])
        errors.append(top.error)
        yield top
        yield near(f"base force, {body.name} [N]", pushed, value["base_force"], 1e-10)
    for body, coarse, fine in zip(s.bodies, errors, errors[1:]):
        yield order(f"order in h of uy, {body.name} halved", coarse, fine, 2.0, 0.2)


CASES = (
    *(case for problem in PROBLEMS for case in problem.cases()),
    Case("column_self_weight", "SVK", "1x2x1 2x4x2 4x8x4", partial(column, "SVK"), fine=True),
    Case("column_self_weight", "COR", "1x2x1 2x4x2 4x8x4", partial(column, "COR")),
)
