"""The camera: framing, projection, motion, rays and clipping."""

import numpy as np
import pytest

import taisoft as ts
from taisoft.cli.scene_file import load_scene
from taisoft.mesh.placing import FROM_Y_UP
from taisoft.output.viewpoint import BORDER, EDGE, FILL, WHOLE, Viewpoint, framed_points, start_positions
from tests.view.numpy_raster import rasterise

SIZE = (320, 180)


@pytest.mark.parametrize("azimuth, elevation", [(0, 0), (32, 20), (140, -60), (270, 89)])
def test_framing_shows_all_points(azimuth, elevation):
    points = np.random.default_rng(0).uniform(-1, 1, (200, 3)) * (4, 1, 1) + (10, 20, 30)
    camera = Viewpoint.framing(points, azimuth=azimuth, elevation=elevation)
    projected = camera.project(points, SIZE)
    assert (projected[:, 2] > 0).all()
    fill = np.abs(2 * projected[:, :2] / SIZE - 1).max(axis=0)  # of the picture's width and height
    assert fill.max() == pytest.approx(FILL)
    assert np.allclose(camera.project(camera.target[None], SIZE), [[160, 90, camera.distance]])


@pytest.mark.parametrize("azimuth, elevation", [(0, 0), (32, 20), (140, -60), (270, 89)])
@pytest.mark.parametrize("free", [WHOLE, (0.4, 0.0, 1.0, 1.0), (0.1, 0.0, 0.3, 0.7)])
def test_framing_is_as_close_as_the_free_part_of_the_picture_allows(azimuth, elevation, free):
    """Two opposite sides of the part, less its border, are touched, and a camera that has moved back is so, too."""
    points = np.random.default_rng(0).uniform(-1, 1, (200, 3)) * (3, 1, 2) + (10, 20, 30)
    left, bottom, right, top = free

    def gaps(camera, points):
        """Distances from the left, right, bottom and top end of the part, (2,2), as fractions of its width and height."""
        projected = camera.project(points, SIZE)
        assert (projected[:, 2] > 0).all()
        within = np.array([projected[:, 0] / SIZE[0] - left, 1 - projected[:, 1] / SIZE[1] - bottom]).T / (
            right - left,
            top - bottom,
        )
        return np.array([within.min(axis=0), 1.0 - within.max(axis=0)]).T

    camera = Viewpoint.framing(points, SIZE, free, azimuth=azimuth, elevation=elevation)
    border = (1.0 - FILL) / 2
    assert gaps(camera, points).min() == pytest.approx(border)
    assert np.abs(gaps(camera, points) - border).max(axis=1).min() < 1e-9, "two opposite sides"
    middle = ((left + right) / 2 * SIZE[0], (1 - (bottom + top) / 2) * SIZE[1])
    for one in (camera, camera.orbit(20.0, -5.0), camera.zoom(3.0)):
        assert np.allclose(one.project(one.target[None], SIZE)[0, :2], middle), "the target stays there"
    assert camera.widened(points, SIZE, 1e3, free) == camera
    grown = 2 * points - points.mean(axis=0)
    assert gaps(camera.widened(grown, SIZE, 1e3, free), grown).min() == pytest.approx(BORDER / 2)


@pytest.mark.parametrize("name", ["hanging_cloth", "thin_cloth", "sheet_on_box", "sheet_and_cube"])
@pytest.mark.filterwarnings("ignore:.*linear tet")
def test_cloth_fills_the_picture(name):
    scene = load_scene(name)[0]
    across = Viewpoint.framing(framed_points(scene)).project(start_positions(scene), (16, 9))[:, 0] / 16
    assert np.ptp(across) > 0.75 and across.min() > 0.05 and across.max() < 0.95


def falling_cube(height: float, gravity=(0, -9.81, 0), normal=(0, 1, 0)) -> ts.Scene:
    """A cube of 1 m whose underside is at this height above the ground, a half-space through the origin."""
    scene = ts.Scene(gravity=gravity)
    scene.add_body(ts.box_mesh((1, 1, 1), (1, 1, 1)), ts.Material(), name="cube", position=(0, height + 0.5, 0))
    scene.add_obstacle(ts.HalfSpace((0, 0, 0), normal), name="ground")
    return scene


def test_the_first_picture_shows_the_ground_below_a_falling_body():
    points = framed_points(falling_cube(2.0))
    assert points[:, 1].min() == pytest.approx(0.0) and points[:, 1].max() == pytest.approx(3.0) and len(points) == 16
    camera = Viewpoint.framing(points, SIZE)
    down = camera.project(points, SIZE)[:, 1]
    assert down.min() == pytest.approx(0.1 * SIZE[1]) and down.max() == pytest.approx(0.9 * SIZE[1])
    tilted = falling_cube(2.0, normal=(1, 1, 0))
    landed = framed_points(tilted)[8:]
    assert (landed @ [1, 1, 0]).min() == pytest.approx(0.0) and np.allclose(landed[:, 0], framed_points(tilted)[:8, 0])


