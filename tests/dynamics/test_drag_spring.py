"""Dragging a body at a point:

* a dragged beam comes to rest at the static equilibrium under the same force, and returns after the release;
* the stiffest spring and a far target stay stable: no tet inverts, and the force keeps its limit;
* without `draggable` nothing is allocated, and drag is refused; a drag that has ended leaves no trace;
* a drag compiles nothing.
"""

import numpy as np
import pytest

import taisoft as ts
from taisoft.backend.runtime import compile_clock
from taisoft.dynamics.drag_spring import HEAVY, SOFT, STRAIN
from taisoft.errors import SceneError, SimulationError

RUBBER = ts.Material(law="stable_neo_hookean", young=1e6, poisson=0.3, density=1000.0, mass_damping=8.0)
SETTINGS = {"implicit_euler": 0.02, "bdf2": 0.02, "implicit_midpoint": 0.02, "velocity_verlet": 1e-3, "symplectic_euler": 1e-3}


def beam(order=1):
    scene = ts.Scene(gravity=(0, 0, 0))
    body = scene.add_body(ts.box_mesh((6, 2, 2), (2, 0.5, 0.5)), RUBBER, name="beam", order=order)
    body.fix(lambda X: X[:, 0] < -0.99)
    return scene, np.flatnonzero(body.rest_positions[:, 0] > 0.99)


CASES = [("implicit_euler", 1), ("bdf2", 2), ("velocity_verlet", 1)]


@pytest.mark.parametrize("integrator, order", CASES)
def test_rests_at_the_static_equilibrium_and_returns(integrator, order):
    scene, tip = beam(order)
    rest = scene.bodies[0].rest_positions
    start = rest[tip].mean(axis=0)
    target = start + (0, 0.1, 0.15)
    with ts.Simulator(scene, dt=SETTINGS[integrator], integrator=integrator, draggable=True) as sim:
        if sim.settings.explicit:
            sim.dt = 0.5 * sim.stable_dt
        sim.drag("beam", tip, np.ones(len(tip)), target, 15000.0)
        sim.run(2.0, fps=20)
        drag, dragged = sim.dragged, sim.positions()
        assert np.allclose(drag.force, 15000.0 * (target - dragged[tip].mean(axis=0)), rtol=0.01, atol=0.5)
        moved, pull = dragged[tip].mean(axis=0) - start, target - start
        assert 0.2 < moved @ pull / (pull @ pull) < 0.95
        sim.release()
        sim.run(2.0, fps=20)
        assert np.abs(sim.positions() - rest).max() < 0.003
    still, _ = beam(order)
    still.bodies[0].add_force(tip, np.outer(np.full(len(tip), 1 / len(tip)), drag.force))
    static = ts.solve_static(still, precision="f32", tolerance=1e-4)
    assert np.abs(static.positions("beam") - dragged).max() < 0.02 * np.linalg.norm(moved)


@pytest.mark.parametrize("integrator", SETTINGS)
def test_the_stiffest_spring_is_stable(integrator):
    scene, tip = beam()
    corner = tip[:1]
    with ts.Simulator(scene, dt=SETTINGS[integrator], integrator=integrator, draggable=True) as sim:
        if sim.settings.explicit:
            sim.dt = 0.9 * sim.stable_dt
        target = scene.bodies[0].rest_positions[corner[0]] + (0, 0.1, 0)
        sim.drag("beam", corner, [2.0], target, 1e12)
        energies = []
        for _ in range(40):
            assert sim.run(0.05, fps=20).status == "ok"
            assert np.linalg.norm(sim.dragged.force) <= 1.0001 * sim.dragged.max_force
            energies.append(sim.energies().kinetic + sim.energies().elastic)
        assert sim.energies().kinetic < 0.05 * sim.energies().elastic, "it comes to rest"
        assert np.linalg.norm(sim.positions()[corner[0]] - target) < 0.09
        drag, held = sim.dragged, sim.dt * sim.advance(1000).steps  # [s] over which the force is held: steps of one launch
        assert max(energies) < 0.5 * SOFT * drag.mass / held**2 * 0.1**2, "at most the initial energy of the spring"


@pytest.mark.parametrize("integrator", ["implicit_euler", "symplectic_euler"])
def test_a_far_target_inverts_no_tet(integrator):
    scene, tip = beam()
    with ts.Simulator(scene, dt=SETTINGS[integrator], integrator=integrator, draggable=True) as sim:
        if sim.settings.explicit:
            sim.dt = 0.5 * sim.stable_dt
        for far in ((9.0, 50.0, 0.0), (-90.0, 0.0, 0.0)):
            sim.drag("beam", tip[:3], np.ones(3), far, 1e12)
            for _ in range(10):
                result = sim.run(0.05, fps=20)
                assert result.status != "failed"
                assert all(step.n_inverted == 0 for step in result.step_reports)
            drag, mass = sim.dragged, 1000.0 * 0.5
            assert np.linalg.norm(drag.force) <= 1.0001 * min(HEAVY * 9.81 * mass, STRAIN * 1e6 * (drag.mass / 1000.0) ** (2 / 3))
            assert np.abs(sim.positions()).max() < 5.0


@pytest.mark.parametrize("integrator", ["implicit_euler", "velocity_verlet"])
def test_a_drag_compiles_nothing_and_leaves_no_trace(integrator):
    ends = []
    for dragged in (False, True):
        scene, tip = beam()
        scene.gravity = (0, -1, 0)
        with ts.Simulator(scene, dt=1e-3, integrator=integrator, draggable=True) as sim:
            sim.advance(4)
            if dragged:
                compiled = compile_clock()
                sim.drag("beam", tip, np.ones(len(tip)), (1, 1, 0), 100.0)
                sim.advance(4)
                assert compile_clock() == compiled and np.linalg.norm(sim.dragged.force) > 0
                sim.reset()
                assert sim.dragged is None
                sim.advance(4)
            ends.append(sim.positions())
    assert np.array_equal(*ends)


def test_drag_is_refused_unless_draggable():
    scene, tip = beam()
    with ts.Simulator(scene, dt=0.01) as sim:
        assert not sim.plan.on["loads"] and "loads" not in sim.field_bytes
        sim.release()
        with pytest.raises(SimulationError, match="draggable=True"):
            sim.drag("beam", tip, np.ones(len(tip)), (0, 0, 0), 1.0)
    with ts.Simulator(scene, dt=0.01, draggable=True) as sim:
        entry = next(e for e in sim.plan.entries if e["feature"] == "loads")
        assert entry["on"] and entry["why"] == "bodies can be dragged"
        for nodes, weights, target, message in (
            ([99999], [1.0], (0, 0, 0), "from 0 to"),
            ([0], [1.0, 1.0], (0, 0, 0), "weights"),
            ([0], [-1.0], (0, 0, 0), "weights"),
            ([0], [1.0], (0, np.nan, 0), "target"),
        ):
            with pytest.raises(SceneError, match=message):
                sim.drag("beam", nodes, weights, target, 1.0)
    with pytest.raises(SimulationError, match="draggable must be True or False, not 1"):
        ts.Simulator(scene, draggable=1)
