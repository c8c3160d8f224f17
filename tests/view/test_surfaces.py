"""What pictures are made of: surfaces, the squares of half-spaces, shadows, lines, and picking and dragging them."""

import numpy as np
import pytest

import taisoft as ts
from taisoft.mesh.distances import ray_hits
from taisoft.output.smoothing import smoothing_groups, vertex_normals
from taisoft.output.viewpoint import Viewpoint
from taisoft.scene.key_frames import KeyFrames
from taisoft.view.drawn import DrawnScene
from taisoft.view.ground import Square, finite_points
from taisoft.view.layers import Layers
from taisoft.view.offscreen import Offscreen
from taisoft.view.scene_view import MARKER_COLOUR, Surfaces
from taisoft.view.shadow import Shadows, blurred
from taisoft.view.window.picking import MouseDrag, pick
from taisoft.view.window.window_shadow import ShadowMesh
from tests.view.drawing import sampled
from tests.view.fake_simulator import RUBBER, FakeSimulator, beam_scene


def test_edges_of_a_box_are_sharp_and_a_ball_is_smooth():
    box, ball = ts.box_mesh((2, 3, 4), (1, 1, 1)), ts.ball_mesh(2.0, 8)
    for mesh, n, least in ((box, 2 * (3 * 4 + 4 * 5 + 3 * 5), 0.4), (ball, len(np.unique(ball.surface)), 1.95)):
        nodes, corners = smoothing_groups(mesh.vertices, mesh.surface)
        assert (
            np.array_equal(nodes[corners], mesh.surface) and len(nodes) == n
        )  # sides share no vertices, the ball's are not split
        normals = vertex_normals(mesh.vertices[nodes], corners)
        assert (np.einsum("ij,ij->i", normals, mesh.vertices[nodes]) > least).all()
        assert mesh is ball or np.allclose(np.abs(normals).max(axis=1), 1.0)


@pytest.mark.parametrize("order", [1, 2])
def test_drawn_surface_follows_the_body_and_marks_fixed_nodes(order):
    scene = beam_scene(("one", "two"), order=order)
    surfaces, sim = Surfaces(scene), FakeSimulator(scene)
    x, normals = surfaces.of_bodies(sampled(sim))
    sim.time = 1.0
    moved, _ = surfaces.of_bodies(sampled(sim))
    assert len(x) == len(normals) == len(surfaces.colours)
    assert surfaces.triangles.min() == 0 and surfaces.triangles.max() == len(x) - 1
    assert (moved[:, 1] <= x[:, 1] + 1e-12).all() and (x[:, 1] - moved[:, 1]).max() > 1.0
    assert len(np.unique(surfaces.colours, axis=0)) == 3  # two bodies and the markers
    n_fixed = (2 * order + 1) ** 2  # nodes of the left end
    assert (surfaces.colours == MARKER_COLOUR).all(axis=1).sum() == 2 * n_fixed * 62  # vertices of a marker
    assert np.allclose(np.linalg.norm(normals, axis=1), 1.0)
    a, b, c = np.moveaxis(x[surfaces.triangles], 1, 0)
    outward = normals[surfaces.triangles].sum(axis=1)
    assert (np.einsum("ij,ij->i", np.cross(b - a, c - a), outward) > 0).all()


FLOOR, CORNERS = ts.HalfSpace((0, 0, 0), (0, 1, 0)), np.array([(x, 0.0, z) for x in (-2.0, 2.0) for z in (-2.0, 2.0)])
WALL, SLOPE = ts.HalfSpace((-2, 0, 0), (1, 0, 0)), ts.HalfSpace((0, 0, 0), (1, 1, 0))
BEHIND, CEILING = ts.HalfSpace((0, 0, -2), (0, 0, 1)), ts.HalfSpace((0, 9, 0), (0, -1, 0))


def cloud(centre, half=0.5):
    return np.array(centre) + half * np.array([(-1.0, 0, -1), (1, 0.3, 1), (1, 2, -1), (-1, 1, 1)])


