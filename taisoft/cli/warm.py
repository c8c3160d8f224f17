"""`taisoft warm`: compiles the kernels of common scenes ahead, so that later runs find them in the cache on disk."""

import contextlib
import time
import warnings
from argparse import Namespace
from collections.abc import Callable
from typing import Any

import numpy as np

import taisoft as ts
from taisoft import compile_message
from taisoft.cli import warm_scenes
from taisoft.cli.warm_scenes import Structure
from taisoft.dynamics import EXPLICIT
from taisoft.errors import SimulationError
from taisoft.runtime import n_compiled

STEPS = {True: (1e-5, 200), False: (1e-2, 10)}  # of explicit and implicit integrators: dt [s], and how many
LONG = 1.0  # [s]
HEAVY = (0.0, -500.0, 0.0)  # [m/s^2]
SQUEEZE = np.array([0.3, 1.0, 1.0])  # of positions
WILD = 0.5  # of a body's extent in a step: speed at which nodes fly about


def command(arguments: Namespace) -> int:
    """Compiles, one line for each structure, and returns 0. Without --precision simulations are in f32, statics in f64."""
    start, before = time.perf_counter(), n_compiled()
    with compile_message.silenced():
        for structure in dict.fromkeys(warm_scenes.structures()):  # laws and integrators share some
            _report(str(structure), simulate, structure, arguments.precision or "f32")
        for structure in warm_scenes.static_structures():
            precision = arguments.precision or "f64"
            _report(f"statics in {precision}, {structure}", solve, structure, precision)
    print(f"{n_compiled() - before} kernels in {time.perf_counter() - start:.0f} s")
    return 0


def simulate(structure: Structure, precision: str) -> None:
    """A few steps, and what a run with --out writes of them."""
    dt, count = STEPS[structure.integrator in EXPLICIT]
    with ts.Simulator(warm_scenes.build(structure), dt=dt, integrator=structure.integrator, precision=precision) as sim:
        while sim.step_count < count:
            sim.advance(count - sim.step_count)
        implicit = structure.integrator not in EXPLICIT
        if implicit:
            sim._stepper.compile_hard_steps()
        if not sim.touches and implicit:
            sim.dt = LONG  # so long that inertia does not hide the stiffness
            sim.set_state(SQUEEZE * sim.positions())  # where the stiffness must be projected and the line search has work
            sim.step()
        if implicit:
            x = sim.positions()
            size = WILD * float(np.ptp(x, axis=0).min()) / sim.dt
            sim.set_state(velocities=size * np.random.default_rng(0).standard_normal(x.shape))
            with contextlib.suppress(SimulationError):  # what is refused or ends in no numbers has compiled all the same
                sim.step()
        sim.energies()
        sim.stress()


def solve(structure: Structure, precision: str) -> None:
    """The static state under a load so large that the line search has work."""
    scene = warm_scenes.build(structure)
    scene.gravity = HEAVY
    ts.solve_static(scene, precision=precision)


def _report(what: str, do: Callable, *arguments: Any) -> None:
    start, before = time.perf_counter(), n_compiled()
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")  # of scenes that nobody looks at
        do(*arguments)
    print(f"{what:<90} {n_compiled() - before:3d} kernels {time.perf_counter() - start:6.1f} s", flush=True)
