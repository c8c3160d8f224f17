"""Bodies with Maxwell branches in time: every integrator keeps its order, and energies and dissipation add up; contacts, threads
and repeated steps change nothing; failures, resets, checkpoints and changed numbers have the right history (relaxation, creep and
hysteresis: `test_references`).
"""

from dataclasses import replace

import numpy as np
import pytest

import taisoft as ts
from taisoft.dynamics import explicit, implicit_stages
from taisoft.dynamics.contact_paths import ContactPaths
from taisoft.dynamics.dynamics import Dynamics
from taisoft.dynamics.part_check import BLOCKED, MET
from taisoft.dynamics.part_length import PartLength
from taisoft.dynamics.schemes import INTEGRATORS, SECOND_ORDER
from tests.dynamics.scenes import cube, dynamics, rubber, set_state, use_threads
from tests.dynamics.test_retries import patch_ways
from tests.simulator.scenes import follow
from tests.simulator.test_checkpoint import assert_same

BRANCHED = rubber(branches=((0.1, 0.5), (0.02, 0.3)))


def swinging(material=BRANCHED) -> ts.Scene:
    scene = ts.Scene(gravity=(0, 0, 0))
    scene.contact_forces = False
    scene.add_body(cube(), material, name="block").fix(lambda X: X[:, 1] < -0.44)
    return scene


def shear(sim: ts.Simulator) -> None:
    x = sim.positions()
    sim.set_state(positions=x + 0.1 * (x[:, 1:2] + 0.45) * [1.0, 0.0, 0.0])


@pytest.mark.parametrize("integrator", INTEGRATORS)
def test_integrators_keep_their_order_and_energies_add_up(integrator):
    """Of steps dt, dt/2 and dt/4. Midpoint and Verlet lose no energy but to the branches; the others damp by themselves."""
    ends, losses = [], []
    tight = {} if integrator in ("symplectic_euler", "velocity_verlet") else {"newton_tolerance": 1e-12}
    with ts.Simulator(swinging(), dt=1e-3, integrator=integrator, precision="f64", **tight) as sim:
        for dt in (4e-3, 2e-3, 1e-3):
            sim.reset()
            sim.dt = dt
            shear(sim)
            start = sim.energies()
            while sim.time < 0.1 - 1e-9:
                sim.step()
            ends.append(sim.positions())
            losses.append(start.total - sim.energies().total - sim.energies().dissipated)
    order, expected = np.log2(np.linalg.norm(ends[0] - ends[1]) / np.linalg.norm(ends[1] - ends[2])), nominal(integrator)
    assert order == pytest.approx(expected, abs=0.15)
    assert abs(losses[1] / losses[2]) > 1.8**expected and abs(losses[2]) < 0.03 * start.total
    if integrator in ("implicit_midpoint", "velocity_verlet"):
        assert abs(losses[2]) < 1e-4 * start.total


def nominal(integrator: str) -> int:
    return 2 if integrator in SECOND_ORDER else 1


@pytest.mark.parametrize("integrator", ["symplectic_euler", "velocity_verlet"])
def test_explicit_steps_are_alike_alone_on_threads_and_with_contacts(integrator, monkeypatch):
    def end(touches: bool) -> list:
        scene = swinging()
        if touches:
            scene.contact_forces = True
            scene.add_obstacle(ts.HalfSpace((0, -9, 0), (0, 1, 0)))
        with ts.Simulator(scene, dt=2e-3, integrator=integrator, precision="f64") as sim:
            shear(sim)
            for _ in range(10):
                sim.step()
            return [sim.positions(), sim.stress(), sim.energies().dissipated]

    ends = [end(False), end(True)]
    use_threads(monkeypatch)
    ends.append(end(False))
    for other in ends[1:]:
        assert all(np.allclose(a, b, rtol=1e-12, atol=1e-10) for a, b in zip(other, ends[0])) and ends[0][2] > 1.0


def sheared(d: Dynamics) -> None:
    """As `shear`."""
    x = d.state.state()[0]
    set_state(d, x=x + 0.1 * (x[:, 1:2] + 0.45) * [1.0, 0.0, 0.0])
    d.state.move_branches(0.0)


