"""What steps and searches spend by kind:

* every module with kernels of a step has a kind;
* the kinds of a demo with contacts add up to its step, and each of its kernels has one; so do those of its searches.
"""

from pathlib import Path

import pytest

import taisoft as ts
from benchmarks.kinds import FORCES, FRICTION, HOST, IN_SEARCH, KINDS, LAUNCHES, OTHER, POINTS, SEARCH, SOLVE, kind_of, watching
from taisoft.cli.scene_file import load_scene

PACKAGE = Path(ts.__file__).parent
IN_NO_STEP = ("backend", "view")


def test_every_module_with_kernels_has_a_kind():
    with_kernels = [path for path in PACKAGE.rglob("*.py") if "\n@kernel" in path.read_text(encoding="utf-8")]
    parts = [path.relative_to(PACKAGE).with_suffix("").parts for path in with_kernels]
    names = [".".join(own) for own in parts if own[0] not in IN_NO_STEP]
    assert len(names) > 40 and {kind_of(name) for name in names} == set(KINDS) - {LAUNCHES, HOST}


def test_the_kinds_add_up_to_the_step_of_a_demo_with_contacts():
    scene, settings = load_scene("cube_on_box")
    del settings["seconds"], settings["fps"]
    with ts.Simulator(scene, **settings) as sim:
        steps = sim.run(0.5, fps=60.0).steps  # compiles; the cube lands
        sim.reset()
        with watching() as spend:
            found = spend(lambda: sim.run(0.5, fps=60.0), steps)
            search = spend(sim.detect_contacts)
    seconds, launches = found.seconds, sum(found.launches.values())
    watched = launches * (found.launch.watched - found.launch.plain)
    assert sum(seconds.values()) + watched == pytest.approx(found.watched, rel=1e-9)
    assert sum(found.joined().values()) == pytest.approx(sum(seconds.values()), rel=1e-12) and found.joined()[SEARCH] > 0.0
    assert set(seconds) <= set(KINDS) and seconds[SOLVE] > 0.0
    assert set(found.launches) >= {SOLVE, FRICTION, FORCES, POINTS} and 10 < launches < 10_000
    assert {OTHER, *search.launches} <= {*IN_SEARCH} and min(search.launches.values()) >= 1
