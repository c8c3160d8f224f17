"""Contacts with obstacles are those of closed forms, in stations that stand far apart in one scene:

* the corner of a cube on a half-space, a sphere, a capsule, a box (its faces and an edge) and an open mesh;
* a large triangle on a sphere (inside it, and on an edge of it), on a capsule's end, on the corner of a box and of a closed mesh;
* all turns and shifts with the obstacles and bodies, and obstacles are where their paths lead them;
* a moving obstacle is met before it arrives, and one that leaves is not.
"""

from dataclasses import dataclass

import numpy as np
import pytest
from rotations import rotation

import taisoft as ts

MARGIN = 0.01  # [m]
DT = 1e-3  # [s]
UP = np.array([0.0, 1.0, 0.0])


@dataclass(frozen=True)
class Station:
    """A body over an obstacle, at the station's origin, and the one contact expected there."""

    shape: object
    mesh: ts.TetMesh
    point: np.ndarray  # (3,) [m] of the body: the contact's is half a gap off it, towards the obstacle
    normal: np.ndarray  # (3,)
    gap: float  # [m]
    kind: str
    turned: np.ndarray | None = None  # (3,3) by which the obstacle's path turns it


def standing(normal: np.ndarray) -> np.ndarray:
    """(3,3) rotation that turns a cube's diagonal (1,1,1) along a unit normal (3,)."""
    axis = np.cross([1.0, 1.0, 1.0], normal)
    return rotation(axis, np.arctan2(np.linalg.norm(axis), normal.sum()))


def corner(point: np.ndarray, normal: np.ndarray) -> ts.TetMesh:
    """A cube of 0.5 m that stands on its corner, nearly: there is nothing else of it near a point (3,) [m]."""
    mesh = ts.box_mesh((1, 1, 1), (0.5, 0.5, 0.5), (0.25, 0.25, 0.25), "six")
    return ts.TetMesh(mesh.vertices @ (rotation((0.3, 0.1, 0.9), 0.2) @ standing(normal)).T + point, mesh.tets)


def on_corner(shape, foot, normal, gap: float, kind: str = "vertex_field") -> Station:
    """A corner over a point (3,) [m] of the obstacle's surface with its normal (3,)."""
    normal = np.asarray(normal) / np.linalg.norm(normal)
    point = foot + gap * normal
    return Station(shape, corner(point, normal), point, normal, gap, kind)


def under_face(shape, depth: float, where, kind: str = "face_field", turned=None) -> Station:
    """A slab whose lower face, y = 0, is two triangles that meet in a diagonal of the square; it is pierced at (3,) [m]."""
    mesh = ts.box_mesh((1, 1, 1), (2.0, 0.5, 2.0), (0.0, 0.25, 0.0), "six")
    return Station(shape, mesh, np.array(where, dtype=float), UP, -depth, kind, turned)


def octahedron(below: float) -> ts.MeshObstacle:
    """A closed mesh whose upper corner is at (0.2, -below, -0.5) [m]."""
    vertices = 0.3 * np.array([(1, 0, 0), (-1, 0, 0), (0, 1, 0), (0, -1, 0), (0, 0, 1), (0, 0, -1)])
    faces = [(0, 2, 4), (2, 1, 4), (1, 3, 4), (3, 0, 4), (2, 0, 5), (1, 2, 5), (3, 1, 5), (0, 3, 5)]
    return ts.MeshObstacle(vertices + (0.2, -0.3 - below, -0.5), faces)


def pole(height: float) -> ts.Box:
    """A cube of 0.4 m whose corner is at (0.2, height, -0.4) [m] once it stands upright."""
    return ts.Box((0.2, height - 0.2 * np.sqrt(3), -0.4), (0.2, 0.2, 0.2))


