"""Contacts with obstacles equal closed forms. The cases stand far apart in one scene:

* the corner of a cube on a half-space, sphere, capsule, box (face and edge) and open mesh;
* a large triangle on a sphere (in its interior and on its edge), a capsule's end, and the corner of a box and of a closed mesh;
* contacts rotate and translate with everything, and obstacles follow their paths;
* contacts with an approaching obstacle are found before it arrives; a receding one has none.
"""

from dataclasses import dataclass

import numpy as np
import pytest

import taisoft as ts
from tests.collision.rotations import rotation

MARGIN = 0.01  # [m]
DT = 1e-3  # [s]
UP = np.array([0.0, 1.0, 0.0])


@dataclass(frozen=True)
class Case:
    """A body and an obstacle near the origin, and their only contact."""

    shape: object
    mesh: ts.TetMesh
    point: np.ndarray  # (3,) [m] of the body; the contact point is half a gap away, towards the obstacle
    normal: np.ndarray  # (3,)
    gap: float  # [m]
    kind: str
    R: np.ndarray | None = None  # (3,3) rotation of the obstacle by its path


def align_diagonal(normal: np.ndarray) -> np.ndarray:
    """(3,3) rotation of a cube's diagonal (1,1,1) to a unit normal (3,)."""
    axis = np.cross([1.0, 1.0, 1.0], normal)
    return rotation(axis, np.arctan2(np.linalg.norm(axis), normal.sum()))


def vertex_case(shape, foot, normal, gap: float, kind: str = "vertex_field") -> Case:
    """The corner of a cube over a point (3,) [m] of the obstacle's surface with its normal (3,). The cube is tilted a little."""
    normal = np.asarray(normal) / np.linalg.norm(normal)
    point, cube = foot + gap * normal, ts.box_mesh((1, 1, 1), (0.5, 0.5, 0.5), (0.25, 0.25, 0.25), "six")
    R = rotation((0.3, 0.1, 0.9), 0.2) @ align_diagonal(normal)
    return Case(shape, ts.TetMesh(cube.vertices @ R.T + point, cube.tets), point, normal, gap, kind)


def face_case(shape, depth: float, point, kind: str = "face_field", R=None) -> Case:
    """A slab with the obstacle below a point (3,) [m] of its lower face y = 0, which is two triangles."""
    mesh = ts.box_mesh((1, 1, 1), (2.0, 0.5, 2.0), (0.0, 0.25, 0.0), "six")
    return Case(shape, mesh, np.array(point, dtype=float), UP, -depth, kind, R)


def octahedron(below: float) -> ts.MeshObstacle:
    """A closed mesh whose top is at (0.2, -below, -0.5) [m]."""
    vertices = 0.3 * np.array([(1, 0, 0), (-1, 0, 0), (0, 1, 0), (0, -1, 0), (0, 0, 1), (0, 0, -1)])
    faces = [(0, 2, 4), (2, 1, 4), (1, 3, 4), (3, 0, 4), (2, 0, 5), (1, 2, 5), (3, 1, 5), (0, 3, 5)]
    return ts.MeshObstacle(vertices + (0.2, -0.3 - below, -0.5), faces)


def cube_on_corner(height: float) -> ts.Box:
    """A cube of 0.4 m whose top corner is at (0.2, height, -0.4) [m] after the rotation `upright` below."""
    return ts.Box((0.2, height - 0.2 * np.sqrt(3), -0.4), (0.2, 0.2, 0.2))


