"""Loads, tensions and lengths that change while a simulator runs:

* steps are bitwise those of a simulator whose scene had the loads from the start, also if they were 0;
* loads survive a reset, a rebuild and a checkpoint, which needs the scene with the initial loads; a drag force is added to them;
* checkpoints resume bitwise, also of loads along paths, and refuse scenes with other loads or connections;
* a change of the density keeps total forces; the user's scene does not change;
* missing loads, invalid indices and invalid values are refused, and nothing changes.
"""

import numpy as np
import pytest

import taisoft as ts
from taisoft.backend.runtime import compile_clock
from taisoft.checkpoint import read_checkpoint
from taisoft.errors import SceneError
from taisoft.scene.plan import change_load
from tests.dynamics.companion import add_companion
from tests.dynamics.scenes import dynamics, rubber

FIRST = [(0.0, 0.0, 0.0), (1.0, 2.0, 0.0), (0.0, 30.0, 0.0), 50.0, 4.0, 1.0]  # forces, traction, pressure, tension, length
PER_NODE = np.arange(12.0).reshape(4, 3)  # [N] of the second force
NEXT = [(0.0, -20.0, 5.0), PER_NODE, (0.0, 0.0, 700.0), 2e3, 300.0, 0.8]
DT = {"velocity_verlet": 5e-4, "bdf2": 5e-3}


def beam(loads=FIRST, density: float = 1000.0) -> ts.Scene:
    scene = ts.Scene()
    scene.contact_forces = False
    scene.add_body(ts.box_mesh((1, 1, 1), (1, 1, 1), (5, 0, 0)), rubber(density=density), name="unloaded")
    body = scene.add_body(ts.box_mesh((3, 1, 1), (3, 1, 1)), rubber(mass_damping=0.1, density=density), name="beam")
    body.fix(lambda X: X[:, 0] < -1.4)
    body.add_force(lambda X: X[:, 0] > 1.4, loads[0])
    body.add_force(lambda X: X[:, 0] > 1.4, loads[1])
    body.add_traction(lambda c: c[:, 1] > 0.4, loads[2])
    body.add_pressure(lambda c: c[:, 1] > 0.4, loads[3])
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
    change(sim)
    sim.reset()
    path(sim, 3)
    sim.save_checkpoint(tmp_path / "c.npz")
    with pytest.raises(SceneError, match="body 'beam': force 0 is .0.0, -20.0, 5.0. in this scene and was .0.0, 0.0, 0.0. at"):
        ts.Simulator.load_checkpoint(tmp_path / "c.npz", beam(NEXT))
    for k, message in (
        (3, "body 'beam': pressure 0 is"),
        (4, "tendon 'rope': force is 300.0 in"),
        (5, "tendon 'band': length is"),
    ):
        with pytest.raises(SceneError, match=message):
            ts.Simulator.load_checkpoint(tmp_path / "c.npz", beam([*FIRST[:k], NEXT[k], *FIRST[k + 1 :]]))
    other = beam()
    other.add_spring(("beam", 0), ("beam", 9), 1.0, name="new")
    with pytest.raises(SceneError, match="differs in spring 'new'"):
        ts.Simulator.load_checkpoint(tmp_path / "c.npz", other)
    with ts.Simulator.load_checkpoint(tmp_path / "c.npz", beam()) as loaded:
        assert np.array_equal(path(loaded, 3), expected[3:])
        assert loaded.scene.body("beam").forces[0].value.tolist() == list(NEXT[0])
        loaded.rebuild(dt=loaded.dt)
        loaded.save_checkpoint(tmp_path / "d.npz")  # the initial loads stay those of the scene
        assert read_checkpoint(tmp_path / "d.npz").start == read_checkpoint(tmp_path / "c.npz").start
        loaded.reset()
        assert np.array_equal(path(loaded), expected)


@pytest.mark.parametrize("integrator", DT)
def test_checkpoints_of_paths_resume_bitwise(integrator, tmp_path):
    """In the middle of the paths, of which some have been replaced by values; an obstacle carries the end of a spring."""

    def scene(last=1e6) -> ts.Scene:
        rises = [ts.KeyFrames((0, 1), [(0, 0, 0), (1e4 * k, 2e4, 0)]) for k in range(3)]
        made = beam([*rises, *(ts.KeyFrames((0, 1), values=(1.0, end)) for end in (last, 3e4, 0.5))])
        lift = ts.KeyFrames((0.0, 1.0), translations=[(0, 0, 0), (0, 20, 0)])
        made.add_obstacle(ts.Sphere((0, 9, 0), 1.0), name="lift", path=lift)
        made.add_spring(("beam", 9), ("lift", (0, 8, 0)), 1e3, damping=5.0, name="hook")
        return made

    with ts.Simulator(scene(), dt=DT[integrator], integrator=integrator, precision="f64") as sim:
        path(sim, 2)
        sim.set_force("beam", 0, (5.0, 6.0, 7.0))
        sim.set_tension("rope", 35.0)
        path(sim, 2)
        sim.save_checkpoint(tmp_path / "c.npz")
        expected, joint = path(sim, 3), [sim.joint_force(name) for name in ("rope", "band", "hook")]
        numbers = sim.energies().loads, sim.velocities()
    with ts.Simulator.load_checkpoint(tmp_path / "c.npz", scene()) as sim:
        assert [load.path is None for load in sim.scene.body("beam").loads].count(True) == 1
        assert np.array_equal(path(sim, 3), expected) and sim.energies().loads == numbers[0]
        assert np.array_equal(sim.velocities(), numbers[1])
        assert [sim.joint_force(name) for name in ("rope", "band", "hook")] == joint and joint[0] == 35.0
    with pytest.raises(SceneError, match="differs in body 'beam': loads"):
        ts.Simulator.load_checkpoint(tmp_path / "c.npz", scene(2e6))


