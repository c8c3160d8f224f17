"""The gripper of the demos: from a scene file it holds at a friction of 0.8, and the cube stays on the ground at 0.1."""

import pytest

import taisoft as ts
from taisoft.cli.scene_file import load_shipped

gripper = load_shipped("demos", "gripper")


@pytest.mark.long
@pytest.mark.parametrize(("friction", "lifted"), [(0.8, gripper.HEIGHT), (0.1, 0.0)])
def test_gripper(tmp_path, friction, lifted):
    settings = {key: value for key, value in gripper.solver.items() if key in ("integrator", "dt")}
    ts.write_scene(tmp_path / "gripper.toml", gripper.build(friction), settings)
    scene, solver = ts.read_scene(tmp_path / "gripper.toml")
    with ts.Simulator(scene, **solver) as sim:
        report = sim.run(seconds=gripper.solver["seconds"])
        assert report.status == "ok"
        assert gripper.rise(sim) == pytest.approx(lifted, abs=0.01)
