"""Shadows of bodies on half-spaces:

* below a body the ground is darker, beside it as light as without one, and darker the lower the body;
* slopes and moving half-spaces have shadows, walls and ceilings have none; nodes that are not finite cast none;
* a blur keeps the sum, and spreads by its standard deviation.
"""

import numpy as np
import pytest

import taisoft as ts
from taisoft.output.camera import Camera
from taisoft.scene.key_frames import KeyFrames
from taisoft.view.offscreen import Offscreen
from taisoft.view.scene_view import Surfaces
from taisoft.view.shadow import FADE, STRENGTH, Shadows, blurred
from tests.view.fake_simulator import RUBBER, FakeSimulator

SIZE = (160, 120)
ABOVE = Camera(target=np.array([0.0, 0.0, 0.0]), distance=8.0, azimuth=0.0, elevation=15.0)


def scene_of(height, normal=(0.0, 1.0, 0.0), path=None):
    """A cube of 1 m above a half-space through the origin."""
    scene = ts.Scene()
    scene.add_body(ts.box_mesh((2, 2, 2), (1, 1, 1)), RUBBER, name="cube", position=(0, height + 0.5, 0))
    scene.add_obstacle(ts.HalfSpace((0, 0, 0), normal), name="ground", path=path)
    return scene


def maps_of(scene, x=None):
    surfaces = Surfaces(scene)
    vertices, _ = surfaces.with_obstacles(surfaces.of_bodies(FakeSimulator(scene)), 0.0, np.array([0.0, 9.0, 9.0]))
    return Shadows(scene, surfaces).draw(vertices if x is None else x(vertices), 0.0)


def picture(scene):
    return Offscreen(scene, SIZE, ABOVE).image(FakeSimulator(scene)).astype(int)


def test_the_ground_is_darker_below_a_body():
    with_body = picture(scene_of(0.7))
    places = ABOVE.project(np.array([[0.0, 0.0, 0.3], [0.0, 0.0, 1.5], [1.5, 0.0, 0.3]]), SIZE)[:, :2].astype(int)
    below, before, beside = (with_body[row, column] for column, row in places)
    assert (below < 0.9 * beside).all() and np.ptp(below) < 12, "grey"
    assert (beside > 150).all() and np.abs(before - beside).max() < 12


def test_a_shadow_is_darker_the_lower_the_body():
    darkest = [maps_of(scene_of(height))[0].max() for height in (0.0, 0.2, 0.5)]
    size = np.sqrt(3.0)
    assert darkest == pytest.approx([STRENGTH * np.exp(-h / (FADE * size)) for h in (0.0, 0.2, 0.5)], rel=0.02)


def test_coordinates_of_the_map_are_below_the_body():
    """The nodes of the ground's square lie where the map is zero, and the middle of the cube's shadow where it is dark."""
    (shadow,), at = maps_of(scene_of(0.1))
    ground = at[:, 2] == 0
    assert ground.sum() == 3 * 4 * 4**3 and (at[~ground, 2] == -1).all()
    assert shadow[0].max() == shadow[-1].max() == shadow[:, 0].max() == shadow[:, -1].max() == 0.0
    n = len(shadow)
    assert shadow[n // 2 - 2 : n // 2 + 2, n // 2 - 2 : n // 2 + 2].min() > 0.9 * shadow.max()
    middle = at[ground].mean(axis=0)[:2]
    assert np.allclose(middle, n / 2, atol=1e-6)


@pytest.mark.parametrize("normal, has_shadow", [((1, 3, 0), True), ((1, 0, 0), False), ((0, -1, 0), False), ((0, 0.2, 1), False)])
def test_slopes_have_shadows_and_walls_have_none(normal, has_shadow):
    maps, at = maps_of(scene_of(1.0, normal))
    assert (maps.max() > 0.05) == has_shadow and (at[:, 2].max() == 0) == has_shadow


def test_a_moving_half_space_has_a_shadow():
    path = KeyFrames([0.0, 1.0], [(0.0, 0.0, 0.0), (0.0, 0.2, 0.0)])
    scene = scene_of(0.5, path=path)
    surfaces, darkest = Surfaces(scene), []
    for t in (0.0, 1.0):
        x, _ = surfaces.with_obstacles(surfaces.of_bodies(FakeSimulator(scene)), t, np.array([0.0, 9.0, 9.0]))
        darkest.append(Shadows(scene, surfaces).draw(x, t)[0].max())
    assert darkest[1] > 1.2 * darkest[0]


def test_nodes_that_are_not_finite_cast_no_shadow():
    def spoil(x, part):
        x = x.copy()
        x[part] = np.nan
        return x

    scene = scene_of(0.1)
    n = Surfaces(scene).n_of_bodies
    some, _ = maps_of(scene, lambda x: spoil(x, slice(0, 3)))
    assert np.isfinite(some).all() and 0.1 < some.max() <= STRENGTH
    none, at = maps_of(scene, lambda x: spoil(x, slice(0, n)))
    assert none.max() == 0.0 and (at[:, 2] == -1).all()


def test_blur():
    image = np.zeros((40, 60))
    image[20, 30] = 1.0
    smooth = blurred(image, (2.0, 4.0))
    assert smooth.sum() == pytest.approx(1.0)
    rows, columns = np.mgrid[:40, :60]
    deviation = [np.sqrt((smooth * (axis - middle) ** 2).sum()) for axis, middle in ((rows, 20), (columns, 30))]
    assert deviation == pytest.approx([2.0, 4.0], rel=0.15)  # cut off at two deviations
