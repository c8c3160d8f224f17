"""Every demo runs as `taisoft run` runs it, ends with status ok, and passes its own check of the physics.

* demos are found in the folder, so a new one is tested without a line here;
* the check fails where the material is 1 % stiffer than the demo says, so it would notice wrong physics (where it knows an
  energy);
* a demo says what it is in one line;
* the bunny of benchmarks/scenes/ runs where its mesh is there, and says what is missing where it is not.
"""

from pathlib import Path
from types import ModuleType

import pytest

from taisoft.cli.scene_file import first_line, load_module, shipped_files
from taisoft.errors import MeshError
from taisoft.simulator import Simulator

DEMOS = shipped_files("demos")
BUNNY = Path(__file__).resolve().parents[1] / "benchmarks" / "scenes" / "bunny_pull.py"
LINE = 100  # characters that `taisoft list` has for a demo's sentence


def opened(demo: ModuleType) -> tuple[Simulator, dict]:
    """The demo's simulator, open, and the arguments of its run."""
    settings = dict(demo.solver)
    run = {name: settings.pop(name) for name in ("seconds", "fps")}
    return Simulator(demo.build(), **settings), run


def test_there_are_demos():
    assert {"hanging_beam", "midpoint_traction", "twisting_bar"} <= set(DEMOS)


@pytest.mark.parametrize("name", DEMOS)
def test_demo(name):
    demo = load_module(DEMOS[name])
    sim, run = opened(demo)
    with sim:
        result = sim.run(**run)
        assert result.status == "ok" and result.problems == []
        assert abs(sim.time - run["seconds"]) < 1e-9
        demo.check(sim, result)

        if not hasattr(demo, "ENERGY"):  # nothing in its check depends on the stiffness
            return
        for body in sim.scene.bodies:
            sim.set_material(body.name, young=1.01 * body.material.young)
        sim.reset()
        result = sim.run(**run)
        with pytest.raises(AssertionError):
            demo.check(sim, result)


@pytest.mark.parametrize("name", DEMOS)
def test_demo_says_what_it_is(name):
    line = first_line(DEMOS[name])
    assert line.endswith(".") and len(line) <= LINE


def test_bunny():
    example = load_module(BUNNY)
    if not example.mesh_path().is_file():
        pytest.skip("the bunny's mesh, which is not part of the repository, is absent")
    example.solver["dt"] = 1 / 60  # half the steps: enough for its check
    sim, run = opened(example)
    with sim:
        example.check(sim, sim.run(**run))


def test_bunny_without_its_mesh(monkeypatch, tmp_path):
    monkeypatch.setenv("BUNNY_MESH", str(tmp_path / "gone.msh"))
    with pytest.raises(MeshError, match=r"gone\.msh: no such file; set the variable BUNNY_MESH"):
        load_module(BUNNY).build()
