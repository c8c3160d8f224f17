"""Candidates found by the spatial hash.

The scenes are random: sizes differ by a factor of 1000, some triangles are at 1e300 m, NaN or inf, degenerate to points or
needles, sweep, or belong to self-colliding bodies.

* the result is the brute-force set for any cell size and grid, serial in f64 scenes and parallel in f32 scenes;
* entries do not depend on the number of threads;
* the grid is periodic: triangles whole periods away share cells but are no candidates; triangles beyond the range of cell
  indices are found outside the grid;
* buffers grow without changing the result; at max_capacity the search raises an error that states the required size.
"""

import re

import numpy as np
import pytest

from taisoft.backend.arrays import FieldArena
from taisoft.collision.spatial_hash import COUNTABLE, MAX_CELLS, N_LARGE, SpatialHash, grid_size
from taisoft.errors import SimulationError
from tests.collision.surfaces import brute_pairs, pairs_of, place, soup, surface_of
from tests.collision.test_bvh import EMPTY, colliders, scatter

EXTENTS = {"usual": np.ones(3), "one cell": np.zeros(3)}  # [m]


@pytest.fixture
def arena():
    fields = FieldArena()
    yield fields
    fields.release()


# --- without the module's rig, which keeps a runtime open ---


@pytest.mark.parametrize("n", [0, 1, 1000, 10**6, 10**8])
def test_grid_sizes_are_bounded_powers_of_two(n):
    rng = np.random.default_rng(7)
    limit = min(MAX_CELLS, max(512, 2 * n))
    for extent in (np.zeros(3), np.ones(3), np.full(3, 1e300), *10.0 ** rng.uniform(-9, 9, (50, 3))):
        size = np.array(grid_size(extent, 0.1, n))
        assert (size >= 1).all() and (size & (size - 1) == 0).all() and size.prod() <= limit
        cells = np.ceil(extent.clip(0.1, 1e5) / 0.1)
        if cells.prod() * 8 <= limit:
            assert (cells <= size).all() and (size < 2 * cells).all()


def test_scene_without_triangles_has_no_candidates(arena):
    with surface_of([EMPTY, EMPTY]) as made:
        spatial_hash = SpatialHash(made.surface, arena, 0.1, np.ones(3))
        assert len(pairs_of(spatial_hash.find())) == 0
        spatial_hash.release()


def test_cell_borders_and_grid_periods(arena):
    """A body and its copy, with box faces on cell borders, and whole periods apart in the same cells."""
    rng = np.random.default_rng(6)
    x, t = soup(rng, 60)
    x = np.round((x - 0.5) * 2**20) / 2**20  # makes shifts exact
    with surface_of([(x, t), (x, t)], self_on=[True, True], margin=2.0**-5) as made:
        spatial_hash = SpatialHash(made.surface, arena, 0.125, np.ones(3), capacity=2**15)
        period = np.array(spatial_hash.grid.size) * spatial_hash.cell

        def check(*parts: np.ndarray) -> np.ndarray:
            place(made, np.concatenate(parts))
            expected = brute_pairs(made)
            assert np.array_equal(pairs_of(spatial_hash.find()), expected) and len(expected) > 100
            return made.topology.body[expected]

        coincident = check(x, x)
        assert (coincident[:, 0] != coincident[:, 1]).sum() > 100
        for periods in ((2, 0, 0), (0, -3, 0), (-(2**20), 2**20, 1), (2**28, 0, -(2**28))):
            body = check(x, x + period * periods)
            assert np.array_equal(body[:, 0], body[:, 1])
            first = spatial_hash.grid.first_cell.to_numpy()
            assert np.array_equal(first[: len(t)], first[len(t) :]) and spatial_hash.grid.count[N_LARGE] < len(t)
        made.margin = 0.0
        for step in (spatial_hash.cell, 0.5 * spatial_hash.cell, 3 * spatial_hash.cell):
            check(step * np.round(x / step), step * np.round(x / step) - (step, 0, 0))
        for shift in (0.5, 2.0, 1e200):  # just within the range of cell indices, and beyond
            check(*[x * max(1.0, shift) + shift * COUNTABLE * spatial_hash.cell] * 2)
        assert spatial_hash.grid.count[N_LARGE] == made.surface.n_triangles  # all are outside the grid
        spatial_hash.release()


# --- with the rig ---


