"""What holds of a step that failed or was done again."""

import numpy as np

import taisoft as ts

State = tuple[np.ndarray, np.ndarray]  # positions [m], velocities [m/s]


def state_of(sim: ts.Simulator) -> State:
    """Its positions and velocities."""
    return sim.positions(), sim.velocities()


def assert_is_before_first_step(sim: ts.Simulator, before: State) -> None:
    """A first step that failed has left the state as it was, and prescribed nodes are still prescribed."""
    assert np.array_equal(sim.positions(), before[0]) and np.array_equal(sim.velocities(), before[1])
    assert sim.time == 0.0 and sim.step_count == 0
    sim.set_state(velocities=np.ones_like(before[1]))  # 0 on axes that are still constrained
    for body in sim.scene.bodies:
        v = sim.velocities(body.name)
        assert not any(v[np.ix_(c.nodes, np.flatnonzero(c.axes))].any() for c in body.constraints)
    sim.set_state(velocities=before[1])


def assert_steps_as_new(sim: ts.Simulator, close: float) -> None:
    """Its next step ends where that of a simulator that was reset does, up to `close` [m]."""
    sim.step()
    first = sim.positions()
    sim.reset()
    sim.step()
    assert np.abs(sim.positions() - first).max() < close
