"""A body touches itself: the end of a folded strip is thrown at the strip's own beginning and does not pass through it."""

import numpy as np
from detection_scenes import folded

import taisoft as ts


def test_a_folded_strip_does_not_pass_through_itself():
    """At 3 m/s, 0.03 m a step, to a strip 0.02 m thick; it bears an impulse, loses its speed, and no triangles intersect."""
    scene = ts.Scene(gravity=(0, 0, 0))
    rubber = ts.Material(young=1e5, poisson=0.3, friction=0.3)
    strip = scene.add_body(ts.sheet_mesh((16, 2), (2.0, 0.02, 0.4)), rubber, name="strip")
    strip.fix(lambda X: X[:, 0] < -0.24)
    with ts.Simulator(scene, dt=0.01, precision="f64", self_collision=True) as sim:
        x, beyond = folded(sim.positions(), 0.05)
        v = np.where(beyond[:, None], [0.0, -3.0, 0.0], 0.0)
        sim.set_state(x, v)
        assert sim.intersecting_triangles() == [] and beyond.sum() >= 9
        borne = 0.0
        for _ in range(12):
            report = sim.step()
            assert sim.intersecting_triangles() == [], report
            c = sim.contacts()
            borne += np.linalg.norm(c.impulse, axis=1).sum()
            assert report.n_inverted == 0 and (c.body_a == c.body_b).all()
        assert borne > 1.0  # [N s]; the fold's own stiffness takes the rest of the 17 N s that were thrown
        end = np.flatnonzero(beyond)
        assert sim.positions()[end, 1].min() > -0.01 and sim.velocities()[end, 1].mean() > -1.0
