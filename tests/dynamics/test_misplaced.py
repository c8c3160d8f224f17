"""Contact normals are those of the step's end; what those of its start would falsify is measured and reported.

* a capsule that slides by D over a soft block: the forces are right; with the normals of the start, D / R of the force is
  friction that is too large or a false drag; in steps of a tenth a tenth, which is not reported; a checkpoint keeps the sums;
* a box that slides over two boxes side by side passes the seam; with the normals of the start it is stopped there, which is
  reported at once; over one box nothing is.
"""

import numpy as np
import pytest

import taisoft as ts
from taisoft.dynamics.renewal import Renewal

RADIUS = 0.5


def ironed(friction: float) -> ts.Scene:
    """A block of tiny mass under a capsule that is pressed in for a second and then slides by RADIUS / 20 a second."""
    scene = ts.Scene(gravity=(0, 0, 0))
    body = scene.add_body(ts.box_mesh((8, 3, 1), (1.6, 0.4, 0.2)), ts.Material(young=1e6, density=1e-4), name="block")
    body.fix(lambda x: x[:, 1] < -0.19)
    slide = ts.KeyFrames([0, 1, 21], [(0, 0, 0), (0, -0.03, 0), (RADIUS, -0.03, 0)])
    ends = ((-0.3, 0.201 + RADIUS, z) for z in (-1.0, 1.0))
    scene.add_obstacle(ts.Capsule(*ends, RADIUS), name="iron", path=slide)
    scene.set_contact("block", "iron", friction=friction)
    return scene


def test_normals_of_the_end_on_a_curve():
    ratios = []
    for friction in (0.3, 0.0):
        with ts.Simulator(ironed(friction), dt=1.0, precision="f64") as sim:
            assert sim.run(12.0, fps=None).status == "ok"
            reports, forces = zip(*((sim.step(), sim.contact_force("block", "iron")) for _ in range(8)))
            assert all(r.converged and not r.problems for r in reports) and reports[-1].misplaced < 0.005
            ratios.append(np.mean([force[0] / -force[1] for force in forces]))  # from edge to edge: it oscillates
    # the block bulges ahead of the capsule as the slide begins, with friction or without
    assert abs(ratios[1]) < 0.03 and ratios[0] - ratios[1] == pytest.approx(0.3, rel=0.05)


@pytest.mark.parametrize("friction, text", [(0.3, "friction between 'block' and 'iron' may be"), (0.0, "may be a false drag")])
def test_a_slide_over_a_curve(friction, text, tmp_path, monkeypatch):
    monkeypatch.setattr(Renewal, "MAX_LOOKS", 0)
    with ts.Simulator(ironed(friction), dt=1.0) as sim:
        sim.run(12.0, fps=None)
        sim.save_checkpoint(tmp_path / "slide.npz")
        result = sim.run(5.0, fps=None)
        assert result.status == "degraded" and any(text in one and "smaller steps" in one for one in result.problems)
        assert result.step_reports[-1].misplaced == pytest.approx(0.05, rel=0.3)
        positions = sim.positions()
        sim.reset()
        sim.dt = 0.1
        result = sim.run(4.0, fps=None)
        assert result.step_reports[-1].misplaced == pytest.approx(0.005, rel=0.3) and "inexact" not in " ".join(result.problems)
    with ts.Simulator.load_checkpoint(tmp_path / "slide.npz", ironed(friction)) as sim:
        assert text in sim.run(5.0, fps=None).step_reports[-1].contact_error and (sim.positions() == positions).all()


@pytest.mark.parametrize("boxes, looks", [(1, 0), (2, 0), (2, Renewal.MAX_LOOKS)])
def test_a_seam(boxes, looks, monkeypatch):
    monkeypatch.setattr(Renewal, "MAX_LOOKS", looks)
    scene = ts.Scene()
    for k in range(boxes):
        scene.add_obstacle(ts.Box(((k - 0.5) * (boxes - 1), -0.1, 0), (0.5, 0.1, 0.5)), name=f"box {k}", friction=0.0)
    mesh = ts.box_mesh((2, 1, 2), (0.2, 0.1, 0.2))
    scene.add_body(mesh, ts.Material(young=1e6, friction=0.0), name="slider", position=(-0.13, 0.0503, 0), velocity=(1, 0, 0))
    with ts.Simulator(scene, dt=1 / 120) as sim:
        result = sim.run(10 / 120)
        speed, errors = sim.velocities("slider")[:, 0].mean(), [r.contact_error for r in result.step_reports]
    if boxes == 1 or looks:
        assert result.status == "ok" and speed == pytest.approx(1.0, abs=1e-3) and result.step_reports[-1].misplaced < 1e-3
    else:
        assert result.status == "degraded" and any("between 'slider' and 'box 1' may be a false drag" in e for e in errors)