def stations() -> dict[str, Station]:
    """By name; a half-space fills one side of the world, so that it comes first."""
    tilted, slope = np.array([1.0, 0.2, -0.1]), np.array([0.2, 1.0, 0.1])
    square = [(-1, 0, -1), (-1, 0, 1), (1, 0, 1), (1, 0, -1)]
    slope = slope / np.linalg.norm(slope)
    below = np.array([0.3, -0.4 + 0.02, -0.5])
    on_diagonal = np.array([0.3, -0.4 + 0.02, 0.3])
    across = np.array([0.3, -0.4 + 0.02, -0.3])
    end = np.array([0.4, -0.1, 0.2])
    upright = standing(UP)  # a box's corner (1,1,1) to the top
    flat = np.cross([0.3, 0.0, 1.0], [1.0, -0.4, 0.0])  # of an open mesh through the origin
    flat /= np.linalg.norm(flat)
    sheet = np.array(square) @ np.stack([[1.0, -0.4, 0.0], flat, [0.3, 0.0, 1.0]])
    return {
        "half_space": on_corner(ts.HalfSpace((0, 0, 0), tilted), np.zeros(3), tilted, -0.003),
        "sphere": on_corner(ts.Sphere((0, 0, 0), 0.4), 0.4 * slope, slope, 0.004),
        "capsule": on_corner(ts.Capsule((-1, 0, 0), (1, 0, 0), 0.2), (0.3, 0.2, 0.0), UP, -0.005),
        "capsule_end": on_corner(ts.Capsule((-1, -1, 0), (0, 0, 0), 0.2), 0.2 * slope, slope, 0.006),
        "box_face": on_corner(ts.Box((0, -0.5, 0), (0.5, 0.5, 0.5)), (0.1, 0.0, 0.2), UP, -0.004),
        "box_edge": on_corner(ts.Box((-0.5, -0.5, 0), (0.5, 0.5, 0.5)), (0.0, 0.0, 0.2), (0.5, 1.0, 0.0), 0.007),
        "mesh_open": on_corner(
            ts.MeshObstacle(sheet, [(0, 1, 2), (0, 2, 3)]), 0.3 * sheet[0] + 0.1 * sheet[1], flat, -0.004, "vertex_face"
        ),
        "ball_in_triangle": under_face(ts.Sphere(below, 0.4), 0.02, (0.3, 0, -0.5)),
        "ball_on_diagonal": under_face(ts.Sphere(on_diagonal, 0.4), 0.02, (0.3, 0, 0.3)),
        "ball_across_diagonal": under_face(ts.Sphere(across, 0.4), 0.02, (0.3, 0, -0.3)),
        "capsule_in_triangle": under_face(ts.Capsule(end - (1, 0.3, 0.1), end, 0.105), 0.005, (0.4, 0, 0.2)),
        "mesh_corner": under_face(octahedron(0.004), -0.004, (0.2, 0, -0.5), "vertex_face"),
        "mesh_corner_inside": under_face(octahedron(-0.01), 0.01, (0.2, 0, -0.5), "vertex_face"),
        "box_corner": under_face(pole(0.03), 0.03, (0.2, 0, -0.4), "vertex_face", upright),
        "box_corner_near": under_face(pole(-0.005), -0.005, (0.2, 0, -0.4), "vertex_face", upright),
    }


ALL = stations()


