"""Contacts with obstacles equal closed forms. The cases stand far apart in one scene:

* the corner of a cube on a half-space, sphere, capsule, box (face and edge) and open mesh; a large triangle on a sphere, a
  capsule's end and the corner of a box;
* contacts rotate and translate with everything, and obstacles follow their paths;
* contacts with an approaching obstacle are found before it arrives; a receding one has none.
"""

from dataclasses import dataclass
from types import SimpleNamespace

import numpy as np

import taisoft as ts
from tests.collision.detection_scenes import DT, shifted, simulator
from tests.collision.rotations import rotation

MARGIN = 0.01  # [m]
UP, STILL = np.array([0.0, 1.0, 0.0]), np.eye(3)


@dataclass(frozen=True)
class Case:
    """A body and an obstacle near the origin, and their only contact."""

    shape: object
    mesh: ts.TetMesh
    point: np.ndarray  # (3,) [m] of the body; the contact point is half a gap away, towards the obstacle
    normal: np.ndarray  # (3,)
    gap: float  # [m]
    kind: str
    R: np.ndarray  # (3,3) rotation of the obstacle by its path


def align_diagonal(normal: np.ndarray) -> np.ndarray:
    """(3,3) rotation of a cube's diagonal (1,1,1) to a unit normal (3,)."""
    axis = np.cross([1.0, 1.0, 1.0], normal)
    return rotation(axis, np.arctan2(np.linalg.norm(axis), normal.sum()))


def vertex_case(shape, foot, normal, gap: float, kind: str = "vertex_field") -> Case:
    """The corner of a cube over a point (3,) [m] of the obstacle's surface with its normal (3,). The cube is tilted a little."""
    normal = np.asarray(normal) / np.linalg.norm(normal)
    point, cube = foot + gap * normal, ts.box_mesh((1, 1, 1), (0.5, 0.5, 0.5), (0.25, 0.25, 0.25), "six")
    R = rotation((0.3, 0.1, 0.9), 0.2) @ align_diagonal(normal)
    return Case(shape, ts.TetMesh(cube.vertices @ R.T + point, cube.tets), point, normal, gap, kind, STILL)


def face_case(shape, depth: float, point, kind: str = "face_field", R=STILL) -> Case:
    """A slab with the obstacle below a point (3,) [m] of its lower face y = 0, which is two triangles."""
    mesh = ts.box_mesh((1, 1, 1), (2.0, 0.5, 2.0), (0.0, 0.25, 0.0), "six")
    return Case(shape, mesh, np.array(point, dtype=float), UP, -depth, kind, R)


TILTED, SLOPE = np.array([1.0, 0.2, -0.1]), np.array([0.2, 1.0, 0.1]) / np.linalg.norm([0.2, 1.0, 0.1])
ACROSS = np.cross([0.3, 0.0, 1.0], [1.0, -0.4, 0.0]) / np.linalg.norm(np.cross([0.3, 0.0, 1.0], [1.0, -0.4, 0.0]))
SHEET = np.array([(-1, 0, -1), (-1, 0, 1), (1, 0, 1), (1, 0, -1)]) @ np.stack([[1.0, -0.4, 0.0], ACROSS, [0.3, 0.0, 1.0]])
OPEN, BALL = ts.MeshObstacle(SHEET, [(0, 1, 2), (0, 2, 3)]), ts.Sphere((0.3, -0.38, -0.5), 0.4)
ON_CORNER = ts.Box((0.2, 0.03 - 0.2 * np.sqrt(3), -0.4), (0.2, 0.2, 0.2))  # its top is at (0.2, 0.03, -0.4) once it is turned
CASES = {  # the half-space comes first, since it fills the space on one side
    "half_space": vertex_case(ts.HalfSpace((0, 0, 0), TILTED), np.zeros(3), TILTED, -0.003),
    "sphere": vertex_case(ts.Sphere((0, 0, 0), 0.4), 0.4 * SLOPE, SLOPE, 0.004),
    "capsule": vertex_case(ts.Capsule((-1, 0, 0), (1, 0, 0), 0.2), (0.3, 0.2, 0.0), UP, -0.005),
    "capsule_end": vertex_case(ts.Capsule((-1, -1, 0), (0, 0, 0), 0.2), 0.2 * SLOPE, SLOPE, 0.006),
    "box_face": vertex_case(ts.Box((0, -0.5, 0), (0.5, 0.5, 0.5)), (0.1, 0.0, 0.2), UP, -0.004),
    "box_edge": vertex_case(ts.Box((-0.5, -0.5, 0), (0.5, 0.5, 0.5)), (0.0, 0.0, 0.2), (0.5, 1.0, 0.0), 0.007),
    "mesh": vertex_case(OPEN, 0.3 * SHEET[0] + 0.1 * SHEET[1], ACROSS, -0.004, "vertex_face"),
    "ball_in_triangle": face_case(BALL, 0.02, (0.3, 0, -0.5)),
    "capsule_in_triangle": face_case(ts.Capsule((-0.6, -0.4, 0.1), (0.4, -0.1, 0.2), 0.105), 0.005, (0.4, 0, 0.2)),
    "box_corner": face_case(ON_CORNER, 0.03, (0.2, 0, -0.4), "vertex_face", align_diagonal(UP)),
}


