"""The drawn squares of half-spaces: they stay at their start while bodies are well inside, then move along and grow, but only in
directions in which no other half-space cuts them off."""

import numpy as np
import pytest

import taisoft as ts
from taisoft.view.ground import MARGIN, Square, finite_points

FLOOR, CORNERS = ts.HalfSpace((0, 0, 0), (0, 1, 0)), np.array([(x, 0.0, z) for x in (-2.0, 2.0) for z in (-2.0, 2.0)])
WALL, SLOPE = ts.HalfSpace((-2, 0, 0), (1, 0, 0)), ts.HalfSpace((0, 0, 0), (1, 1, 0))
BEHIND = ts.HalfSpace((0, 0, -2), (0, 0, 1))


def cloud(centre, half=0.5):
    return np.array(centre) + half * np.array([(-1.0, 0, -1), (1, 0.3, 1), (1, 2, -1), (-1, 1, 1)])


def extent(square):
    return [tuple(square[:, k][[np.argmin(square[:, k]), np.argmax(square[:, k])]].round(9)) for k in (0, 2)]


def test_bodies_inside_move_nothing():
    square = Square(FLOOR, CORNERS, [])
    assert square.below(cloud((0.5, 1, -0.5))) is CORNERS
    assert square.below(finite_points(np.full((3, 3), np.nan))) is CORNERS, "a state that is not finite"
    with_one_bad = np.vstack([cloud((0.0, 1, 0)), [np.inf, 0, 0]])
    assert square.below(finite_points(with_one_bad)) is CORNERS


@pytest.mark.parametrize("place", [(7.0, 1.0, 0.0), (-30.0, 5.0, 12.0)])
def test_the_square_moves_along(place):
    square = Square(FLOOR, CORNERS, []).below(cloud(place))
    assert np.ptp(square, axis=0).tolist() == pytest.approx([4.0, 0.0, 4.0])
    margin = 4 * MARGIN
    for (low, high), at in zip(extent(square), (place[0], place[2])):
        assert low <= at - 0.5 - margin + 1e-9 and high >= at + 0.5 + margin - 1e-9
        if abs(at) > 2:
            assert min(at - 0.5 - low, high - at - 0.5) == pytest.approx(margin), "no farther than needed"


def test_the_square_grows():
    square = Square(FLOOR, CORNERS, []).below(cloud((0.0, 1.0, 0.0), half=10.0))
    for low, high in extent(square):
        assert low == pytest.approx(-10 - 4 * MARGIN) and high == pytest.approx(10 + 4 * MARGIN)


@pytest.mark.parametrize("others, moves", [([WALL], (False, True)), ([WALL, BEHIND], (False, False)), ([SLOPE], (False, True))])
def test_cut_squares_move_along_the_cut(others, moves):
    square = Square(FLOOR, CORNERS, others).below(cloud((9.0, 1.0, 9.0)))
    assert [low != -2.0 for low, _ in extent(square)] == list(moves)


def test_parallel_half_spaces_cut_nothing():
    ceiling = ts.HalfSpace((0, 9, 0), (0, -1, 0))
    square = Square(FLOOR, CORNERS, [ceiling]).below(cloud((9.0, 1.0, 9.0)))
    assert all(low > 0 for low, _ in extent(square))
