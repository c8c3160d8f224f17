"""The exact path of the falling beam, the reference for errors of solvers and peers:

* integration gives the independent reference path of the coarse beam;
* the stored paths are those of the present code, and converged.
"""

import json

import numpy as np

from benchmarks.exact_path import MESHES, FallingBeam, integrate, load_exact


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
        assert exact.path.shape == (101, 3) and exact.convergence.max() < 1e-5
        assert 4.1 < exact.excursion < 4.3  # m, about the length of the beam
    exact, (_, path) = load_exact((12, 3, 3)), integrate(FallingBeam((12, 3, 3)), 1e-8, seconds=0.1)
    assert np.linalg.norm(path - exact.path[: len(path)], axis=1).max() < 1e-7 * exact.excursion