@pytest.fixture(scope="module", params=[("f64", True), ("f32", False)], ids=str)
def rig(request):
    rng = np.random.default_rng(1)
    precision, serial = request.param
    arenas = {name: FieldArena() for name in EXTENTS}
    with surface_of(**colliders(rng), precision=precision, serial=serial) as made:
        made.x0 = made.x
        made.hashes = {
            name: SpatialHash(made.surface, arenas[name], 0.1, extent, capacity=2**17) for name, extent in EXTENTS.items()
        }
        yield made
        for name, grid in made.hashes.items():
            grid.release()
            arenas[name].release()


def mix_sizes(rng, made) -> None:
    """Shrink triangles that share no vertex by a factor of up to 1000 about their first corners."""
    t, x = made.topology.triangle, made.x.copy()
    own = t[np.bincount(t.ravel(), minlength=len(x))[t].max(axis=1) == 1]
    size = 10.0 ** rng.uniform(-3, 0, (len(own), 1, 1))
    with np.errstate(invalid="ignore"):
        x[own] = x[own[:, :1]] + size * (x[own] - x[own[:, :1]])
    place(made, x, made.move)


def test_candidates_equal_brute_force(rig):
    rng = np.random.default_rng(2)
    total, large = 0, 0
    scenes = 200 if rig.surface.serial else 60
    for kind in range(scenes):
        scatter(rng, rig, kind)
        if kind % 3 == 0:
            mix_sizes(rng, rig)
        with np.errstate(invalid="ignore"):
            expected = brute_pairs(rig)
        total += len(expected)
        spatial_hash = rig.hashes[list(EXTENTS)[kind // 5 % 2]]  # each kind of scene meets both grids
        spatial_hash.cell = 10.0 ** rng.uniform(-5, 2)
        assert np.array_equal(pairs_of(spatial_hash.find()), expected)
        large += 0 < spatial_hash.grid.count[N_LARGE] < rig.surface.n_triangles / 2
    assert total > scenes * 500 and large > scenes / 10


def test_extreme_cells(rig):
    """So small that no triangle fits the range of cell indices; so large that all are in one cell."""
    scatter(np.random.default_rng(3), rig, 0)
    expected = brute_pairs(rig)
    for spatial_hash in rig.hashes.values():
        for spatial_hash.cell in (1e-300, 1e-17, 1e17, 1e300):
            assert np.array_equal(pairs_of(spatial_hash.find()), expected)


def test_order_does_not_depend_on_threads(rig):
    scatter(np.random.default_rng(4), rig, 0)
    spatial_hash = rig.hashes["usual"]
    spatial_hash.cell = 0.1

    def rows() -> tuple[np.ndarray, np.ndarray, list[np.ndarray]]:
        found = spatial_hash.find()
        start, end, entry = (f.to_numpy() for f in (found.start, found.end, found.entry))
        return start, end, np.concatenate([entry[a:b] for a, b in zip(start, end)])

    first = rows()
    assert len(first[2]) > 2000
    for _ in range(20):
        assert all(np.array_equal(a, b) for a, b in zip(first, rows()))


def test_buffers_grow_up_to_max_capacity(rig, arena):
    scatter(np.random.default_rng(5), rig, 0)
    expected, chunks = brute_pairs(rig), rig.surface.chunks
    spatial_hash = SpatialHash(rig.surface, arena, 0.1, np.ones(3), capacity=64)
    members, rows = spatial_hash.members, spatial_hash.rows
    for buffer, buffer.max_capacity in ((members, 64), (rows, 65)):
        with pytest.raises(SimulationError) as error:
            spatial_hash.find()
        needed = spatial_hash.grid.cell_count.to_numpy().prod(axis=1).sum() if buffer is members else rows.count[0] * chunks
        rest = f"\\({buffer.chunks} parts of [0-9]+\\), and max_capacity allows {buffer.max_capacity}$"
        assert re.match(f"{buffer.name}: {needed} entries are needed {rest}", str(error.value))
        assert needed > 500 and buffer.capacity == 64 and buffer.growths == 0
        buffer.max_capacity = int(needed)  # just enough
    assert needed >= 2 * len(expected) and (chunks > 1 or needed == 2 * len(expected))
    assert np.array_equal(pairs_of(spatial_hash.find()), expected)
    assert (members.growths, rows.growths) == (1, 1) and rows.capacity == needed
    spatial_hash.release()
