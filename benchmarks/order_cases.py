"""Cases of `order.py`: static problems, each with a scene, measured displacements and a reference.

References are results of other programs, closed forms, or extrapolated; no error below their `uncertainty` is claimed. Scenes use
SI units, except Cook's panel.
"""

from collections.abc import Callable
from dataclasses import dataclass, field

import numpy as np

import taisoft as ts
from taisoft.scene.scene import Body

from .reference_cases.record import GRAVITY, LAWS, face, nearest, scene
from .reference_cases.statics import cook_membrane, cook_panel, hanging_beam, soft_sheet

Element = tuple[int, int | None]  # order of the shape functions, and the degree of a quadrature rule
LINEAR, QUADRATIC, QUADRATIC_14 = (1, None), (2, 2), (2, 4)
POINTS = {LINEAR: 1, QUADRATIC: 4, QUADRATIC_14: 14}  # of quadrature in a tet

BEAM_MESHES = {
    LINEAR: ((11, 2, 2), (22, 4, 4), (44, 8, 8), (66, 12, 12)),
    QUADRATIC: ((6, 1, 1), (11, 2, 2), (16, 3, 3), (22, 4, 4)),
}
FINER_MESHES = {LINEAR: BEAM_MESHES[LINEAR][1:], QUADRATIC: BEAM_MESHES[QUADRATIC][:3]}
NESTED_MESHES = {LINEAR: ((6, 2, 2), (12, 4, 4), (24, 8, 8)), QUADRATIC: ((3, 1, 1), (6, 2, 2), (12, 4, 4))}
STRIP_MESHES = {LINEAR: ((50, 1, 5), (100, 1, 10)), QUADRATIC: ((10, 1, 1), (20, 1, 2), (30, 1, 3))}

BRICKS = "27-node bricks of scikit-fem 12.0.2 on nested meshes, full Newton, Richardson extrapolation"
NESTED = "quadratic tets with four points on meshes to 24x8x8, extrapolated"
ELASTICA = "elastica: elliptic integrals (Bisshopp and Drucker 1945); thickness and shear move a 3D bar by less than 0.1 %"
HEAVY_ELASTICA = "elastica under its own weight: boundary value problem solved to 1e-11; thickness, stretch and shear as above"

RUBBER = {"young": 1e6, "poisson": 0.3, "density": 1000.0}
BEAM, STRIP, SHEET = (4.0, 1.0, 1.0), (10.0, 0.1, 1.0), (4.0, 0.05, 4.0)
PANEL = {"geometry": {"thickness_z": 10.0, "corner_points_xy": ((0, 0), (48, 44), (48, 60), (0, 44))}}
STRIP_MATERIAL = {"young": 1.2e6, "poisson": 0.0, "density": 1.0}
# weight over bending stiffness w L^3 / (E I) = 8, with w = rho g and I = h^2/12 for one unit of the section's area
HEAVY = 8.0 * 1.2e6 * STRIP[1] ** 2 / (12.0 * GRAVITY * STRIP[0] ** 3)


@dataclass(frozen=True)
class Reference:
    """Reference of a case. values: of its numbers; uncertainty: relative, of the worst value."""

    values: tuple[float, ...]
    uncertainty: float
    source: str


@dataclass(frozen=True)
class Case:
    """One problem with one law; by default a beam that is clamped at its left end and hangs from it.

    meshes: cells, coarse to fine, for each element. hold: fixes and loads the body. point, axes: where and along which axes its
    displacement is measured.
    """

    name: str
    title: str
    law: str
    meshes: dict[Element, tuple]
    reference: Reference
    mesh: Callable[[tuple], ts.TetMesh] = lambda cells: ts.box_mesh(cells, BEAM)
    material: dict = field(default_factory=lambda: RUBBER)
    hold: Callable[[Body], object] = lambda beam: hanging_beam(beam, {})
    point: tuple[float, float, float] = (2.0, 0.0, 0.0)
    axes: tuple[int, ...] = (1,)
    gravity: bool = True
    unit: str = " [m]"

    @property
    def quantity(self) -> str:
        """What is measured."""
        return f"{', '.join('u' + 'xyz'[axis] for axis in self.axes)} at {self.point}{self.unit}"

    def build(self, cells, element: Element) -> ts.Scene:
        """The scene with its one body."""
        s, (order, degree) = scene(self.gravity), element
        more = {} if degree is None else {"quadrature_degree": degree}
        body = s.add_body(self.mesh(cells), ts.Material(law=LAWS[self.law], **self.material), order=order, **more)
        self.hold(body)
        return s

    def read(self, body: Body, state) -> np.ndarray:
        """The displacements of the node nearest to the point, or the mean of several equally near ones."""
        nodes = nearest(body.rest_positions, self.point)
        return (state.positions(body.name) - body.rest_positions)[nodes].mean(axis=0)[list(self.axes)]