def test_a_fall_is_framed_only_where_it_is_known():
    """Not of bodies that something holds, without gravity, beside walls, on or below the ground, or to the end of a long fall."""
    fixed, attached, wall = falling_cube(2.0), falling_cube(2.0), falling_cube(2.0, normal=(1, 0, 0))
    fixed.bodies[0].fix([0])
    attached.add_spring(("cube", 0), ("ground", (0, 0, 0)), 10.0)
    for scene in (fixed, attached, wall, falling_cube(2.0, (0, 0, 0)), falling_cube(0.0), falling_cube(2.0, (0, 9.81, 0))):
        assert np.array_equal(framed_points(scene), start_positions(scene))
    assert 2 < np.ptp(framed_points(falling_cube(1000.0))[:, 1]) < 20


def test_obstacles_near_the_bodies_are_framed():
    """Whole, and where key frames move them; of a table a part; nothing of what is far, or of half-spaces."""
    scene = falling_cube(0.0)
    n = len(scene.bodies[0].rest_positions)
    scene.add_obstacle(ts.Capsule((1.0, 0.5, 0), (1.5, 0.5, 0), 0.25), name="rod")
    scene.add_obstacle(ts.Box((0, -0.2, 0), (50, 0.1, 50)), name="table")
    scene.add_obstacle(ts.Sphere((9, 0, 0), 1.0), name="far")
    x = framed_points(scene)
    assert np.array_equal(x[:n], start_positions(scene)) and x[n:-8, 0].max() == pytest.approx(1.75)
    assert x[n:-8, 1].max() == pytest.approx(0.75) and x[n:-8, 1].min() == pytest.approx(0.25), "the rod"
    beside = 0.5 + EDGE * np.sqrt(3)
    assert x[-8:].min(axis=0) == pytest.approx((-beside, -0.3, -beside)) and x[-8:].max(axis=0) == pytest.approx(
        (beside, -0.1, beside)
    )
    moved = falling_cube(0.0)
    moved.add_obstacle(ts.Sphere((9, 0, 0), 0.5), name="one", path=ts.KeyFrames((0.0, 2.0), ((0, 0, 0), (-7.5, 0, 0))))
    assert framed_points(moved)[:, 0].max() == pytest.approx(2.0)


def test_projection_is_that_of_a_pinhole_camera():
    """Which rays invert."""
    camera = Viewpoint(target=np.zeros(3), distance=10.0, azimuth=0.0, elevation=0.0, fov=90.0)
    projected = camera.project(np.array([[1.0, 0, 0], [0, 2.0, 0], [0, 0, 5.0], [1.0, 0, 5.0]]), (200, 100))
    # half the height, 50 pixels, is 10 m at a depth of 10 m: 5 pixels per metre, 10 at 5 m; x right, y up, z towards the camera
    assert np.allclose(projected, [[105, 50, 10], [100, 40, 10], [100, 50, 5], [110, 50, 5]])
    camera = Viewpoint(target=np.array([1.0, 2, 3]), distance=4.0, azimuth=70.0, elevation=-30.0)
    for point in np.random.default_rng(1).uniform(-1, 1, (20, 3)) + camera.target:
        across, down, _ = camera.project(point[None], SIZE)[0]
        ray = camera.ray((across / SIZE[0], 1 - down / SIZE[1]), SIZE)
        assert np.allclose(np.cross(ray, point - camera.position), 0, atol=1e-12) and ray @ camera.forward > 0


def test_orbit_zoom_and_pan():
    camera = Viewpoint(target=np.zeros(3), distance=10.0, azimuth=350.0, elevation=80.0)
    orbited, panned = camera.orbit(20.0, 50.0), camera.pan(0.0, 0.25)  # up by a quarter of the picture's height
    assert orbited.azimuth == pytest.approx(10.0) and orbited.elevation == 89.0
    assert np.linalg.norm(orbited.position - orbited.target) == pytest.approx(10.0) and camera.zoom(0.5).distance == 5.0
    assert panned.project(np.zeros((1, 3)), SIZE)[0, 1] == pytest.approx(90 + 45, abs=1e-9)


def test_a_camera_with_z_up_is_one_with_y_up_turned():
    """At azimuth 0 it looks along y, at 90 along -x; turning it leaves the horizon level."""
    turn, points = FROM_Y_UP["z"], np.random.default_rng(2).uniform(-1, 1, (20, 3))
    for azimuth, elevation in ((0.0, 0.0), (90.0, 0.0), (32.0, -40.0)):
        upright = Viewpoint.framing(points, azimuth=azimuth, elevation=elevation).orbit(10.0, 20.0)
        turned = Viewpoint.framing(points @ turn.T, up="z", azimuth=azimuth, elevation=elevation).orbit(10.0, 20.0)
        assert np.allclose(turned.position, turn @ upright.position) and np.allclose(turned.axes, upright.axes @ turn.T)
        assert abs(turned.axes[0, 2]) < 1e-15
    assert np.allclose([Viewpoint(azimuth=a, elevation=0.0, up="z").forward for a in (0.0, 90.0)], [(0, 1, 0), (-1, 0, 0)])


