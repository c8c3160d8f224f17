"""The exact path of the falling beam, the reference for errors of solvers and peers:

* the force is minus the gradient of the St. Venant-Kirchhoff energy;
* the masses sum to the total, and exactly the end face is fixed;
* integration gives the independent reference path of the coarse beam;
* the stored paths are those of the present code, and converged; errors are distances over the excursion.
"""

import json

import numpy as np
import pytest

from benchmarks.exact_path import DENSITY, MESHES, FallingBeam, integrate, load_exact


def energy(beam: FallingBeam, x) -> float:
    """Elastic energy [J] at the positions x (n,3), from the formula with F tet by tet."""
    edges_rest = beam.vertices[beam.tets[:, 1:]] - beam.vertices[beam.tets[:, :1]]
    edges = x[beam.tets[:, 1:]] - x[beam.tets[:, :1]]
    F = np.linalg.solve(edges_rest, edges).transpose(0, 2, 1)
    E = (F.transpose(0, 2, 1) @ F - np.eye(3)) / 2
    psi = beam.mu * np.einsum("eij,eij->e", E, E) + beam.lam / 2 * np.trace(E, axis1=1, axis2=2) ** 2
    return float(psi @ beam.volumes)


@pytest.fixture(scope="module")
def beam():
    return FallingBeam((4, 2, 1))


def test_force_is_minus_the_gradient_of_the_energy(beam):
    rng = np.random.default_rng(1)
    u = 0.05 * rng.standard_normal(beam.vertices.shape)
    direction = rng.standard_normal(u.shape)
    h = 1e-5
    forward, backward = (energy(beam, beam.vertices + u + step * direction) for step in (h, -h))
    slope = (forward - backward) / (2 * h)
    power = -np.sum(beam.elastic_force(u.T).T * direction)
    assert abs(slope) > 1e4
    assert power == pytest.approx(slope, rel=1e-7)


def test_mass_and_fixed_nodes(beam):
    assert beam.mass.sum() == pytest.approx(4 * DENSITY)
    assert np.array_equal(beam.free, beam.vertices[:, 0] > -2)
    assert np.all(beam.vertices[beam.tip, 0] == 2) and len(beam.tip) == 3 * 2
    a = beam.acceleration(np.zeros((3, len(beam.vertices))))
    assert np.allclose(a[:, beam.free].T, [0, -9.8, 0]) and np.all(a[:, ~beam.free] == 0)


def test_integration_gives_the_reference_path(shared):
    value = json.loads((shared / "references" / "beam_fall_semidiscrete.json").read_text())["value"]["SVK_lumped"]
    beam = FallingBeam((11, 2, 2))
    node = np.flatnonzero(np.all(np.isclose(beam.vertices, [2, 0, 0]), axis=1))
    t, path = integrate(beam, 1e-9, points=node)
    assert np.allclose(t[10::10], value["t"][:10])
    assert np.abs(path[10::10] - np.array(value["probe_x"])[:10]).max() < 1e-8  # m


def test_stored_paths_are_converged_and_those_of_this_code():
    for cells in MESHES:
        exact = load_exact(cells)
        assert exact.path.shape == (101, 3) and exact.convergence.shape == (101,)
        assert exact.convergence.max() < 1e-5  # accurate enough for the errors quoted against it
        assert 4.1 < exact.excursion < 4.3  # m, about the length of the beam
    t, path = integrate(FallingBeam((12, 3, 3)), 1e-8, seconds=0.1)
    assert load_exact((12, 3, 3)).error(t, path) < 1e-7


def test_error_is_the_largest_distance_over_the_excursion():
    exact = load_exact((12, 3, 3))
    moved = exact.path.copy()
    moved[90] += [0, 0.3, 0.4]
    assert exact.error(exact.t, exact.path) == 0
    assert exact.error(exact.t, moved) == pytest.approx(0.5 / exact.excursion)
    assert exact.error(exact.t, moved, until=0.8) == 0
    assert exact.error(exact.t[90:91], moved[90:91]) == pytest.approx(0.5 / exact.excursion)
    with pytest.raises(ValueError, match=r"time 1, 0.005 s, is not a multiple"):
        exact.error([0, 0.005], np.zeros((2, 3)))
