"""The structures that `taisoft warm` compiles, as data, and a tiny scene for each.

Kernels depend on the fields of `Structure`, not on meshes or numbers, so a cube of 40 tets suffices for a body. The table
contains every demo's structure, which `tests/test_cli_warm.py` checks.
"""

from collections.abc import Iterator
from dataclasses import dataclass, fields

import numpy as np

from taisoft.dynamics import EXPLICIT
from taisoft.mesh.shapes import box_mesh, sheet_mesh
from taisoft.mesh.tet_mesh import TetMesh
from taisoft.scene.body import LAWS
from taisoft.scene.key_frames import KeyFrames
from taisoft.scene.obstacles import Box, HalfSpace, MeshObstacle
from taisoft.scene.scene import Material, Scene

IMPLICIT = ("implicit_euler", "bdf2")  # the common ones
STATIC = ""  # in place of an integrator
SIZE = 0.1  # [m] of a cube
SPEED = 2.0  # [m/s] of falling bodies: fast enough that collisions retry steps


@dataclass(frozen=True)
class Structure:
    """Features that kernels are compiled for. obstacles: "half-space", "box" or "mesh"; orders: element order of each body.

    fixed, prescribed: some nodes are fixed, or follow a path; loaded: forces on nodes; thin: tets so flat that strains are
    computed in f64; fine: a surface of more than 1,500 triangles, searched by parallel loops.
    """

    integrator: str
    law: str = "stable_neo_hookean"
    orders: tuple[int, ...] = (1,)
    obstacles: tuple[str, ...] = ()
    fixed: bool = False
    prescribed: bool = False
    loaded: bool = False
    mass_damping: bool = False
    stiffness_damping: bool = False
    thin: bool = False
    fine: bool = False
    contacts: bool = True  # whether contact forces are modelled

    def __str__(self) -> str:
        words = [name.replace("_", " ") for name in (self.law, self.integrator) if name]
        words += [f"orders {' '.join(map(str, self.orders))}"] if 2 in self.orders else []
        words += [f"{len(self.orders)} bodies"] if len(self.orders) > 1 else []
        words += self.obstacles
        on = [f.name for f in fields(self) if f.default is False and getattr(self, f.name)]
        words += [name.replace("_", " ") for name in on]
        return ", ".join(words)


def structures() -> Iterator[Structure]:
    """Yield the table: first the features common to all laws, then those of the default law."""
    for law in LAWS:
        for integrator in (*EXPLICIT, *IMPLICIT):
            yield Structure(integrator, law, fixed=True)
        yield Structure("implicit_euler", law, fixed=True, mass_damping=True)
        yield Structure("implicit_euler", law, obstacles=("half-space",))
        yield Structure("implicit_euler", law, orders=(1, 1), fixed=True)
        yield Structure("symplectic_euler", law, obstacles=("half-space",))
    for integrator in EXPLICIT:
        yield from _explicit(integrator)
    for integrator in IMPLICIT:
        yield from _implicit(integrator)
    yield Structure("implicit_euler", obstacles=("half-space",), fine=True)
    yield Structure("implicit_euler", obstacles=("half-space", "box"), fine=True)
    yield Structure("implicit_euler", obstacles=("box",), thin=True, fine=True, mass_damping=True)


def static_structures() -> Iterator[Structure]:
    """Yield the structures for `solve_static`, which has no integrator and no contacts."""
    for law in LAWS:
        yield Structure(STATIC, law, fixed=True)
    yield Structure(STATIC, fixed=True, loaded=True)
    yield Structure(STATIC, fixed=True, prescribed=True)
    yield Structure(STATIC, orders=(2,), fixed=True)


def _explicit(integrator: str) -> Iterator[Structure]:
    yield Structure(integrator)
    yield Structure(integrator, fixed=True, mass_damping=True)
    yield Structure(integrator, fixed=True, loaded=True)
    yield Structure(integrator, fixed=True, prescribed=True)
    yield Structure(integrator, obstacles=("half-space",))
    yield Structure(integrator, orders=(1, 1), fixed=True)


