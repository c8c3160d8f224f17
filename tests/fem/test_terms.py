"""Forces of every term in random states of both orders, in f64, serial and parallel:

* the force is minus the finite difference of the energy;
* internal forces and closed pressures have no resultant force or moment, elastic ones on each body, and rotate with the state;
  other loads do not depend on it;
* dampers dissipate, except in rigid translation.
"""

from dataclasses import replace

import numpy as np
import pytest
import taichi as ti

from taisoft.backend.runtime import kernel
from taisoft.fem.measure import measure
from taisoft.fem.model import damping_table
from taisoft.fem.node_graph import EVERYTHING
from taisoft.fem.state import ELASTIC, GRAVITY, LOADS
from taisoft.fem.terms import TERMS, dead_loads, elasticity, gravity, pressure, rayleigh_damping, rigid_damping, springs
from taisoft.fem.terms.elasticity import elastic_forces
from taisoft.linear import block_csr
from taisoft.linear.block_csr import row_times
from tests.collision.rotations import rotation
from tests.dynamics.scenes import built, driven_scene

# indices in State.scalars, written by `measure`
ENERGY = {elasticity: (ELASTIC,), springs: (ELASTIC, LOADS), gravity: (GRAVITY,), dead_loads: (LOADS,), pressure: (LOADS,)}
POTENTIALS = tuple(term for term in TERMS if term is not rigid_damping)  # damps rigid bodies: tests/dynamics
H = 1e-6  # [m]


@kernel
def force_of(m: ti.template(), term: ti.template(), out: ti.template()):
    """The force of a term on every node."""
    ti.loop_config(serialize=True)
    for i in range(m.n_nodes):
        out[i] = term.force(m, i)


@kernel
def damping_of(m: ti.template(), damper: ti.template(), mass: ti.template(), stiffness: ti.template()):
    """Forces of both dampers on every node."""
    ti.loop_config(serialize=True)
    for i in range(m.n_nodes):
        mass[i] = rayleigh_damping.mass_force(m, i, m.state.v[i])
        stiffness[i] = rayleigh_damping.stiffness_force(m, i, row_times(m, damper, 0, i, m.state.v))


@pytest.fixture(scope="module", params=[1, 2])
def rig(request):
    scene = driven_scene(mass_damping=3.0, stiffness_damping=0.004, order=request.param, connected=True)
    scene.body("flyer").add_pressure(lambda c: c[:, 0] > 0.0, 2e4)
    with built(scene, "f64") as made:
        rng = np.random.default_rng(5)
        made.x = made.oracle.rest + 0.02 * rng.standard_normal(made.oracle.rest.shape)
        made.outs = [made.vectors(f"term_{k}") for k in range(2)]
        yield made


def forces(rig, term, x: np.ndarray) -> np.ndarray:
    rig.model.state.x.from_numpy(x)
    elastic_forces(rig.model)
    force_of(rig.model, term, rig.outs[0])
    return rig.outs[0].to_numpy()


def energy(rig, term, x: np.ndarray, model=None) -> float:
    model = model or rig.model
    model.state.x.from_numpy(x)
    own = {springs: {"springs": None}, pressure: {"pressure": None}, dead_loads: {"loaded": False}}.get(term)
    if own is None:
        return measured(replace(model, springs=None, pressure=None), term)
    return measured(model, term) - measured(replace(model, **own), term)


def measured(model, term) -> float:
    """The energies to which a term contributes."""
    measure(model)
    return sum(model.state.scalars[k] for k in ENERGY[term])


def test_scene_activates_every_term(rig):
    assert set(rig.model.terms) == set(POTENTIALS) and set(ENERGY) == set(POTENTIALS)


@pytest.mark.parametrize("term", POTENTIALS, ids=lambda term: term.__name__.rpartition(".")[2])
def test_force_is_minus_the_energy_gradient(rig, term):
    f = forces(rig, term, rig.x)
    assert np.abs(f).max() > 1.0  # [N]
    rng = np.random.default_rng(6)
    for node, axis in zip(rng.integers(0, len(rig.x), 12), rng.integers(0, 3, 12)):
        step = np.zeros_like(rig.x)
        step[node, axis] = H
        for model in (rig.model, rig.parallel):
            slope = (energy(rig, term, rig.x + step, model) - energy(rig, term, rig.x - step, model)) / (2 * H)
            assert -slope == pytest.approx(f[node, axis], rel=1e-5, abs=1e-6 * np.abs(f).max())


@pytest.mark.parametrize("term", POTENTIALS, ids=lambda term: term.__name__.rpartition(".")[2])
def test_rigid_motions_rotate_internal_forces(rig, term):
    f, R = forces(rig, term, rig.x), rotation((1.0, -2.0, 0.5), 0.7)
    moved = forces(rig, term, rig.x @ R.T + (0.3, -0.2, 0.1))
    if term.LOAD and not term.STIFFNESS:
        assert np.array_equal(moved, f)
        return
    tolerance = 1e-10 * np.abs(f).max()
    assert np.abs(moved - f @ R.T).max() < tolerance
    start = rig.layout.node_start if term is elasticity else rig.layout.node_start[[0, -1]]  # springs act between bodies
    for first, last in zip(start[:-1], start[1:]):
        force, x = f[first:last], rig.x[first:last]
        assert np.abs(force.sum(axis=0)).max() < 100 * tolerance
        assert np.abs(np.cross(x, force).sum(axis=0)).max() < 100 * tolerance


def test_gravity_force_is_mass_times_acceleration(rig):
    f, weight = forces(rig, gravity, rig.x), rig.model.gravity_mass.to_numpy()
    assert gravity.ACCELERATION and np.abs(f - weight[:, None] * rig.model.gravity.to_numpy()[0]).max() < 1e-12


def test_dampers_dissipate(rig):
    m, rng = rig.model, np.random.default_rng(7)
    matrix = block_csr.build_block_csr(m, rig.arena, "test_damper")
    rates = np.repeat(damping_table(rig.scene)[:, 0], [body.n_nodes for body in rig.scene.bodies])
    drag = rates * m.mass.to_numpy()
    m.state.x.from_numpy(rig.x)
    block_csr.assemble(m, matrix, EVERYTHING, True)
    for v in (rng.standard_normal(rig.x.shape), np.zeros_like(rig.x), np.tile([1.0, 2.0, 3.0], (len(rig.x), 1))):
        m.state.v.from_numpy(v)
        damping_of(m, matrix, *rig.outs)
        mass, stiffness = (out.to_numpy() for out in rig.outs)
        assert np.abs(mass + drag[:, None] * v).max() <= 1e-12 * np.abs(mass).max()
        power = float(np.sum(stiffness * v))
        if np.ptp(v, axis=0).max() > 0.0:
            assert power < -1.0  # [W]
        else:  # rigid translation
            assert np.abs(stiffness).max() < 1e-6