def test_a_square_moves_along_with_the_bodies_and_grows():
    """A cut one only along the cut."""

    def extent(others, points):
        square = Square(FLOOR, CORNERS, others).below(points)
        assert (square[:, 1] == 0.0).all()
        return np.stack([square.min(axis=0), square.max(axis=0)], axis=1)[[0, 2]].tolist()

    for points in (cloud((0.5, 1, -0.5)), np.full((3, 3), np.nan), np.vstack([cloud((0.0, 1, 0)), [np.inf, 0, 0]])):
        assert Square(FLOOR, CORNERS, []).below(finite_points(points)) is CORNERS
    for place, half in (((7.0, 1.0, 0.0), 0.5), ((-30.0, 5.0, 12.0), 0.5), ((0.0, 1.0, 0.0), 10.0)):
        for (low, high), at in zip(extent([], cloud(place, half)), (place[0], place[2])):
            gaps = (at - half - low, high - at - half)
            assert min(gaps) > 0.2 and (min(gaps) < 1.0 or max(abs(at), half) <= 2.0), "no farther than needed"
            assert high - low == pytest.approx(4.0) if half < 2.0 else gaps[0] == pytest.approx(gaps[1])
    for others, moves in (
        ([WALL], [False, True]),
        ([WALL, BEHIND], [False] * 2),
        ([SLOPE], [False, True]),
        ([CEILING], [True] * 2),
    ):
        assert [low != pytest.approx(-2.0) for low, _ in extent(others, cloud((9.0, 1.0, 9.0)))] == moves


ABOVE = Viewpoint(target=np.array([0.0, 0.0, 0.0]), distance=8.0, azimuth=0.0, elevation=15.0)


def cube_above(height, normal=(0.0, 1.0, 0.0), path=None):
    """A cube of 1 m above a half-space through the origin."""
    scene = ts.Scene()
    scene.add_body(ts.box_mesh((2, 2, 2), (1, 1, 1)), RUBBER, name="cube", position=(0, height + 0.5, 0))
    scene.add_obstacle(ts.HalfSpace((0, 0, 0), normal), name="ground", path=path)
    return scene


def maps_of(scene, bad=None, t=0.0):
    """Shadow maps and their texels; bad: vertices that are not finite."""
    surfaces = Surfaces(scene)
    sim = FakeSimulator(scene)
    sim.time = t
    state = sampled(sim)
    x, _ = surfaces.with_obstacles(surfaces.of_bodies(state), state, np.array([0.0, 9.0, 9.0]))
    if bad is not None:
        x[bad] = np.nan
    return Shadows(state.scene, surfaces).draw(x, state.poses)


def test_the_ground_is_darker_below_a_body():
    scene, size = cube_above(0.7), (160, 120)
    picture = Offscreen(scene, size, ABOVE).image(FakeSimulator(scene)).astype(int)
    columns, rows, _ = ABOVE.project(np.array([[0.0, 0.0, 0.3], [0.0, 0.0, 1.5], [1.5, 0.0, 0.3]]), size).astype(int).T
    below, before, beside = picture[rows, columns]
    assert (below < 0.9 * beside).all() and np.ptp(below) < 12, "grey"
    assert (beside > 150).all() and np.abs(before - beside).max() < 12


