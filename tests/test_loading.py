"""Forces and tractions that change while a simulator runs:

* explicit and implicit steps follow, bit by bit as in a simulator whose scene had them from the start, from zero too;
* they survive a reset, a rebuild and a checkpoint, whose scene must have the values of the start, and add up with a pull;
* a change of the density leaves total forces what they are; the user's scene stays what it was;
* a load that is not there, an index or a value outside the rules is refused in a sentence, and nothing changes.
"""

import numpy as np
import pytest
from scenes import rubber

import taisoft as ts
from taisoft.backend.runtime import compile_clock
from taisoft.checkpoint import read_checkpoint
from taisoft.errors import SceneError
from taisoft.output.camera import Camera
from taisoft.view.scene_view import Layers

FIRST = [(0.0, 0.0, 0.0), (1.0, 2.0, 0.0), (0.0, 30.0, 0.0)]  # of the two forces and the traction
EACH = np.arange(12.0).reshape(4, 3)  # [N] for each node of the second force
NEXT = [(0.0, -20.0, 5.0), EACH, (0.0, 0.0, 700.0)]
DT = {"velocity_verlet": 5e-4, "bdf2": 5e-3}


def beam(loads=FIRST) -> ts.Scene:
    scene = ts.Scene()
    scene.add_body(ts.box_mesh((1, 1, 1), (1, 1, 1), (5, 0, 0)), rubber(), name="bare")
    body = scene.add_body(ts.box_mesh((3, 1, 1), (3, 1, 1)), rubber(mass_damping=0.1), name="beam")
    body.fix(lambda X: X[:, 0] < -1.4)
    body.add_force(lambda X: X[:, 0] > 1.4, loads[0])
    body.add_force(lambda X: X[:, 0] > 1.4, loads[1])
    body.add_traction(lambda c: c[:, 1] > 0.4, loads[2])
    scene.contact_forces = False
    return scene


def change(sim, loads=NEXT) -> None:
    for index, value in enumerate(loads[:2]):
        sim.set_force("beam", index, value)
    sim.set_traction("beam", 0, loads[2])


def path(sim, steps: int = 6) -> np.ndarray:
    return np.array([(sim.step(), sim.positions())[1] for _ in range(steps)])


@pytest.fixture(scope="module", params=DT)
def sims(request):
    """One simulator whose loads change, and the path of another that has had them from the start."""
    settings = {"dt": DT[request.param], "integrator": request.param, "precision": "f64", "draggable": True}
    with ts.Simulator(beam(NEXT), **settings) as other:
        expected = path(other)
    with ts.Simulator(beam(), **settings) as sim:
        yield sim, expected


def test_as_if_they_had_been_there_from_the_start(sims):
    sim, expected = sims
    before, given = path(sim, 3), sim.scene.body("beam").forces[0].value
    assert np.abs(before - expected[:3]).max() > 1e-6
    sim.reset()
    compiled = compile_clock()
    change(sim)
    assert given.tolist() == [0, 0, 0] and np.array_equal(sim.scene.body("beam").forces[1].value, EACH)
    assert np.array_equal(path(sim, 3), expected[:3]) and compile_clock() == compiled
    sim.reset()
    assert np.array_equal(path(sim), expected), "a reset keeps them"
    change(sim, FIRST)
    sim.reset()
    assert np.array_equal(path(sim, 3), before)


def test_checkpoints_and_rebuilt_simulators_have_them(sims, tmp_path):
    sim, expected = sims
    if not sim.settings.explicit:
        pytest.skip("they do not depend on the integrator")
    change(sim)
    sim.reset()
    path(sim, 3)
    sim.save_checkpoint(tmp_path / "c.npz")
    with pytest.raises(SceneError, match="body 'beam': force 0 is .0.0, -20.0, 5.0. in this scene and was .0.0, 0.0, 0.0. at"):
        ts.Simulator.load_checkpoint(tmp_path / "c.npz", beam(NEXT))
    with ts.Simulator.load_checkpoint(tmp_path / "c.npz", beam()) as loaded:
        assert np.array_equal(path(loaded, 3), expected[3:])
        assert loaded.scene.body("beam").forces[0].value.tolist() == list(NEXT[0])
        loaded.rebuild(dt=loaded.dt)
        loaded.save_checkpoint(tmp_path / "d.npz")  # of a run that still began as it did
        assert read_checkpoint(tmp_path / "d.npz").start == read_checkpoint(tmp_path / "c.npz").start
        loaded.reset()
        assert np.array_equal(path(loaded), expected)


