"""`taisoft warm`: compiles the kernels of common scenes in advance, so that later runs find them in the disk cache."""

import contextlib
import time
import warnings
from argparse import Namespace
from collections.abc import Callable
from typing import Any

import numpy as np

import taisoft as ts
from taisoft import compile_message
from taisoft.backend.runtime import n_compiled
from taisoft.cli import warm_scenes
from taisoft.cli.warm_scenes import Structure
from taisoft.dynamics.schemes import EXPLICIT
from taisoft.errors import SimulationError

STEPS = {True: (1e-5, 200), False: (1e-2, 10)}  # explicit integrator: (dt [s], number of steps)
LONG_DT = 1.0  # [s]
STRONG_GRAVITY = (0.0, -500.0, 0.0)  # [m/s^2]
SQUEEZE = np.array([0.3, 1.0, 1.0])  # factor of positions
RANDOM_SPEED = 0.5  # of nodes, in smallest extents of the scene per step


def command(arguments: Namespace) -> int:
    """Compile, print one line per structure, and return 0. Without --precision simulations use f32, statics f64."""
    start, before = time.perf_counter(), n_compiled()
    with compile_message.silenced():
        for structure in dict.fromkeys(warm_scenes.structures()):  # some laws and integrators have structures in common
            _report(str(structure), simulate, structure, arguments.precision or "f32")
        for structure in warm_scenes.static_structures():
            precision = arguments.precision or "f64"
            _report(f"statics in {precision}, {structure}", solve, structure, precision)
    print(f"{n_compiled() - before} kernels in {time.perf_counter() - start:.0f} s")
    return 0


def simulate(structure: Structure, precision: str) -> None:
    """Take a few steps, and compute what a run with --out writes."""
    dt, count = STEPS[structure.integrator in EXPLICIT]
    with ts.Simulator(warm_scenes.build(structure), dt=dt, integrator=structure.integrator, precision=precision) as sim:
        while sim.step_count < count:
            sim.advance(count - sim.step_count)
        implicit = structure.integrator not in EXPLICIT
        if implicit:
            sim._dynamics.stepper.compile_hard_steps()
        if not sim.touches and implicit:
            sim.dt = LONG_DT  # so long that stiffness dominates inertia
            sim.set_state(SQUEEZE * sim.positions())  # needs projected stiffness and a line search
            sim.step()
        if implicit:
            x = sim.positions()
            size = RANDOM_SPEED * float(np.ptp(x, axis=0).min()) / sim.dt
            sim.set_state(velocities=size * np.random.default_rng(0).standard_normal(x.shape))
            with contextlib.suppress(SimulationError):  # a step that fails has compiled its kernels all the same
                sim.step()
        sim.energies()
        sim.stress()


def solve(structure: Structure, precision: str) -> None:
    """Solve for the static state under a load large enough to need the line search."""
    scene = warm_scenes.build(structure)
    scene.gravity = STRONG_GRAVITY
    ts.solve_static(scene, precision=precision)


def _report(what: str, do: Callable, *arguments: Any) -> None:
    start, before = time.perf_counter(), n_compiled()
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")  # these scenes are not the user's
        do(*arguments)
    print(f"{what:<90} {n_compiled() - before:3d} kernels {time.perf_counter() - start:6.1f} s", flush=True)