def test_a_change_during_a_run_acts_from_the_next_step_on(sims):
    """Verlet must not reuse the acceleration of the last step; BDF2 depends on the step before the change."""
    sim, _ = sims
    if sim.settings.explicit:
        change(sim, FIRST)
        sim.reset()
        path(sim, 3)
        x, v = sim.positions(), sim.velocities()
        change(sim)
        after = path(sim, 2)
        sim.reset()
        sim.set_state(x, v)
        assert np.array_equal(path(sim, 2), after)


def test_the_drag_force_is_added_to_changed_loads():
    with dynamics(beam(), dt=5e-4, integrator="velocity_verlet", precision="f64", draggable=True) as d:
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
    (lambda s: s.set_force("beam", 2, (0, 0, 0)), "body 'beam': set_force: index must be a whole number from 0 to 1, not 2"),
    (lambda s: s.set_force("beam", -1, (0, 0, 0)), "from 0 to 1, not -1"),
    (lambda s: s.set_force("beam", True, (0, 0, 0)), "from 0 to 1, not True"),
    (lambda s: s.set_force("beam", 1, np.zeros((3, 3))), r"set_force: force 1 must have shape \(3,\) or \(4, 3\), not \(3, 3\)"),
    (lambda s: s.set_force("beam", 0, (0, np.nan, 0)), r"force 0: entry \[1\] is nan, not finite"),
    (lambda s: s.set_force("unloaded", 0, (0, 0, 0)), "body 'unloaded': set_force: it has no force: give it one of 0 by"),
    (lambda s: s.set_traction("unloaded", 0, (0, 0, 0)), "set_traction: it has no traction: give it one of 0"),
    (lambda s: s.set_traction("beam", 0, PER_NODE), r"traction 0 must have shape \(3,\), not \(4, 3\)"),
    (lambda s: s.set_force("bean", 0, (0, 0, 0)), "no body is called 'bean'; did you mean 'beam'"),
    (lambda s: s.set_pressure("beam", 0, (0, 0, 1)), "body 'beam': set_pressure: pressure 0 must be a number, not of shape .3,."),
    (lambda s: s.set_pressure("beam", 1, 1.0), "set_pressure: index must be"),
    (lambda s: s.scene.body("beam").add_pressure([0], 1.0), "call sim.set_pressure"),
    (lambda s: s.set_tension("rope", -1.0), "tendon 'rope': force must be at least 0 N, not -1: a tendon cannot push"),
    (lambda s: s.set_tension("rop", 1.0), r"^set_tension: no tendon is called 'rop' \(did you mean rope\?\)$"),
    (lambda s: s.set_tension("band", 1.0), "^set_tension: tendon 'band' has a given length: call set_length$"),
    (lambda s: s.set_length("band", -1.0), "^tendon 'band': length must be above 0 m, not -1$"),
    (lambda s: s.set_length("ban", 1.0), r"^set_length: no tendon is called 'ban' \(did you mean band\?\)$"),
    (lambda s: s.set_length("rope", 1.0), "^set_length: tendon 'rope' has a given force: call set_tension$"),
]


def test_invalid_changes_are_refused(sims):
    sim, _ = sims
    before = [*sim.scene.body("beam").loads, *sim.scene.tendons]
    for call, message in INVALID:
        with pytest.raises(SceneError, match=message):
            call(sim)
    assert all(now is then for now, then in zip([*sim.scene.body("beam").loads, *sim.scene.tendons], before))


def test_changes_of_a_closed_simulator_are_refused():
    sim = ts.Simulator(beam(), dt=5e-4, integrator="velocity_verlet", precision="f64")
    sim.close()
    for call in (lambda: sim.set_force("beam", 0, (1, 0, 0)), lambda: sim.joint_force("rope")):
        with pytest.raises(ts.SimulationError, match="closed"):
            call()