def _implicit(integrator: str) -> Iterator[Structure]:
    for damped in (False, True):
        yield Structure(integrator, fixed=True, mass_damping=damped)
        yield Structure(integrator, fixed=True, loaded=True, mass_damping=damped)
        yield Structure(integrator, fixed=True, prescribed=True, mass_damping=damped)
        yield Structure(integrator, obstacles=("half-space",), mass_damping=damped)
        yield Structure(integrator, obstacles=("half-space", "box"), mass_damping=damped)
        yield Structure(integrator, orders=(1, 1), fixed=True, mass_damping=damped)
        yield Structure(integrator, orders=(1, 1), obstacles=("half-space",), mass_damping=damped)
        yield Structure(integrator, obstacles=("box",), mass_damping=damped)
    yield Structure(integrator, obstacles=("mesh",))
    yield Structure(integrator, fixed=True, prescribed=True, stiffness_damping=True)
    yield Structure(integrator, orders=(2,), fixed=True)
    yield Structure(integrator, orders=(2,), fixed=True, mass_damping=True)
    yield Structure(integrator, orders=(2,), fixed=True, thin=True, mass_damping=True)
    yield Structure(integrator, orders=(1, 2), fixed=True, mass_damping=True, contacts=False)
    yield Structure(integrator, orders=(1, 1), fixed=True, thin=True, mass_damping=True)


def build(structure: Structure) -> Scene:
    """Build stacked cubes (the lowest may be a sheet) that fall on what is below; the lowest has the conditions and loads."""
    scene = Scene()
    scene.contact_forces = structure.contacts
    damping = {"mass_damping": float(structure.mass_damping), "stiffness_damping": 1e-3 * structure.stiffness_damping}
    soft = Material(law=structure.law, young=1e5, poisson=0.3, density=1000.0, friction=0.5, **damping)
    mesh, bottom = _first_mesh(structure), 0.001 * SIZE
    for k, order in enumerate(structure.orders):
        height = float(np.ptp(mesh.vertices[:, 1]))
        falls = k > 0 or not structure.fixed
        scene.add_body(
            mesh,
            soft,
            name=f"body {k}",
            position=(0.0, bottom + 0.5 * height, 0.0),
            order=order,
            velocity=(0.0, -SPEED if falls else 0.0, 0.0),
        )
        mesh, bottom = box_mesh((2, 2, 2), (0.5 * SIZE, 0.5 * SIZE, 0.5 * SIZE)), bottom + height + 0.001 * SIZE
    _add_conditions(scene.bodies[0], structure)
    for name in structure.obstacles:
        scene.add_obstacle(_obstacle(name), name=name, friction=0.5)
    return scene


def _first_mesh(structure: Structure) -> TetMesh:
    if not structure.thin and not structure.fine:
        return box_mesh((2, 2, 2), (SIZE, SIZE, SIZE))
    cells = 20 if structure.fine else 2
    return sheet_mesh((cells, cells), (SIZE * cells, SIZE / 50 if structure.thin else SIZE, SIZE * cells))


def _add_conditions(body, structure: Structure) -> None:
    """Fix, prescribe and load nodes on the body's sides."""
    side = float(np.abs(body.rest_positions[:, 0]).max()) - 1e-6
    if structure.fixed:
        body.fix(lambda X: X[:, 0] < -side)
    if structure.prescribed:
        body.move(lambda X: X[:, 0] > side, KeyFrames([0.0, 1.0], [(0.0, 0.0, 0.0), (0.1 * SIZE, 0.0, 0.0)], release=True))
    if structure.loaded:
        body.add_force(lambda X: X[:, 0] > side, (0.0, 1.0, 0.0))


def _obstacle(name: str):
    if name == "half-space":
        return HalfSpace((0.0, 0.0, 0.0), (0.0, 1.0, 0.0))
    half = 0.2 * SIZE
    if name == "box":
        return Box((0.0, -half, 0.0), (half, half, half))
    cube = box_mesh((1, 1, 1), (2 * half, 2 * half, 2 * half), center=(0.0, -half, 0.0))
    return MeshObstacle(cube.vertices, cube.surface)
