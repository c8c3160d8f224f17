"""Contacts between sharp features are at the expected points, with the expected normals, in every case of `contact_cases`:

* by proximity, also on obstacles, and while a body slides over edges, vertices and faces;
* by a distance field, in the cases that a field resolves;
* the cases themselves: all fourteen of the reference are present, bodies overlap by the given depth, expected contacts connect
  the two surfaces along their normals, and wrong normals, depths and positions, and missing ends, are reported.

All cases of one kind lie far apart in one scene, so that kernels are compiled once.
"""

import json
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import replace

import numpy as np
import pytest

import taisoft as ts
from taisoft.mesh.sdf import signed_distances
from tests.collision.contact_cases import Case, P, cases

APART = 20.0  # [m] between cases; those on the common half-space lie side by side, the others above it
CASES = cases()


def offset(k: int, case: Case) -> np.ndarray:
    """Position (3,) [m] of case k."""
    return np.array([k * APART, 0.0 if isinstance(case.b, ts.HalfSpace) else APART, 0.0])


def shifted(shape, by: np.ndarray):
    """An obstacle's shape, moved (3,) [m]."""
    if isinstance(shape, ts.MeshObstacle):
        return ts.MeshObstacle(shape.vertices + by, shape.triangles)
    return replace(shape, center=shape.center + by)


@contextmanager
def simulated(collision: str, chosen: dict[str, Case]) -> Iterator[dict[str, list]]:
    """Problems of every case with a `collision` method, at all positions of its body A."""
    scene = ts.Scene(gravity=(0, 0, 0))
    scene.contact_forces = False
    scene.collision = ts.CollisionSettings(margin=P / 2)
    places = {name: offset(k, case) for k, (name, case) in enumerate(chosen.items())}
    for name, case in chosen.items():
        scene.add_body(case.a, ts.Material(), name=f"{name} a", position=places[name], collision=collision)
        if isinstance(case.b, ts.TetMesh):
            scene.add_body(case.b, ts.Material(), name=f"{name} b", position=places[name], collision=collision)
    for name, case in chosen.items():
        if isinstance(case.b, ts.HalfSpace):
            if "ground" not in [o.name for o in scene.obstacles]:
                scene.add_obstacle(case.b, name="ground")
        elif not isinstance(case.b, ts.TetMesh):
            scene.add_obstacle(shifted(case.b, places[name]), name=f"{name} b")
    # no step is taken: the explicit integrator compiles least, and its stability does not matter
    with ts.Simulator(scene, dt=1e-9, integrator="symplectic_euler", precision="f64", allow_unstable=True) as sim:
        yield dict(_problems(sim, chosen, places))


def _problems(sim: ts.Simulator, chosen: dict[str, Case], places: dict[str, np.ndarray]):
    """Pairs of a case's name and its problems."""
    found = {name: [] for name in chosen}
    rest = {name: sim.positions(f"{name} a") for name in chosen}
    for step in range(max(len(case.where) for case in chosen.values())):
        moved = {name: case.where[step] for name, case in chosen.items() if step < len(case.where)}
        for name, where in moved.items():
            sim.set_state(positions=rest[name] + where, body=f"{name} a")
        contacts = sim.detect_contacts()
        for name, where in moved.items():
            mine = contacts.body_a == f"{name} a"
            other = "ground" if isinstance(chosen[name].b, ts.HalfSpace) else f"{name} b"
            found[name] += [f"contact with {b}" for b in set(contacts.body_b[mine]) - {other}]
            found[name] += [
                f"at {where}: {text}"
                for text in chosen[name].problems(
                    contacts.point[mine] - places[name], contacts.normal[mine], contacts.gap[mine], where
                )
            ]
        assert set(contacts.body_a) <= {f"{name} a" for name in chosen}
    return found.items()


@pytest.fixture(scope="module")
def by_proximity():
    with simulated("proximity", CASES) as found:
        yield found


@pytest.fixture(scope="module")
def by_field():
    with simulated("distance_field", {name: case for name, case in CASES.items() if case.field}) as found:
        yield found


@pytest.mark.parametrize("name", CASES)
def test_contacts_by_proximity(by_proximity, name):
    assert not by_proximity[name], "\n".join(by_proximity[name])


@pytest.mark.parametrize("name", [name for name, case in CASES.items() if case.field])
def test_contacts_by_distance_field(by_field, name):
    assert not by_field[name], "\n".join(by_field[name])


# --- the cases themselves ---------------------------------------------------------------------------------------------