def make_cases() -> dict[str, Case]:
    """The half-space comes first, since it fills the space on one side."""
    tilted, slope = np.array([1.0, 0.2, -0.1]), np.array([0.2, 1.0, 0.1])
    square = [(-1, 0, -1), (-1, 0, 1), (1, 0, 1), (1, 0, -1)]
    slope = slope / np.linalg.norm(slope)
    below = np.array([0.3, -0.4 + 0.02, -0.5])
    on_diagonal = np.array([0.3, -0.4 + 0.02, 0.3])
    across = np.array([0.3, -0.4 + 0.02, -0.3])
    end = np.array([0.4, -0.1, 0.2])
    upright = align_diagonal(UP)
    sheet_normal = np.cross([0.3, 0.0, 1.0], [1.0, -0.4, 0.0])  # of an open mesh through the origin
    sheet_normal /= np.linalg.norm(sheet_normal)
    sheet = np.array(square) @ np.stack([[1.0, -0.4, 0.0], sheet_normal, [0.3, 0.0, 1.0]])
    return {
        "half_space": vertex_case(ts.HalfSpace((0, 0, 0), tilted), np.zeros(3), tilted, -0.003),
        "sphere": vertex_case(ts.Sphere((0, 0, 0), 0.4), 0.4 * slope, slope, 0.004),
        "capsule": vertex_case(ts.Capsule((-1, 0, 0), (1, 0, 0), 0.2), (0.3, 0.2, 0.0), UP, -0.005),
        "capsule_end": vertex_case(ts.Capsule((-1, -1, 0), (0, 0, 0), 0.2), 0.2 * slope, slope, 0.006),
        "box_face": vertex_case(ts.Box((0, -0.5, 0), (0.5, 0.5, 0.5)), (0.1, 0.0, 0.2), UP, -0.004),
        "box_edge": vertex_case(ts.Box((-0.5, -0.5, 0), (0.5, 0.5, 0.5)), (0.0, 0.0, 0.2), (0.5, 1.0, 0.0), 0.007),
        "mesh_open": vertex_case(
            ts.MeshObstacle(sheet, [(0, 1, 2), (0, 2, 3)]), 0.3 * sheet[0] + 0.1 * sheet[1], sheet_normal, -0.004, "vertex_face"
        ),
        "ball_in_triangle": face_case(ts.Sphere(below, 0.4), 0.02, (0.3, 0, -0.5)),
        "ball_on_diagonal": face_case(ts.Sphere(on_diagonal, 0.4), 0.02, (0.3, 0, 0.3)),
        "ball_across_diagonal": face_case(ts.Sphere(across, 0.4), 0.02, (0.3, 0, -0.3)),
        "capsule_in_triangle": face_case(ts.Capsule(end - (1, 0.3, 0.1), end, 0.105), 0.005, (0.4, 0, 0.2)),
        "mesh_corner": face_case(octahedron(0.004), -0.004, (0.2, 0, -0.5), "vertex_face"),
        "mesh_corner_inside": face_case(octahedron(-0.01), 0.01, (0.2, 0, -0.5), "vertex_face"),
        "box_corner": face_case(cube_on_corner(0.03), 0.03, (0.2, 0, -0.4), "vertex_face", upright),
        "box_corner_near": face_case(cube_on_corner(-0.005), -0.005, (0.2, 0, -0.4), "vertex_face", upright),
    }


CASES = make_cases()


