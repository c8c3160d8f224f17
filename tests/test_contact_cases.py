"""The cases of contact geometry themselves, which the tests of the collision stand on:

* all fourteen of the reference are there, with meshes that are closed and overlap by what they say;
* every expected contact joins the two surfaces along its normal;
* what the reference lists is found right; what it calls wrong is told: other normals, depths and places, missing ends.
"""

import json

import numpy as np
import pytest
from contact_cases import Case, P, cases

import taisoft as ts
from taisoft.mesh.sdf import signed_distances

CASES = cases()


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


def right(case: Case) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Contacts that the case asks for: point, normal, gap."""
    rows = [(end, line.normal, -line.depth) for line in case.lines for end in (line.start, line.stop)]
    normal, gap = np.array([row[1] for row in rows]), np.array([row[2] for row in rows])
    return np.array([row[0] for row in rows]), normal, gap


def test_all_of_the_reference_are_there(shared):
    value = json.loads((shared / "references" / "contact_geometry_erleben.json").read_text(encoding="utf-8"))["value"]
    names = {name for key in value for name in key.split(" / ")}
    assert len(value) == 14 and names <= set(CASES)
    # the reference counts both slides as one case
    assert sum(any(CASES[name].field for name in key.split(" / ")) for key in value) == 8


@pytest.mark.parametrize("name", CASES)
def test_contacts_join_the_two_surfaces(name):
    case = CASES[name]
    for line in case.lines:
        n = np.array(line.normal)
        assert np.linalg.norm(n) == pytest.approx(1.0, abs=1e-12)
        ends = np.unique([line.start, line.stop], axis=0)
        below = np.concatenate([ends, ends - line.depth * n])  # either may be A's, the other B's
        on_a, on_b = np.abs(distance(case.a, below)) < 1e-12, distance(case.b, below + line.depth * n) < 1e-12
        assert (on_a & on_b).reshape(2, -1).any(axis=0).all()


@pytest.mark.parametrize("name", CASES)
def test_they_overlap_by_what_they_say(name):
    """Lifted by that they only touch, and half of it is not enough; of two wedges that shows at no corner."""
    case = CASES[name]
    a, b = case.a.vertices, case.b.vertices if isinstance(case.b, ts.TetMesh) else np.zeros((0, 3))
    lowest, highest = a[a[:, 1] < a[:, 1].min() + 2 * P], b[np.abs(b[:, 1] - 0.25) < 0.25 + 2 * P]
    if name.startswith("ball"):  # a grid of all others' coordinates takes a minute
        highest = highest[np.abs(highest[:, 0]) < 0.1]
    for lift, free in ((P, True), (P / 2, False)):
        inside = [distance(case.b, lowest + (0, lift, 0)), distance(case.a, highest - (0, lift, 0))]
        deepest = np.concatenate(inside).min()
        assert deepest > -1e-12 if free else deepest < -5e-4 or name.startswith("wedge_on_wedge")


@pytest.mark.parametrize("name", CASES)
def test_what_is_right_and_what_is_not(name):
    case = CASES[name]
    point, normal, gap = right(case)
    for place in case.where:
        assert case.problems(point + place, normal, gap, place) == []
    turned = normal @ np.array([[1, 0.01, 0], [-0.01, 1, 0], [0, 0, 1]])
    for wrong in ((point + (0, 0.5, 0), normal, gap), (point, turned, gap), (point, normal, 1.03 * gap), (point, -normal, gap)):
        assert len(case.problems(*wrong)) >= len(point)
    assert case.problems(np.zeros((0, 3)), np.zeros((0, 3)), np.zeros(0))


def test_wrong_answers_of_the_reference_are_told():
    flank, side = np.array([4.0, 1.0, 0.0]) / np.sqrt(17), np.array([6.0, 1.0, 0.0]) / np.sqrt(37)
    for name, bad in (("cliff_edges", flank), ("spike_on_spike", side), ("internal_edges", np.array([2e-3, 1.0, 0.0]))):
        case = CASES[name]
        point, normal, gap = right(case)
        told = case.problems(np.r_[point, point[:1]], np.r_[normal, [bad]], np.r_[gap, gap[:1]])
        assert len(told) == 1 and told[0].endswith("is none")
    case = CASES["box_on_box_offset"]
    point, normal, gap = right(case)
    assert case.problems(np.r_[point, [[0.2, 0.495, 0.3]]], np.r_[normal, normal[:1]], np.r_[gap, gap[:1]]) == []
    keep = (point[:, [0, 2]] > 0.1).any(axis=1)  # one corner missing
    told = case.problems(point[keep], normal[keep], gap[keep])
    assert told and all(line.startswith("no contact") for line in told)