def test_contacts_equal_closed_forms():
    # at: rotation Q (3,3) and translation T (3,) [m] of everything; retreat: distance of each obstacle from its contact position
    # along the negative normal [m]; speed: of all obstacles along their normals [m/s]
    at, scene = SimpleNamespace(Q=np.eye(3), T=np.zeros(3), retreat=0.0, speed=0.0), ts.Scene(gravity=(0, 0, 0))
    scene.contact_forces = False
    scene.collision = ts.CollisionSettings(margin=MARGIN)
    origins = dict(zip(CASES, 10.0 * np.arange(len(CASES))[:, None] * (1.0, 0.0, 0.0)))
    for name, case in CASES.items():
        scene.add_body(case.mesh, ts.Material(young=1e3), name=name, position=origins[name], collision="proximity")
    for name, case in CASES.items():
        shape = shifted(case.shape, origins[name])

        def path(t: float, case=case, pivot=shape.pivot):
            moved = pivot + (at.speed * t - at.retreat) * case.normal
            return at.Q @ moved + at.T - pivot, at.Q @ case.R

        scene.add_obstacle(shape, name=f"{name} obstacle", path=path)
    with simulator(scene) as sim:
        start = sim.positions()

        def check(touching: bool = True) -> None:
            """Each case has exactly its expected contact, or none if not touching."""
            sim.set_state(positions=start @ at.Q.T + at.T)
            c = sim.detect_contacts()
            assert c.body_a.tolist() == (list(CASES) if touching else [])
            assert c.body_b.tolist() == [f"{name} obstacle" for name in c.body_a]
            for k, name in enumerate(c.body_a):
                case, gap = CASES[name], CASES[name].gap + at.retreat
                # a face search finds phi to 1e-8, and the place of its minimum to the root of that
                close = 2e-4 if case.kind == "face_field" else 1e-9
                assert c.kind[k] == case.kind and abs(c.gap[k] - gap) < 1e-8, name
                assert np.abs(c.point[k] - at.Q @ (case.point + origins[name] - 0.5 * gap * case.normal) - at.T).max() < close, (
                    name
                )
                assert np.abs(c.normal[k] - at.Q @ case.normal).max() < close, name

        check()
        rng = np.random.default_rng(3)
        for _ in range(3):
            at.Q, at.T = rotation(rng.standard_normal(3), rng.uniform(0, np.pi)), 10.0 * rng.standard_normal(3)
            check()
        at.retreat = 0.0025
        check()
        at.retreat = MARGIN + 0.031  # all gaps are above the margin now: the deepest was -0.03
        check(touching=False)
        at.speed = 0.05 / DT  # all gaps are below the margin at the end of the step
        check()
        at.speed = -at.speed
        check(touching=False)
