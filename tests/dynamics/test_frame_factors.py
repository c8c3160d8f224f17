"""r-factors of contacts with rigid bodies are 1 / diag(J A^-1 J^T), computed densely with the blocks of A of each rigid body on
its free axes, and with the diagonal of A alone at soft nodes: of a rigid body on a plane, on a soft body, on another rigid one,
and where some of its axes, or those along which a contact could slip, are fixed.
"""

import numpy as np
import pytest

import taisoft as ts
from taisoft.contact.matrix_contacts import jacobian
from taisoft.dynamics import stage_system
from taisoft.fem.model import Model
from taisoft.linear import block_csr
from tests.collision.rotations import rotation
from tests.dynamics.companion import opened
from tests.dynamics.contact_scenes import SIDE, cube, ground, material

SHAPE = ts.box_mesh((1, 1, 1), (0.12, 0.06, 0.09))


def add_rigid(scene: ts.Scene, name: str, height: float, turned: float = 0.0, x: float = 0.01) -> ts.Body:
    """A turned box whose lowest point is at that height, and which falls."""
    vertices = SHAPE.vertices @ rotation((1.0, 0.2, 0.5), turned).T
    at = (x, height + 1e-4 - vertices[:, 1].min(), 0.0)
    return scene.add_rigid_body(ts.TetMesh(vertices, SHAPE.tets), name=name, position=at, velocity=(0.1, -0.5, 0.0), friction=0.5)


def on_the_ground() -> ts.Scene:
    scene = ts.Scene()
    add_rigid(scene, "box", 0.0)
    scene.add_obstacle(ground(), friction=0.5)
    return scene


def on_a_soft_cube() -> ts.Scene:
    """The soft one falls on the ground; and two rigid ones that meet beside them."""
    scene = ts.Scene()
    scene.add_body(cube(2), material(), name="soft", position=(0.0, 1e-4, 0.0))
    add_rigid(scene, "box", SIDE + 1e-4)
    for name, height in (("lower", 0.0), ("upper", 0.06 + 1e-4)):
        add_rigid(scene, name, height, x=0.5)
    scene.add_obstacle(ground(), friction=0.5)
    return scene


def with_fixed_axes() -> ts.Scene:
    """One in a plane, and one that moves along y without turning."""
    scene = ts.Scene()
    add_rigid(scene, "disc", 0.0, 0.4).fix(axes="z")
    add_rigid(scene, "piston", 0.0, x=0.5).fix(axes="xz")
    scene.add_obstacle(ground(), friction=0.5)
    return scene


def expected_factors(m: Model, A: block_csr.BlockCsr, diagonal, p) -> tuple[np.ndarray, np.ndarray]:
    """Factors (k,2) of all contacts, and which of them are with rigid bodies."""
    J, number = jacobian(p).toarray(), m.rigid_tets.number.to_numpy()
    whole, inverse = block_csr.to_bsr(m, A, diagonal).toarray(), np.diag(p.inverse_mass.to_numpy().reshape(-1))
    free, is_rigid = m.free.to_numpy().reshape(-1) > 0.0, np.zeros(len(J) // 3, dtype=bool)
    for body in range(m.rigid_tets.n):
        nodes = np.flatnonzero(number // 4 == body)
        own = (3 * nodes[:, None] + np.arange(3)).reshape(-1)
        is_rigid |= np.abs(J[:, own]).reshape(len(is_rigid), -1).any(axis=1)
        inverse[np.ix_(own, own)] = 0.0
        own = own[free[own]]
        inverse[np.ix_(own, own)] = np.linalg.inv(whole[np.ix_(own, own)])
    d = np.einsum("ij,jk,ik->i", J, inverse, J).reshape(-1, 3)
    compliance = np.stack([d[:, 0], d[:, 1:].max(axis=1)], axis=1)
    return np.divide(1.0, compliance, out=np.zeros_like(compliance), where=compliance > 0.0), is_rigid


@pytest.mark.parametrize("make", [on_the_ground, on_a_soft_cube, with_fixed_axes])
def test_factors_are_those_of_whole_bodies(make, monkeypatch):
    """Whenever they are set in a step; those of other contacts stay."""
    set_factors, sizes = stage_system.set_frame_factors, []

    def checked(m, A, diagonal, p):
        k, before = int(p.count[0]), p.factor.to_numpy()
        set_factors(m, A, diagonal, p)
        after, (expected, is_rigid) = p.factor.to_numpy(), expected_factors(m, A, diagonal, p)
        assert np.allclose(after[:k][is_rigid], expected[is_rigid], rtol=1e-10, atol=0.0)
        assert np.array_equal(after[:k][~is_rigid], before[:k][~is_rigid]) and np.array_equal(after[k:], before[k:])
        sizes.append(
            (is_rigid.sum(), (~is_rigid).sum(), after[:k].min(), (after[:k][is_rigid] < 0.9 * before[:k][is_rigid]).any())
        )

    monkeypatch.setattr(stage_system, "set_frame_factors", checked)
    with opened(make(), "implicit_euler", 1 / 200) as sim:
        assert all(sim.step().converged for _ in range(2))
    n_rigid, n_soft, least, differ = np.array(sizes).T
    assert n_rigid.min() > 3 and differ.all() and (make is with_fixed_axes) == (least.min() == 0.0)
    assert (n_soft > 0).any() == (make is on_a_soft_cube)
