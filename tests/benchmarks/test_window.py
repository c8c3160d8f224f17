"""What a step spends by kind:

* every module with kernels of a step has a kind;
* the kinds of a demo with contacts add up to its step, and each of its kernels has one.
"""

from pathlib import Path

import pytest

import taisoft as ts
from benchmarks.window_kinds import FORCES, FRICTION, KINDS, PATHS, SEARCH, SOLVE, kind_of, spend
from taisoft.cli.scene_file import load_scene

PACKAGE = Path(ts.__file__).parent
IN_NO_STEP = ("backend", "view")


def test_every_module_with_kernels_has_a_kind():
    with_kernels = [path for path in PACKAGE.rglob("*.py") if "\n@kernel" in path.read_text(encoding="utf-8")]
    parts = [path.relative_to(PACKAGE).with_suffix("").parts for path in with_kernels]
    names = [".".join(own) for own in parts if own[0] not in IN_NO_STEP]
    assert len(names) > 40 and {kind_of(name) for name in names} == {SOLVE, FRICTION, FORCES, SEARCH, PATHS}


def test_the_kinds_add_up_to_the_step_of_a_demo_with_contacts():
    scene, settings = load_scene("cube_on_box")
    del settings["seconds"], settings["fps"]
    with ts.Simulator(scene, **settings) as sim:
        sim.run(0.5, fps=60.0)  # compiles; the cube lands
        found = spend(sim, 0.5, 60.0)
    seconds, launches = found["seconds"], sum(found["launches"].values())
    watching = launches * (found["watched_launch"] - found["launch"])
    assert sum(seconds.values()) + watching == pytest.approx(found["watched"], rel=1e-9)
    assert list(seconds) == list(KINDS) and seconds[SOLVE] > 0.0
    assert set(found["launches"]) >= {SOLVE, FRICTION, FORCES, SEARCH} and 10 < launches < 10_000
