"""Skins: embedded weights, motion, contacts on the skin, drawing, USD, refinement, files and refusals."""

import numpy as np
import pytest

import taisoft as ts
from taisoft.mesh.nodes import make_nodes
from taisoft.output.appearance import ShownBodies
from taisoft.output.nodal_fields import NodalMean
from taisoft.scene.fingerprint import scene_digest
from taisoft.scene.plan import make_plan
from taisoft.scene.refine import refined, with_order
from tests.cli.command import write

CAGE = ts.box_mesh(cells=(2, 2, 2), size=(1, 1, 1))
GROUND = ts.HalfSpace(point=(0, 0, 0), normal=(0, 1, 0))
SOFT = ts.Material(young=2e5, density=500.0, mass_damping=5.0)


def ball(radius: float = 0.45, cells: int = 4) -> ts.SurfaceMesh:
    mesh = ts.ball_mesh(radius=radius, cells=cells)
    used, triangles = np.unique(mesh.surface, return_inverse=True)
    return ts.SurfaceMesh(mesh.vertices[used], triangles.reshape(-1, 3))


def skinned(contact: bool, order: int = 1, **arguments) -> tuple[ts.Scene, ts.Body]:
    scene = ts.Scene()
    body = scene.add_body(CAGE, SOFT, name="cage", order=order, **arguments)
    body.embed(ball(), contact=contact)
    return scene, body


@pytest.mark.parametrize("order", [1, 2])
def test_weights_reproduce_the_skin_and_every_affine_motion(order):
    _, body = skinned(False, order)
    W, X = body.skin.weights, body.rest_positions
    assert np.allclose(W @ X, body.skin.surface.vertices, atol=1e-14)
    A, b = np.random.default_rng(0).normal(size=(3, 3)), np.array([1.0, 2.0, 3.0])
    assert np.allclose(W @ (X @ A.T + b), body.skin.surface.vertices @ A.T + b, atol=1e-13)


@pytest.mark.parametrize("order", [1, 2])
def test_a_touched_skin_adds_nodes_behind_those_of_the_tets(order):
    _, body = skinned(True, order)
    own = make_nodes(CAGE, order)
    n = len(own.positions)
    assert body.n_nodes == n + len(ball().vertices) and body.nodes.n_elastic == n and body.selectable == slice(0, n)
    assert np.array_equal(body.nodes.surface - n, ball().triangles) and np.array_equal(body.nodes.boundary, own.surface)
    fixed = body.fix(lambda X: X[:, 1] < 0)
    assert fixed.nodes.max() < n


@pytest.mark.parametrize("integrator", ["symplectic_euler", "implicit_euler"])
def test_a_skin_rests_on_the_ground_where_its_tets_would_sink_in(integrator):
    scene, body = skinned(True, position=(0, 0.452, 0))
    scene.add_obstacle(GROUND)
    dt = 1 / 120 if integrator == "implicit_euler" else 2e-4
    with ts.Simulator(scene, dt=dt, integrator=integrator, precision="f64") as sim:
        result = sim.run(seconds=1.5)
        assert result.status == "ok"
        x = sim.positions("cage")
        n = body.nodes.n_elastic
        assert np.allclose(x[n:], body.skin.weights @ x[:n], atol=1e-12)
        assert -1e-3 < x[n:, 1].min() < 1e-2 and x[:n, 1].min() < -0.02
        assert sim.contact_force("cage")[1] == pytest.approx(body.mass * 9.81, rel=0.05)


def test_a_riding_skin_changes_no_bit_of_the_motion():
    def run(with_skin: bool) -> np.ndarray:
        scene = ts.Scene()
        body = scene.add_body(CAGE, SOFT, name="cage", position=(0, 0.502, 0), velocity=(1, 0, 0))
        if with_skin:
            body.embed(ball())
        scene.add_obstacle(GROUND)
        assert not make_plan(scene, False, False).on["dependent_nodes"]
        with ts.Simulator(scene, dt=1 / 60, integrator="implicit_euler") as sim:
            sim.run(seconds=0.2)
            return sim.positions()

    assert np.array_equal(run(True), run(False))


def test_momentum_is_kept_when_skins_collide():
    scene = ts.Scene(gravity=(0, 0, 0))
    free = ts.Material(young=2e5, density=500.0)
    for k, v in ((0, 1.0), (1, -0.5)):
        scene.add_body(CAGE, free, name=f"b{k}", position=(1.3 * k, 0.1 * k, 0.05 * k), velocity=(v, 0, 0)).embed(
            ball(), contact=True
        )
    with ts.Simulator(scene, dt=1 / 100, integrator="implicit_euler", precision="f64") as sim:
        mass = sim.scene.bodies[0].mass
        assert sim.run(seconds=0.8).status == "ok"
        means = [
            np.average(
                sim.velocities(f"b{k}")[: CAGE.n_verts],
                axis=0,
                weights=np.bincount(CAGE.tets.ravel(), np.repeat(CAGE.volumes, 4)),
            )
            for k in (0, 1)
        ]
        assert np.allclose(mass * (means[0] + means[1]), [0.5 * mass, 0, 0], atol=1e-6 * mass)
        assert means[0][0] < 0.9  # they have met
        assert sim.intersecting_triangles() == []


