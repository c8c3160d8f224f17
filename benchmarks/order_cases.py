"""Cases of `order.py`: static problems, each with a scene, measured numbers and a reference.

References are results of other programs, closed forms, or extrapolated; no error below their `uncertainty` is claimed. Scenes use
SI units, except Cook's panel.
"""

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np

import taisoft as ts
from taisoft.scene.scene import Body

from .reference_cases.record import GRAVITY, LAWS, face, nearest, scene
from .reference_cases.statics import cook_panel

Element = tuple[int, int | None]  # order of the shape functions, and the degree of a quadrature rule
LINEAR, QUADRATIC, QUADRATIC_14 = (1, None), (2, 2), (2, 4)
POINTS = {LINEAR: 1, QUADRATIC: 4, QUADRATIC_14: 14}  # of quadrature in a tet


@dataclass(frozen=True)
class Reference:
    """Reference of a case. values: of its numbers; uncertainty: relative, of the worst value."""

    values: tuple[float, ...]
    uncertainty: float
    source: str


@dataclass(frozen=True)
class Case:
    """One problem with one law, and the cells of its meshes, coarse to fine, for each element."""

    name: str
    title: str
    law: str
    quantity: str
    mesh: Callable[[tuple], ts.TetMesh]
    material: dict  # young, poisson, density
    clamped: Callable[[np.ndarray], np.ndarray]  # choice of nodes
    read: Callable[[Body, object], np.ndarray]
    meshes: dict[Element, tuple]
    reference: Reference
    gravity: bool = True
    load: Callable[[Body], object] | None = None  # more than gravity

    def build(self, cells, element: Element) -> ts.Scene:
        """The scene with its one body."""
        s, (order, degree) = scene(self.gravity), element
        more = {} if degree is None else {"quadrature_degree": degree}
        body = s.add_body(self.mesh(cells), ts.Material(law=LAWS[self.law], **self.material), order=order, **more)
        body.fix(self.clamped)
        if self.load is not None:
            self.load(body)
        return s


def displacement(point, *axes: int) -> Callable[[Body, object], np.ndarray]:
    """Reader of the displacement along axes [m] of the node nearest to a point, or the mean of several equally near ones."""

    def read(body: Body, state) -> np.ndarray:
        nodes = nearest(body.rest_positions, point)
        return (state.positions(body.name) - body.rest_positions)[nodes].mean(axis=0)[list(axes)]

    return read


def _box(size, starts_at_zero: bool = False) -> Callable[[tuple], ts.TetMesh]:
    """Boxes (3,) [m] of any cells, centred, or with their left end at x = 0."""
    return lambda cells: ts.box_mesh(cells, size, (size[0] / 2 if starts_at_zero else 0.0, 0.0, 0.0))


# --- meshes -----------------------------------------------------------------------------------------------------------


BEAM_MESHES = {
    LINEAR: ((11, 2, 2), (22, 4, 4), (44, 8, 8), (66, 12, 12)),
    QUADRATIC: ((6, 1, 1), (11, 2, 2), (16, 3, 3), (22, 4, 4)),
}
FINER_MESHES = {LINEAR: BEAM_MESHES[LINEAR][1:], QUADRATIC: BEAM_MESHES[QUADRATIC][:3]}
NESTED_MESHES = {LINEAR: ((6, 2, 2), (12, 4, 4), (24, 8, 8)), QUADRATIC: ((3, 1, 1), (6, 2, 2), (12, 4, 4))}
STRIP_MESHES = {LINEAR: ((50, 1, 5), (100, 1, 10)), QUADRATIC: ((10, 1, 1), (20, 1, 2), (30, 1, 3))}

# --- references -------------------------------------------------------------------------------------------------------

BRICKS = "27-node bricks of scikit-fem 12.0.2 on nested meshes, full Newton, Richardson extrapolation"
ELASTICA = "elastica: elliptic integrals (Bisshopp and Drucker 1945); thickness and shear move a 3D bar by less than 0.1 %"
HEAVY_ELASTICA = "elastica under its own weight: boundary value problem solved to 1e-11; thickness, stretch and shear as above"
NESTED = "quadratic tets with four points on meshes to 24x8x8, extrapolated"

# --- cases ------------------------------------------------------------------------------------------------------------