def test_in_the_middle_of_a_run(sims):
    """The next step has the new loads from its start: Verlet keeps the acceleration of the last one."""
    sim, _ = sims
    if not sim.settings.explicit:
        pytest.skip("bdf2 looks back")
    change(sim, FIRST)
    sim.reset()
    path(sim, 3)
    x, v = sim.positions(), sim.velocities()
    change(sim)
    after = path(sim, 2)
    sim.reset()
    sim.set_state(x, v)
    assert np.array_equal(path(sim, 2), after)


def test_they_add_up_with_a_pull(sims):
    sim, _ = sims
    nodes = sim.scene.body("beam").forces[0].nodes
    loads = sim._dynamics.state.model.loads
    change(sim, FIRST)
    sim.reset()
    own = loads.to_numpy()
    sim.drag("beam", nodes, np.ones(4), (3.0, 1.0, 0.0), 50.0)
    sim.step()
    dragged = loads.to_numpy() - own
    assert np.abs(dragged).max() > 1e-3
    change(sim)
    both = loads.to_numpy()
    sim.release()
    new = loads.to_numpy()
    assert np.allclose(both, new + dragged, rtol=0, atol=1e-12) and np.abs(new - own).max() > 1.0
    sim.drag("beam", nodes, np.ones(4), (3.0, 1.0, 0.0), 50.0)
    sim.step()
    assert np.abs(loads.to_numpy() - new).max() > 1e-3
    sim.set_material("beam", density=1500.0)
    sim.release()
    assert np.allclose(loads.to_numpy(), new, rtol=1e-14, atol=0)
    sim.set_material("beam", density=1000.0)
    assert np.array_equal(loads.to_numpy(), new)


def test_arrows_follow(sims):
    sim, _ = sims
    change(sim, FIRST)
    layers = Layers(sim.scene, ("tractions",))
    camera = Camera(target=np.zeros(3), distance=10.0, azimuth=30.0, elevation=20.0)
    up = layers.lines(sim, camera)[0]
    sim.set_traction("beam", 0, (0, -30, 0))
    down = layers.lines(sim, camera)[0]
    assert up.shape == down.shape and np.abs(up - down).max() > 0.1


@pytest.mark.parametrize(
    "call, words",
    [
        (lambda s: s.set_force("beam", 2, (0, 0, 0)), "body 'beam': set_force: index must be a whole number from 0 to 1, not 2"),
        (lambda s: s.set_force("beam", -1, (0, 0, 0)), "from 0 to 1, not -1"),
        (lambda s: s.set_force("beam", True, (0, 0, 0)), "from 0 to 1, not True"),
        (
            lambda s: s.set_force("beam", 1, np.zeros((3, 3))),
            r"set_force: force 1 must have shape \(3,\) or \(4, 3\), not \(3, 3\)",
        ),
        (lambda s: s.set_force("beam", 0, (0, np.nan, 0)), r"force 0: entry \[1\] is nan, not finite"),
        (
            lambda s: s.set_force("bare", 0, (0, 0, 0)),
            "body 'bare': set_force: it has no force: give it one of 0 by body.add_force",
        ),
        (
            lambda s: s.set_traction("bare", 0, (0, 0, 0)),
            "set_traction: it has no traction: give it one of 0 by body.add_traction",
        ),
        (lambda s: s.set_traction("beam", 0, EACH), r"traction 0 must have shape \(3,\), not \(4, 3\)"),
        (lambda s: s.set_force("bean", 0, (0, 0, 0)), "no body is called 'bean'; did you mean 'beam'"),
    ],
)
def test_what_is_refused(sims, call, words):
    sim, _ = sims
    before = [load.value for load in sim.scene.body("beam").forces]
    with pytest.raises(SceneError, match=words):
        call(sim)
    assert all(load.value is value for load, value in zip(sim.scene.body("beam").forces, before))


def test_a_scene_without_any_load():
    scene = ts.Scene()
    scene.add_body(ts.box_mesh((1, 1, 1), (1, 1, 1)), rubber(), name="bare")
    sim = ts.Simulator(scene, dt=5e-4, integrator="velocity_verlet", precision="f64")
    with sim, pytest.raises(SceneError, match="it has no force"):
        sim.set_force("bare", 0, (1, 0, 0))
    with pytest.raises(ts.SimulationError, match="closed"):
        sim.set_force("bare", 0, (1, 0, 0))