def test_pictures_and_usd_show_the_skin(tmp_path):
    from pxr import Usd, UsdGeom

    from taisoft.output.usd import UsdWriter

    for contact in (False, True):
        scene, body = skinned(contact)
        shown = ShownBodies(scene)
        assert len(shown.surfaces[0][1]) == len(ball().triangles) and (shown.matrix is None) is contact
        with ts.Simulator(scene, dt=1 / 60, integrator="implicit_euler", precision="f64") as sim:
            sim.run(seconds=0.1)
            x = sim.positions("cage")[: body.nodes.n_elastic]
            writer = UsdWriter(tmp_path / str(contact), sim.scene, 60.0)
            writer.frame(sim, 0)
            writer.close()
        stage = Usd.Stage.Open(str(tmp_path / str(contact) / "scene.usdc"))
        points = np.array(UsdGeom.Mesh(stage.GetPrimAtPath("/World/cage/surface")).GetPointsAttr().Get(0))
        assert np.allclose(points, body.skin.weights @ x, atol=1e-6)


def test_nodal_means_are_carried_to_a_touched_skin():
    _, body = skinned(True)
    values = np.random.default_rng(1).normal(size=CAGE.n_tets)
    mean, n = NodalMean([body])(values), body.nodes.n_elastic
    assert np.allclose(mean[n:], body.skin.weights @ mean[:n])


def test_refinement_and_order_embed_the_skin_again():
    scene, _ = skinned(True, velocity=(1, 0, 0))
    for changed in (refined(scene), with_order(scene, 2), with_order(refined(scene), 2)):
        body = changed.body("cage")
        assert body.skin.contact and np.allclose(
            body.skin.weights @ body.rest_positions[: body.nodes.n_elastic], ball().vertices, atol=1e-13
        )


def test_velocities_of_nodes_reach_the_skin():
    scene = ts.Scene()
    v = np.random.default_rng(2).normal(size=(CAGE.n_verts, 3))
    body = scene.add_body(CAGE, SOFT, velocity=v)
    body.embed(ball(), contact=True)
    assert np.allclose(body.velocity[CAGE.n_verts :], body.skin.weights @ v)


FILE = """
[bodies.cage]
mesh = { shape = "box", cells = [1, 1, 1], size = [1, 1, 1] }
material = { young = 1e5 }

[bodies.cage.skin]
contact = true

[bodies.cage.skin.surface]
vertices = [[0, 0, 0], [0.4, 0, 0], [0, 0.4, 0], [0, 0, 0.4]]
triangles = [[0, 2, 1], [0, 1, 3], [0, 3, 2], [1, 2, 3]]
"""


def test_scene_files_hold_skins(tmp_path):
    scene, _ = ts.read_scene(write(tmp_path / "a.toml", FILE))
    assert scene.body("cage").skin.contact and scene.body("cage").n_nodes == 8 + 4
    ts.write_scene(tmp_path / "b.toml", scene)
    again, _ = ts.read_scene(tmp_path / "b.toml")
    assert scene_digest(again) == scene_digest(scene)
    with pytest.raises(ts.SceneError, match="bodies.cage.skin.*vertex 1 lies outside of the body"):
        ts.read_scene(write(tmp_path / "c.toml", FILE.replace("[0.4, 0, 0]", "[4, 0, 0]")))


def test_checkpoints_tell_skins_apart(tmp_path):
    scene, _ = skinned(True)
    with ts.Simulator(scene, dt=1 / 60, integrator="implicit_euler") as sim:
        sim.step()
        sim.save_checkpoint(tmp_path / "c.npz")
    other = ts.Scene()
    other.add_body(CAGE, SOFT, name="cage").embed(ball(cells=2), contact=True)
    with pytest.raises(ts.SceneError, match="surface"):
        ts.Simulator.load_checkpoint(tmp_path / "c.npz", other)


@pytest.mark.parametrize(
    ("surface", "arguments", "message"),
    [
        (3, {}, "surface must be a SurfaceMesh"),
        (ball(2.0), {}, "lies outside of the body, by"),
        (ts.SurfaceMesh(ball().vertices, ball().triangles[1:]), {"contact": True}, "must bound a solid: 1 hole"),
        (ball(), {"contact": 1}, "contact must be True or False"),
    ],
)
def test_bad_skins_are_refused(surface, arguments, message):
    body = ts.Scene().add_body(CAGE, SOFT, name="cage")
    with pytest.raises(ts.SceneError) as caught:
        body.embed(surface, **arguments)
    assert message in str(caught.value) and body.skin is None


def test_a_second_skin_and_distance_fields_are_refused():
    _, body = skinned(True)
    with pytest.raises(ts.SceneError, match="has a skin already"):
        body.embed(ball())
    with pytest.raises(ts.SceneError, match="has no distance field"):
        body.collision = "distance_field"
    other = ts.Scene().add_body(CAGE, SOFT, collision="distance_field")
    with pytest.raises(ts.SceneError, match="has no distance field"):
        other.embed(ball(), contact=True)
    with pytest.raises(ts.SceneError, match="skin cannot be set: call body.embed"):
        body.skin = None