def distance(shape, points: np.ndarray) -> np.ndarray:
    """Signed distance (k,) of points (k,3) to a mesh or an obstacle; the plane of triangles is a half-space."""
    if isinstance(shape, (ts.HalfSpace, ts.MeshObstacle)):
        return points[:, 1]
    if isinstance(shape, ts.Sphere):
        return np.linalg.norm(points - shape.center, axis=1) - shape.radius
    vertices, triangles = (shape.vertices, shape.surface) if isinstance(shape, ts.TetMesh) else shape.surface()
    if len(points) == 0:
        return np.zeros(0)
    axes, places = zip(*(np.unique(points[:, k], return_inverse=True) for k in range(3)))
    return signed_distances(vertices, triangles, list(axes))[places]


def expected_contacts(case: Case) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Point, normal and gap of the contacts of a case."""
    rows = [(end, line.normal, -line.depth) for line in case.lines for end in (line.start, line.stop)]
    normal, gap = np.array([row[1] for row in rows]), np.array([row[2] for row in rows])
    return np.array([row[0] for row in rows]), normal, gap


def test_all_cases_of_the_reference_are_present(shared):
    value = json.loads((shared / "references" / "contact_geometry_erleben.json").read_text(encoding="utf-8"))["value"]
    names = {name for key in value for name in key.split(" / ")}
    assert len(value) == 14 and names <= set(CASES)
    # the reference counts both slides as one case
    assert sum(any(CASES[name].field for name in key.split(" / ")) for key in value) == 8


@pytest.mark.parametrize("name", CASES)
def test_contacts_connect_the_two_surfaces(name):
    case = CASES[name]
    for line in case.lines:
        n = np.array(line.normal)
        assert np.linalg.norm(n) == pytest.approx(1.0, abs=1e-12)
        ends = np.unique([line.start, line.stop], axis=0)
        below = np.concatenate([ends, ends - line.depth * n])  # either may lie on A, the other on B
        on_a, on_b = np.abs(distance(case.a, below)) < 1e-12, distance(case.b, below + line.depth * n) < 1e-12
        assert (on_a & on_b).reshape(2, -1).any(axis=0).all()


@pytest.mark.parametrize("name", CASES)
def test_bodies_overlap_by_the_given_depth(name):
    """Lifted by the depth they only touch, lifted by half of it they overlap; between two wedges no corner shows that."""
    case = CASES[name]
    a, b = case.a.vertices, case.b.vertices if isinstance(case.b, ts.TetMesh) else np.zeros((0, 3))
    lowest, highest = a[a[:, 1] < a[:, 1].min() + 2 * P], b[np.abs(b[:, 1] - 0.25) < 0.25 + 2 * P]
    if name.startswith("ball"):  # a grid of the coordinates of all vertices takes a minute
        highest = highest[np.abs(highest[:, 0]) < 0.1]
    for lift, free in ((P, True), (P / 2, False)):
        inside = [distance(case.b, lowest + (0, lift, 0)), distance(case.a, highest - (0, lift, 0))]
        deepest = np.concatenate(inside).min()
        assert deepest > -1e-12 if free else deepest < -5e-4 or name.startswith("wedge_on_wedge")


@pytest.mark.parametrize("name", CASES)
def test_expected_contacts_pass_and_wrong_ones_fail(name):
    case = CASES[name]
    point, normal, gap = expected_contacts(case)
    for offset in case.where:
        assert case.problems(point + offset, normal, gap, offset) == []
    tilted = normal @ np.array([[1, 0.01, 0], [-0.01, 1, 0], [0, 0, 1]])
    for wrong in ((point + (0, 0.5, 0), normal, gap), (point, tilted, gap), (point, normal, 1.03 * gap), (point, -normal, gap)):
        assert len(case.problems(*wrong)) >= len(point)
    assert case.problems(np.zeros((0, 3)), np.zeros((0, 3)), np.zeros(0))


def test_wrong_contacts_of_the_reference_are_reported():
    flank, side = np.array([4.0, 1.0, 0.0]) / np.sqrt(17), np.array([6.0, 1.0, 0.0]) / np.sqrt(37)
    for name, bad in (("cliff_edges", flank), ("spike_on_spike", side), ("internal_edges", np.array([2e-3, 1.0, 0.0]))):
        case = CASES[name]
        point, normal, gap = expected_contacts(case)
        problems = case.problems(np.r_[point, point[:1]], np.r_[normal, [bad]], np.r_[gap, gap[:1]])
        assert len(problems) == 1 and problems[0].endswith("is none")
    case = CASES["box_on_box_offset"]
    point, normal, gap = expected_contacts(case)
    assert case.problems(np.r_[point, [[0.2, 0.495, 0.3]]], np.r_[normal, normal[:1]], np.r_[gap, gap[:1]]) == []
    keep = (point[:, [0, 2]] > 0.1).any(axis=1)  # one corner missing
    problems = case.problems(point[keep], normal[keep], gap[keep])
    assert problems and all(line.startswith("no contact") for line in problems)
