"""`taisoft warm` compiles the kernels of scenes, so that similar scenes of any size compile none:

* scenes of the compiled kinds add no kernel;
* without names, every demo can be built and is compiled, with the requested precision or its own.
"""

import numpy as np

import taisoft as ts
from taisoft.backend.runtime import n_compiled
from taisoft.cli import main, warm
from taisoft.cli.scene_file import shipped_files


def falling(cells, size, **numbers) -> ts.Scene:
    scene = ts.Scene()
    scene.add_body(ts.box_mesh(cells, size), ts.Material(**numbers), position=(0, 0.5 * size[1] + 1e-4, 0))
    scene.add_ground()
    return scene


def test_scenes_of_other_sizes_compile_nothing():
    warm.simulate(falling((2, 2, 2), (0.1, 0.1, 0.1), young=1e5), {"dt": 0.01})
    before = n_compiled()
    scene = falling((4, 3, 2), (0.3, 0.2, 0.1), young=2e5, poisson=0.2, density=900.0)
    with ts.Simulator(scene, dt=2e-3, integrator="implicit_euler") as sim:
        sim.advance(2)
        assert np.isfinite(sim.positions()).all() and n_compiled() == before


def test_all_demos_are_compiled_in_the_requested_precision_or_their_own(monkeypatch, capsys):
    found = []
    monkeypatch.setattr(warm, "simulate", lambda scene, settings: found.append(settings.get("precision", "f32")))
    monkeypatch.setattr(warm, "draw", lambda scene, precision: found.append(precision))
    monkeypatch.setattr(warm, "solve_static", lambda scene, precision: found.append(precision))
    assert main(["warm"]) == 0
    assert len(found) == len(shipped_files("demos")) + 2 and set(found[:-2]) == {"f32", "f64"} and found[-2:] == ["f32", "f64"]
    assert "gripper  " in capsys.readouterr().out
    found.clear()
    assert main(["warm", "gripper", "--precision", "f32"]) == 0 and found == ["f32"]
