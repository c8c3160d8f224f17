"""Contacts between sharp features are at the expected points, with the expected normals, in every case of `contact_cases`:

* by proximity, also on obstacles, and while a body slides over edges, vertices and faces;
* by a distance field, in the cases that a field resolves;
* contacts that close within the step are found, separating ones are not, whichever side moves;
* two equal cubes, one flush on the other, have contacts that span the whole face, whatever rounding moves their vertices;
* all fourteen cases of the reference are present.

All cases of one kind lie far apart in one scene.
"""

import json

import numpy as np
import pytest
from scipy.spatial import ConvexHull

import taisoft as ts
from tests.collision.contact_cases import Case, P, cases
from tests.collision.detection_scenes import DT, shifted, simulator
from tests.dynamics.scenes import rubber

APART = 20.0  # [m] between cases; those on the common half-space lie side by side, the others above it
CASES = cases()


def offset(k: int, case: Case) -> np.ndarray:
    """Position (3,) [m] of case k."""
    return np.array([k * APART, 0.0 if isinstance(case.b, ts.HalfSpace) else APART, 0.0])


def problems(collision: str, chosen: dict[str, Case]) -> list[str]:
    """What is wrong in cases with a `collision` method, at all positions of their bodies A."""
    scene, found = ts.Scene(gravity=(0, 0, 0)), []
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
    with simulator(scene) as sim:
        rest = {name: sim.positions(f"{name} a") for name in chosen}
        for step in range(max(len(case.where) for case in chosen.values())):
            moved = {name: case.where[step] for name, case in chosen.items() if step < len(case.where)}
            for name, where in moved.items():
                sim.set_state(positions=rest[name] + where, body=f"{name} a")
            c = sim.detect_contacts()
            assert set(c.body_a) <= {f"{name} a" for name in chosen}
            for name, where in moved.items():
                case, mine = chosen[name], c.body_a == f"{name} a"
                other = "ground" if isinstance(case.b, ts.HalfSpace) else f"{name} b"
                found += [f"{name}: contact with {b}" for b in set(c.body_b[mine]) - {other}]
                of_case = case.problems(c.point[mine] - places[name], c.normal[mine], c.gap[mine], where)
                found += [f"{name} at {where}: {text}" for text in of_case]
    return found


def test_contacts_by_proximity():
    assert problems("proximity", CASES) == []


def test_contacts_by_distance_field():
    assert problems("distance_field", {name: case for name, case in CASES.items() if case.field}) == []


def test_all_cases_of_the_reference_are_present(shared):
    value = json.loads((shared / "references" / "contact_geometry_erleben.json").read_text(encoding="utf-8"))["value"]
    names = {name for key in value for name in key.split(" / ")}
    assert len(value) == 14 and names <= set(CASES)
    # the reference counts both slides as one case
    assert sum(any(CASES[name].field for name in key.split(" / ")) for key in value) == 8
    nothing = np.zeros((0, 3)), np.zeros((0, 3)), np.zeros(0)
    assert all(case.problems(*nothing) for case in CASES.values())  # missing contacts are reported


@pytest.fixture(scope="module")
def cubes():
    scene = ts.Scene()
    scene.contact_forces = False
    scene.collision = ts.CollisionSettings(margin=0.1)
    for name in ("below", "above"):
        scene.add_body(ts.box_mesh((1, 1, 1), (1, 1, 1)), rubber(), name=name, collision="proximity")
    with simulator(scene) as sim:
        yield sim


@pytest.mark.parametrize("gap", [0.005, -0.001, -0.01])
def test_contacts_of_flush_cubes_span_the_whole_face(cubes, gap):
    """Noise far below and far above the search's tolerances moves vertices slightly outside or inside the other cube's sides."""
    rng, rest = np.random.default_rng(3), cubes.scene.body("below").rest_positions
    for noise in np.repeat([0.0, 1e-14, 1e-12, 1e-10, 1e-9, 1e-8, 1e-7, 1e-6, 1e-5, 1e-4], 4):
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
