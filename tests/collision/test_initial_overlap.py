"""Overlaps in the initial state:

* the deepest overlap has the right names and exact depth: two bodies; a body and each kind of obstacle; one wholly inside the
  other; a face over a sphere; crossing edges and a rod through a sheet or a capsule, where no vertex lies inside;
* flush bodies, and overlaps below 1e-6 of the size, do not count; a Simulator refuses larger ones;
* every step and the end of a run report overlaps, even if no surfaces touch; without contact forces bodies pass each other.
"""

import numpy as np
import pytest

import taisoft as ts
from tests.collision.rotations import rotation

FAR = np.array([0.0, 50.0, 0.0])  # [m] away from everything else
SOFT = ts.Material(young=1e6)
BOX = ts.box_mesh((2, 2, 2), (1, 1, 1))
OBSTACLES = {
    "ground": ts.HalfSpace((0, -20, 0), (0, 1, 0)),
    "sphere": ts.Sphere((10, 0, 0), 0.4),
    "box": ts.Box((20, 0, 0), (0.5, 0.3, 0.4)),
    "capsule": ts.Capsule((30, 0, -0.5), (30, 0, 0.5), 0.3),
    "mesh": ts.MeshObstacle(BOX.vertices + (40, 0, 0), BOX.surface),
}
CUBE = ts.box_mesh((1, 1, 1), (1, 1, 1))
BODIES = {
    "cube": CUBE,
    "small": ts.box_mesh((1, 1, 1), (0.2, 0.2, 0.2)),
    "big": ts.box_mesh((3, 3, 3), (2, 2, 2)),
    "sheet": ts.sheet_mesh((2, 2), (2.0, 0.05, 2.0)),
    "rod": ts.box_mesh((1, 1, 1), (0.02, 2.0, 0.02)),
    "ball": ts.ball_mesh(0.5, 4),
    "two cubes": ts.TetMesh(
        np.concatenate([CUBE.vertices, CUBE.vertices + (2.0, 0, 0)]), np.concatenate([CUBE.tets, CUBE.tets + 8])
    ),
}


@pytest.fixture(scope="module")
def sim(taken_path):
    """Separate bodies and one obstacle of each kind."""
    scene = ts.Scene(gravity=(0, 0, 0))
    for k, (name, mesh) in enumerate(BODIES.items()):
        scene.add_body(mesh, SOFT, name=name, position=FAR + (5.0 * k, 0, 0))
    for name, shape in OBSTACLES.items():
        scene.add_obstacle(shape, name=name)
    with ts.Simulator(scene, dt=1e-4, integrator="symplectic_euler", precision="f64", self_collision=True) as made:
        yield made


def place(sim, **bodies) -> None:
    """Set all bodies apart, but some: by name, their center [m], or that and a rotation (3,3)."""
    sim.reset()
    for name, at in bodies.items():
        center, R = at if len(at) == 2 else (at, np.eye(3))
        sim.set_state(sim.scene.body(name).rest_positions @ R.T + np.asarray(center, dtype=float), body=name)


def overlap(sim) -> tuple[set[str], float] | None:
    """Names and depth [m] of the deepest overlap."""
    deepest = sim.deepest_overlap()
    return None if deepest is None else ({deepest.name_a, deepest.name_b}, deepest.depth)


CORNER_DOWN = rotation((1, 0, -1), np.arccos(np.sqrt(1 / 3)))
LOW, TOP = np.sqrt(0.75), np.sqrt(0.5)  # [m] of a corner below the cube's center, and of an edge of the cube turned by 45 degrees
FACE = BODIES["ball"].vertices[BODIES["ball"].surface[0]]
NORMAL = np.cross(FACE[1] - FACE[0], FACE[2] - FACE[0])
OVER_FACE = (10, 0, 0) - (0.4 - 0.002) * NORMAL / np.linalg.norm(NORMAL) - FACE.mean(axis=0)
ABOUT_Z, ABOUT_X = rotation((0, 0, 1), np.pi / 4), rotation((1, 0, 0), np.pi / 4)
EDGE = (0.05, TOP + np.sqrt(2) - 0.03, 0.1)
CASES = {  # bodies with their centers [m] and rotations, the collider that the first overlaps, and how deep [m]
    "two bodies": ({"cube": (0, 0, 0), "big": (0.3, 1.48, 0.2)}, "big", 0.02),
    "a corner in a face": ({"cube": ((0.1, LOW - 0.05, 0.05), CORNER_DOWN), "big": (0, -1, 0)}, "big", 0.05),
    "wholly inside": ({"small": (0.3, 0.1, 0.2), "big": (0, 0, 0)}, "big", 0.8),  # of the vertex at x = 0.2
    "crossing edges": ({"cube": ((0, 0, 0), ABOUT_Z), "big": (EDGE, ABOUT_X)}, "big", 0.03),
    "on ground": ({"cube": (3, -19.6, 1)}, "ground", 0.1),
    "a vertex in a sphere": ({"cube": (10.1, 0.85, 0.1)}, "sphere", 0.05),
    "in a box": ({"cube": (20.2, 0.7, 0.05)}, "box", 0.1),
    "in a capsule": ({"cube": (30.05, 0.75, 0.1)}, "capsule", 0.05),
    "inside a sphere": ({"small": (10, 0.01, 0)}, "sphere", 0.4),  # its center lies in the body
    "inside a box": ({"small": (20, 0.01, 0)}, "box", 0.29),
    "inside a mesh": ({"small": (40, 0.01, 0)}, "mesh", 0.49),
    "a corner beside a sphere's center": ({"big": (11, 1, 1) - np.full(3, 0.401 / np.sqrt(3))}, "sphere", 0.4),
    "a face over a sphere": ({"ball": OVER_FACE}, "sphere", 0.002),  # all vertices lie outside
    "a rod beside the axis of a capsule": ({"rod": (30.1, 0, 0.3)}, "capsule", 0.21),
}


