"""Damping of rigid bodies in implicit steps:

* its force is that of a viscous stress of the strain's rate, its blocks are the derivatives of the force;
* momentum and angular momentum stay, and a step that turns bodies has no resistance.
"""

from dataclasses import dataclass
from typing import Any

import numpy as np
import pytest
import taichi as ti

import taisoft as ts
from taisoft.backend.runtime import kernel
from taisoft.fem.rigid_tets import begin_rigid_stage
from taisoft.fem.terms import rigid_damping
from taisoft.fem.terms.elasticity import prepare_terms
from taisoft.linear import block_csr
from tests.collision.rotations import rotation
from tests.dynamics.companion import add_companion
from tests.dynamics.scenes import built

BETA, NOW, BEFORE = 0.01, 4.0 / 3.0, 1.0 / 3.0
H = 1e-6  # [m]


@dataclass(frozen=True, eq=False)
class Past:
    """Earlier positions, as in the history of an implicit stepper."""

    x_now: Any
    x_before: Any


@kernel
def force_of(m: ti.template(), out: ti.template()):
    """The damping force on every node."""
    prepare_terms(m)
    ti.loop_config(serialize=True)
    for i in range(m.n_nodes):
        out[i] = rigid_damping.force(m, i)


@pytest.fixture(scope="module")
def rig():
    scene = ts.Scene()
    scene.add_rigid_body(ts.box_mesh((1, 1, 1), (1.0, 0.6, 0.3)), name="a", position=(0.3, 1.0, 0.0))
    scene.add_body(ts.box_mesh((1, 1, 1), (1, 1, 1)), ts.Material(young=1e4), name="soft", position=(0, 3, 0))
    scene.add_rigid_body(ts.box_mesh((1, 1, 1), (0.2, 0.2, 0.2)), name="b", position=(4.0, 1.0, 0.0))
    with built(add_companion(scene, attached=True, varied=False).snapshot(), "f64") as made:
        rng = np.random.default_rng(2)
        made.rest = made.model.state.x.to_numpy()
        made.frames = [made.layout.node_start[k] + np.arange(4) for k in (0, 2)]
        made.past = Past(made.vectors("x_now"), made.vectors("x_before"))
        made.out = made.vectors("force")
        made.states = [made.rest + 0.01 * rng.standard_normal(made.rest.shape) for _ in range(3)]
        yield made


def begin(rig, now: np.ndarray, before: np.ndarray) -> None:
    rig.past.x_now.from_numpy(now)
    rig.past.x_before.from_numpy(before)
    begin_rigid_stage(rig.model, rig.past, True, NOW, BEFORE, BETA)


def forces(rig, x: np.ndarray) -> np.ndarray:
    rig.model.state.x.from_numpy(x)
    force_of(rig.model, rig.out)
    return rig.out.to_numpy()


def green(rest: np.ndarray, x: np.ndarray):
    """F and E of the affine map of four points."""
    F = np.linalg.solve((rest[1:] - rest[0]), (x[1:] - x[0])).T
    return F, 0.5 * (F.T @ F - np.eye(3))


def test_the_force_is_that_of_a_viscous_stress(rig):
    x, now, before = rig.states
    begin(rig, now, before)
    f, viscosities = forces(rig, x), rig.model.rigid_tets.viscosity.to_numpy()
    expected, relaxations, size = np.zeros_like(x), [], np.abs(f).max()
    for k, own, viscosity in zip((0, 2), rig.frames, viscosities):
        body, rest = rig.scene.bodies[k], rig.rest[own]
        F, E = green(rest, x[own])
        rate = (E - NOW * green(rest, now[own])[1] + BEFORE * green(rest, before[own])[1]) / BETA
        gradients = np.linalg.inv(np.column_stack([np.ones(4), rest]))[1:].T
        expected[own] = -viscosity * gradients @ (F @ rate).T
        frequency = np.sqrt(body.young / body.density / np.linalg.eigvalsh(np.cov(rest.T, bias=True))[-1])
        relaxations.append(viscosity * frequency / (body.young * body.mass / body.density))
    rows = np.concatenate(rig.frames)
    assert size > 1.0 and np.allclose(f[rows], expected[rows], atol=1e-9 * size)
    assert relaxations[0] == pytest.approx(relaxations[1]) and relaxations[0] > 1.0  # in periods of the lowest vibration
    assert np.abs(f.sum(axis=0)).max() < 1e-9 * size and np.abs(np.cross(x, f).sum(axis=0)).max() < 1e-8 * size


def test_a_step_that_turns_bodies_has_no_resistance(rig):
    x, R = rig.states[0], rotation((1.0, -2.0, 0.5), 0.7)
    begin(rig, x @ R.T, x)
    strained = np.abs(forces(rig, x @ (R @ R).T + 1.0)).max()
    begin(rig, rig.states[1], x)
    assert strained < 1e-8 * np.abs(forces(rig, x)).max()


@pytest.mark.parametrize("projected", [False, True])
def test_blocks_are_the_derivative_of_the_force(rig, projected):
    """Along random directions. A projected matrix lacks the part of E - E_hat, which is 0 here."""
    x, now, before = (rig.states[0],) * 3 if projected else rig.states
    begin(rig, now, before)
    m, matrices = rig.model, []
    matrix = block_csr.build_block_csr(m, rig.arena, f"test_{projected}")
    viscosity = m.rigid_tets.viscosity.to_numpy()
    for factor in (0.0, 1.0):
        m.rigid_tets.viscosity.from_numpy(factor * viscosity)
        m.state.x.from_numpy(x)
        matrix.value.fill(0.0)
        matrix.diagonal.fill(0.0)
        block_csr.to_system(m, matrix, matrix, int(projected), 1.0, BETA)
        matrices.append(block_csr.to_bsr(m, matrix))
    K, rows = (matrices[1] - matrices[0]) / BETA**2, np.concatenate(rig.frames)
    for seed in range(3):
        way = np.zeros_like(x)
        way[rows] = np.random.default_rng(seed).standard_normal((len(rows), 3))
        slope = -(forces(rig, x + H * way) - forces(rig, x - H * way)) / (2 * H)
        assert np.allclose((K @ way.ravel()).reshape(-1, 3)[rows], slope[rows], atol=1e-6 * np.abs(slope).max())
