"""Measurements for step reports, and their number of launches:

* energies, volume ratios and the first softened tet are the oracle's for all laws and orders, in serial and parallel kernels;
* a frame of explicit steps is one launch of steps and one measurement; an implicit step, and the start of a run, take one
  measurement each; a report describes the state at the end of its frame;
* the number of sub-steps per launch follows from the launch time and the cost of the law and its damping.
"""

from types import SimpleNamespace

import numpy as np
import pytest

import taisoft as ts
from taisoft.backend import runtime
from taisoft.dynamics.explicit_stepper import LAUNCH_SECONDS, MAX_BATCH, largest_batch
from taisoft.fem.laws import LAWS
from taisoft.fem.measure import NO_TET, measure
from taisoft.fem.state import FIRST_SOFTENED, GRAVITY
from tests.dynamics.scenes import COR, SNH, SVK, built, cube, mixed_scene, rubber
from tests.fem.oracle import Oracle

LARGE = 34_560  # tets of the largest mesh of the elasticity benchmark


def first_softened(rig, x) -> int:
    """Index, by blocks and lanes, of the first tet with a stretch below that where its law softens."""
    softened = [NO_TET]
    for k, part in enumerate(rig.oracle.parts):
        stretch = np.linalg.svd(rig.oracle.gradients(x, part), compute_uv=False)[:, -1].reshape(-1, part.points).min(axis=1)
        tets = np.flatnonzero(stretch < LAWS[part.material.law].SOFTENS_BELOW)
        softened += [int(rig.layout.lane_of_tet[rig.layout.tet_start[k] + tet]) for tet in tets]
    return min(softened)


@pytest.mark.parametrize("laws, precision", [((SVK, SNH, SNH, COR), "f64"), ((SVK, SNH, COR, SVK), "f32")])
def test_energies_and_volume_ratios_of_all_laws(laws, precision):
    """Combinations of law and order that the tests of elasticity leave out; serial in f64, parallel in f32."""
    with built(mixed_scene(laws, order="both"), precision) as rig:
        m, rng, cases = rig.model if precision == "f64" else rig.parallel, np.random.default_rng(3), set()
        for squeeze, noise in ((1.0, 0.02), (0.75, 0.03), (0.7, 0.2)):
            x = rig.oracle.rest * [1.0, squeeze, 1.0] + noise * rng.standard_normal(rig.oracle.rest.shape)  # [m]
            v = rng.standard_normal(x.shape).astype(rig.machine.np_real)
            m.state.x.from_numpy(x)
            m.state.v.from_numpy(v)
            measure(m)
            elastic, lowest, inverted, kinetic, gravity = m.state.scalars.to_numpy()[: GRAVITY + 1]
            low, count = rig.oracle.volume_ratios(x)
            # The rest shape, masses and gravity are stored in the model's precision. A strain of 0.02 is a difference of numbers
            # of about 1, so its relative error is 50 times as large, and that of its energy 100 times
            assert elastic == pytest.approx(rig.oracle.energy(x), rel=100 * rig.eps)
            expected = low, rig.oracle.kinetic(v.astype(float), False), rig.oracle.weight(x, False)
            assert (lowest, kinetic, gravity) == pytest.approx(expected, rel=10 * rig.eps, abs=10 * rig.eps)
            assert inverted == count and m.state.scalars[FIRST_SOFTENED] == first_softened(rig, x)
            cases.add((int(m.state.scalars[FIRST_SOFTENED]), bool(inverted)))
        assert len(cases) == 3 and (NO_TET, False) in cases and any(inverted for _, inverted in cases)


def launches(sim: ts.Simulator, seconds: float, **arguments) -> dict[str, int]:
    """Number of launches of each kernel in a run."""
    before = dict(runtime.launches)
    assert sim.run(seconds, **arguments).status == "ok"
    return {name: n - before.get(name, 0) for name, n in runtime.launches.items() if n > before.get(name, 0)}


@pytest.mark.parametrize("integrator", ["symplectic_euler", "implicit_euler"])
def test_explicit_frames_and_implicit_steps_are_measured_once(integrator):
    scene, frames = ts.Scene(), []
    scene.add_body(cube(), rubber(SVK), name="block", velocity=(1.0, 0.0, 0.0)).fix([0, 1, 2])

    def on_frame(sim, index, report):
        if index:
            frames.append((report, sim.positions(), sim.velocities()))

    with ts.Simulator(scene, 0.002, integrator, precision="f64") as sim:
        counts, oracle = launches(sim, 0.15, on_frame=on_frame, fps=20), Oracle(scene)  # 25 steps a frame
        explicit = sim.settings.explicit
    assert len(frames) == 3 and counts["measure"] == 1 + (3 if explicit else 75)  # 1 at the start
    if explicit:
        assert counts == {"advance_serial": 3, "measure": 4}
    for report, x, v in frames:
        expected = oracle.kinetic(v, explicit), oracle.energy(x), oracle.weight(x, explicit)
        assert (report.kinetic, report.elastic, report.gravity) == pytest.approx(expected)


def model_of(law: str, tets: int, damped: bool = False, chunks: int = 1) -> SimpleNamespace:
    """The attributes of a model that determine the time of its sub-steps."""
    group = SimpleNamespace(law=LAWS[law], first=0, last=tets // 4, n_points=1)
    return SimpleNamespace(groups=(group,), lanes=4, stiffness_damping=damped, on_cpu=True, chunks=chunks)


def test_sub_steps_per_launch_follow_from_the_launch_time():
    assert largest_batch(model_of(SNH, 4)) == MAX_BATCH
    assert largest_batch(model_of(SNH, LARGE)) >= 84  # a frame of the benchmark
    assert largest_batch(model_of(COR, LARGE)) < largest_batch(model_of(SVK, LARGE))
    assert largest_batch(model_of(SNH, 10**8)) == 1
    assert largest_batch(model_of(SNH, 10**6, chunks=32)) >= 10  # the measurement that ends a batch is a tenth of it at most
    # a damped quadrature point takes at least 436 ns
    assert largest_batch(model_of(SNH, LARGE, damped=True)) <= LAUNCH_SECONDS / (436e-9 * LARGE)
