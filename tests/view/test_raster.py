"""The rasteriser of pictures, against the one in NumPy: coverage, order, opacity, colours, invisible triangles, shadow maps."""

import numpy as np
import pytest

from taisoft.backend.runtime import open_runtime
from taisoft.errors import OutputError
from taisoft.view.raster import Raster
from taisoft.view.shading import N_ATTRIBUTES, SAMPLES, TILE
from tests.view.numpy_raster import averaged, rasterise

NEAR = 0.5
SHAPE = (3 * TILE + 10, 4 * TILE + 6)  # samples; the last tiles are cut off


@pytest.fixture(autouse=True)
def runtime():
    runtime = open_runtime("cpu", "f32")
    yield
    runtime.close()


def drawn(points, triangles, colours, shape=SHAPE, near=NEAR, shadows=None, texels=None, raster=None, opacities=None):
    """The picture and 1/depth of the kernels."""
    made = raster or Raster(shape[::-1])
    attributes = np.zeros((len(points), N_ATTRIBUTES))
    attributes[:, :3], attributes[:, 5] = colours, -1.0
    if texels is not None:
        attributes[:, 3:] = texels
    picture = np.full((shape[0] // SAMPLES, shape[1] // SAMPLES, 3), 200, np.uint8)
    made.draw(points, triangles, attributes, near, np.zeros((1, 2, 2)) if shadows is None else shadows, picture, opacities)
    return picture, made.inverse_depths(points, triangles, near)


def expected(points, triangles, colours):
    """The picture of NumPy, and the mask of covered samples."""
    image = np.full((*SHAPE, 3), 200, np.uint8)
    mask = rasterise(points, triangles, colours, NEAR, image)
    return averaged(image), mask


def scattered(rng, n, radius):
    """n triangles of about a radius [samples], partly outside the picture."""
    centre = rng.uniform(-radius, np.array(SHAPE[::-1]) + radius, (n, 1, 2))
    points = np.concatenate([centre + rng.uniform(-radius, radius, (n, 3, 2)), rng.uniform(2.0, 3.0, (n, 3, 1))], axis=2)
    return points.reshape(-1, 3), np.arange(3 * n).reshape(n, 3)


def test_random_triangles_equal_those_of_numpy():
    """Also where a raster is used again."""
    raster = Raster(SHAPE[::-1])
    for n, radius, thin in ((400, 6.0, False), (60, 60.0, False), (9000, 0.9, False), (12, 1e5, False), (900, 40.0, True)):
        rng = np.random.default_rng(0)
        points, triangles = scattered(rng, n, radius)
        if thin:
            points[2::3, :2] = 0.5 * (points[::3] + points[1::3])[:, :2] + rng.uniform(-0.05, 0.05, (n, 2))
        flat = np.repeat(rng.uniform(0, 1, (n, 3)), 3, axis=0)  # one colour a triangle: only the order matters
        picture, inverse = drawn(points, triangles, flat, raster=raster)
        reference, covered = expected(points, triangles, flat)
        assert 0.01 < covered.mean() <= 1.0 and np.array_equal(inverse > 0, covered)
        assert np.abs(picture.astype(int) - reference).max() <= 1


def blended(points, triangles, colours, opacities):
    """The picture of NumPy, sample by sample: triangles of one colour each over one another from the farthest on."""
    y, x = np.mgrid[: SHAPE[0], : SHAPE[1]] + 0.5
    layers = np.zeros((len(triangles), *SHAPE))  # 1/depth
    for layer, (p, q, r) in zip(layers, points[triangles]):
        (a, b), (c, d) = q[:2] - p[:2], r[:2] - p[:2]
        v, w = (d * (x - p[0]) - c * (y - p[1])) / (a * d - b * c), (a * (y - p[1]) - b * (x - p[0])) / (a * d - b * c)
        inside = (v >= 0) & (w >= 0) & (v + w <= 1)
        layer[inside] = ((1 - v - w) / p[2] + v / q[2] + w / r[2])[inside]
    image = np.full((*SHAPE, 3), 200.0)
    for k in np.argsort(layers, axis=0):
        covered = np.take_along_axis(layers, k[None], axis=0)[0] > 0
        share = np.where(covered, opacities[k], 0.0)[..., None]
        image = (1 - share) * image + share * 255 * colours[3 * k]
    return image.reshape(SHAPE[0] // SAMPLES, SAMPLES, SHAPE[1] // SAMPLES, SAMPLES, 3).mean(axis=(1, 3))


def test_transparent_triangles_are_blended_by_depth_whatever_their_order():
    """Those that intersect, too."""
    raster = Raster(SHAPE[::-1])
    for n, radius, least in ((60, 60.0, 0.1), (300, 15.0, 0.3), (40, 200.0, 0.02)):
        rng = np.random.default_rng(1)
        points, triangles = scattered(rng, n, radius)
        flat = np.repeat(rng.uniform(0, 1, (n, 3)), 3, axis=0)
        opacities = np.where(rng.uniform(size=n) < 0.2, 1.0, rng.uniform(least, 1.0, n))
        picture, _ = drawn(points, triangles, flat, raster=raster, opacities=opacities)
        assert np.abs(picture - blended(points, triangles, flat, opacities)).max() < 1.1
        mixed = rng.permutation(n)
        again, _ = drawn(points, triangles[mixed], flat, raster=raster, opacities=opacities[mixed])
        assert np.array_equal(picture, again)


def test_samples_on_the_edge_of_two_transparent_triangles_are_drawn_once():
    square = np.array([[0.0, 0, 1], [64, 0, 1], [64, 64, 1], [0, 64, 1]])
    triangles, half = np.array([[0, 1, 2], [0, 2, 3]]), np.full(2, 0.5)  # the diagonal passes through centres of samples
    picture, _ = drawn(square, triangles, np.zeros((4, 3)), shape=(64, 64), opacities=half)
    assert (picture == 100).all()


def test_colours_are_interpolated_in_perspective():
    """Depths of 1 to 10 in one triangle. A pixel inside takes the colour at its centre, which differs little from the mean."""
    points = np.array([[-4.1, -3.2, 1.0], [150.3, 20.1, 10.0], [10.7, 120.9, 4.0]])
    colours, triangles = np.eye(3), np.array([[0, 1, 2]])
    picture, _ = drawn(points, triangles, colours)
    reference, covered = expected(points, triangles, colours)
    assert covered.mean() > 0.3 and np.abs(picture.astype(int) - reference).max() <= 2
    linear, _ = expected(points * (1, 1, 0) + (0, 0, 1), triangles, colours)
    assert np.abs(linear.astype(int) - reference).max() > 50, "the test tells perspective from linear interpolation"


def test_the_order_is_by_depth_and_then_by_number():
    """Also of depths whose bits are round: keys are compared and combined as integers, and those of 1/depth = 2 add up to 0."""
    square = np.array([[0.0, 0, 0], [40, 0, 0], [40, 40, 0], [0, 40, 0]])
    points = np.concatenate([square + (0, 0, depth) for depth in (3.0, 2.0, 2.0, 2.0 * (1 + 1e-7))])
    corners = np.array([[0, 1, 2], [0, 2, 3]])
    for order, front in (((0, 1), 1), ((1, 0), 1), ((1, 2), 2), ((2, 1), 1), ((2, 3), 2), ((3, 2), 2)):
        triangles = np.concatenate([4 * k + corners for k in order])
        picture, _ = drawn(points, triangles, np.repeat(np.linspace(0, 1, 4), 4)[:, None] * np.ones(3))
        assert (picture[:19, :19] == round(255 * front / 3)).all()
    for depth in (2.0**-3, 2.0**-1, 2.0**40):
        points = np.array([[-300.0, -300, depth], [900, -300, depth], [-300, 900, depth]])
        picture, inverse = drawn(points, np.array([[0, 1, 2]]), np.eye(3)[[0, 0, 0]], near=0.01)
        assert (picture == (255, 0, 0)).all() and np.allclose(inverse, 1 / depth, rtol=1e-8)


def test_invisible_triangles_are_skipped():
    """Near the eye, without area, not finite, far outside: none of them changes the picture or disturbs a good one."""
    good = np.array([[10.0, 10, 2], [90, 20, 2], [30, 80, 2]])
    bad = [good.copy() for _ in range(9)]
    bad[0][1, 2], bad[1][2, 2] = NEAR, -1.0
    bad[2][0, 0], bad[3][1, 1], bad[4][2, 2] = np.nan, np.inf, np.nan
    bad[5][0, 0] = 1e11
    bad[6][:] = good[0]
    bad[7][:, 0] -= 500.0
    bad[8][:, 2] = np.inf, np.nan, -np.inf
    points, n = np.concatenate([good, *bad]), 3 * (1 + len(bad))
    colours = np.random.default_rng(0).uniform(0, 1, (n, 3))
    alone = drawn(points, np.array([[0, 1, 2]]), colours)
    for triangles in (np.arange(n).reshape(-1, 3), np.arange(n).reshape(-1, 3)[::-1]):
        assert all(np.array_equal(a, b) for a, b in zip(drawn(points, triangles, colours), alone))
    picture, inverse = drawn(points, np.arange(3, n).reshape(-1, 3), colours)
    assert (picture == 200).all() and (inverse == 0).all() and (alone[1] > 0).any()
    nothing = drawn(np.zeros((0, 3)), np.zeros((0, 3), int), np.zeros((0, 3)))
    assert (nothing[0] == 200).all() and (nothing[1] == 0).all(), "no triangles change nothing"


def test_a_shadow_map_darkens_between_its_texels():
    """Texels of 8 samples; the map's second column is dark. A triangle without a map stays light."""
    square = np.array([[0.0, 0, 1], [64, 0, 1], [64, 64, 1], [0, 64, 1]])
    points = np.concatenate([square, square + (0, 64, 0)])
    texels = np.concatenate([np.column_stack([square[:, :2] / 8, np.ones(4)]), np.tile([0.0, 0.0, -1.0], (4, 1))])
    triangles, shadows = np.array([[0, 1, 2], [0, 2, 3], [4, 5, 6], [4, 6, 7]]), np.zeros((2, 8, 8))
    shadows[1, :, 1] = 0.5
    picture, _ = drawn(points, triangles, np.full((8, 3), 0.8), shape=(128, 64), shadows=shadows, texels=texels)
    lit, x = 0.8 * 255, (np.arange(32) + 0.5) / 4  # of pixels, in texels
    shade = 0.5 * np.clip(1 - np.abs(x - 1.5), 0, 1) * (x > 0.5)
    assert np.abs(picture[8:24, :, 0] - lit * (1 - shade)).max() <= 0.51
    assert (picture[32:] == 204).all()


def test_too_many_triangles_are_refused(monkeypatch):
    points, triangles = scattered(np.random.default_rng(0), 5, 30.0)
    for name, message in (("MAX_LISTED", "5 triangles of this size"), ("ORDINALS", "cannot show 5 triangles: at most 3")):
        monkeypatch.setattr(f"taisoft.view.raster.{name}", 3)
        with pytest.raises(OutputError, match=message):
            drawn(points, triangles, np.zeros((15, 3)))
