"""Skins: embedded weights, nodes, USD, refinement, refusals (files: test_toml_round_trips.py; contact: demos/seesaw.py)."""

import numpy as np
import pytest
from pxr import Usd

import taisoft as ts
from taisoft.mesh.nodes import make_nodes
from taisoft.output.nodal_fields import NodalMean
from taisoft.output.usd import UsdWriter
from taisoft.scene.plan import make_plan
from taisoft.scene.refine import refined, with_order
from tests.view.fake_simulator import FakeSimulator

CAGE = ts.box_mesh(cells=(2, 2, 2), size=(1, 1, 1))
SOFT = ts.Material(young=2e5, density=500.0)


def ball(radius: float = 0.45) -> ts.SurfaceMesh:
    mesh = ts.ball_mesh(radius=radius, cells=4)
    used, triangles = np.unique(mesh.surface, return_inverse=True)
    return ts.SurfaceMesh(mesh.vertices[used], triangles.reshape(-1, 3))


def skinned(contact: bool, order: int = 1, **arguments) -> tuple[ts.Scene, ts.Body]:
    scene = ts.Scene()
    body = scene.add_body(CAGE, SOFT, name="cage", order=order, **arguments)
    body.embed(ball(), contact=contact)
    return scene, body


@pytest.mark.parametrize("order", [1, 2])
def test_weights_follow_affine_motions_and_a_touched_skin_adds_nodes_behind_those_of_the_tets(order):
    scene, body = skinned(True, order)
    n, W, own = body.nodes.n_elastic, body.skin.weights, make_nodes(CAGE, order)
    X, skin = body.rest_positions[:n], body.skin.surface.vertices
    A, b = np.random.default_rng(0).normal(size=(3, 3)), np.array([1.0, 2.0, 3.0])
    assert np.allclose(W @ X, skin, atol=1e-14) and np.allclose(W @ (X @ A.T + b), skin @ A.T + b, atol=1e-13)
    assert n == len(own.positions) and body.n_nodes == n + len(skin) and body.selectable == slice(0, n)
    assert np.array_equal(body.nodes.surface - n, ball().triangles) and np.array_equal(body.nodes.boundary, own.surface)
    assert body.fix(lambda X: X[:, 1] < 0).nodes.max() < n
    assert make_plan(scene, False, False).on["dependent_nodes"]
    riding, body = skinned(False, order)
    assert body.n_nodes == n and np.array_equal(body.nodes.surface, own.surface)
    assert not make_plan(riding, False, False).on["dependent_nodes"]


def test_usd_shows_the_skin(tmp_path):
    scene, body = skinned(False)
    sim, writer = FakeSimulator(scene), UsdWriter(tmp_path, scene, 60.0)
    sim.time = 0.5
    writer.frame(sim, 0)
    writer.close()
    stage, skin = Usd.Stage.Open(str(tmp_path / "scene.usdc")), body.skin.weights @ sim.positions("cage")
    points = np.array(stage.GetAttributeAtPath("/World/cage/surface.points").Get(0))
    assert np.allclose(points, skin, atol=1e-6) and not np.allclose(points, ball().vertices, atol=1e-2)


def test_values_and_velocities_of_nodes_reach_a_touched_skin_which_refinement_embeds_again():
    _, body = skinned(True)
    values = np.random.default_rng(1).normal(size=CAGE.n_tets)
    mean, n = NodalMean([body])(values), body.nodes.n_elastic
    assert np.allclose(mean[n:], body.skin.weights @ mean[:n])
    v = np.random.default_rng(2).normal(size=(CAGE.n_verts, 3))
    _, body = skinned(True, velocity=v)
    assert np.allclose(body.velocity[n:], body.skin.weights @ v)
    scene, _ = skinned(True, velocity=(1, 0, 0))
    for changed in (refined(scene), with_order(scene, 2), with_order(refined(scene), 2)):
        body = changed.body("cage")
        x = body.skin.weights @ body.rest_positions[: body.nodes.n_elastic]
        assert body.skin.contact and np.allclose(x, ball().vertices, atol=1e-13)


def test_bad_skins_are_refused():
    open_ball = ts.SurfaceMesh(ball().vertices, ball().triangles[1:])
    new, field = ts.Scene().add_body(CAGE, SOFT), ts.Scene().add_body(CAGE, SOFT, collision="distance_field")
    body = skinned(True)[1]
    for call, message in (
        (lambda: new.embed(3), "surface must be a SurfaceMesh"),
        (lambda: new.embed(ball(2.0)), "lies outside of the body, by"),
        (lambda: new.embed(open_ball, contact=True), "must bound a solid: 1 hole"),
        (lambda: new.embed(ball(), contact=1), "contact must be True or False"),
        (lambda: body.embed(ball()), "has a skin already"),
        (lambda: setattr(body, "collision", "distance_field"), "has no distance field"),
        (lambda: field.embed(ball(), contact=True), "has no distance field"),
        (lambda: setattr(body, "skin", None), "skin cannot be set: call body.embed"),
    ):
        with pytest.raises(ts.SceneError, match=message):
            call()
    assert new.skin is field.skin is None