RUBBER = {"young": 1e6, "poisson": 0.3, "density": 1000.0}
BEAM, STRIP, SHEET = (4.0, 1.0, 1.0), (10.0, 0.1, 1.0), (4.0, 0.05, 4.0)
PANEL = {"geometry": {"thickness_z": 10.0, "corner_points_xy": ((0, 0), (48, 44), (48, 60), (0, 44))}}
# weight over bending stiffness w L^3 / (E I) = 8, with w = rho g and I = h^2/12 for one unit of the section's area
HEAVY = 8.0 * 1.2e6 * STRIP[1] ** 2 / (12.0 * GRAVITY * STRIP[0] ** 3)


def _beam(name: str, title: str, law: str, reference: Reference, young: float = 1e6, **more) -> Case:
    """The beam 4 x 1 x 1 m, clamped at its left end, bends under its own weight, unless `more` says otherwise."""
    own = {
        "quantity": "uy of the tip [m]",
        "read": displacement((2, 0, 0), 1),
        "meshes": FINER_MESHES,
        "material": RUBBER | {"young": young},
    }
    return Case(name, title, law, mesh=_box(BEAM), clamped=face(0, -2.0), reference=reference, **own | more)


def _elastica(name: str, title: str, values: tuple, source: str, density: float = 1.0, **more) -> Case:
    """A strip clamped at its left end."""
    material, read = {"young": 1.2e6, "poisson": 0.0, "density": density}, displacement((10, 0, 0), 0, 1)
    return Case(
        name,
        title,
        "SVK",
        "ux, uy of the tip [m]",
        _box(STRIP, True),
        material,
        face(0, 0.0),
        read,
        STRIP_MESHES,
        Reference(values, 1e-3, source),
        **more,
    )


HANGING = "hanging_beam"  # the case with a limit on the speed-up
CASES = (
    _beam(
        HANGING,
        "hanging beam",
        "SNH",
        Reference((-2.70947892267,), 4.3e-4, BRICKS),
        meshes=BEAM_MESHES | {QUADRATIC_14: ((6, 1, 1), (11, 2, 2))},
    ),
    _beam("hanging_beam_cor", "hanging beam", "COR", Reference((-2.6807151797,), 3e-4, BRICKS)),
    _beam(
        "hanging_beam_svk",
        "hanging beam, E = 2 MPa",
        "SVK",
        Reference((-1.73061189475,), 5.8e-3, BRICKS + ", two meshes only: not converged"),
        young=2e6,
    ),
    _beam(
        "hanging_beam_nu0.499",
        "hanging beam, nu = 0.499",
        "SNH",
        Reference((-2.672,), 8e-3, NESTED),
        material=RUBBER | {"poisson": 0.499},
        meshes=NESTED_MESHES | {QUADRATIC_14: ((6, 2, 2),)},
    ),
    Case(
        "cook",
        "Cook's panel",
        "SNH",
        "uy of the right side's middle",
        lambda cells: cook_panel(cells, PANEL),
        {"young": 240.565, "poisson": 0.3, "density": 1.0},
        face(0, 0.0),
        displacement((48, 52, 0), 1),
        {LINEAR: ((8, 8, 2), (16, 16, 4), (32, 32, 8)), QUADRATIC: ((2, 2, 1), (4, 4, 1), (8, 8, 2))},
        Reference((8.39990723254,), 5e-4, BRICKS),
        gravity=False,
        load=lambda panel: panel.add_traction(face(0, 48.0), (0.0, 6.25, 0.0)),
    ),
    _elastica(
        "elastica_shear",
        "elastica, end shear",
        (-3.28941242247, 6.69964181278),
        ELASTICA,
        gravity=False,
        load=lambda strip: strip.add_traction(face(0, 10.0), (0.0, 4.0 / (STRIP[1] * STRIP[2]), 0.0)),  # 4 N in all
    ),
    _elastica("elastica_weight", "elastica, own weight", (-2.75575265862, -6.40630717422), HEAVY_ELASTICA, HEAVY),
    Case(
        "soft_sheet",
        "soft sheet",
        "SNH",
        "uy of the centre [m]",
        _box(SHEET),
        RUBBER,
        lambda X: np.abs(np.abs(X[:, 0]) - 2.0) < 1e-9,
        displacement((0, 0, 0), 1),
        {LINEAR: ((18, 1, 8), (38, 2, 18), (56, 3, 26)), QUADRATIC: ((6, 1, 2), (10, 1, 4), (20, 1, 10))},
        Reference((-0.484115899582,), 3e-4, BRICKS),
    ),
)
