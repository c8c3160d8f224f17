"""Forces of every term in a random state of linear and quadratic bodies are minus the finite difference of the energies; dampers
act by the rates of each body; forces and stiffness of dependent nodes, x = T q, act on the others as T^T f and T^T K T.
"""

import numpy as np
import pytest
import taichi as ti

import taisoft as ts
from taisoft.backend.runtime import kernel
from taisoft.fem.dependent_table import dependent_table
from taisoft.fem.dependents import force_with_dependents
from taisoft.fem.measure import measure
from taisoft.fem.state import ELASTIC, GRAVITY, LOADS
from taisoft.fem.terms import TERMS, elasticity, gravity, rayleigh_damping, rigid_damping
from taisoft.linear import block_csr
from taisoft.linear.block_csr import stiffness_times
from tests.dynamics.scenes import built, cube, driven_scene, rubber
from tests.fem.oracle_springs import shape_row

POTENTIALS = tuple(term for term in TERMS if term is not rigid_damping)  # damps rigid bodies: tests/dynamics


@kernel
def forces_of(m: ti.template(), terms: ti.template(), out: ti.types.ndarray()):
    """The forces (terms, n_nodes, 3) of each term."""
    for n, term in ti.static(enumerate(terms)):
        ti.loop_config(serialize=True)
        for i in range(m.n_nodes):
            f = force_with_dependents(m, term, i)
            for axis in ti.static(range(3)):
                out[n, i, axis] = f[axis]


@kernel
def damping_of(m: ti.template(), damper: ti.template(), mass: ti.template(), stiffness: ti.template(), decayed: ti.template()):
    """Forces of both dampers on every node, and its velocity after a decay of 0.1 s."""
    ti.loop_config(serialize=True)
    for i in range(m.n_nodes):
        mass[i] = rayleigh_damping.mass_force(m, i, m.state.v[i])
        decayed[i] = rayleigh_damping.mass_decay(m, i, 0.1) * m.state.v[i]
        stiffness[i] = rayleigh_damping.stiffness_force(m, i, stiffness_times(m, damper, 0, i, m.state.v))


@pytest.fixture(scope="module")
def rig():
    scene = driven_scene(mass_damping=3.0, stiffness_damping=0.004, order="both", connected=True)
    scene.body("flyer").add_pressure(lambda c: c[:, 0] > 0.0, 2e4)
    with built(scene, "f64") as made:
        assert set(made.model.terms) == set(POTENTIALS)
        rng = np.random.default_rng(5)
        made.x = made.oracle.rest + 0.02 * rng.standard_normal(made.oracle.rest.shape)
        made.start = made.layout.node_start
        yield made


def forces(rig, x: np.ndarray) -> dict:
    """The force (n,3) [N] of each term."""
    rig.model.state.x.from_numpy(x)
    elasticity.elastic_forces(rig.model)
    terms = tuple(rig.model.terms)
    out = np.zeros((len(terms), *x.shape))
    forces_of(rig.model, terms, out)
    return dict(zip(terms, out))


def energies(rig, x: np.ndarray) -> np.ndarray:
    """Elastic energy, that of gravity and that of loads [J]."""
    rig.model.state.x.from_numpy(x)
    measure(rig.model)
    return rig.model.state.scalars.to_numpy()[[ELASTIC, GRAVITY, LOADS]]


def test_forces_are_minus_the_energy_gradient(rig):
    """Tendons under a given tension are loads, other springs are elastic."""
    found, h, rng = forces(rig, rig.x), 1e-6, np.random.default_rng(6)
    assert all(np.abs(f).max() > 1.0 for f in found.values())  # [N]
    weight = rig.model.gravity_mass.to_numpy()[:, None] * rig.model.gravity.to_numpy()[0]
    assert gravity.ACCELERATION and np.abs(found[gravity] - weight).max() < 1e-12
    for node, axis in zip(rng.integers(0, len(rig.x), 20), rng.integers(0, 3, 20)):
        step = np.zeros_like(rig.x)
        step[node, axis] = h
        slopes = -(energies(rig, rig.x + step) - energies(rig, rig.x - step)) / (2 * h)
        f = {term: force[node, axis] for term, force in found.items()}
        assert slopes[1] == pytest.approx(f[gravity], rel=1e-6, abs=1e-6)
        assert slopes[0] + slopes[2] == pytest.approx(sum(f.values()) - f[gravity], rel=1e-6, abs=1e-4)


def test_dampers_act_by_the_rates_of_each_body(rig):
    m, rng = rig.model, np.random.default_rng(7)
    outs = [rig.vectors(f"term_{k}") for k in range(3)]
    matrix = block_csr.build_block_csr(m, rig.arena, "test_damper")
    m.state.x.from_numpy(rig.x)
    block_csr.assemble(m, matrix, True)  # a stiffness: its rows sum to zero
    rates = np.repeat(rayleigh_damping.damping_table(rig.scene)[:, 0], [body.n_nodes for body in rig.scene.bodies])
    drag = rates * m.mass.to_numpy()
    v = rng.standard_normal(rig.x.shape)
    m.state.v.from_numpy(v)
    damping_of(m, matrix, *outs)
    mass, stiffness, decayed = (out.to_numpy() for out in outs)
    assert np.abs(mass + drag[:, None] * v).max() <= 1e-12 * np.abs(mass).max()
    assert np.abs(decayed - np.exp(-0.1 * rates)[:, None] * v).max() < 1e-14 * np.abs(v).max()
    rates = np.where(np.arange(len(v)) < rig.start[1], 0.004, 0.0)[:, None]  # the flyer has none
    expected = -rates * (block_csr.to_bsr(m, matrix) @ v.reshape(-1)).reshape(-1, 3)
    assert np.abs(stiffness - expected).max() < 1e-12 * np.abs(expected).max()


def test_forces_and_stiffness_of_dependent_nodes_act_on_the_others():
    scene = ts.Scene()
    bodies = [scene.add_body(cube(), rubber(), name=name, position=(0.7 * k, 0, 0)) for k, name in enumerate("ab")]
    scene.attach("b", [0, 2], "a", name="joint")
    T = np.eye(16)
    for node in (8, 10):
        T[node] = np.append(shape_row(bodies[0], bodies[1].rest_positions[node - 8] + (0.7, 0, 0)), np.zeros(8))
    assert np.abs(dependent_table(scene).matrix.toarray() - T).max() < 1e-12
    with built(scene, "f64") as rig:
        q, own = rig.oracle.rest + 0.05 * np.random.default_rng(3).standard_normal((16, 3)), np.delete(np.arange(16), [8, 10])
        f, wanted = forces(rig, q)[elasticity], T.T @ rig.oracle.force(T @ q)
        assert np.abs(f - wanted)[own].max() < 1e-12 * np.abs(wanted).max()
        matrix = block_csr.build_block_csr(rig.model, rig.arena)
        block_csr.assemble(rig.model, matrix, False)
        axes = (3 * own[:, None] + np.arange(3)).reshape(-1)
        found, K = block_csr.to_bsr(rig.model, matrix).toarray(), rig.oracle.stiffness(T @ q)
        wanted = np.kron(T, np.eye(3)).T @ K @ np.kron(T, np.eye(3))
        assert np.abs(found - wanted)[np.ix_(axes, axes)].max() < 1e-12 * np.abs(wanted).max()
