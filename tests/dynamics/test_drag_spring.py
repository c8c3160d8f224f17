"""Dragging a body at a point (nodes that are attached to others: test_attachments):

* a dragged beam comes to rest where its reactions balance the drag, and returns after the release;
* the stiffest spring and a far target stay stable: no tet inverts, and the force keeps its limit;
* a drag compiles nothing and leaves no trace; without `draggable` nothing is allocated, and drag is refused.
"""

import numpy as np
import pytest

import taisoft as ts
from taisoft.backend.runtime import compile_clock
from taisoft.errors import SceneError, SimulationError
from tests.dynamics.contact_scenes import material

DT = {"implicit_euler": 0.02, "velocity_verlet": 1e-3, "symplectic_euler": 1e-3}  # [s]


@pytest.fixture
def beam(request):
    """A simulator of a beam held at its left end, and the nodes of its tip."""
    integrator, scene = request.param, ts.Scene(gravity=(0, 0, 0))
    body = scene.add_body(ts.box_mesh((6, 2, 2), (2, 0.5, 0.5)), material(young=1e6, mass_damping=8.0), name="beam")
    body.fix(lambda X: X[:, 0] < -0.99)
    with ts.Simulator(scene, DT[integrator], integrator, precision="f64", draggable=True) as sim:
        if sim.settings.explicit:
            sim.dt = 0.7 * sim.stable_dt
        yield sim, np.flatnonzero(body.rest_positions[:, 0] > 0.99)


def by(*integrators: str):
    return pytest.mark.parametrize("beam", integrators, indirect=True)


@by("implicit_euler", "velocity_verlet")
def test_rests_in_balance_with_the_drag_and_returns(beam):
    (sim, tip), rest = beam, beam[0].positions()
    weights = np.linspace(1.0, 2.0, len(tip))
    shares = weights / weights.sum()
    start, pull = shares @ rest[tip], np.array([0, 0.1, 0.15])
    sim.drag("beam", tip, weights, start + pull, 15000.0)
    sim.run(1.5, fps=20)
    force, x, reactions = sim.dragged.force, sim.positions(), sim.reactions()
    moved, close = shares @ x[tip] - start, 0.02 * np.linalg.norm(force)
    assert np.allclose(force, 15000.0 * (pull - moved), rtol=0.01, atol=0.5)
    assert 0.2 < moved @ pull / (pull @ pull) < 0.95
    assert np.abs(reactions.sum(axis=0) + force).max() < close
    assert np.abs(np.cross(x, reactions).sum(axis=0) + np.cross(shares @ x[tip], force)).max() < close
    sim.release()
    sim.run(1.5, fps=20)
    assert np.abs(sim.positions() - rest).max() < 0.003


@by("implicit_euler", "symplectic_euler")
def test_the_stiffest_spring_is_stable(beam):
    """Far targets, too."""
    sim, tip = beam
    target, energies = sim.positions()[tip[0]] + (0, 0.1, 0), []
    sim.drag("beam", tip[:1], [2.0], target, 1e12)
    for _ in range(30):
        assert sim.run(0.05, fps=20).status == "ok"
        energies.append(sim.energies().kinetic + sim.energies().elastic)
    assert sim.energies().kinetic < 0.05 * sim.energies().elastic, "it comes to rest"
    assert np.linalg.norm(sim.positions()[tip[0]] - target) < 0.09
    drag, held = sim.dragged, sim.dt * sim.advance(1000).steps  # [s] over which the force is held: steps of one launch
    assert max(energies) < 0.5 * 0.5 * drag.mass / held**2 * 0.1**2, "at most the initial energy of the softened spring"
    for far in ((9.0, 50.0, 0.0), (-90.0, 0.0, 0.0)):
        sim.drag("beam", tip[:3], np.ones(3), far, 1e12)
        for _ in range(6):
            result = sim.run(0.05, fps=20)
            assert result.status != "failed" and all(step.n_inverted == 0 for step in result.step_reports)
        drag, weight = sim.dragged, 9.81 * 1000.0 * 0.5
        allowed = min(20.0 * weight, 0.25 * 1e6 * (drag.mass / 1000.0) ** (2 / 3))  # [N] 0.25 young times the dragged area
        assert 0 < np.linalg.norm(drag.force) <= 1.0001 * allowed and np.abs(sim.positions()).max() < 5.0


@by("implicit_euler", "velocity_verlet")
def test_a_drag_compiles_nothing_and_leaves_no_trace(beam):
    sim, tip = beam
    sim.set_gravity((0, -1, 0))
    sim.dt = 1e-3
    sim.advance(4)
    expected, compiled = sim.positions(), compile_clock()
    sim.drag("beam", tip, np.ones(len(tip)), (1, 1, 0), 100.0)
    sim.advance(4)
    assert compile_clock() == compiled and np.linalg.norm(sim.dragged.force) > 0
    sim.reset()
    assert sim.dragged is None
    sim.advance(4)
    assert np.array_equal(sim.positions(), expected)


@by("implicit_euler")
def test_drag_is_refused_unless_draggable(beam):
    sim, scene = beam[0], beam[0].scene
    assert sim.plan.on["loads"] and sim.plan.why("loads") == "bodies can be dragged"
    for nodes, weights, target, message in (
        ([99999], [1.0], (0, 0, 0), "nodes to pull at: node 99999 does not exist"),
        ([0, 1, 1], np.ones(3), (0, 0, 0), "nodes to pull at: 3 node ids that are all 0 or 1 are a mask"),
        *(([0], weights, (0, 0, 0), "weights") for weights in ([1.0, 1.0], [-1.0])),
        ([0], [1.0], (0, np.nan, 0), "target"),
    ):
        with pytest.raises(SceneError, match=message):
            sim.drag("beam", nodes, weights, target, 1.0)
    with ts.Simulator(scene, dt=0.01, precision="f64") as other:
        assert not other.plan.on["loads"] and "loads" not in other.field_bytes
        other.release()
        with pytest.raises(SimulationError, match="draggable=True"):
            other.drag("beam", [0], [1.0], (0, 0, 0), 1.0)
    with pytest.raises(SimulationError, match="draggable must be True or False, not 1"):
        ts.Simulator(scene, draggable=1)