def _strip(name: str, title: str, values: tuple, source: str, hold: Callable[[Body], object], **more) -> Case:
    """A strip clamped at its left end, which is at x = 0."""
    end, reference = (STRIP[0], 0.0, 0.0), Reference(values, 1e-3, source)
    more |= {"mesh": lambda cells: ts.box_mesh(cells, STRIP, (STRIP[0] / 2, 0.0, 0.0)), "point": end, "axes": (0, 1)}
    return Case(name, title, "SVK", STRIP_MESHES, reference, hold=hold, **more)


def _pull(strip: Body) -> None:
    """4 N across its right end."""
    strip.fix(face(0, 0.0))
    strip.add_traction(face(0, STRIP[0]), (0.0, 4.0 / (STRIP[1] * STRIP[2]), 0.0))


HANGING = "hanging_beam"  # the case with a limit on the speed-up
FOURTEEN = {QUADRATIC_14: ((6, 1, 1), (11, 2, 2))}
CASES = (
    Case(HANGING, "hanging beam", "SNH", BEAM_MESHES | FOURTEEN, Reference((-2.70947892267,), 4.3e-4, BRICKS)),
    Case("hanging_beam_cor", "hanging beam", "COR", FINER_MESHES, Reference((-2.6807151797,), 3e-4, BRICKS)),
    Case(
        "hanging_beam_svk",
        "hanging beam, E = 2 MPa",
        "SVK",
        FINER_MESHES,
        Reference((-1.73061189475,), 5.8e-3, BRICKS + ", two meshes only: not converged"),
        material=RUBBER | {"young": 2e6},
    ),
    Case(
        "hanging_beam_nu0.499",
        "hanging beam, nu = 0.499",
        "SNH",
        NESTED_MESHES | {QUADRATIC_14: ((6, 2, 2),)},
        Reference((-2.672,), 8e-3, NESTED),
        material=RUBBER | {"poisson": 0.499},
    ),
    Case(
        "cook",
        "Cook's panel",
        "SNH",
        {LINEAR: ((8, 8, 2), (16, 16, 4), (32, 32, 8)), QUADRATIC: ((2, 2, 1), (4, 4, 1), (8, 8, 2))},
        Reference((8.39990723254,), 5e-4, BRICKS),
        lambda cells: cook_panel(cells, PANEL),
        {"young": 240.565, "poisson": 0.3, "density": 1.0},
        lambda panel: cook_membrane(panel, PANEL),
        (48.0, 52.0, 0.0),
        gravity=False,
        unit="",
    ),
    _strip(
        "elastica_shear",
        "elastica, end shear",
        (-3.28941242247, 6.69964181278),
        ELASTICA,
        _pull,
        material=STRIP_MATERIAL,
        gravity=False,
    ),
    _strip(
        "elastica_weight",
        "elastica, own weight",
        (-2.75575265862, -6.40630717422),
        HEAVY_ELASTICA,
        lambda strip: strip.fix(face(0, 0.0)),
        material=STRIP_MATERIAL | {"density": HEAVY},
    ),
    Case(
        "soft_sheet",
        "soft sheet",
        "SNH",
        {LINEAR: ((18, 1, 8), (38, 2, 18), (56, 3, 26)), QUADRATIC: ((6, 1, 2), (10, 1, 4), (20, 1, 10))},
        Reference((-0.484115899582,), 3e-4, BRICKS),
        lambda cells: ts.box_mesh(cells, SHEET),
        hold=lambda sheet: soft_sheet(sheet, {"geometry": {"box": SHEET}}),
        point=(0.0, 0.0, 0.0),
    ),
)
