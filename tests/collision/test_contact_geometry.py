"""Contacts between sharp features are at the expected points, with the expected normals, in every case of `contact_cases`:

* by proximity, also on obstacles, and while a body slides over edges, vertices and faces;
* by a distance field, in the cases that a field resolves;
* contacts that close within the step are found, separating ones are not, whichever side moves;
* two equal cubes, one flush on the other, have contacts that span the whole face, whatever rounding moves their vertices;
* sheets thinner than the margin touch with the sides that face each other; fields of stretched bodies give gaps in space.

All cases of one kind lie far apart in one scene.
"""

import json

import numpy as np
import pytest
from scipy.spatial import ConvexHull

import taisoft as ts
from tests.collision.contact_cases import Case, P, cases, plane
from tests.collision.detection_scenes import DT, shifted, simulator
from tests.dynamics.scenes import rubber

APART = 20.0  # [m] between cases, which stand above each other; the half-space comes first
CASES = cases()


def problems(collision: str, chosen: dict[str, Case]) -> list[str]:
    """What is wrong in cases with a `collision` method, at all positions of their bodies A."""
    scene, found = ts.Scene(gravity=(0, 0, 0)), []
    scene.contact_forces = False
    scene.collision = ts.CollisionSettings(margin=P / 2)
    places = {name: np.array([0.0, k * APART, 0.0]) for k, name in enumerate(chosen)}
    for name, case in chosen.items():
        scene.add_body(case.a, ts.Material(), name=f"{name} a", position=places[name], collision=collision)
        if isinstance(case.b, ts.TetMesh):
            scene.add_body(case.b, ts.Material(), name=f"{name} b", position=places[name], collision=collision)
    for name, case in chosen.items():
        if not isinstance(case.b, ts.TetMesh):
            scene.add_obstacle(shifted(case.b, places[name]), name=f"{name} b")
    with simulator(scene) as sim:
        rest = {name: sim.positions(f"{name} a") for name in chosen}
        for step in range(max(len(case.where) for case in chosen.values())):
            moved = {name: case.where[step] for name, case in chosen.items() if step < len(case.where)}
            for name, where in moved.items():
                sim.set_state(positions=rest[name] + where, body=f"{name} a")
            c = sim.detect_contacts()
            assert all(a.endswith(" a") and b == a[:-1] + "b" for a, b in zip(c.body_a, c.body_b))
            for name, where in moved.items():
                mine = (c.body_a == f"{name} a") & ((c.kind != "mortar") | (c.gap < 0))  # means exceed the least distance
                of_case = chosen[name].problems(c.point[mine] - places[name] - where, c.normal[mine], c.gap[mine])
                found += [f"{name} at {where}: {text}" for text in of_case]
    return found


def test_contacts_by_proximity(shared):
    reference = json.loads((shared / "references" / "contact_geometry_erleben.json").read_text(encoding="utf-8"))["value"]
    assert {name for key in reference for name in key.split(" / ")} <= set(CASES)
    assert problems("proximity", CASES) == []


@pytest.mark.gpu_path
def test_contacts_by_distance_field():
    assert problems("distance_field", {name: case for name, case in CASES.items() if case.field}) == []


def pair(low: ts.TetMesh, high: ts.TetMesh, margin: float, collision: str = "proximity") -> ts.Simulator:
    """Two bodies, the first of which is side a."""
    scene = ts.Scene()
    scene.contact_forces, scene.allow_initial_overlap = False, True
    scene.collision = ts.CollisionSettings(margin=margin)
    for name, mesh in (("below", low), ("above", high)):
        scene.add_body(mesh, rubber(), name=name, collision=collision)
    return simulator(scene)


@pytest.fixture(scope="module")
def cubes():
    with pair(*[ts.box_mesh((1, 1, 1), (1, 1, 1))] * 2, 0.1) as sim:
        yield sim


@pytest.mark.parametrize("gap", [0.005, -0.001, -0.01])
def test_contacts_of_flush_cubes_span_the_whole_face(cubes, gap):
    """Noise far below and far above the search's tolerances moves vertices slightly outside or inside the other cube's sides."""
    rng, rest = np.random.default_rng(3), cubes.scene.body("below").rest_positions
    for noise in np.repeat([0.0, 1e-14, 1e-12, 1e-10, 1e-9, 1e-8, 1e-7, 1e-6, 1e-5, 1e-4], 2):
        for name, lift in (("below", 0.0), ("above", 1.0 + gap)):
            cubes.set_state(positions=rest + (0, lift, 0) + noise * rng.standard_normal(rest.shape), body=name)
        c = cubes.detect_contacts()
        assert (np.abs(c.normal[:, 1]) > 0.99).all() and (np.abs(c.gap - gap) < 10 * noise + 1e-9).all()
        assert ConvexHull(c.point[:, [0, 2]]).volume > 0.98


