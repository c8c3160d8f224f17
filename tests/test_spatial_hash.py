"""Candidates by the spatial hash, over the random scenes of the trees and more: sizes mixed a thousandfold, things that have
flown off to 1e300 m, NaN and inf, points and needles, sweeps, bodies against themselves:

* they are the brute-force set whatever the cells, from a ten-thousandth of a triangle to the whole scene, and whatever the grid,
  one of a single cell too; serial with f64 and parallel with f32 as the precision of the rest;
* threads change nothing, entry by entry;
* the grid is periodic: what lies whole periods away is in the same cells and is no candidate; beyond where cells can be counted
  nothing is in it, and all is found still;
* small buffers grow to the same result; where they may not, the search stops with what is needed and what is allowed.
"""

import re

import numpy as np
import pytest
from surfaces import brute_pairs, pairs_of, place, soup, surface_of
from test_bvh import EMPTY, colliders, scatter

from taisoft.backend.arrays import FieldArena
from taisoft.collision.spatial_hash import COUNTABLE, MAX_CELLS, N_LARGE, SpatialHash, grid_size
from taisoft.errors import SimulationError

EXTENTS = {"usual": np.ones(3), "one cell": np.zeros(3)}  # [m]


@pytest.fixture
def arena():
    fields = FieldArena()
    yield fields
    fields.release()


# Without the rig, which holds the machine from its first test to its last.


@pytest.mark.parametrize("n", [0, 1, 1000, 10**6, 10**8])
def test_size_of_the_grid(n):
    rng = np.random.default_rng(7)
    most = min(MAX_CELLS, max(512, 2 * n))
    for extent in (np.zeros(3), np.ones(3), np.full(3, 1e300), *10.0 ** rng.uniform(-9, 9, (50, 3))):
        size = np.array(grid_size(extent, 0.1, n))
        assert (size >= 1).all() and (size & (size - 1) == 0).all() and size.prod() <= most
        cells = np.ceil(extent.clip(0.1, 1e5) / 0.1)
        if cells.prod() * 8 <= most:
            assert (cells <= size).all() and (size < 2 * cells).all()


def test_a_scene_without_triangles(arena):
    with surface_of([EMPTY, EMPTY]) as made:
        used = SpatialHash(made.surface, arena, 0.1, np.ones(3))
        assert len(pairs_of(used.find())) == 0
        used.release()


def test_borders_and_periods_of_the_grid(arena):
    """A body and its copy: with boxes whose faces are on borders of cells, and whole periods away, in the same cells."""
    rng = np.random.default_rng(6)
    x, t = soup(rng, 60)
    x = np.round((x - 0.5) * 2**20) / 2**20  # so that shifts are exact
    with surface_of([(x, t), (x, t)], self_on=[True, True], margin=2.0**-5) as made:
        used = SpatialHash(made.surface, arena, 0.125, np.ones(3), capacity=2**15)
        period = np.array(used.grid.size) * used.cell

        def check(*parts: np.ndarray) -> np.ndarray:
            place(made, np.concatenate(parts))
            expected = brute_pairs(made)
            assert np.array_equal(pairs_of(used.find()), expected) and len(expected) > 100
            return made.topology.body[expected]

        together = check(x, x)
        assert (together[:, 0] != together[:, 1]).sum() > 100
        for turns in ((2, 0, 0), (0, -3, 0), (-(2**20), 2**20, 1), (2**28, 0, -(2**28))):
            body = check(x, x + period * turns)
            assert np.array_equal(body[:, 0], body[:, 1])
            first = used.grid.first_cell.to_numpy()
            assert np.array_equal(first[: len(t)], first[len(t) :]) and used.grid.count[N_LARGE] < len(t)
        made.margin = 0.0
        for step in (used.cell, 0.5 * used.cell, 3 * used.cell):
            check(step * np.round(x / step), step * np.round(x / step) - (step, 0, 0))
        for shift in (0.5, 2.0, 1e200):  # nearly as far as cells can be counted, and beyond
            check(*[x * max(1.0, shift) + shift * COUNTABLE * used.cell] * 2)
        assert used.grid.count[N_LARGE] == made.surface.n_triangles  # none is in the grid any more
        used.release()


# Scenes on the rig.


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
    """Shrink triangles up to a thousandfold about their first corners, as far as they share none."""
    t, x = made.topology.triangle, made.x.copy()
    own = t[np.bincount(t.ravel(), minlength=len(x))[t].max(axis=1) == 1]
    size = 10.0 ** rng.uniform(-3, 0, (len(own), 1, 1))
    with np.errstate(invalid="ignore"):
        x[own] = x[own[:, :1]] + size * (x[own] - x[own[:, :1]])
    place(made, x, made.move)


def test_candidates_are_the_brute_force_set(rig):
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
        used = rig.hashes[list(EXTENTS)[kind // 5 % 2]]  # every kind of scene with either grid
        used.cell = 10.0 ** rng.uniform(-5, 2)
        assert np.array_equal(pairs_of(used.find()), expected)
        large += 0 < used.grid.count[N_LARGE] < rig.surface.n_triangles / 2
    assert total > scenes * 500 and large > scenes / 10


def test_extreme_cells(rig):
    """So small that no triangle can be counted, so large that all are in one."""
    scatter(np.random.default_rng(3), rig, 0)
    expected = brute_pairs(rig)
    for used in rig.hashes.values():
        for used.cell in (1e-300, 1e-17, 1e17, 1e300):
            assert np.array_equal(pairs_of(used.find()), expected)


def test_order_does_not_depend_on_threads(rig):
    scatter(np.random.default_rng(4), rig, 0)
    used = rig.hashes["usual"]
    used.cell = 0.1

    def rows() -> tuple[np.ndarray, np.ndarray, list[np.ndarray]]:
        found = used.find()
        start, end, entry = (f.to_numpy() for f in (found.start, found.end, found.entry))
        return start, end, np.concatenate([entry[a:b] for a, b in zip(start, end)])

    first = rows()
    assert len(first[2]) > 2000
    for _ in range(20):
        assert all(np.array_equal(a, b) for a, b in zip(first, rows()))


def test_capacities_grow_or_stop(rig, arena):
    scatter(np.random.default_rng(5), rig, 0)
    expected, chunks = brute_pairs(rig), rig.surface.chunks
    used = SpatialHash(rig.surface, arena, 0.1, np.ones(3), capacity=64)
    members, rows = used.members, used.rows
    for buffer, buffer.max_capacity in ((members, 64), (rows, 65)):
        with pytest.raises(SimulationError) as stopped:
            used.find()
        needed = used.grid.cell_count.to_numpy().prod(axis=1).sum() if buffer is members else rows.count[0] * chunks
        ending = f"\\({buffer.chunks} parts of [0-9]+\\), and max_capacity allows {buffer.max_capacity}$"
        assert re.match(f"{buffer.name}: {needed} entries are needed {ending}", str(stopped.value))
        assert needed > 500 and buffer.capacity == 64 and buffer.growths == 0
        buffer.max_capacity = int(needed)  # just enough
    assert needed >= 2 * len(expected) and (chunks > 1 or needed == 2 * len(expected))
    assert np.array_equal(pairs_of(used.find()), expected)
    assert (members.growths, rows.growths) == (1, 1) and rows.capacity == needed
    used.release()