@pytest.mark.gpu_path
def test_depth_and_names(sim):
    for name, (bodies, other, depth) in CASES.items():
        place(sim, **bodies)
        names, found = overlap(sim)
        assert names == {next(iter(bodies)), other} and found == pytest.approx(depth, rel=1e-6), name


def test_separate_and_flush_bodies_do_not_overlap(sim):
    """Face on face, edge along edge, a face on every obstacle, and an overlap below 1e-6 of the size."""
    place(sim)
    assert overlap(sim) is None
    place(sim, big=(0, 0, 0), cube=(0.5, 1.5, 0.5), small=(1.1, 1.1, 0.0), ball=(-0.2, -1.5 + 4e-7, 0.1))
    assert overlap(sim) is None
    for center in ((3, -19.5, 0), (10, 0.9, 0), (20, 0.8, 0), (30, 0.8, 0), (40, 1.0, 0)):
        place(sim, cube=center)
        assert overlap(sim) is None
        place(sim, cube=np.add(center, (0, -1e-5, 0)))
        assert overlap(sim)[1] == pytest.approx(1e-5, rel=1e-3)


def test_runs_report_overlaps(sim):
    """Also where no triangles cross: one wholly inside the other, and coincident surfaces."""

    def problems() -> tuple[str, str]:
        report = sim.run(2 * sim.dt, fps=None)
        first = report.step_reports[0]
        assert all(r.deep == bool(r.problems) and (r.max_penetration > 1e-3) == bool(r.problems) for r in report.step_reports)
        assert report.status == ("degraded" if report.problems else "ok")
        return " ".join(report.problems), " ".join(first.problems)

    place(sim)
    assert problems() == ("", "")
    inside = [("small", name, OBSTACLES[name].pivot + (0.0, 0.01, 0.0)) for name in ("sphere", "box", "capsule", "mesh")]
    around = [("big", name, OBSTACLES[name].pivot) for name in ("sphere", "mesh")]
    for body, obstacle, center in [*inside, *around, ("cube", "mesh", OBSTACLES["mesh"].pivot)]:
        place(sim, **{body: center})
        assert overlap(sim)[0] == {body, obstacle}
        assert all(f"'{body}' and '{obstacle}' overlap by" in text for text in problems())
    place(sim, small=(0.3, 0.1, 0.2), big=(0, 0, 0))
    assert all("'small' and 'big' overlap by" in text for text in problems())
    place(sim)
    a = sim.positions("two cubes")[:8]
    for scale, shift in ((1.0, 0.0), (0.1, 0.2)):  # the second cube coincides with the first, or lies inside it
        b = a.mean(axis=0) + shift + scale * (a - a.mean(axis=0))
        sim.set_state(np.concatenate([a, b]), body="two cubes")
        assert "parts of 'two cubes' overlap by" in problems()[1]
    place(sim, sheet=(0, 0, 0), rod=(0.35, 0.1, 0.55))  # no vertex of either lies near the other
    assert overlap(sim)[0] == {"sheet", "rod"} and len(sim.intersecting_triangles()) > 0
    assert "crossing pairs of triangles" in problems()[0] and sim.step().crossings > 3


def test_overlaps_are_refused_and_without_contact_forces_passed_through():
    scene = ts.Scene(gravity=(0, -9.81, 0))
    for k, name in enumerate(("lower", "upper")):
        scene.add_body(CUBE, SOFT, name=name, position=(0.1 * k, 0.875 * k, 0))
    settings = {"dt": 1e-4, "integrator": "symplectic_euler", "precision": "f64"}
    with pytest.raises(ts.SceneError, match=r"^'lower' and 'upper' overlap at the start, 0.125 m deep: move them apart, or set "):
        ts.Simulator(scene, **settings)
    with pytest.raises(ts.SceneError, match="^scene: contact_forces must be True or False, not 1$"):
        scene.contact_forces = 1
    scene.contact_forces = False
    with ts.Simulator(scene, **settings) as sim:
        assert len(sim.detect_contacts()) and len(sim.contacts()) == 0
        start = sim.positions()
        reports = [sim.step() for _ in range(3)]
        displacement = sim.positions() - start
    assert np.abs(displacement - (1 + 2 + 3) * np.array([0, -9.81, 0]) * 1e-4**2).max() < 1e-14  # [m]
    assert all(r.converged and not r.n_contacts and not r.problems for r in reports)
