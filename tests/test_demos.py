"""Every demo runs as `taisoft run` runs it, ends with status ok, and passes its own check of the physics.

* demos are found in the folder, so a new one is tested without a line here;
* the check fails where the material is 1 % stiffer than the demo says, or another number off by as much, so it would notice
  wrong physics;
* of sheets in contact no triangle meets one of what they touch in any frame, by the judgement of ipctk;
* its USD file holds the positions of every frame, and no validator objects to it;
* a demo says what it is in one line.
"""

from itertools import combinations
from types import ModuleType

import numpy as np
import pytest
from pxr import Usd
from test_self_collision import judged
from usd_stage import check_frames, faults

from taisoft.cli.scene_file import first_line, load_module, shipped_files
from taisoft.output.usd import UsdWriter
from taisoft.simulator import Simulator

DEMOS = shipped_files("demos")
LINE = 100  # characters that `taisoft list` has for a demo's sentence


NEVER_CROSS = ("sheet_and_cube", "sheet_on_box")


def stiffer(sim: Simulator) -> None:
    """All bodies by 1 %."""
    for body in sim.scene.bodies:
        sim.set_material(body.name, young=1.01 * body.material.young)


def rougher(sim: Simulator) -> None:
    """The slope, by 1 %: the cube that slides is accelerated half as much."""
    sim.set_contact("slides", "slope", friction=1.01 * 0.49)


def heavier(sim: Simulator) -> None:
    """All bodies by 1 %: where a pile comes to rest is chance, but what it weighs is not."""
    sim.set_gravity((0.0, -1.01 * 9.81, 0.0))


WRONG = {"incline": rougher, "cube_pile": heavier}


def crossing(sim: Simulator) -> list[tuple[str, str]]:
    """Names of bodies, or of a body and an obstacle with a surface, of which two triangles intersect."""
    ipctk = pytest.importorskip("ipctk")
    parts = [(b.name, sim.positions(b.name), b.nodes.surface) for b in sim.scene.bodies]
    parts += [(o.name, *o.shape.surface()) for o in sim.scene.obstacles]
    found = []
    for (one, x, t), (other, y, u) in combinations(parts, 2):
        lo, hi = (f(axis=0) for f in (y.min, y.max))
        t = t[(x[t].min(axis=1) <= hi).all(axis=1) & (x[t].max(axis=1) >= lo).all(axis=1)]
        both = np.concatenate([t, u + len(x)])
        if len(t) and any((i < len(t)) != (j < len(t)) for i, j in judged(ipctk, np.concatenate([x, y]), both)):
            found.append((one, other))
    return found


def opened(demo: ModuleType) -> tuple[Simulator, dict]:
    """The demo's simulator, open, and the arguments of its run."""
    settings = dict(demo.solver)
    run = {name: settings.pop(name) for name in ("seconds", "fps")}
    return Simulator(demo.build(), **settings), run


def test_there_are_demos():
    assert {"hanging_beam", "midpoint_traction", "twisting_bar"} <= set(DEMOS)


@pytest.mark.parametrize("name", DEMOS)
def test_demo(name, tmp_path):
    demo = load_module(DEMOS[name])
    sim, run = opened(demo)
    crossed, seen = [], []
    writer = UsdWriter(tmp_path, sim.scene, fps=run["fps"])

    def look(sim, frame, report):
        if name in NEVER_CROSS and crossing(sim):
            crossed.append(frame)
        seen.append({body.name: sim.positions(body.name) for body in sim.scene.bodies})
        writer.frame(sim, frame)

    with sim:
        result = sim.run(on_frame=look, **run)
        assert result.status == "ok" and result.problems == []
        assert crossed == []
        assert abs(sim.time - run["seconds"]) < 1e-9
        demo.check(sim, result)
        writer.close()
        assert check_frames(tmp_path / "scene.usdc", seen) == len(seen) > 1
        assert faults(Usd.Stage.Open(str(tmp_path / "scene.usdc"))) == []

        WRONG.get(name, stiffer)(sim)
        sim.reset()
        result = sim.run(**run)
        with pytest.raises(AssertionError):
            demo.check(sim, result)


@pytest.mark.parametrize("name", DEMOS)
def test_demo_says_what_it_is(name):
    line = first_line(DEMOS[name])
    assert line.endswith(".") and len(line) <= LINE
