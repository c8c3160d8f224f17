"""A simulator that steps side by side with the oracle."""

import numpy as np
import pytest

import taisoft as ts
from tests.fem.oracle import Oracle

DT = 0.002  # [s]; the driven scene's release falls between the fourth step and the fifth


def simulator(scene, integrator, precision="f64", **settings):
    return ts.Simulator(scene, dt=DT, integrator=integrator, precision=precision, **settings)


def follow(sim, method: str, steps: int, relative: float) -> Oracle:
    """Step sim and the oracle side by side from the start; compare them after every step. Returns the oracle."""
    sim.reset()
    oracle = Oracle(sim.scene)
    for _ in range(steps):
        sim.step()
        getattr(oracle, method)(DT)
        assert sim.time == pytest.approx(oracle.time, rel=1e-14)
        assert np.abs(sim.positions() - oracle.x).max() < relative * 1e-2  # [m] a hundredth is about how far things move
        assert np.abs(sim.velocities() - oracle.v).max() < relative * np.abs(oracle.v).max()
        assert np.abs(oracle.reactions).max() > 100.0  # [N]
        assert np.abs(sim.reactions() - oracle.reactions).max() < relative * np.abs(oracle.reactions).max()
    return oracle