def test_a_shadow_lies_below_its_body_and_fades_exponentially_with_height():
    """The nodes of the ground's square lie where the map is zero, and the middle of the cube's shadow where it is dark."""
    first, second, third = (maps_of(cube_above(height))[0].max() for height in (0.0, 0.2, 0.5))
    assert 1.0 > first > second > third > 0.05
    assert np.log(first / third) == pytest.approx(2.5 * np.log(first / second), rel=0.1)
    (shadow,), at = maps_of(cube_above(0.1))
    ground, n = at[:, 2] == 0, len(shadow)
    assert ground.any() and (at[~ground, 2] == -1).all()
    assert shadow[0].max() == shadow[-1].max() == shadow[:, 0].max() == shadow[:, -1].max() == 0.0
    assert shadow[n // 2 - 2 : n // 2 + 2, n // 2 - 2 : n // 2 + 2].min() > 0.9 * shadow.max()
    assert np.allclose(at[ground].mean(axis=0)[:2], n / 2, atol=1e-6)


def test_shadows_on_slopes_and_moving_half_spaces_and_of_nodes_that_are_not_finite():
    for normal, has_shadow in (((1, 3, 0), True), ((0, -1, 0), False), ((0, 0.2, 1), False)):  # walls have none
        maps, at = maps_of(cube_above(1.0, normal))
        assert (maps.max() > 0.05) == has_shadow and (at[:, 2].max() == 0) == has_shadow
    lifted, scene = cube_above(0.5, path=KeyFrames([0.0, 1.0], [(0.0, 0.0, 0.0), (0.0, 0.2, 0.0)])), cube_above(0.1)
    assert maps_of(lifted, t=1.0)[0].max() > 1.2 * maps_of(lifted)[0].max()
    some, _ = maps_of(scene, slice(0, 3))
    assert np.isfinite(some).all() and 0.1 < some.max() <= 1.0
    none, at = maps_of(scene, slice(0, Surfaces(scene).n_of_bodies))
    assert none.max() == 0.0 and (at[:, 2] == -1).all()


def test_shadows_fall_along_the_first_light_from_above_and_are_lighter_below_transparent_bodies():
    """A light that is nearly level casts none."""
    low, side = ts.Light((1, -0.1, 0)), ts.Light((1, -1, 0))
    for lights, moved in ((None, 0.0), ((), 0.0), ((low,), 0.0), ((low, side, ts.Light((0, -1, 0))), 1.0)):
        scene = cube_above(1.0)
        scene.lights = lights
        surfaces = Surfaces(scene)
        state = sampled(FakeSimulator(scene))
        x, _ = surfaces.with_obstacles(surfaces.of_bodies(state), state, ABOVE.position)
        (shadow,) = Shadows(state.scene, surfaces).maps(x, state.poses)
        v, u = (weights @ (np.arange(len(weights)) + 0.5) for weights in (shadow.darkness.sum(axis=k) for k in (1, 0)))
        centre = shadow.origin + (np.array([u, v]) / shadow.darkness.sum() * shadow.texel + shadow.low) @ shadow.axes[:2]
        height = x[: surfaces.n_of_bodies, 1].mean()
        assert centre[[0, 2]] == pytest.approx([moved * height, 0.0], abs=0.3)
    scene = cube_above(0.1)
    dark, _ = maps_of(scene)
    scene.bodies[0].opacity = 0.25
    assert np.allclose(maps_of(scene)[0], 0.25 * dark)


def test_the_window_has_the_shadow_as_a_mesh_on_the_ground():
    scene = cube_above(0.1)
    surfaces = Surfaces(scene)
    state = sampled(FakeSimulator(scene))
    x, _ = surfaces.with_obstacles(surfaces.of_bodies(state), state, ABOVE.position)
    mesh = ShadowMesh(state.scene, surfaces)
    points, colours, triangles = mesh.draw(x, state.poses, ABOVE)
    assert len(points) == len(colours) == mesh.size[0] and len(triangles) <= mesh.size[1]
    rays = points - ABOVE.position  # they lie a little nearer to the eye
    on_ground = ABOVE.position - rays * (ABOVE.position[1] / rays[:, 1:2])
    assert np.allclose(points, on_ground, atol=0.02) and (points[:, 1] > 0).all()
    assert np.abs(on_ground[colours[:, 0].argmin()][[0, 2]]).max() < 0.5, "darkest below the cube"
    assert colours[triangles].min() < 0.7 * colours[triangles].max()
    clear = ts.Scene()
    clear.add_body(scene.bodies[0].mesh, RUBBER, position=scene.bodies[0].position)
    clear.add_ground(opacity=0.5)
    clear = DrawnScene.of(clear)
    assert ShadowMesh(clear, Surfaces(clear)).draw(x, {}, ABOVE) is None, "it would hide what a transparent ground shows"


def test_the_mesh_of_shadows_has_room_for_a_wall_that_faces_a_slanting_light():
    scene = cube_above(0.1)
    scene.add_obstacle(ts.HalfSpace((-1, 0, 0), (1, 0, 0)), "wall")
    scene.lights = (ts.Light((-1, -1, 0)),)
    surfaces = Surfaces(scene)
    state = sampled(FakeSimulator(scene))
    x, _ = surfaces.with_obstacles(surfaces.of_bodies(state), state, ABOVE.position)
    mesh = ShadowMesh(state.scene, surfaces)
    points, _, triangles = mesh.draw(x, state.poses, ABOVE)
    assert len(points) == mesh.size[0] and points[:, 0].min() < -0.5 and len(triangles) <= mesh.size[1]


def test_a_blur_keeps_the_sum_and_spreads_by_its_deviation():
    smooth = blurred(np.pad(np.ones((1, 1)), ((20, 19), (30, 29))), (2.0, 4.0))
    assert smooth.sum() == pytest.approx(1.0)
    deviation = [np.sqrt((smooth * (axis - middle) ** 2).sum()) for axis, middle in zip(np.mgrid[:40, :60], (20, 30))]
    assert deviation == pytest.approx([2.0, 4.0], rel=0.15)  # cut off at two deviations


def test_ray_hits_the_nearest_triangle():
    x = np.array([[0.0, 0, 0], [1, 0, 0], [0, 1, 0], [0, 0, 2], [1, 0, 2], [0, 1, 2]])
    triangles, ray = np.array([[3, 4, 5], [0, 2, 1]]), np.array([0.0, 0, 1])
    for z, nearest in ((-1, 1), (1, 0)):
        along, u, v = ray_hits(x[triangles], np.array([0.2, 0.3, z]), ray)
        t = int(np.argmin(along))
        assert t == nearest and np.allclose((1 - u[t] - v[t], u[t], v[t]) @ x[triangles[t]], (0.2, 0.3, 2 - 2 * t))
    for beside in ([0.2, 0.3, 3], [0.9, 0.3, -1]):
        assert np.isinf(ray_hits(x[triangles], np.array(beside), ray)[0]).all()


TWO = (("one", "two"), (8, 2, 2))


def ball_in_a_cube(cells, size, order):
    """A skin in a cube of tets."""
    scene, ball = ts.Scene(), ts.ball_mesh(0.45, 4)
    body = scene.add_body(ts.box_mesh((cells,) * 3, (size,) * 3), RUBBER, name="two", position=(3, 0, 0), order=order)
    used, triangles = np.unique(ball.surface, return_inverse=True)
    body.embed(ts.SurfaceMesh(ball.vertices[used], triangles.reshape(-1, 3)))
    return scene


@pytest.mark.parametrize(
    "build, arguments",
    [(beam_scene, (*TWO, 1)), (beam_scene, (*TWO, 2)), (ball_in_a_cube, (12, 1.0, 1)), (ball_in_a_cube, (1, 0.8, 2))],
)  # the last one's tets do not hold all of the skin
def test_cursor_picks_and_drags_a_body(build, arguments):
    """Deformed, and as the window's process sees it."""
    scene, size = build(*arguments), (1600, 900)
    real, body = FakeSimulator(scene), scene.bodies[-1]
    real.time = 1.0
    sim, camera = sampled(real), Viewpoint.framing(real.positions())
    x = sim.positions("two")
    skin = body.riding_skin
    shown, triangles = (x, body.nodes.surface) if skin is None else (skin.weights @ x, skin.surface.triangles)
    centres = shown[triangles].mean(axis=1)
    point = centres[np.argmin(np.linalg.norm(centres - camera.position, axis=1))]

    def cursor_at(place):
        across, down, _ = camera.project(place[None], size)[0]
        return across / size[0], 1 - down / size[1]

    cursor = cursor_at(point)
    hit = pick(sim, camera, cursor, size)
    assert scene.bodies[hit.body] is body and np.allclose(hit.point, point) and np.allclose(hit.weights @ x[hit.nodes], point)
    drag = MouseDrag(sim, hit)
    target = drag.target
    assert drag.body == "two" and drag.weights.sum() == pytest.approx(1.0) and (drag.weights > 0.0).all() and len(drag.nodes) >= 3
    assert np.linalg.norm(drag.weights @ body.rest_positions[drag.nodes] - hit.weights @ body.rest_positions[hit.nodes]) < 0.3
    assert np.allclose(target, drag.weights @ x[drag.nodes]), "without motion there is no force"
    drag.move(camera, cursor, size)
    assert np.allclose(drag.target, target)
    up = (cursor[0], cursor[1] + 0.1)
    assert drag.move(camera, up, size) and not drag.move(camera, up, size)
    along = camera.axes @ (drag.target - target)
    assert along[[0, 2]] == pytest.approx(0, abs=1e-9) and along[1] > 0
    assert np.allclose(drag.line(sim), [point, point + drag.target - target]), "it begins at the point under the cursor"
    assert pick(sim, camera, (0.01, 0.99), size) is None
    inside = 0.98 * x + 0.02 * x.mean(axis=0)
    corner = cursor_at(inside[np.argmax(inside @ camera.axes[0])])
    assert skin is None or pick(sim, camera, corner, size) is None, "only a corner of the tets is there"


def test_lines_of_layers():
    scene = beam_scene()
    scene.bodies[0].add_traction(lambda c: c[:, 0] > 1.99, (0, 0, 50.0))
    sim, layers, camera = FakeSimulator(scene), Layers(scene), Viewpoint.framing(scene.bodies[0].rest_positions)
    contacts, found = sim.contacts(), {}
    loaded = 2 * 2 * 2  # triangles of the end
    counts = {"wires": 3 * len(scene.bodies[0].mesh.surface) // 2, "contacts": 2, "tractions": 3 * loaded, "fixed_nodes": 0}
    for name, count in counts.items():
        layers.shown = {other: other == name for other in layers.shown}
        found[name], colours = layers.lines(sampled(sim, [name]), camera)
        assert len(found[name]) == len(colours) == 2 * count <= 2 * layers.n_segments
    nodes, drawn = (camera.project(points, (200, 100))[:, :2] for points in (sim.positions(), found["wires"]))
    assert np.linalg.norm(drawn[:, None] - nodes, axis=2).min(axis=1).max() < 1e-9, "wires end at nodes"
    a, b, _, c = (found["contacts"] - camera.position) / 0.1 + camera.position
    assert np.allclose(a, contacts.point) and np.allclose((b - a) / np.linalg.norm(b - a), contacts.normal)
    assert np.allclose(np.cross(c - a, contacts.impulse[0]), 0, atol=1e-12)


def test_strokes_lie_in_triangles_along_deformed_fibres():
    scene, (mesh, a) = ts.Scene(), (ts.box_mesh((2, 1, 1), (1, 0.4, 0.4)), np.array([0.6, 0.8, 0.0]))
    scene.add_body(mesh, RUBBER, name="plain", position=(0, 3, 0))
    scene.add_body(mesh, ts.Material(active_stress=1.0), name="muscle", fibres=a)
    (nodes, weights), first = DrawnScene.of(scene).bodies[1].strokes, len(mesh.vertices)
    F = np.array([[1.2, 0.3, 0.0], [0.0, 0.9, 0.1], [0.2, 0.0, 1.1]])
    x = np.concatenate([mesh.vertices, mesh.vertices @ F.T])
    ends, corners = weights @ x[first + nodes], (mesh.vertices @ F.T)[mesh.surface]
    assert np.allclose(ends.mean(axis=1), corners.mean(axis=1))
    p, q, r = (mesh.vertices[mesh.surface[:, k]] for k in range(3))
    normal = np.cross(q - p, r - p)
    normal /= np.linalg.norm(normal, axis=1, keepdims=True)
    along = (a - (normal @ a)[:, None] * normal) @ F.T
    assert np.allclose(np.cross(ends[:, 1] - ends[:, 0], along), 0.0, atol=1e-12) and np.ptp(ends, axis=1).max() > 0.1
