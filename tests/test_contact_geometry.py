"""Contacts of two bodies with sharp features are where geometry says they are, in every case of `contact_cases`:

* by proximity, also on obstacles, and while a body slides over edges, vertices and faces;
* by a distance field, where a field can tell.

All cases of one kind stand far apart in one scene: kernels are compiled once, and no case may see another.
"""

from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import replace

import numpy as np
import pytest
from contact_cases import Case, P, cases

import taisoft as ts

APART = 20.0  # [m] between cases; those on the common half-space stand side by side, the others above it
CASES = cases()


def offset(k: int, case: Case) -> np.ndarray:
    """(3,) [m]: where case number k stands."""
    return np.array([k * APART, 0.0 if isinstance(case.b, ts.HalfSpace) else APART, 0.0])


def shifted(shape, by: np.ndarray):
    """An obstacle's shape, moved (3,) [m]."""
    if isinstance(shape, ts.MeshObstacle):
        return ts.MeshObstacle(shape.vertices + by, shape.triangles)
    return replace(shape, center=shape.center + by)


@contextmanager
def simulated(collision: str, chosen: dict[str, Case]) -> Iterator[dict[str, list]]:
    """Problems of every case, hit by `collision`, at all places of its body A."""
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
    # nothing moves: the explicit integrator is built fastest, and its limit of stability is of no interest
    with ts.Simulator(scene, dt=1e-9, integrator="symplectic_euler", precision="f64", allow_unstable=True) as sim:
        yield dict(_problems(sim, chosen, places))


def _problems(sim: ts.Simulator, chosen: dict[str, Case], places: dict[str, np.ndarray]):
    """Pairs of a case and its problems."""
    found = {name: [] for name in chosen}
    rest = {name: sim.positions(f"{name} a") for name in chosen}
    for step in range(max(len(case.where) for case in chosen.values())):
        going = {name: case.where[step] for name, case in chosen.items() if step < len(case.where)}
        for name, where in going.items():
            sim.set_state(positions=rest[name] + where, body=f"{name} a")
        contacts = sim.detect_contacts()
        for name, where in going.items():
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
def test_proximity_finds_what_geometry_says(by_proximity, name):
    assert not by_proximity[name], "\n".join(by_proximity[name])


@pytest.mark.parametrize("name", [name for name, case in CASES.items() if case.field])
def test_a_distance_field_finds_what_it_can_tell(by_field, name):
    assert not by_field[name], "\n".join(by_field[name])
