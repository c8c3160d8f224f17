"""Self-contact:

* the end of a folded strip is thrown at its beginning and does not pass through it;
* a thin strip that is folded flat, and penetrates itself at the fold, snaps open: its speed, which builds up within a step,
  leads to substeps, and no step is refused.
"""

import numpy as np
import pytest

import taisoft as ts
from tests.collision.detection_scenes import folded

DT = 0.01  # [s]


@pytest.fixture(scope="module")
def shared_sim():
    scene = ts.Scene(gravity=(0, 0, 0))
    rubber = ts.Material(young=1e5, poisson=0.3, friction=0.3)
    strip = scene.add_body(ts.sheet_mesh((16, 2), (2.0, 0.02, 0.4)), rubber, name="strip")
    strip.fix(lambda X: X[:, 0] < -0.24)
    stiff = ts.Material(young=1e7, poisson=0.3, density=1000.0)
    scene.add_body(ts.sheet_mesh((16, 2), (1.6, 0.005, 0.4)), stiff, name="thin", position=(0, 0, 3))
    with ts.Simulator(scene, dt=DT, precision="f64", self_collision=True) as sim:
        yield sim


@pytest.fixture
def sim(shared_sim):
    shared_sim.reset()
    return shared_sim


def test_a_folded_strip_does_not_pass_through_itself(sim):
    """At 3 m/s, 0.03 m a step, and 0.02 m thick; contact impulses stop it, and no triangles intersect."""
    x, beyond = folded(sim.positions("strip"), 0.05)
    v = np.where(beyond[:, None], [0.0, -3.0, 0.0], 0.0)
    sim.set_state(x, v, body="strip")
    assert sim.intersecting_triangles() == [] and beyond.sum() >= 9
    impulse = 0.0
    for _ in range(12):
        report = sim.step()
        assert sim.intersecting_triangles() == [], report
        c = sim.contacts()
        impulse += np.linalg.norm(c.impulse, axis=1).sum()
        assert report.n_inverted == 0 and (c.body_a == c.body_b).all()
    assert impulse > 1.0  # [N s]; of 17 N s, the fold's stiffness takes the rest
    end = np.flatnonzero(beyond)
    assert sim.positions("strip")[end, 1].min() > -0.01 and sim.velocities("strip")[end, 1].mean() > -1.0


def test_a_strip_folded_flat_snaps_open(sim):
    """Folded by 178 degrees, the layers penetrate each other at the fold; after two steps they are apart."""
    x, turn = sim.positions("thin"), np.radians(178.0)
    half = x[:, 0] > 1e-9
    x[half, :2] = x[half, :2] @ [[np.cos(turn), np.sin(turn)], [-np.sin(turn), np.cos(turn)]]
    sim.set_state(x, np.zeros_like(x), body="thin")
    energy, speed = sim.energies().total, 0.0
    assert len(sim.intersecting_triangles()) > 20
    reports = [sim.step() for _ in range(4)]
    assert max(report.substeps for report in reports[:2]) > 2
    for report in reports[2:]:
        assert report.crossings == 0 and report.n_inverted == 0 and report.max_penetration < 1e-6
        speed = max(speed, np.linalg.norm(sim.velocities("thin"), axis=1).max())
    assert sim.energies().total < energy and speed > 5.0  # [m/s]
