"""Results on every arch; the marker `cuda` needs a GPU, and one variant of each test runs on the CPU with --long:

* energies, forces and the assembled stiffness agree with the NumPy oracle, in both precisions;
* steps agree with the oracle; steps with contacts in f32, with both broad phases, agree with those of the CPU in f64;
* serial and coloured Gauss-Seidel solve the same problem, by a residual in NumPy;
* a checkpoint written on the CPU can be continued.
"""

import numpy as np
import pytest

import taisoft as ts
from benchmarks.contact_colouring import measure_crossover
from benchmarks.contact_runs import GOAL
from taisoft.fem.measure import measure
from taisoft.fem.state import ELASTIC
from taisoft.fem.terms import elasticity
from taisoft.linear import block_csr
from tests.backend.lanes import opened
from tests.dynamics.following import follow, simulator
from tests.dynamics.scenes import SNH, SVK, built, driven_scene, mixed_scene

GPU = pytest.mark.cuda
ARCHS = [pytest.param("cpu", marks=pytest.mark.long), pytest.param("cuda", marks=GPU)]
STEPS = 20


def on(*values: str) -> list:
    """Return parameters (arch, value): the first value on the CPU, all values on a GPU."""
    return [pytest.param("cpu", values[0], marks=pytest.mark.long), *(pytest.param("cuda", value, marks=GPU) for value in values)]


@pytest.mark.parametrize(("arch", "precision"), on("f32", "f64"))
def test_energy_force_and_stiffness_agree_with_the_oracle(arch, precision):
    scene = mixed_scene((SNH, SVK, SNH, SVK), order="both")
    with built(scene, precision, arch=arch) as rig:
        rng = np.random.default_rng(11)
        x = rig.oracle.rest @ np.array([[0.6, 0.1, 0.0], [-0.15, 1.2, 0.05], [0.0, 0.1, 0.7]])
        x = x + 0.05 * rng.standard_normal(x.shape)
        rig.model.state.x.from_numpy(x)
        measure(rig.model)
        assert rig.model.state.scalars.to_numpy()[ELASTIC] == pytest.approx(rig.oracle.energy(x), rel=100 * rig.eps)
        force = rig.vectors("force")
        elasticity.elastic_forces(rig.model)
        elasticity.gather_forces(rig.model, force)
        expected = rig.oracle.force(x)
        assert np.abs(force.to_numpy() - expected).max() < 100 * rig.eps * np.abs(expected).max()
        matrix = block_csr.build_block_csr(rig.model, rig.arena)
        block_csr.assemble(rig.model, matrix, False)
        direction, product = rng.standard_normal(x.shape), rig.vectors("product")
        factor = rig.vectors("factor", direction.astype(rig.machine.np_real))
        block_csr.multiply(rig.model, matrix, factor, product)
        expected = (rig.oracle.stiffness(x) @ direction.reshape(-1)).reshape(-1, 3)
        assert np.abs(product.to_numpy() - expected).max() < 300 * rig.eps * np.abs(expected).max()


@pytest.mark.parametrize(
    ("arch", "method"), on("symplectic_euler", "velocity_verlet", "implicit_euler", "implicit_midpoint", "bdf2")
)
def test_steps_agree_with_the_oracle(arch, method):
    scene = driven_scene(mass_damping=3.0, stiffness_damping=0.004)
    implicit = method not in ("symplectic_euler", "velocity_verlet")
    tight = {"newton_tolerance": 1e-13, "linear_tolerance": 1e-13} if implicit else {}
    with simulator(scene, method, arch=arch, **tight) as sim:
        follow(sim, method, 9, 1e-8)


def stacked() -> ts.Scene:
    """A cube on the ground, and another one that falls onto it."""
    scene = ts.Scene()
    rubber = ts.Material(young=2e5, friction=0.5)
    scene.add_body(ts.box_mesh((2, 2, 2), (1, 1, 1)), rubber, name="below", position=(0, 0.501, 0))
    smaller = ts.box_mesh((2, 2, 2), (0.8, 0.8, 0.8))
    scene.add_body(smaller, rubber, name="above", position=(0.11, 1.405, 0.07), velocity=(0.2, -1, 0))
    scene.add_obstacle(ts.HalfSpace((0, 0, 0), (0, 1, 0)), name="ground")
    return scene


CONTACTS = (
    "implicit_euler auto bvh",
    "symplectic_euler gauss_seidel spatial_hash",
    "symplectic_euler coloured_gauss_seidel bvh",
    "bdf2 auto spatial_hash",
)


@pytest.mark.parametrize(("arch", "method"), on(*CONTACTS))
def test_steps_with_contacts_agree_with_the_cpu(arch, method):
    integrator, solver, broad_phase = method.split()
    dt = 0.005 if solver == "auto" else 1e-3
    ends, n_contacts, scene = [], 0, stacked()
    scene.collision = ts.CollisionSettings(broad_phase=broad_phase)
    for run_on, precision in (("cpu", "f64"), (arch, "f32")):
        settings = {"contact_solver": solver, "precision": precision, "arch": run_on}
        with ts.Simulator(scene, dt=dt, integrator=integrator, **settings) as sim:
            for _ in range(STEPS):
                report = sim.step()
                assert report.converged and report.problems == []
                n_contacts = max(n_contacts, report.n_contacts)
            ends.append(sim.positions())
    assert n_contacts >= 8
    assert np.abs(ends[1] - ends[0]).max() < 1e-4  # [m] of 0.1 that the upper cube falls


@pytest.mark.parametrize("arch", ARCHS)
def test_serial_and_coloured_sweeps_converge(arch):
    with opened("f32", arch) as runtime:
        (point,) = measure_crossover((4,), runtime)
    assert point.contacts > 30 and point.colours > 1
    assert max(point.serial.residual, point.coloured.residual) <= 2 * GOAL  # the solvers stop by their f32 residual


@pytest.mark.parametrize("arch", ARCHS)
def test_a_checkpoint_of_the_cpu_continues(arch, tmp_path):
    with simulator(driven_scene(), "velocity_verlet") as sim:
        sim.advance(3)
        sim.save_checkpoint(tmp_path / "c.npz")
        sim.advance(3)
        expected = sim.positions()
    with ts.Simulator.load_checkpoint(tmp_path / "c.npz", driven_scene(), arch=arch) as sim:
        assert sim.settings.arch == arch and sim.step_count == 3
        sim.advance(3)
        assert np.abs(sim.positions() - expected).max() < 1e-10  # [m]
