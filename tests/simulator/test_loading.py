"""Loads, tensions and lengths that change while a simulator runs act bitwise as loads from the start; they survive a reset, a
rebuild and a checkpoint; a change of the density keeps total forces; invalid changes are refused.
"""

import numpy as np
import pytest

import taisoft as ts
from taisoft.backend.runtime import compile_clock
from taisoft.checkpoint import read_checkpoint
from taisoft.errors import SceneError
from tests.dynamics.companion import add_companion
from tests.dynamics.scenes import rubber

FIRST = [(0.0, 0.0, 0.0), (1.0, 2.0, 0.0), (0.0, 30.0, 0.0), 50.0, 4.0, 1.0]  # forces, traction, pressure, tension, length
PER_NODE = np.arange(12.0).reshape(4, 3)  # [N] of the second force
NEXT = [(0.0, -20.0, 5.0), PER_NODE, (0.0, 0.0, 700.0), 2e3, 300.0, 0.8]
DT = {"velocity_verlet": 5e-4, "bdf2": 5e-3}


def beam(loads=FIRST, density: float = 1000.0, end: float = 1e4) -> ts.Scene:
    """With loads that change, and a force and the end of a spring along paths; end: of the force [N]."""
    scene = ts.Scene()
    scene.contact_forces = False
    scene.add_body(ts.box_mesh((1, 1, 1), (1, 1, 1), (5, 0, 0)), rubber(density=density), name="unloaded")
    body = scene.add_body(ts.box_mesh((3, 1, 1), (3, 1, 1)), rubber(mass_damping=0.1, density=density), name="beam")
    body.fix(lambda X: X[:, 0] < -1.4)
    body.add_force(lambda X: X[:, 0] > 1.4, loads[0])
    body.add_force(lambda X: X[:, 0] > 1.4, loads[1])
    body.add_traction(lambda c: c[:, 1] > 0.4, loads[2])
    body.add_pressure(lambda c: c[:, 1] > 0.4, loads[3])
    body.add_force(lambda X: X[:, 0] > 1.4, ts.KeyFrames((0, 1), [(0, 0, 0), (end, 2e4, 0)]))
    lift = ts.KeyFrames((0.0, 1.0), translations=[(0, 0, 0), (0, 20, 0)])
    scene.add_obstacle(ts.Sphere((0, 9, 0), 1.0), name="lift", path=lift)
    scene.add_spring(("beam", 9), ("lift", (0, 8, 0)), 1e3, damping=5.0, name="hook")
    scene.add_tendon([("beam", (1.5, 0.5, 0.0)), ("unloaded", (4.5, 0.5, 0.0))], loads[4], name="rope")
    scene.add_tendon([("beam", (1.5, 0, 0.5)), ("beam", (0.5, 0, 0.5))], length=loads[5], stiffness=1e3, name="band")
    return add_companion(scene)


def change(sim, loads=NEXT) -> None:
    for index, value in enumerate(loads[:2]):
        sim.set_force("beam", index, value)
    sim.set_traction("beam", 0, loads[2])
    sim.set_pressure("beam", 0, loads[3])
    sim.set_tension("rope", loads[4])
    sim.set_length("band", loads[5])


def path(sim, steps: int = 6) -> np.ndarray:
    return np.array([(sim.step(), sim.positions())[1] for _ in range(steps)])


@pytest.fixture(scope="module", params=DT)
def shared_sims(request):
    """A simulator whose loads change, and the path of another that had the new loads from the start."""
    settings = {"dt": DT[request.param], "integrator": request.param, "precision": "f64", "draggable": True}
    with ts.Simulator(beam(NEXT), **settings) as reference:
        expected = path(reference)
    with ts.Simulator(beam(), **settings) as sim:
        yield sim, expected


@pytest.fixture
def sims(shared_sims):
    sim, expected = shared_sims
    change(sim, FIRST)
    sim.reset()
    return sim, expected


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
    if sim.settings.explicit:  # Verlet must not reuse the acceleration of the last step; BDF2 depends on the step before
        ends = []
        for is_set in (False, True):
            change(sim, FIRST)
            sim.reset()
            path(sim, 3)
            change(sim)
            if is_set:
                sim.set_state(sim.positions(), sim.velocities())
            ends.append(path(sim, 2))
        assert np.array_equal(*ends)


