"""Generated meshes: boxes of both patterns have their vertices in the documented order and fill their volume; balls are round
and well shaped; invalid arguments and too large meshes are refused.
"""

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from taisoft.errors import MeshError
from taisoft.mesh.quality import edge_lengths, mean_ratio
from taisoft.mesh.shapes import ball_mesh, box_mesh, sheet_mesh

PATTERNS = {"five": 5, "six": 6}
EVEN_MIDDLE = {(0, 0, 0), (1, 1, 0), (1, 0, 1), (0, 1, 1)}


@settings(max_examples=20, deadline=None)
@given(st.tuples(*[st.integers(1, 4)] * 3), st.tuples(*[st.floats(0.1, 10.0)] * 3), st.sampled_from(sorted(PATTERNS)))
@pytest.mark.filterwarnings("ignore:.*nearly flat")
def test_a_box_fills_its_volume(cells, size, pattern):
    center = np.array([0.5, -1.0, 2.0])
    mesh = box_mesh(cells, size, center, pattern)
    nx, ny, nz = cells
    assert mesh.n_tets == PATTERNS[pattern] * nx * ny * nz
    assert all("nearly flat or needles" in message for message in mesh.warnings)  # of long or thin cells
    assert mesh.n_components == 1 and len(mesh.flipped) == 0
    assert mesh.volumes.sum() == pytest.approx(np.prod(size))
    for i, j, k in ((0, 0, 0), (nx, 0, 0), (0, ny, nz), (nx, ny, nz), (nx // 2, ny - 1, 1)):
        expected = center + np.array(size) * (np.array([i / nx, j / ny, k / nz]) - 0.5)
        assert mesh.vertices[(i * (ny + 1) + j) * (nz + 1) + k] == pytest.approx(expected, abs=1e-12)
    assert len(mesh.surface) == 4 * (nx * ny + ny * nz + nz * nx)


def cell_tets(mesh, cells):
    """For every cell (i,j,k), its tets as sets of corners relative to the cell, such as (1,0,1)."""
    found: dict[tuple, list] = {}
    grid = np.stack(np.unravel_index(mesh.tets, np.array(cells) + 1), axis=-1)
    for tet in grid:
        low = tet.min(axis=0)
        found.setdefault(tuple(low.tolist()), []).append({tuple(corner) for corner in (tet - low).tolist()})
    return found


def test_pattern_five_alternates_like_a_checkerboard_and_six_shares_the_diagonal():
    cells = (3, 2, 2)
    found = cell_tets(box_mesh(cells, (3, 2, 2)), cells)
    assert len(found) == 12
    for cell, tets in found.items():
        odd = sum(cell) % 2
        middle = {(x ^ odd, y, z) for x, y, z in EVEN_MIDDLE}
        assert middle in tets and len(tets) == 5
        for corner in {(x, y, z) for x in (0, 1) for y in (0, 1) for z in (0, 1)} - middle:
            near = {other for other in middle if sum(abs(a - b) for a, b in zip(corner, other)) == 1}
            assert {corner} | near in tets
    cells = (2, 2, 1)
    for tets in cell_tets(box_mesh(cells, (2, 2, 1), pattern="six"), cells).values():
        assert len(tets) == 6 and all({(0, 0, 0), (1, 1, 1)} <= tet for tet in tets)
    sheet = sheet_mesh((4, 3), (2.0, 0.05, 1.5), pattern="six")
    assert sheet.n_tets == 72 and np.ptp(sheet.vertices, axis=0) == pytest.approx([2.0, 0.05, 1.5])
    assert sheet_mesh((4, 2, 3), (2.0, 0.05, 1.5)).n_verts == 60
    flat, box = sheet_mesh((4, 3), (2.0, 1.5, 0.05), up="z"), box_mesh((4, 3, 1), (2.0, 1.5, 0.05))
    assert np.array_equal(flat.vertices, box.vertices) and np.array_equal(flat.tets, box.tets)
    for size, up, message in (
        ((2.0, 1.6, 1.5), "y", "thickness"),
        ((2.0, 0.1, 1.5), "z", "thickness"),
        ((1, 1, 1), "x", "one of y, z"),
    ):
        with pytest.raises(MeshError, match=message):
            sheet_mesh((4, 3), size, up=up)


@pytest.mark.parametrize("cells", [2, 4, 8])
def test_a_ball_is_round_and_well_shaped(cells):
    center = np.array([1.0, 2.0, -3.0])
    mesh = ball_mesh(0.7, cells, center)
    assert mesh.n_tets == 6 * cells**3 and mesh.warnings == ()
    radii = np.linalg.norm(mesh.vertices - center, axis=1)
    assert radii[np.unique(mesh.surface)] == pytest.approx(0.7)
    assert radii.max() <= 0.7 * (1 + 1e-12)
    missing = 1.0 - mesh.volumes.sum() / (4.0 / 3.0 * np.pi * 0.7**3)
    assert 0 < missing < 1.2 / cells**2  # the volume between chords of length h and the sphere scales with h^2
    assert mean_ratio(edge_lengths(mesh.vertices, mesh.tets), mesh.volumes).min() > 0.68
    assert mesh.volumes @ mesh.vertices[mesh.tets].mean(axis=1) == pytest.approx(center * mesh.volumes.sum(), abs=1e-12)


def test_invalid_arguments_and_too_large_meshes_are_refused():
    for name, values, rule in (
        ("cells", [(0, 1, 1), (1, 1), (1.5, 1, 1), 3, "abc", (True, 1, 1), None], " must be three positive integers"),
        ("size", [(0, 1, 1), (1, -1, 1), (1, 1), (1, np.nan, 1), "abc", ((1, 2), 3)], ""),
        ("pattern", ["four"], " must be one of five, six, not 'four'"),
        ("center", [(0, 0, np.nan)], r": entry \[2\] is nan, not finite"),
    ):
        for value in values:
            with pytest.raises(MeshError, match=f"box_mesh: {name}{rule}"):
                box_mesh(**({"cells": (1, 1, 1), "size": (1, 1, 1)} | {name: value}))
    for cells in ((1000, 1000, 1000), (10**30, 1, 1)):
        with pytest.raises(MeshError, match="tets"):
            box_mesh(cells, (1, 1, 1))
        with pytest.raises(MeshError, match="ball_mesh.*tets"):
            ball_mesh(1.0, 2 * cells[0])
    for radius, cells, rule in ((0, 4, "radius"), (1, 3, "even"), (1, 2.0, "even")):
        with pytest.raises(MeshError, match=rule):
            ball_mesh(radius, cells)