class CaseScene:
    """All cases in one simulator.

    Q (3,3), T (3,) [m]: rotation and translation of everything. retreat: distance of each obstacle from its contact position
    along the negative normal [m]. speed: of all obstacles along their normals [m/s].
    """

    def __init__(self):
        self.restore()
        scene = ts.Scene(gravity=(0, 0, 0))
        scene.contact_forces = False
        scene.collision = ts.CollisionSettings(margin=MARGIN)
        origins = dict(zip(CASES, 10.0 * np.arange(len(CASES))[:, None] * (1.0, 0.0, 0.0)))
        for name, case in CASES.items():
            scene.add_body(case.mesh, ts.Material(young=1e3), name=name, position=origins[name], collision="proximity")
        for name, case in CASES.items():
            shape = translated(case.shape, origins[name])
            scene.add_obstacle(shape, name=f"{name} obstacle", path=self.path(case, shape.pivot))
        self.sim = ts.Simulator(scene, dt=DT, integrator="symplectic_euler", precision="f64", allow_unstable=True)
        self.start = self.sim.positions()

    def restore(self) -> None:
        """Set the initial placement of everything."""
        self.Q, self.T, self.retreat, self.speed = np.eye(3), np.zeros(3), 0.0, 0.0

    def path(self, case: Case, pivot: np.ndarray):
        """The path of an obstacle with the present values of Q, T, retreat and speed."""
        R = np.eye(3) if case.R is None else case.R

        def pose(t: float):
            displacement = (self.speed * t - self.retreat) * case.normal
            return self.Q @ (pivot + displacement) + self.T - pivot, self.Q @ R

        return pose

    def check(self, touching: bool = True) -> None:
        """Check that each case has exactly its expected contact, or none if not touching."""
        self.sim.set_state(positions=self.start @ self.Q.T + self.T)
        c = self.sim.detect_contacts()
        assert (np.array([a + " obstacle" for a in c.body_a]) == c.body_b).all()
        wrong = []
        for k, (name, case) in enumerate(CASES.items()):
            own = np.flatnonzero(c.body_a == name)
            if len(own) != touching:
                wrong.append(f"{name}: {len(own)} contacts, gaps {c.gap[own]}, kinds {c.kind[own]}, normals {c.normal[own]}")
            if not touching or not len(own):
                continue
            gap = case.gap + self.retreat
            point = self.Q @ (case.point + (10.0 * k, 0, 0) - 0.5 * gap * case.normal) + self.T
            errors = (
                np.abs(c.point[own] - point).max(),
                np.abs(c.normal[own] - self.Q @ case.normal).max(),
                np.abs(c.gap[own] - gap).max(),
            )
            # a face search finds phi to 1e-8, and the place of its minimum to the root of that
            tolerance = 2e-4 if case.kind == "face_field" else 1e-9
            if max(errors[:2]) > tolerance or errors[2] > 1e-8 or set(c.kind[own]) != {case.kind}:
                wrong.append(f"{name}: {c.kind[own]}, errors {errors}: {c.point[own]}, {c.normal[own]}, {c.gap[own]}")
        assert not wrong, "\n".join(wrong)


def translated(shape, by: np.ndarray):
    """A shape, translated by (3,) [m]."""
    if isinstance(shape, ts.MeshObstacle):
        return ts.MeshObstacle(shape.vertices + by, shape.triangles)
    if isinstance(shape, ts.Capsule):
        return ts.Capsule(shape.a + by, shape.b + by, shape.radius)
    if isinstance(shape, ts.HalfSpace):
        return ts.HalfSpace(shape.point + by, shape.normal)
    return type(shape)(shape.center + by, shape.radius if isinstance(shape, ts.Sphere) else shape.half_extents)


@pytest.fixture(scope="module")
def shared_scene():
    scene = CaseScene()
    yield scene
    scene.sim.close()


@pytest.fixture
def cases(shared_scene):
    shared_scene.restore()
    return shared_scene


def test_contacts_equal_closed_forms(cases):
    cases.check()


def test_contacts_rotate_and_translate_with_everything(cases):
    rng = np.random.default_rng(3)
    for _ in range(4):
        cases.Q, cases.T = rotation(rng.standard_normal(3), rng.uniform(0, np.pi)), 10.0 * rng.standard_normal(3)
        cases.check()


def test_obstacles_follow_their_paths(cases):
    cases.retreat = 0.0025
    cases.check()


def test_contacts_with_approaching_obstacles_are_found_before_they_arrive(cases):
    cases.retreat = MARGIN + 0.031  # all gaps are above the margin now: the deepest was -0.03
    cases.check(touching=False)
    cases.speed = 0.05 / DT  # all gaps are below the margin at the end of the step
    cases.check()
    cases.speed = -cases.speed
    cases.check(touching=False)
