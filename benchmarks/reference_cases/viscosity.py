"""A bar and a block with one Maxwell branch at small strains, with little inertia: relaxation, creep and a cycle of shear.

A bulk modulus K stays elastic, and the shear modulus relaxes as mu (1 + g exp(-t/tau)).
"""

from functools import partial

import numpy as np

import taisoft as ts

from .record import LAWS, Case, face, near, scene, worst

SMALL = 1e-5  # strain
TAU, G = 0.1, 0.5  # relaxation time [s] and fraction of the branch
STEPS = 50  # per relaxation time
LIMIT = 1e-3
RUBBER = partial(ts.Material, young=1e5, poisson=0.3, density=1e-6, branches=[(TAU, G)])
MU, K = RUBBER().mu, RUBBER().lam + 2.0 / 3.0 * RUBBER().mu


def _bar(law: str) -> ts.Scene:
    """A unit cube on rollers, which can widen."""
    made = scene()
    bar = made.add_body(ts.box_mesh((1, 1, 1), (1, 1, 1), (0.5, 0.5, 0.5)), RUBBER(LAWS[law]))
    for axis, name in enumerate("xyz"):
        bar.fix(face(axis, 0.0), axes=name)
    return made


def _young(shear: float) -> float:
    return 9.0 * K * shear / (3.0 * K + shear)


def _stretched_at_once(sim: ts.Simulator, axial: float) -> None:
    """Set the state of a sudden strain along y."""
    lateral = -axial * 0.5 * (1.0 - _young(MU * (1 + G)) / (3.0 * K))
    sim.set_state(positions=sim.positions() * (1.0 + np.array([lateral, axial, lateral])))


def relaxation(law: str, _reference: dict, arch: str):
    """Axial stress of a bar of constant length, E = E_inf + (E_0 - E_inf) exp(-t/tau_E)."""
    made, checks = _bar(law), []
    made.bodies[0].fix(face(1, 1.0), axes="y")
    at_once, relaxed = _young(MU * (1 + G)), _young(MU)
    tau = TAU * (3.0 * K + MU * (1 + G)) / (3.0 * K + MU)
    with ts.Simulator(made, dt=TAU / STEPS, integrator="bdf2", precision="f64", arch=arch) as sim:
        _stretched_at_once(sim, SMALL)
        for _ in range(2 * STEPS):
            sim.step()
            exact = SMALL * (relaxed + (at_once - relaxed) * np.exp(-sim.time / tau))
            checks.append(near(f"at {sim.time:.3f} s", sim.stress()[:, 1, 1].mean(), exact, LIMIT))
    yield worst(checks, "axial stress [Pa]")


def creep(law: str, _reference: dict, arch: str):
    """Strain of a bar under a constant load: its shear compliance is (1 - g/(1 + g) exp(-t/(tau (1 + g)))) / mu."""
    made, checks, load = _bar(law), [], SMALL * MU
    made.bodies[0].add_traction(face(1, 1.0), (0.0, load, 0.0))
    with ts.Simulator(made, dt=TAU / STEPS, integrator="bdf2", precision="f64", arch=arch) as sim:
        _stretched_at_once(sim, load / _young(MU * (1 + G)))
        for _ in range(3 * STEPS):
            sim.step()
            exact = load / _young(MU / (1.0 - G / (1 + G) * np.exp(-sim.time / (TAU * (1 + G)))))
            checks.append(near(f"at {sim.time:.3f} s", np.ptp(sim.positions()[:, 1]) - 1.0, exact, LIMIT))
    yield worst(checks, "axial strain")


def cycle(law: str, _reference: dict, arch: str):
    """Energy that a block dissipates in a cycle of shear: pi gamma^2 mu g w tau / (1 + (w tau)^2)."""
    made, period = scene(), 0.3
    block = made.add_body(ts.box_mesh((1, 1, 1), (1, 1, 1), (0.5, 0.5, 0.5)), RUBBER(LAWS[law]))
    block.fix(face(1, 0.0))
    block.move(face(1, 1.0), lambda t: (SMALL * np.sin(2 * np.pi * t / period), 0.0, 0.0))
    with ts.Simulator(made, dt=period / 100, integrator="implicit_euler", precision="f64", arch=arch) as sim:
        dissipated = [sim.step().dissipated for _ in range(400)]  # the last cycle of four: the start is forgotten
    w = 2 * np.pi / period * TAU
    yield near("dissipated energy [J]", dissipated[-1] - dissipated[-101], np.pi * SMALL**2 * MU * G * w / (1 + w * w), LIMIT)


CASES = tuple(
    Case(f"maxwell_{compute.__name__}", "SVK", "", partial(compute, "SVK"), closed_form=True)
    for compute in (relaxation, creep, cycle)
)
