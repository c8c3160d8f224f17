"""Static problems: on the tabulated meshes the linear tets must give the tabulated value; the converged one is reported.

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
    """A static problem that is compared on its tabulated meshes.

    hold: fixes and loads the body of a box that is centred or starts at x = 0, see `add_body`. reads: quantity -> its key among
    the values converged in space, and how it is read; the first is tabulated on the meshes too. meshes: cells, as in the table.
    counts: law -> how many of the meshes are run. quick: the law whose coarsest mesh the tests run.
    """

    name: str
    hold: Callable[[Body, dict], None]
    reads: dict[str, tuple[str, Callable[[Body, StaticResult], float]]]
    meshes: tuple[str, ...]
    counts: dict[str, int]
    quick: str
    gravity: bool = False
    tolerance: float = TOLERANCE

    def cases(self):
        """Cases in the order of laws and meshes."""
        for law, count in self.counts.items():
            for k, mesh in enumerate(self.meshes[:count]):
                yield Case(self.name, law, mesh, partial(self.solve, law, k), k > 0 or law != self.quick)

    def solve(self, law: str, k: int, reference: dict, arch: str):
        """Solve on the k-th tabulated mesh."""
        curve = reference["notes"]["linear_tet_error_curve"]
        row = (curve if isinstance(curve, list) else curve[law])[k]
        if label(row["cells"]) != self.meshes[k]:
            raise ValueError(f"{self.name}: mesh {k} of the reference is {label(row['cells'])}, not {self.meshes[k]}")
        s = scene(self.gravity)
        body = s.add_body(mesh_of(reference, tuple(row["cells"])), material(reference, law))
        self.hold(body, reference)
        result = ts.solve_static(s, tolerance=self.tolerance, arch=arch)
        yield small("residual / load", result.residual, self.tolerance)
        value = reference["value"].get(law, reference["value"])
        for i, (quantity, (key, read)) in enumerate(self.reads.items()):
            measured = read(body, result)
            if i == 0:
                yield near(f"{quantity}, same mesh", measured, row["value"], SAME_MESH)
            if value.get(key) is not None:
                yield near(f"{quantity}, converged in space", measured, value[key])


def mesh_of(reference: dict, cells) -> ts.TetMesh:
    """The problem's box, centred at the origin or starting at x = 0, or Cook's panel."""
    if "corner_points_xy" in reference["geometry"]:
        return cook_panel(cells, reference)
    size = reference["geometry"]["box"]
    return ts.box_mesh(cells, size, (size[0] / 2 if "x_from" in reference["geometry"] else 0.0, 0.0, 0.0))


def cook_panel(cells, reference: dict) -> ts.TetMesh:
    """Unit square grid mapped bilinearly to the tapered panel."""
    flat = ts.box_mesh(cells, (1, 1, reference["geometry"]["thickness_z"]), (0.5, 0.5, 0.0))
    u, v, z = flat.vertices.T
    corners = np.array(reference["geometry"]["corner_points_xy"], float)
    weights = np.stack([(1 - u) * (1 - v), u * (1 - v), u * v, (1 - u) * v])
    return ts.TetMesh(np.column_stack([weights.T @ corners, z]), flat.tets)


# --- how bodies are held and loaded -----------------------------------------------------------------------------------


def hanging_beam(beam: Body, reference: dict) -> None:
    """Cantilever under its own weight."""
    beam.fix(face(0, -2.0))


def mid_traction_beam(beam: Body, reference: dict) -> None:
    """Beam clamped at both ends, a patch of its bottom pushed up."""
    beam.fix(lambda X: np.abs(np.abs(X[:, 0]) - 2.0) < 1e-9)
    beam.add_traction(lambda C: (np.abs(C[:, 1] + 0.05) < 1e-9) & (np.abs(C[:, 0]) < 0.05), (0.0, 2000.0, 0.0))


def cook_membrane(panel: Body, reference: dict) -> None:
    """Tapered panel, clamped on the left, pulled up on the right."""
    panel.fix(face(0, 0.0))
    panel.add_traction(face(0, 48.0), (0.0, 6.25, 0.0))


def cantilever(beam: Body, reference: dict) -> None:
    """Slender cantilever, 0.01 N of shear spread over its end face."""
    beam.fix(face(0, 0.0))
    _, height, width = reference["geometry"]["box"]
    beam.add_traction(face(0, 1.0), (0.0, 0.01 / (height * width), 0.0))


def soft_sheet(sheet: Body, reference: dict) -> None:
    """Thin sheet held along two opposite sides."""
    half = reference["geometry"]["box"][0] / 2
    sheet.fix(lambda X: np.abs(np.abs(X[:, 0]) - half) < 1e-9)


def twisted_bar(bar: Body, reference: dict) -> None:
    """Thick bar, one end face clamped, the other turned by 90 degrees about x."""
    bar.fix(face(0, -2.0))
    turn_end(bar)


def turn_end(bar: Body) -> None:
    """Turn the face at x = 2 m by 90 degrees about x."""
    end = face(0, 2.0)(bar.rest_positions)
    _, y, z = bar.rest_positions[end].T
    displacement = np.column_stack([np.zeros_like(y), -z - y, y - z])
    bar.move(end, lambda t: displacement)


# --- what is read -----------------------------------------------------------------------------------------------------


def _displacement(choose: Callable[[np.ndarray], np.ndarray], axis: int = 1) -> Callable[[Body, StaticResult], float]:
    """Reads the mean displacement along an axis [m] of the nodes that `choose` picks among the rest positions (n,3)."""

    def read(body: Body, result: StaticResult) -> float:
        X = body.rest_positions
        return float((result.positions(body.name) - X)[choose(X), axis].mean())

    return read


def _at(point, axis: int = 1) -> Callable[[Body, StaticResult], float]:
    """Reads the displacement of the node nearest to a point; the mean of several that are equally near."""
    return _displacement(lambda X: nearest(X, point), axis)


def _through_thickness(x: float, z: float) -> Callable[[Body, StaticResult], float]:
    """Reads the mean vertical displacement of the nodes nearest to the vertical line through (x, z)."""
    return _displacement(lambda X: nearest(X[:, [0, 2]], (x, z)))


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


TIP = {"uy of the tip [m]": ("uy_tip", _at((2, 0, 0))), "ux of the tip [m]": ("ux_tip", _at((2, 0, 0), axis=0))}
MIDDLE = {
    "uy of the centre [m]": ("uy_centre", _at((0, 0, 0))),
    "uy of the centre's top [m]": ("uy_top_centre", _at((0, 0.05, 0))),
}
PANEL = {"uy of the right face's middle": ("uy_mid", _at((48, 52, 0)))}
END = {"mean uy of the end face [m]": ("fe3d", _displacement(face(0, 1.0)))}
SHEET = {
    "uy of the centre [m]": ("uy_centre", _through_thickness(0, 0)),
    "uy of the free edge's middle [m]": ("uy_free_edge_middle", _through_thickness(0, 2)),
}
TWIST = {
    "torque [N m]": ("torque", _torque),
    "axial force [N]": ("axial_force", _axial_force),
    "energy [J]": ("energy", lambda body, result: result.elastic),
}
BEAMS, PANELS = ("11x2x2", "22x4x4", "44x8x8"), ("8x8x2", "16x16x4", "32x32x8")
SLENDER = ("20x2x2", "40x4x4", "80x8x8")
PROBLEMS = (
    Problem("hanging_beam_E1e6", hanging_beam, TIP, BEAMS, {"SNH": 3, "COR": 3, "SVK": 2}, "SNH", gravity=True),
    Problem("hanging_beam_E2e6", hanging_beam, TIP, BEAMS, {"SNH": 3, "SVK": 2}, "SVK", gravity=True),
    Problem("mid_traction_beam", mid_traction_beam, MIDDLE, ("80x2x2", "160x4x4"), {"SNH": 2, "SVK": 1, "COR": 1}, "SNH"),
    Problem("cook_membrane_3d", cook_membrane, PANEL, PANELS, {"SVK": 2, "COR": 2, "SNH": 3}, "SVK"),
    # its load is tiny: 1e-7 of it is the rounding of the stress on the finest mesh
    Problem("cantilever_small", cantilever, END, SLENDER, {"SVK": 3, "COR": 1, "SNH": 1}, "SVK", tolerance=3e-7),
    Problem("soft_sheet_self_weight", soft_sheet, SHEET, ("19x1x9", "38x2x18"), {"SNH": 2, "SVK": 2}, "SNH", gravity=True),
    Problem("twist_bar_90deg", twisted_bar, TWIST, ("8x2x2", "16x4x4"), {"SNH": 2, "COR": 2, "SVK": 2}, "SVK"),
)


def _mean_by_area(body: Body, result: StaticResult, choice) -> float:
    """Vertical displacement, averaged over the area of a face of the surface [m]."""
    X, surface = body.rest_positions, body.mesh.surface
    triangles = surface[choice(X)[surface].all(axis=1)]
    a, b, c = X[triangles].transpose(1, 0, 2)
    area = np.linalg.norm(np.cross(b - a, c - a), axis=1)
    displacement = (result.positions(body.name) - X)[:, 1]
    return float(np.average(displacement[triangles].mean(axis=1), weights=area))


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
        displacement = _mean_by_area(body, result, face(1, height))
        top = near(f"uy of the top, {body.name} [m]", displacement, value["uy_top"][law])
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
