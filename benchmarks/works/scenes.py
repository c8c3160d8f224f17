"""The works as data: W1 a hanging beam, W2 a cube that drops on the ground, W3 three cubes on each other, W4 one on a sheet.

All have 1000 kg/m^3, Poisson's ratio 0.3 and five tets per cell; they are undamped and start at rest.
"""

from dataclasses import dataclass

import numpy as np

from taisoft.mesh.shapes import box_mesh
from taisoft.mesh.tet_mesh import TetMesh

from ..exact_path import GRAVITY, MESHES, SIZE, YOUNG

SOFT, SHEET = 1e5, 1e6  # [Pa]
FRICTION = 0.5
G = 9.81  # m/s^2, where bodies drop


@dataclass(frozen=True)
class Body:
    """mesh: initial positions [m]. young [Pa]. fixed: (n,) bool."""

    name: str
    mesh: TetMesh
    young: float
    fixed: np.ndarray


@dataclass(frozen=True)
class Work:
    """kind: "path" (an exact path of a point is known) or "stand" (it must stand). ground: the plane y = 0. seconds [s].

    gravity [m/s^2] along -y. friction: of all contacts. cells: of the beam's mesh, else None. free_until: time until which the
    last body falls freely [s], if evaluated.
    """

    key: str
    title: str
    kind: str
    bodies: tuple[Body, ...]
    ground: bool
    seconds: float = 1.0
    gravity: float = G
    friction: float = FRICTION
    cells: tuple[int, int, int] | None = None
    free_until: float | None = None

    @property
    def stiff(self) -> bool:
        """Whether explicit steps are far shorter than the motion of interest."""
        return max(body.young for body in self.bodies) > 1e7

    @property
    def tets(self) -> int:
        return sum(body.mesh.n_tets for body in self.bodies)

    @property
    def start(self) -> np.ndarray:
        """Positions of all nodes (n,3) [m] at the start, body after body."""
        return np.concatenate([body.mesh.vertices for body in self.bodies])

    @property
    def touches(self) -> bool:
        """Whether anything can touch."""
        return self.ground or len(self.bodies) > 1

    def slices(self) -> dict[str, slice]:
        """Slice of each body's nodes in an array of all."""
        ends = np.cumsum([body.mesh.n_verts for body in self.bodies])
        return {body.name: slice(end - body.mesh.n_verts, end) for body, end in zip(self.bodies, ends)}


def _box(name: str, cells, size, young: float, at=(0.0, 0.0, 0.0), held=lambda X: np.zeros(len(X), bool)) -> Body:
    mesh = box_mesh(cells, size)
    mesh = TetMesh(mesh.vertices + at, mesh.tets)
    return Body(name, mesh, young, held(mesh.vertices))


def hanging_beam(cells, young: float = YOUNG) -> Work:
    """W1: the beam of exact_path.py."""
    stiff = f", E = {young:.0e} Pa" if young != YOUNG else ""
    name = "x".join(map(str, cells))
    beam = _box("beam", tuple(cells), SIZE, young, held=lambda X: X[:, 0] < -SIZE[0] / 2 + 1e-9)
    title = f"hanging beam of {name} cells{stiff}"
    return Work(f"W1 {name}{stiff}", title, "path", (beam,), False, gravity=GRAVITY, cells=tuple(cells))


def dropped_cube() -> Work:
    """W2."""
    cube = _box("cube", (10,) * 3, (1,) * 3, SOFT, at=(0, 1.0, 0))
    return Work("W2", "cube of 1 m dropped 0.5 m on the ground", "path", (cube,), True)


def stack() -> Work:
    """W3. Waves, 11.6 m/s fast, have 2 m from the ground to the last cube: 0.17 s."""
    cubes = tuple(_box(f"cube {k}", (6,) * 3, (1,) * 3, SOFT, at=(0, 0.501 + 1.001 * k, 0)) for k in range(3))
    return Work("W3", "three cubes of 1 m, 1 mm apart, fall on each other", "stand", cubes, True, free_until=0.15)


def cube_on_sheet() -> Work:
    """W4. The cube would meet the sheet at rest at 0.226 s."""
    sheet = _box("sheet", (20, 2, 10), (4, 0.05, 4), SHEET, held=lambda X: np.abs(X[:, 0]) > 1.9)
    cube = _box("cube", (4,) * 3, (0.5,) * 3, SOFT, at=(0, 0.025 + 0.25 + 0.25, 0))
    return Work("W4", "cube of 0.5 m dropped 0.25 m on a clamped sheet", "stand", (sheet, cube), False, free_until=0.2)


WORKS: tuple[Work, ...] = (
    *(hanging_beam(cells) for cells in MESHES),
    *(hanging_beam(MESHES[0], young) for young in (1e8, 1e9)),
    dropped_cube(),
    stack(),
    cube_on_sheet(),
)