def test_contacts_that_close_within_the_step_are_found(cubes):
    """With a margin of 0.1 m, at a distance of 0.3 m, whichever side moves."""
    rest, down, still = cubes.scene.body("below").rest_positions, np.array([0.0, -1.0, 0.0]), np.zeros(3)
    for closing, moves, touches in (
        (0.25, (still, down), True),
        (0.25, (-down, still), True),
        (0.15, (-down, still), False),
        (-0.25, (still, down), False),
        (0.5, (down, down), False),
    ):
        for name, lift, move in zip(("below", "above"), (0.0, 1.3), moves):
            cubes.set_state(positions=rest + (0, lift, 0), velocities=np.tile(closing / DT * move, (8, 1)), body=name)
        c = cubes.detect_contacts()
        assert (len(c) > 0) == touches and c.gap == pytest.approx(0.3, abs=1e-9)
        assert np.abs(c.normal[:, 1]) == pytest.approx(1.0, abs=1e-9)


def test_obstacles_that_close_within_the_step_are_found():
    """Below cubes at distances of 0.3 m, with a margin of 0.1 m."""
    speed, shapes = [0.0], [ts.HalfSpace((0, 0, 0), (0, 1, 0)), ts.Sphere((0, -0.5, 0), 0.5), ts.Box((0, -0.5, 0), (1, 0.5, 1))]
    shapes += [ts.Capsule((-1, -0.5, 0), (1, -0.5, 0), 0.5), plane(2)]
    scene = ts.Scene()
    scene.contact_forces = False
    scene.collision = ts.CollisionSettings(margin=0.1)
    for k in range(len(shapes)):
        scene.add_body(ts.box_mesh((1, 1, 1), (1, 1, 1)), rubber(), name=f"cube {k}", position=(0, APART * k + 0.8, 0))
    for k, shape in enumerate(shapes):
        scene.add_obstacle(shifted(shape, np.array([0, APART * k, 0])), path=lambda t: ((0, speed[0] * t, 0), np.eye(3)))
    with simulator(scene) as sim:
        for closing, n in ((0.25, 5), (0.15, 0), (-0.25, 0)):
            speed[0] = closing / DT
            c = sim.detect_contacts()
            assert len(set(c.body_a)) == n and c.gap == pytest.approx(0.3, abs=1e-6)
            assert c.normal[:, 1] == pytest.approx(1.0, abs=1e-6)


def test_thin_sheets_touch_with_the_sides_that_face_each_other():
    low, high = (ts.sheet_mesh((n, n), (size, 0.02, size)) for n, size in ((5, 1.0), (4, 0.7)))
    with pair(low, high, 0.03) as sim:
        for gap in (0.004, -0.001):
            x = high.vertices + (0.01, 0.02 + gap, 0.02)
            sim.set_state(positions=x, body="above")
            c = sim.detect_contacts()
            assert np.abs(c.gap - gap).max() < 1e-9 and np.abs(c.normal + (0, 1, 0)).max() < 1e-9
            assert np.abs(c.point[:, 1] - 0.01 - 0.5 * gap).max() < 1e-9
            for p in x[high.vertices[:, 1] < 0]:
                assert np.abs(c.point - (p[0], 0.01 + 0.5 * gap, p[2])).max(axis=1).min() < 1e-9


def test_gaps_to_stretched_bodies_by_distance_fields():
    low, high = ts.box_mesh((2, 2, 2), (1, 1, 1)), ts.box_mesh((1, 1, 1), (0.6, 0.6, 0.6))
    with pair(low, high, 0.05, "distance_field") as sim:
        for stretch, gap in ((1.0, 0.01), (1.5, 0.01), (0.7, -0.01)):
            sim.set_state(positions=low.vertices * (1, stretch, 1), body="below")
            sim.set_state(positions=high.vertices + (0.05, 0.5 * stretch + 0.3 + gap, 0.03), body="above")
            c = sim.detect_contacts()
            assert len(c) > 3 and np.abs(c.gap - gap).max() < 1e-5 and np.abs(np.abs(c.normal[:, 1]) - 1).max() < 1e-5
