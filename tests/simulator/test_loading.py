"""Forces and tractions that change while a simulator runs:

* steps are bitwise those of a simulator whose scene had the loads from the start, also if they were 0;
* loads survive a reset, a rebuild and a checkpoint, which needs the scene with the initial loads; a drag force is added to them;
* a change of the density keeps total forces; the user's scene does not change;
* missing loads, invalid indices and invalid values are refused, and nothing changes.
"""

import numpy as np
import pytest

import taisoft as ts
from taisoft.backend.runtime import compile_clock
from taisoft.checkpoint import read_checkpoint
from taisoft.errors import SceneError
from taisoft.output.camera import Camera
from taisoft.scene.plan import change_load
from taisoft.view.scene_view import Layers
from tests.dynamics.scenes import dynamics, rubber

FIRST = [(0.0, 0.0, 0.0), (1.0, 2.0, 0.0), (0.0, 30.0, 0.0)]  # of the two forces and the traction
PER_NODE = np.arange(12.0).reshape(4, 3)  # [N] of the second force
NEXT = [(0.0, -20.0, 5.0), PER_NODE, (0.0, 0.0, 700.0)]
DT = {"velocity_verlet": 5e-4, "bdf2": 5e-3}


def beam(loads=FIRST, density: float = 1000.0) -> ts.Scene:
    scene = ts.Scene()
    scene.add_body(ts.box_mesh((1, 1, 1), (1, 1, 1), (5, 0, 0)), rubber(), name="unloaded")
    body = scene.add_body(ts.box_mesh((3, 1, 1), (3, 1, 1)), rubber(mass_damping=0.1, density=density), name="beam")
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
    """A simulator whose loads change, and the path of another that had the new loads from the start."""
    settings = {"dt": DT[request.param], "integrator": request.param, "precision": "f64", "draggable": True}
    with ts.Simulator(beam(NEXT), **settings) as reference:
        expected = path(reference)
    with ts.Simulator(beam(), **settings) as sim:
        yield sim, expected


def test_changed_loads_act_as_loads_from_the_start(sims):
    sim, expected = sims
    before, initial = path(sim, 3), sim.scene.body("beam").forces[0].value
    assert np.abs(before - expected[:3]).max() > 1e-6
    sim.reset()
    compiled = compile_clock()
    change(sim)
    assert initial.tolist() == [0, 0, 0] and np.array_equal(sim.scene.body("beam").forces[1].value, PER_NODE)
    assert np.array_equal(path(sim, 3), expected[:3]) and compile_clock() == compiled
    sim.reset()
    assert np.array_equal(path(sim), expected), "a reset keeps changed loads"
    change(sim, FIRST)
    sim.reset()
    assert np.array_equal(path(sim, 3), before)


def test_checkpoints_and_rebuilt_simulators_keep_changed_loads(sims, tmp_path):
    sim, expected = sims
    if not sim.settings.explicit:
        pytest.skip("does not depend on the integrator")
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
        loaded.save_checkpoint(tmp_path / "d.npz")  # the initial loads stay those of the scene
        assert read_checkpoint(tmp_path / "d.npz").start == read_checkpoint(tmp_path / "c.npz").start
        loaded.reset()
        assert np.array_equal(path(loaded), expected)


def test_a_change_during_a_run_acts_from_the_next_step_on(sims):
    """Verlet must not reuse the acceleration of the last step."""
    sim, _ = sims
    if not sim.settings.explicit:
        pytest.skip("BDF2 depends on the step before the change")
    change(sim, FIRST)
    sim.reset()
    path(sim, 3)
    x, v = sim.positions(), sim.velocities()
    change(sim)
    after = path(sim, 2)
    sim.reset()
    sim.set_state(x, v)
    assert np.array_equal(path(sim, 2), after)


@pytest.mark.parametrize("integrator", DT)
def test_the_drag_force_is_added_to_changed_loads(integrator):
    with dynamics(beam(), dt=DT[integrator], integrator=integrator, precision="f64", draggable=True) as d:
        body, loads = d.scene.body("beam"), d.model.loads
        first = loads.to_numpy()
        d.drag_spring.take(1, body.forces[0].nodes, np.ones(4), (3.0, 1.0, 0.0), 50.0)
        d.advance(1)
        drag = loads.to_numpy() - first
        assert np.abs(drag).max() > 1e-3
        for kind, index, value in zip(("force", "force", "traction"), (0, 1, 0), NEXT):
            change_load(body, kind, index, value)
        d.loads_changed()
        both = loads.to_numpy()
        d.end_drag()
        new = loads.to_numpy()
        assert np.allclose(both, new + drag, rtol=0, atol=1e-12) and np.abs(new - first).max() > 1.0


def test_a_change_of_the_density_keeps_total_forces(sims):
    """Also during a drag. A total force is distributed over its nodes by mass."""
    sim, expected = sims
    with ts.Simulator(beam(NEXT, 1500.0), dt=sim.dt, integrator=sim.settings.integrator, precision="f64") as reference:
        denser = path(reference)
    change(sim)
    sim.reset()
    sim.drag("beam", sim.scene.body("beam").forces[0].nodes, np.ones(4), (3.0, 1.0, 0.0), 50.0)
    sim.step()
    sim.set_material("beam", density=1500.0)
    sim.release()
    sim.reset()
    assert np.allclose(path(sim), denser, rtol=0, atol=1e-12) and np.abs(denser - expected).max() > 1e-6
    sim.set_material("beam", density=1000.0)
    sim.reset()
    assert np.array_equal(path(sim), expected)


def test_arrows_of_tractions_follow(sims):
    sim, _ = sims
    change(sim, FIRST)
    layers = Layers(sim.scene, ("tractions",))
    camera = Camera(target=np.zeros(3), distance=10.0, azimuth=30.0, elevation=20.0)
    up = layers.lines(sim, camera)[0]
    sim.set_traction("beam", 0, (0, -30, 0))
    down = layers.lines(sim, camera)[0]
    assert up.shape == down.shape and np.abs(up - down).max() > 0.1


@pytest.mark.parametrize(
    "call, message",
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
            lambda s: s.set_force("unloaded", 0, (0, 0, 0)),
            "body 'unloaded': set_force: it has no force: give it one of 0 by body.add_force",
        ),
        (
            lambda s: s.set_traction("unloaded", 0, (0, 0, 0)),
            "set_traction: it has no traction: give it one of 0 by body.add_traction",
        ),
        (lambda s: s.set_traction("beam", 0, PER_NODE), r"traction 0 must have shape \(3,\), not \(4, 3\)"),
        (lambda s: s.set_force("bean", 0, (0, 0, 0)), "no body is called 'bean'; did you mean 'beam'"),
    ],
)
def test_invalid_loads_are_refused(sims, call, message):
    sim, _ = sims
    before = [load.value for load in sim.scene.body("beam").forces]
    with pytest.raises(SceneError, match=message):
        call(sim)
    assert all(load.value is value for load, value in zip(sim.scene.body("beam").forces, before))


def test_loads_of_a_scene_without_loads_or_of_a_closed_simulator_are_refused():
    scene = ts.Scene()
    scene.add_body(ts.box_mesh((1, 1, 1), (1, 1, 1)), rubber(), name="unloaded")
    sim = ts.Simulator(scene, dt=5e-4, integrator="velocity_verlet", precision="f64")
    with sim, pytest.raises(SceneError, match="it has no force"):
        sim.set_force("unloaded", 0, (1, 0, 0))
    with pytest.raises(ts.SimulationError, match="closed"):
        sim.set_force("unloaded", 0, (1, 0, 0))
