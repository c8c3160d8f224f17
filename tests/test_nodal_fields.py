"""Stress and contact impulses at nodes:

* a stress that is the same in all tets is that at every node, of both orders; else it is the mean by rest volumes over the tets
  at the node; tets without a finite stress do not count;
* von Mises' equivalent is 0 under pressure, |s| under tension s, sqrt(3) |t| under shear t, and does not change under rotations;
* of bodies in a homogeneous state the stress at every node is that of the law, and a rotation of the state leaves its equivalent;
  stresses of all bodies are those of each, in the order added;
* the impulses at a body's nodes sum up to those of its contacts, which are its contact force times dt, by proximity and in
  distance fields, of both orders; only surface nodes of bodies that touch have any.
"""

import numpy as np
import pytest
from rotations import rotation
from scenes import SNH, SVK, mixed_scene, rubber

import taisoft as ts
from taisoft.output.nodal_fields import NodalMean, contact_impulses, von_mises

TURN = rotation((1, -2, 0.5), 1.1)
F = np.array([[1.1, 0.05, 0.0], [0.02, 0.95, -0.04], [0.03, 0.0, 1.02]])


def symmetric(rng, *shape):
    """Random stresses (*shape, 3, 3) [Pa]."""
    a = 1e4 * rng.standard_normal((*shape, 3, 3))
    return a + a.swapaxes(-1, -2)


def bodies_of(order):
    """Two irregular ones."""
    scene = ts.Scene()
    for k, mesh in enumerate((ts.ball_mesh(0.4, 4), ts.box_mesh((3, 2, 1), (0.3, 0.5, 0.7)))):
        moved = mesh.vertices + np.random.default_rng(k).uniform(-0.01, 0.01, mesh.vertices.shape)
        scene.add_body(ts.TetMesh(moved, mesh.tets), rubber(), name=f"body{k}", order=order)
    return scene.bodies


@pytest.mark.parametrize("order", [1, 2])
def test_a_constant_stress_is_that_at_every_node(order):
    bodies, one = bodies_of(order), symmetric(np.random.default_rng(3))
    m, n = sum(b.mesh.n_tets for b in bodies), sum(b.n_nodes for b in bodies)
    mean = NodalMean(bodies)(np.tile(one, (m, 1, 1)))
    assert mean.shape == (n, 3, 3) and np.abs(mean - one).max() < 1e-14 * np.abs(one).max() * m


@pytest.mark.parametrize("order", [1, 2])
def test_the_mean_is_weighted_by_volumes(order):
    bodies, rng = bodies_of(order), np.random.default_rng(4)
    values = symmetric(rng, sum(b.mesh.n_tets for b in bodies))
    values[5], known = np.nan, np.arange(len(values)) != 5
    mean, n, m = NodalMean(bodies)(values), 0, 0
    for body in bodies:
        volumes, own = np.abs(body.mesh.volumes), values[m : m + body.mesh.n_tets]
        for node in rng.choice(body.n_nodes, 20).tolist() + body.nodes.elements[5].tolist():
            at = (body.nodes.elements == node).any(axis=1) & known[m : m + body.mesh.n_tets]
            wanted = np.einsum("e,eij->ij", volumes[at], own[at]) / volumes[at].sum() if at.any() else np.zeros((3, 3))
            assert np.abs(mean[n + node] - wanted).max() < 1e-9
        n, m = n + body.n_nodes, m + body.mesh.n_tets


def test_of_numbers_and_of_nothing_known():
    bodies = bodies_of(1)
    m, n = sum(b.mesh.n_tets for b in bodies), sum(b.n_nodes for b in bodies)
    assert np.allclose(NodalMean(bodies)(np.full(m, 2.5)), np.full(n, 2.5))
    assert np.array_equal(NodalMean(bodies)(np.full((m, 2), np.inf)), np.zeros((n, 2)))


def test_von_mises():
    s = 3e5
    assert von_mises(-s * np.eye(3)) == pytest.approx(0.0, abs=1e-9)
    assert von_mises(np.diag([0.0, -s, 0.0])) == pytest.approx(s)
    shear = np.zeros((3, 3))
    shear[0, 2] = shear[2, 0] = s
    assert von_mises(shear) == pytest.approx(np.sqrt(3) * s)
    sigma = symmetric(np.random.default_rng(5), 4, 6)
    assert von_mises(sigma).shape == (4, 6) and von_mises(sigma).min() > 1e3
    turned = TURN @ sigma @ TURN.T
    assert np.allclose(von_mises(turned), von_mises(sigma), rtol=1e-12)
    assert np.allclose(von_mises(sigma + 1e6 * np.eye(3)), von_mises(sigma), rtol=1e-9)


