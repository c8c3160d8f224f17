"""Follower pressure on triangles of linear and quadratic tets: its force is -p times the gradient of the enclosed volume, its
matrix the derivative, of an open surface the symmetric part (`test_load_paths` has paths, refinement and bad input).
"""

import numpy as np
import pytest
import taichi as ti

import taisoft as ts
from taisoft.backend.runtime import kernel
from taisoft.fem.measure import measure
from taisoft.fem.state import LOADS
from taisoft.fem.terms import pressure
from taisoft.linear import block_csr
from tests.dynamics.companion import add_companion
from tests.dynamics.scenes import built, cube, rubber
from tests.fem.composition import added
from tests.fem.oracle_elements import Elements
from tests.fem.oracle_laws import cofactor

P, TOP = 7e3, -4e3  # [Pa]


def everywhere(centroids: np.ndarray) -> np.ndarray:
    return np.ones(len(centroids), dtype=bool)


def on_top(centroids: np.ndarray) -> np.ndarray:
    return centroids[:, 1] > 0.44


def enclosed(body: ts.Body, x: np.ndarray) -> tuple[float, np.ndarray]:
    """The volume of a body's elements and its gradient (n,3); a pressure p on all its surface is a force of -p times that."""
    part, slopes = Elements(body.mesh, body.order).part(4, None, 0), np.zeros_like(x)
    F = np.einsum("eai,eaj->eij", x[part.nodes], part.gradients)
    np.add.at(slopes, part.nodes, np.einsum("e,eij,eaj->eai", part.weights, cofactor(F), part.gradients))
    return part.weights @ np.linalg.det(F), slopes


@pytest.fixture(params=[1, 2], scope="module")
def rig(request):
    """A body under pressure on its whole surface and once more on its top, beside one of the other order."""
    scene = ts.Scene(gravity=(0.0, 0.0, 0.0))
    scene.add_body(cube((5, 0, 0)), rubber(), name="unloaded", order=request.param)
    body = scene.add_body(cube(cells=(2, 1, 1)), rubber(), name="body", order=request.param)
    body.add_pressure(everywhere, P)
    body.add_pressure(on_top, TOP)
    with built(add_companion(scene, varied=False), "f64") as made:
        rng = np.random.default_rng(4)
        made.x = made.layout.rest + 0.05 * rng.standard_normal(made.layout.rest.shape)
        made.out, made.body = made.vectors("out"), made.scene.bodies[1]
        made.rows, made.matrix = made.layout.nodes(1), block_csr.build_block_csr(made.model, made.arena, "pressed")
        yield made


@kernel
def gather(m: ti.template(), out: ti.template()):
    """The force on every node."""
    ti.loop_config(serialize=m.serial)
    for i in range(m.n_nodes):
        out[i] = ti.cast(pressure.edge_products(m, i, False), m.real)


def set_pressures(model, amplitudes) -> None:
    """Of the body's two pressures; the companion's loads stay."""
    values = model.amplitudes.to_numpy()
    values[:2] = amplitudes
    model.amplitudes.from_numpy(values)


def forces(rig, x: np.ndarray, amplitudes=(P, 0.0), model=None) -> np.ndarray:
    model = model or rig.model
    set_pressures(model, amplitudes)
    model.state.x.from_numpy(x)
    gather(model, rig.out)
    return rig.out.to_numpy()


def matrix(rig, amplitudes, projected: bool = False) -> np.ndarray:
    """Of the pressures alone, in the second body."""
    parts = []
    for p in (amplitudes, (0.0, 0.0)):
        set_pressures(rig.model, p)
        parts.append(added(rig, rig.x, 1.0, projected))
    own, K = slice(3 * rig.rows.start, 3 * rig.rows.stop), parts[0] - parts[1]
    assert not np.delete(K, np.arange(own.start, own.stop), axis=0).any()
    return K[own, own]


def derivative(rig, direction: np.ndarray, amplitudes) -> np.ndarray:
    """-df along a direction; f is quadratic in x, so that differences are exact but for rounding."""
    up, down = (forces(rig, rig.x + h * direction, amplitudes) for h in (1e-3, -1e-3))
    return -(up - down)[rig.rows].reshape(-1) / 2e-3


def test_force_is_the_gradient_of_the_volume(rig):
    volume, slopes = enclosed(rig.body, rig.x[rig.rows])
    for model in (rig.model, rig.parallel):
        f = forces(rig, rig.x, model=model)
        assert np.abs(f[rig.rows] + P * slopes).max() < 1e-12 * np.abs(f).max() and not f[: rig.rows.start].any()
    measure(rig.model)
    assert rig.model.state.scalars[LOADS] == pytest.approx(P * volume, rel=1e-12) and volume > 0.5
    both = forces(rig, rig.x, (P, TOP))
    assert np.abs(both - f - forces(rig, rig.x, (0.0, TOP))).max() < 1e-12 * np.abs(both).max()


def test_an_open_surface_has_the_normals_of_its_triangles(rig):
    """Its resultant is p times the vector area, which only the border determines; its potential is not counted."""
    f = forces(rig, rig.x, (0.0, TOP))
    x, (_, top) = rig.x[rig.rows], rig.body.pressures
    edges = [np.roll(t, -k) for t in rig.body.mesh.surface[top.triangles] for k in range(3)]
    border = [(a, b) for a, b, _ in edges if not any((b, a) == (c, d) for c, d, _ in edges)]
    if rig.body.order == 1:
        area = sum(np.cross(x[a], x[b]) for a, b in border) / 2
        assert np.abs(f.sum(axis=0) + TOP * area).max() < 1e-12 * np.abs(f).max()
    measure(rig.model)
    assert rig.model.state.scalars[LOADS] == 0.0
    flat = forces(rig, rig.layout.rest, (0.0, TOP))
    assert flat.sum(axis=0) == pytest.approx([0.0, -TOP * 1.0 * 1.1, 0.0], abs=1e-9) and flat[:, 1].min() >= -1e-9


def test_matrix_is_the_derivative(rig):
    """Of an open surface the symmetric part; a projected matrix leaves it out."""
    d, e = np.zeros((2, *rig.x.shape))
    d[rig.rows], e[rig.rows] = np.random.default_rng(5).standard_normal((2, *rig.x[rig.rows].shape))
    flat, other = d[rig.rows].reshape(-1), e[rig.rows].reshape(-1)
    K, D = matrix(rig, (P, 0.0)), derivative(rig, d, (P, 0.0))
    assert np.abs(D).max() > 100.0 and np.abs(K @ flat - D).max() < 1e-8 * np.abs(D).max()
    K, D, E = matrix(rig, (0.0, TOP)), derivative(rig, d, (0.0, TOP)), derivative(rig, e, (0.0, TOP))
    assert np.abs(K - K.T).max() < 1e-13 * np.abs(K).max() and abs(other @ D - flat @ E) > 0.01 * abs(other @ D)
    assert other @ K @ flat == pytest.approx((other @ D + flat @ E) / 2, rel=1e-8)
    assert flat @ K @ flat == pytest.approx(flat @ D, rel=1e-8)
    assert not matrix(rig, (P, TOP), projected=True).any()