def test_camera_moves_back_from_approaching_bodies():
    camera = Viewpoint(target=np.zeros(3), distance=10.0, azimuth=0.0, elevation=0.0, fov=90.0)
    near = np.array([[0.0, 1, 0], [2, 0, 0]])
    size, edge = (200, 100), 1.0 - BORDER  # of what must be seen, over the depth
    assert camera.widened(near, size, 100.0) == camera
    corners = 10.0 * edge * np.array([[-2.0, -1, 0], [2, -1, 0], [-2, 1, 0], [2, 1, 0]])
    for far, distance in (
        ([0.0, -20 * edge, 0], 15.0),
        ([40 * edge, 0, 0], 15.0),
        ([0, 10 * edge, 10], 15.0),
        ([0, 0, 20], 20.0),
    ):
        moved = camera.widened(np.array([far, [0, np.nan, 0]]), size, 100.0)
        assert moved.distance == pytest.approx(distance)
        again = moved.widened(np.concatenate([[far], corners]), size, 100.0)
        assert np.allclose(again.position, moved.position), "what was seen stays in view"
    limited = camera.widened(np.array([[0.0, 900, 0]]), size, 15.0)
    assert limited.distance == 15.0 and np.allclose(limited.widened(corners, size, 100.0).position, limited.position)


def test_floor_that_reaches_behind_the_camera_is_clipped():
    """As rays through pixel centres say; triangles in front are unchanged, those behind are dropped."""
    half, (width, height) = 30.0, SIZE
    floor = [[-half, 0, -half], [half, 0, -half], [half, 0, half], [-half, 0, half]]
    corners = np.array([*floor, [0, 1, -9], [1, 1, -9], [0, 2, -9], [0, 1, 9], [1, 1, 9], [0, 2, 9]])
    shades, triangles = (corners + half) / (2 * half), np.array([[0, 2, 1], [0, 3, 2], [4, 5, 6], [7, 8, 9]])
    camera = Viewpoint(target=np.array([0.0, 0.5, 0.0]), distance=3.0, azimuth=20.0, elevation=10.0)
    x, cut, colours = camera.clipped(corners, triangles, shades)
    assert not (cut == 7).any() and np.array_equal(x[: len(corners)], corners) and (cut == [4, 5, 6]).all(axis=1).sum() == 1
    image, below = np.zeros((height, width, 3), dtype=np.uint8), (cut != [4, 5, 6]).all(axis=1)
    drawn = rasterise(camera.project(x, SIZE), cut[below], colours, camera.clipping[0], image)
    focal = height / 2 / np.tan(np.radians(camera.fov) / 2)
    v, u = np.mgrid[:height, :width] + 0.5
    ray = np.stack([(u - width / 2) / focal, (height / 2 - v) / focal, np.ones_like(u)], axis=-1) @ camera.axes
    with np.errstate(divide="ignore"):
        depth = -camera.position[1] / ray[..., 1]
    hit = camera.position + depth[..., None] * ray
    expected = (depth > camera.clipping[0]) & (np.abs(hit[..., [0, 2]]) < half).all(axis=-1)
    assert (drawn != expected).mean() < 0.005 and 0.4 < expected.mean() < 0.8
    both = drawn & expected
    assert np.abs(image[both] / 255 - (hit[both] + half) / (2 * half))[:, [0, 2]].max() < 0.02
    corners[4] = np.nan
    assert not (camera.clipped(corners, triangles, shades)[1] == 4).any()


def test_lines_are_clipped_at_the_near_plane():
    camera = Viewpoint(target=np.zeros(3), distance=10.0, azimuth=0.0, elevation=0.0)
    ahead, behind = np.array([0.0, 1, 0]), np.array([0.0, 1, 20])
    ends = np.array([ahead, behind, behind, ahead, ahead, 2 * ahead, behind, behind + 1, ahead, [0, np.nan, 0]])
    colours = np.repeat(np.arange(10) / 10, 3).reshape(-1, 3)
    clipped, kept = camera.clipped_lines(ends, colours)
    assert len(clipped) == len(kept) == 6
    assert np.allclose(clipped[[0, 3]], ahead) and np.allclose(clipped[[1, 2]], (0, 1, 9.8), atol=1e-4)
    assert np.array_equal(clipped[4:], ends[4:6]) and np.array_equal(kept[4:], colours[4:6])
    assert np.allclose(kept[1], 0.049, atol=1e-5)