def test_of_a_homogeneous_state():
    scene = mixed_scene((SNH, SVK, SNH, SVK), order="both")
    mean, ends = NodalMean(scene.bodies), np.cumsum([b.n_nodes for b in scene.bodies])[:-1]
    with ts.Simulator(scene, precision="f64") as sim:
        rest = sim.positions()
        found = {}
        for name, gradient in (("as it is", F), ("turned", TURN @ F)):
            sim.set_state(positions=rest @ gradient.T)
            found[name] = mean(sim.stress())
            assert np.array_equal(sim.stress(), np.concatenate([sim.stress(b.name) for b in scene.bodies]))
        for body, sigma in zip(scene.bodies, np.split(found["as it is"], ends)):
            law = body.material
            _, P = ts.evaluate_law(law.law, F[None], law.young, law.poisson)
            wanted = P[0] @ F.T / np.linalg.det(F)
            assert np.abs(wanted).max() > 1e3 and np.abs(sigma - wanted).max() < 1e-8 * np.abs(wanted).max(), body.name
        assert np.allclose(von_mises(found["turned"]), von_mises(found["as it is"]), rtol=1e-8)


PAIRS = {"near": ("proximity", 2), "field": ("distance_field", 1)}


def piled():
    """Of each kind a cube that meets a slab, which meets the ground; a ball beside them meets nothing."""
    scene = ts.Scene(gravity=(0, 0, 0))
    slab = ts.box_mesh((3, 1, 3), (0.3, 0.1, 0.3), (0, 0.051, 0))
    cube = ts.box_mesh((2, 2, 2), (0.1,) * 3, (0.01, 0.1515, 0.02))
    for k, (name, (collision, order)) in enumerate(PAIRS.items()):
        kind = {"position": (k, 0, 0), "collision": collision, "order": order}
        scene.add_body(slab, rubber(), name=f"{name} slab", velocity=(0, -0.5, 0), **kind)
        scene.add_body(cube, rubber(), name=f"{name} cube", velocity=(0.2, -1.5, 0), **kind)
    scene.add_body(ts.ball_mesh(0.1, 2), rubber(), name="ball", position=(0, 1, 0))
    scene.add_obstacle(ts.HalfSpace((0, 0, 0), (0, 1, 0)), name="ground", friction=0.5)
    return scene


def test_impulses_sum_up():
    scene, dt = piled(), 2e-4
    met, kinds = set(), set()
    with ts.Simulator(scene, dt=dt, integrator="symplectic_euler", precision="f64") as sim:
        n = len(sim.positions())
        assert contact_impulses(sim.contacts(), n).shape == (n, 3) and not contact_impulses(sim.contacts(), n).any()
        for _ in range(40):
            sim.step()
            c = sim.contacts()
            pushes = c.impulse.any(axis=1)
            met |= set(zip(c.body_a[pushes], c.body_b[pushes]))
            kinds |= set(c.kind[pushes])
            impulses, first = contact_impulses(c, n), 0
            rounding = 1e-15 * np.abs(c.impulse).sum()
            for body in scene.bodies:
                own = impulses[first : first + body.n_nodes]
                first += body.n_nodes
                wanted = c.impulse[c.body_a == body.name].sum(axis=0) - c.impulse[c.body_b == body.name].sum(axis=0)
                assert np.abs(own.sum(axis=0) - wanted).max() <= 10 * rounding
                assert np.abs(wanted - dt * sim.contact_force(body.name)).max() <= 10 * rounding
                inner = np.setdiff1d(np.arange(body.n_nodes), body.nodes.surface)
                assert len(inner) > 0 or body.name.endswith("slab")
                assert not own[inner].any()
            assert np.abs(impulses.sum(axis=0) - c.impulse[c.body_b == "ground"].sum(axis=0)).max() <= 10 * rounding
    assert met == {(f"{name} slab", other) for name in PAIRS for other in (f"{name} cube", "ground")}
    assert "vertex_field" in kinds or "face_field" in kinds
    assert "vertex_face" in kinds
