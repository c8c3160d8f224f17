"""Meshes from other programs are turned, scaled, rotated and placed by `place`."""

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

import taisoft as ts
from taisoft.errors import MeshError

TOWER = ts.box_mesh((1, 1, 3), (1, 2, 6), center=(10, 20, 30))  # 6 long along z


def test_the_up_axis_turns_to_y_before_scale_rotation_and_place():
    """z up: (1, 2, 3) -> (1, 3, -2); times 2: (2, 6, -4); a quarter turn about x: (2, 4, 6), then about y: (6, 4, -2)."""
    corner = ts.SurfaceMesh([(1, 2, 3), (0, 0, 0), (1, 0, 0)], [(0, 1, 2)], "corner", ["a note"])
    for up, point in (("y", (1, 2, 3)), ("z", (1, 3, -2)), ("x", (-2, 1, 3))):
        assert np.array_equal(ts.place(corner, up).vertices[0], point)
        assert np.array_equal(ts.place(ts.place(corner, up), to="z").vertices, ts.place(corner, up, to="z").vertices)
    assert np.array_equal(ts.place(corner, to="z").vertices[0], (1, -3, 2))
    standing = ts.place(TOWER, "z", 0.5, at=(1, 2, 3), to="z").vertices
    assert standing.min(axis=0).tolist() == [0.75, 1.5, 3] and standing.max(axis=0).tolist() == [1.25, 2.5, 6]
    placed = ts.place(corner, "z", 2, (90, 90, 0))
    assert np.array_equal(placed.vertices[0], (6, 4, -2)) and (placed.source, placed.warnings) == ("corner", ["a note"])
    named = ts.TetMesh(TOWER.vertices, TOWER.tets, regions=np.arange(15) // 5, region_names={1: "middle"})
    placed = ts.place(named, "z", 0.5, at=(1, 2, 3))
    assert placed.vertices.min(axis=0).tolist() == [0.75, 2, 2.5] and placed.vertices.max(axis=0).tolist() == [1.25, 5, 3.5]
    assert np.array_equal(placed.regions, named.regions) and placed.region_names == {1: "middle"}


@settings(max_examples=40, deadline=None)
@given(
    up=st.sampled_from("xyz"),
    scale=st.floats(1e-3, 1e3),
    rotate=st.tuples(*[st.floats(-720, 720)] * 3),
    at=st.tuples(*[st.floats(-10, 10)] * 3),
)
def test_any_placement_keeps_the_shape(up, scale, rotate, at):
    placed = ts.place(TOWER, up, scale, rotate, at)
    assert np.array_equal(placed.tets, TOWER.tets) and len(placed.flipped) == 0
    assert np.allclose(placed.volumes, scale**3 * TOWER.volumes, rtol=1e-9)
    x, X = placed.vertices - placed.vertices[0], scale * (TOWER.vertices - TOWER.vertices[0])
    assert np.allclose(x @ x.T, X @ X.T, atol=1e-8 * scale**2 * 40 + 1e-12)
    low, high = placed.vertices.min(axis=0), placed.vertices.max(axis=0)
    assert np.allclose((0.5 * (low + high)[0], low[1], 0.5 * (low + high)[2]), at, atol=1e-9 * (1 + scale))


def test_bad_arguments_are_refused():
    for arguments, message in (
        ({"up": "w"}, "up must be one of x, y, z, not 'w'"),
        ({"to": "x"}, "to must be one of y, z, not 'x'"),
        ({"scale": 0}, "scale must be greater than 0, not 0"),
        ({"at": (0, float("inf"), 0)}, r"at: entry \[1\] is inf, not finite"),
    ):
        with pytest.raises(MeshError, match=f"place: {message}"):
            ts.place(TOWER, **arguments)
    with pytest.raises(MeshError, match="place needs a TetMesh or a SurfaceMesh, not Scene"):
        ts.place(ts.Scene())