def test_checkpoints_and_rebuilt_simulators_keep_changed_loads(sims, tmp_path):
    sim, expected = sims
    change(sim)
    sim.reset()
    path(sim, 3)
    sim.save_checkpoint(tmp_path / "c.npz")
    late, names = path(sim, 3), ("rope", "band", "hook")
    numbers = sim.energies().loads, *(sim.joint_force(name) for name in names)
    assert np.array_equal(late, expected[3:]) and numbers[1] == NEXT[4]
    with pytest.raises(SceneError, match="beam.traction.0 is .0.0, 0.0, 700.0. in this scene and was .0.0, 30.0, 0.0. at"):
        ts.Simulator.load_checkpoint(tmp_path / "c.npz", beam(NEXT))
    with pytest.raises(SceneError, match="differs in body 'beam': loads"):
        ts.Simulator.load_checkpoint(tmp_path / "c.npz", beam(end=2e4))
    other = beam()
    other.add_spring(("beam", 0), ("beam", 9), 1.0, name="new")
    with pytest.raises(SceneError, match="differs in spring 'new'"):
        ts.Simulator.load_checkpoint(tmp_path / "c.npz", other)
    with ts.Simulator.load_checkpoint(tmp_path / "c.npz", beam()) as loaded:
        assert np.array_equal(path(loaded, 3), late)
        assert numbers == (loaded.energies().loads, *(loaded.joint_force(name) for name in names))
        assert loaded.scene.body("beam").forces[0].value.tolist() == list(NEXT[0])
        loaded.rebuild(dt=loaded.dt)
        loaded.save_checkpoint(tmp_path / "d.npz")  # the initial loads stay those of the scene
        assert read_checkpoint(tmp_path / "d.npz").start == read_checkpoint(tmp_path / "c.npz").start
        loaded.reset()
        assert np.array_equal(path(loaded), expected)


def test_a_change_of_the_density_keeps_total_forces(sims):
    """Also during a drag. A total force is distributed over its nodes by mass."""
    sim, expected = sims
    with ts.Simulator(beam(NEXT, 1500.0), dt=sim.dt, integrator=sim.settings.integrator, precision="f64") as reference:
        denser = path(reference)
    change(sim)
    sim.reset()
    sim.drag("beam", sim.scene.body("beam").forces[0].nodes, np.ones(4), (3.0, 1.0, 0.0), 50.0)
    sim.step()
    for name in ("beam", "unloaded"):
        sim.set_material(name, density=1500.0)
    sim.release()
    sim.reset()
    assert np.allclose(path(sim), denser, rtol=0, atol=1e-12) and np.abs(denser - expected).max() > 1e-6
    for name in ("beam", "unloaded"):
        sim.set_material(name, density=1000.0)
    sim.reset()
    assert np.array_equal(path(sim), expected)


INVALID = [
    (lambda s: s.set_force("beam", 3, (0, 0, 0)), "body 'beam': set_force: index must be a whole number from 0 to 2, not 3"),
    (lambda s: s.set_force("beam", 1, np.zeros((3, 3))), r"set_force: force 1 must have shape \(3,\) or \(4, 3\), not \(3, 3\)"),
    (lambda s: s.set_force("unloaded", 0, (0, 0, 0)), "body 'unloaded': set_force: it has no force: give it one of 0 by"),
    (lambda s: s.set_traction("beam", 0, PER_NODE), r"traction 0 must have shape \(3,\), not \(4, 3\)"),
    (lambda s: s.scene.body("beam").add_pressure([0], 1.0), "call sim.set_pressure"),
    (lambda s: s.set_tension("rope", -1.0), "tendon 'rope': force must be at least 0 N, not -1: a tendon cannot push"),
    (lambda s: s.set_tension("rop", 1.0), r"^set_tension: no tendon is called 'rop' \(did you mean rope\?\); there are "),
    (lambda s: s.set_tension("band", 1.0), "^set_tension: tendon 'band' has a given length: call set_length$"),
    (lambda s: s.set_length("band", -1.0), "^tendon 'band': length must be above 0 m, not -1$"),
    (lambda s: s.set_length("rope", 1.0), "^set_length: tendon 'rope' has a given force: call set_tension$"),
]


def test_invalid_changes_are_refused(sims):
    sim, _ = sims
    before = [*sim.scene.body("beam").loads, *sim.scene.tendons]
    for call, message in INVALID:
        with pytest.raises(SceneError, match=message):
            call(sim)
    assert all(now is then for now, then in zip([*sim.scene.body("beam").loads, *sim.scene.tendons], before))