@pytest.mark.parametrize("integrator", ["symplectic_euler", "velocity_verlet"])
def test_a_repeated_substep_begins_at_the_history_before_it(integrator, monkeypatch):
    """What is found on the way of an explicit sub-step with contacts repeats it; here nothing is found. What is held back has the
    strains of where it is."""
    scene = swinging()
    scene.contact_forces = True
    scene.add_obstacle(ts.HalfSpace((0, -9, 0), (0, 1, 0)))
    ends = []
    with dynamics(scene, dt=2e-3, integrator=integrator, precision="f64") as d:
        history = d.model.viscosity.history
        for ways in ([], [MET, MET], [BLOCKED]):
            d.reset()
            sheared(d)
            patch_ways(monkeypatch, ways)
            for _ in range(3):
                d.advance(1)
            ends.append([d.state.state()[0], history.to_numpy()])
            monkeypatch.undo()
        patch_ways(monkeypatch, [BLOCKED])
        monkeypatch.setattr(ContactPaths, "hold_back", lambda paths, x: d.state.set_state(x.to_numpy(), d.state.velocities()))
        d.advance(1)
        held = history.to_numpy()
        d.state.move_branches(0.0)
        assert np.allclose(history.to_numpy(), held, rtol=1e-12, atol=1e-14)
    for other in ends[1:]:
        assert all(np.allclose(a, b, rtol=1e-12, atol=1e-12) for a, b in zip(other, ends[0]))


@pytest.mark.parametrize("integrator", ["implicit_euler", "bdf2", "implicit_midpoint"])
def test_a_step_in_parts_equals_as_many_steps(integrator, monkeypatch):
    solve, calls = implicit_stages.solve, []

    def first_unconverged(system, stage):
        calls.append(stage.dt)
        return replace(solve(system, stage), converged=len(calls) > 1)

    with ts.Simulator(swinging(), dt=4e-3, integrator=integrator, precision="f64", newton_tolerance=1e-11) as sim:
        shear(sim)
        for _ in range(2):
            sim.step()
        expected = [sim.positions(), sim.stress(), sim.energies().dissipated]
        sim.reset()
        shear(sim)
        sim.dt = 8e-3
        monkeypatch.setattr(implicit_stages, "solve", first_unconverged)
        assert sim.step().substeps == 2 and calls == [8e-3, 4e-3, 4e-3]
        found = [sim.positions(), sim.stress(), sim.energies().dissipated]
    assert all(np.allclose(a, b, rtol=1e-8, atol=1e-6) for a, b in zip(found, expected)) and expected[2] > 1.0


@pytest.mark.parametrize("integrator", ["velocity_verlet", "implicit_euler"])
def test_an_interrupted_step_leaves_the_history_before_it(integrator, monkeypatch):
    advance = explicit.advance_alone

    def interrupted(*arguments):
        if integrator == "velocity_verlet":
            advance(*arguments)
        raise KeyboardInterrupt

    with dynamics(swinging(), dt=2e-3, integrator=integrator, precision="f64") as d:
        table = d.model.viscosity
        sheared(d)
        d.advance(1)
        before, dissipated = [table.history.to_numpy(), table.constants.to_numpy()], d.energies().dissipated
        monkeypatch.setattr(explicit, "advance_alone", interrupted)
        monkeypatch.setattr(PartLength, "keep", interrupted)  # after the part has ended
        with pytest.raises(KeyboardInterrupt):
            d.advance(1)
        assert np.array_equal(table.history.to_numpy(), before[0]) and d.energies().dissipated == dissipated > 0.0
        assert np.allclose(table.constants.to_numpy(), before[1], rtol=1e-14, atol=1e-12)
        d.reset()
        assert not table.history.to_numpy().any()


@pytest.mark.parametrize("integrator, precision", [("velocity_verlet", "f32"), ("bdf2", "f64")])
def test_a_checkpoint_continues_bitwise(integrator, precision, tmp_path):
    path, scene = tmp_path / "checkpoint.npz", swinging()
    with ts.Simulator(scene, dt=1e-3, integrator=integrator, precision=precision) as sim:
        shear(sim)
        follow(sim, 3)
        sim.set_material("block", young=5e4)
        follow(sim, 2)
        sim.save_checkpoint(path)
        stress, expected = sim.stress(), follow(sim, 4)
    with ts.Simulator.load_checkpoint(path, scene) as loaded:
        assert np.array_equal(loaded.stress(), stress)
        assert_same(follow(loaded, 4), expected)
    assert expected[-1][3].dissipated > expected[-2][3].dissipated > 0.0


def test_changes_by_hand():
    """A jump strains the branches at once; stiffnesses follow young, and branches themselves are fixed."""
    with ts.Simulator(swinging(), dt=2e-3, integrator="velocity_verlet", precision="f64") as sim:
        shear(sim)
        energy, stress = sim.energies(), sim.stress()
        sim.set_material("block", young=2 * BRANCHED.young)
        assert np.allclose(sim.stress(), 2 * stress, rtol=1e-12)
        assert sim.energies().elastic == pytest.approx(2 * energy.elastic, rel=1e-12) and energy.dissipated == 0.0
        with pytest.raises(ts.SceneError, match="branches cannot change while it runs"):
            sim.set_material("block", branches=())
