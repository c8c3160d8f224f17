"""`taisoft warm`: scenes of every kind step, a line each; their like, of any size, need no other kernel."""

import numpy as np
import pytest

import taisoft as ts
from taisoft.cli import main, warm
from taisoft.runtime import n_compiled


def test_warm(monkeypatch, capsys):
    monkeypatch.setattr(warm, "LAWS", ("stable_neo_hookean",))
    assert main(["warm"]) == 0
    lines = capsys.readouterr().out.splitlines()
    assert len(lines) == 2 * 3 + 2 and lines[-2].startswith("statics") and lines[-1].endswith(" s")


def test_scenes_of_other_sizes_need_no_other_kernel():
    integrator = "implicit_euler"
    warm._simulate(warm.scene("stable_neo_hookean", "a half-space"), integrator, warm.INTEGRATORS[integrator], "f32")
    before = n_compiled()
    made = ts.Scene()
    rubber = ts.Material(law="stable_neo_hookean", young=2e5, poisson=0.2, density=900.0)
    made.add_body(ts.box_mesh((4, 3, 2), (0.3, 0.2, 0.1)), rubber, position=(0, 0.0501, 0))
    made.add_obstacle(ts.HalfSpace((0, -0.05, 0), (0, 1, 0)))
    with ts.Simulator(made, dt=2e-3, integrator=integrator) as sim:
        sim.advance(2)
        assert np.isfinite(sim.positions()).all() and n_compiled() == before


@pytest.mark.parametrize("contacts", warm.CONTACTS)
def test_scenes_have_what_they_say(contacts):
    made = warm.scene("corotational", contacts)
    counts = {"no contacts": (1, 0), "a half-space": (1, 1), "two bodies": (2, 0)}
    assert (len(made.bodies), len(made.obstacles)) == counts[contacts]
