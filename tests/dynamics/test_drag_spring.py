"""Dragging a body at a point:

* a dragged beam comes to rest where its reactions balance the drag, and returns after the release;
* the stiffest spring and a far target stay stable: no tet inverts, and the force keeps its limit;
* without `draggable` nothing is allocated, and drag is refused; a drag that has ended leaves no trace;
* a drag compiles nothing.
"""

import numpy as np
import pytest

import taisoft as ts
from taisoft.backend.runtime import compile_clock
from taisoft.errors import SceneError, SimulationError
from tests.dynamics.contact_scenes import material

SETTINGS = {"implicit_euler": 0.02, "velocity_verlet": 1e-3, "symplectic_euler": 1e-3}


def beam() -> tuple[ts.Scene, np.ndarray]:
    """A beam held at its left end, and the nodes of its tip."""
    scene = ts.Scene(gravity=(0, 0, 0))
    rubber = material(young=1e6, mass_damping=8.0)
    body = scene.add_body(ts.box_mesh((6, 2, 2), (2, 0.5, 0.5)), rubber, name="beam")
    body.fix(lambda X: X[:, 0] < -0.99)
    return scene, np.flatnonzero(body.rest_positions[:, 0] > 0.99)


def simulator(scene: ts.Scene, integrator: str, fraction: float = 0.5) -> ts.Simulator:
    """fraction: of the stable dt, for explicit steps."""
    sim = ts.Simulator(scene, dt=SETTINGS[integrator], integrator=integrator, precision="f64", draggable=True)
    if sim.settings.explicit:
        sim.dt = fraction * sim.stable_dt
    return sim


@pytest.mark.parametrize("integrator", ["implicit_euler", "velocity_verlet"])
def test_rests_in_balance_with_the_drag_and_returns(integrator):
    scene, tip = beam()
    rest, weights = scene.bodies[0].rest_positions, np.linspace(1.0, 2.0, len(tip))
    shares = weights / weights.sum()
    start = shares @ rest[tip]
    target = start + (0, 0.1, 0.15)
    with simulator(scene, integrator) as sim:
        sim.drag("beam", tip, weights, target, 15000.0)
        sim.run(2.0, fps=20)
        force, x, reactions = sim.dragged.force, sim.positions(), sim.reactions()
        assert np.allclose(force, 15000.0 * (target - shares @ x[tip]), rtol=0.01, atol=0.5)
        moved, pull = shares @ x[tip] - start, target - start
        assert 0.2 < moved @ pull / (pull @ pull) < 0.95
        close = 0.02 * np.linalg.norm(force)
        assert np.abs(reactions.sum(axis=0) + force).max() < close
        assert np.abs(np.cross(x, reactions).sum(axis=0) + np.cross(shares @ x[tip], force)).max() < close
        sim.release()
        sim.run(2.0, fps=20)
        assert np.abs(sim.positions() - rest).max() < 0.003


@pytest.mark.parametrize("integrator", ["implicit_euler", "symplectic_euler"])
def test_the_stiffest_spring_is_stable(integrator):
    """Far targets, too."""
    scene, tip = beam()
    with simulator(scene, integrator, 0.9) as sim:
        target, energies = scene.bodies[0].rest_positions[tip[0]] + (0, 0.1, 0), []
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


@pytest.mark.parametrize("integrator", ["implicit_euler", "velocity_verlet"])
def test_a_drag_compiles_nothing_and_leaves_no_trace(integrator):
    scene, tip = beam()
    scene.gravity = (0, -1, 0)
    with simulator(scene, integrator) as sim:
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


def test_drag_is_refused_unless_draggable():
    scene, tip = beam()
    with ts.Simulator(scene, dt=0.01, precision="f64") as sim:
        assert not sim.plan.on["loads"] and "loads" not in sim.field_bytes
        sim.release()
        with pytest.raises(SimulationError, match="draggable=True"):
            sim.drag("beam", tip, np.ones(len(tip)), (0, 0, 0), 1.0)
    with simulator(scene, "implicit_euler") as sim:
        assert sim.plan.on["loads"] and sim.plan.why("loads") == "bodies can be dragged"
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