class SimulationState:
    """All stations in one simulator. Q (3,3), T (3,) [m]: where everything is; back: [m] how far each obstacle has gone off its
    contact; speed: of all obstacles along their normals [m/s]."""

    def __init__(self):
        self.Q, self.T, self.back, self.speed = np.eye(3), np.zeros(3), 0.0, 0.0
        scene = ts.Scene(gravity=(0, 0, 0))
        scene.contact_forces = False
        scene.collision = ts.CollisionSettings(margin=MARGIN)
        for k, (name, station) in enumerate(ALL.items()):
            place = np.array([10.0 * k, 0.0, 0.0])
            scene.add_body(station.mesh, ts.Material(young=1e3), name=name, position=place, collision="proximity")
        for k, (name, station) in enumerate(ALL.items()):
            place = np.array([10.0 * k, 0.0, 0.0])
            scene.add_obstacle(moved(station.shape, place), name=f"{name} obstacle", path=self.path(station, place))
        self.sim = ts.Simulator(scene, dt=DT, integrator="symplectic_euler", precision="f64", allow_unstable=True)
        self.start = self.sim.positions()

    def path(self, station: Station, place: np.ndarray):
        """The obstacle's path: what is set here."""
        pivot = moved(station.shape, place).pivot
        turned = np.eye(3) if station.turned is None else station.turned

        def pose(t: float):
            way = (self.speed * t - self.back) * station.normal
            return self.Q @ (pivot + way) + self.T - pivot, self.Q @ turned

        return pose

    def check(self, seen: bool = True) -> None:
        """Whether each station has the contact expected of it, and no other; seen False: none has any."""
        self.sim.set_state(positions=self.start @ self.Q.T + self.T)
        c = self.sim.detect_contacts()
        assert (np.array([a + " obstacle" for a in c.body_a]) == c.body_b).all()
        wrong = []
        for k, (name, station) in enumerate(ALL.items()):
            mine = np.flatnonzero(c.body_a == name)
            if len(mine) != seen:
                wrong.append(f"{name}: {len(mine)} contacts, gaps {c.gap[mine]}, kinds {c.kind[mine]}, normals {c.normal[mine]}")
            if not seen or not len(mine):
                continue
            gap = station.gap + self.back
            point = self.Q @ (station.point + (10.0 * k, 0, 0) - 0.5 * gap * station.normal) + self.T
            errors = (
                np.abs(c.point[mine] - point).max(),
                np.abs(c.normal[mine] - self.Q @ station.normal).max(),
                np.abs(c.gap[mine] - gap).max(),
            )
            close = 2e-4 if station.kind == "face_field" else 1e-9  # a search: phi to 1e-8, where it is least to its root
            if max(errors[:2]) > close or errors[2] > 1e-8 or set(c.kind[mine]) != {station.kind}:
                wrong.append(f"{name}: {c.kind[mine]} off by {errors}: {c.point[mine]}, {c.normal[mine]}, {c.gap[mine]}")
        assert not wrong, "\n".join(wrong)


def moved(shape, by: np.ndarray):
    """A shape, moved (3,) [m]."""
    if isinstance(shape, ts.MeshObstacle):
        return ts.MeshObstacle(shape.vertices + by, shape.triangles)
    if isinstance(shape, ts.Capsule):
        return ts.Capsule(shape.a + by, shape.b + by, shape.radius)
    if isinstance(shape, ts.HalfSpace):
        return ts.HalfSpace(shape.point + by, shape.normal)
    return type(shape)(shape.center + by, shape.radius if isinstance(shape, ts.Sphere) else shape.half_extents)


@pytest.fixture(scope="module")
def whole():
    simulation = SimulationState()
    yield simulation
    simulation.sim.close()


@pytest.fixture
def simulation(whole):
    whole.Q, whole.T, whole.back, whole.speed = np.eye(3), np.zeros(3), 0.0, 0.0
    return whole


def test_closed_forms(simulation):
    simulation.check()


def test_all_turned_and_shifted(simulation):
    rng = np.random.default_rng(3)
    for _ in range(4):
        simulation.Q, simulation.T = rotation(rng.standard_normal(3), rng.uniform(0, np.pi)), 10.0 * rng.standard_normal(3)
        simulation.check()


def test_obstacles_are_where_their_paths_lead_them(simulation):
    simulation.back = 0.0025
    simulation.check()


def test_a_moving_obstacle_is_met_before_it_arrives(simulation):
    simulation.back = MARGIN + 0.031  # all gaps are above the margin now: the deepest was -0.03
    simulation.check(seen=False)
    simulation.speed = 0.05 / DT  # and at the end of the step none is
    simulation.check()
    simulation.speed = -simulation.speed
    simulation.check(seen=False)
