"""Graded boxes, balls and cylinders: cells are finer where asked, by the ratio asked for, tets stay well shaped, vertices stay on
the surface; cylinders have their size along every axis, and recipes make the same mesh in scene files.
"""

import numpy as np
import pytest

import taisoft as ts
from taisoft.mesh.quality import edge_lengths, mean_ratio


def lengths_at_ends(mesh: ts.TetMesh, towards) -> tuple[float, float]:
    """Volume^(1/3) of tets farthest opposite a direction, and farthest along it."""
    along = mesh.vertices[mesh.tets].mean(axis=1) @ np.array(towards, dtype=float)
    order = np.argsort(along)
    return np.cbrt(mesh.volumes[order[:6]]).mean(), np.cbrt(mesh.volumes[order[-6:]]).mean()


def worst(mesh: ts.TetMesh) -> float:
    return float(mean_ratio(edge_lengths(mesh.vertices, mesh.tets), mesh.volumes).min())


def test_cells_of_a_box_grow_by_a_constant_factor():
    mesh = ts.box_mesh((4, 3, 1), (2, 3, 1), (1, 0, 0), grading=(8.0, 1.0, 5.0))
    x, y, z = (np.unique(np.round(mesh.vertices[:, k], 12)) for k in range(3))
    steps = np.diff(x)
    assert steps[-1] / steps[0] == pytest.approx(8.0) and np.ptp(steps[1:] / steps[:-1]) < 1e-9
    assert np.allclose(y, [-1.5, -0.5, 0.5, 1.5]) and len(z) == 2  # one cell has no grading
    assert mesh.volumes.sum() == pytest.approx(6.0) and (x[0], x[-1]) == (0.0, 2.0)
    assert np.array_equal(
        ts.box_mesh((3, 3, 3), (1, 1, 1), grading=(1, 1, 1)).vertices, ts.box_mesh((3, 3, 3), (1, 1, 1)).vertices
    )


@pytest.mark.parametrize("grading", [4.0, 30.0])
def test_a_ball_is_finer_at_a_point_and_well_shaped(grading):
    towards = (1.0, -2.0, 0.5)
    mesh, even = ts.ball_mesh(2.0, 16, (1, 2, 3), grading, towards), ts.ball_mesh(2.0, 16)
    far, near = lengths_at_ends(mesh, towards)
    assert far / near == pytest.approx(grading, rel=0.35) and mesh.n_tets == even.n_tets and worst(mesh) > 0.8 * worst(even)
    assert np.abs(np.linalg.norm(mesh.vertices[np.unique(mesh.surface)] - (1, 2, 3), axis=1) - 2.0).max() < 1e-14
    assert np.array_equal(ts.ball_mesh(2.0, 4, towards=(1, 0, 0)).vertices, ts.ball_mesh(2.0, 4).vertices)


@pytest.mark.parametrize("axis", [0, 1, 2])
def test_cylinders(axis):
    mesh = ts.cylinder_mesh(0.5, 3.0, (6, 18), (1, 2, 3), "xyz"[axis])
    local = mesh.vertices - (1, 2, 3)
    across = np.linalg.norm(np.delete(local, axis, axis=1), axis=1)
    assert across.max() == pytest.approx(0.5) and np.ptp(local[:, axis]) == pytest.approx(3.0)
    assert mesh.n_tets == 6 * 6 * 6 * 18 and 0.94 < mesh.volumes.sum() / (np.pi * 0.75) < 1.0 and worst(mesh) > 0.4
    ends, side = np.abs(local[:, axis]) > 1.5 - 1e-12, np.abs(across - 0.5) < 1e-12
    assert (ends | side)[np.unique(mesh.surface)].all()
    along, sideways = np.eye(3)[axis], np.eye(3)[(axis + 1) % 3]
    for towards in (along, -along, sideways):
        graded = ts.cylinder_mesh(0.5, 3.0, (8, 12), axis="xyz"[axis], grading=5.0, towards=towards)
        far, near = lengths_at_ends(graded, towards)
        assert 1.5 < far / near < 5.0 * 1.1  # of volumes, whose other edges stay or shrink too
        assert worst(graded) > 0.08 and np.ptp(graded.vertices[:, axis]) == pytest.approx(3.0)


def test_scene_files_have_the_recipes(tmp_path):
    scene, made = (
        ts.Scene(),
        (
            ts.cylinder_mesh(0.5, 1.0, (4, 3), (0, 1, 0), "x", 3.0, (0, -1, 0)),
            ts.ball_mesh(0.5, 4, grading=3.0, towards=(0, 0, 1)),
            ts.box_mesh((2, 2, 2), (1, 1, 1), grading=(1, 2, 1)),
            ts.cylinder_mesh(0.5, 1.0, (4, 3)),
        ),
    )
    for k, mesh in enumerate(made):
        scene.add_body(mesh, ts.Material(), position=(3 * k, 0, 0), order=2)
    ts.write_scene(tmp_path / "a.toml", scene)
    again, _ = ts.read_scene(tmp_path / "a.toml")
    assert [path.name for path in tmp_path.iterdir()] == ["a.toml"]
    assert all(np.allclose(body.mesh.vertices, mesh.vertices, atol=1e-15) for body, mesh in zip(again.bodies, made))


@pytest.mark.parametrize(
    "make, text",
    [
        (lambda: ts.box_mesh((1, 1, 1), (1, 1, 1), grading=(1, 0, 1)), "box_mesh: grading must be greater than 0"),
        (lambda: ts.ball_mesh(1.0, 4, grading=-1.0), "ball_mesh: grading must be greater than 0"),
        (lambda: ts.ball_mesh(1.0, 4, grading=2.0, towards=(0, 0, 0)), "ball_mesh: towards must be a direction"),
        (lambda: ts.cylinder_mesh(1.0, 1.0, (3, 2)), "cylinder_mesh: cells must be an even integer"),
        (lambda: ts.cylinder_mesh(1.0, 1.0, 4), "cylinder_mesh: cells must be two positive integers"),
        (lambda: ts.cylinder_mesh(0.0, 1.0, (4, 2)), "cylinder_mesh: radius must be greater than 0"),
        (lambda: ts.cylinder_mesh(1.0, 1.0, (4, 2), axis="w"), "cylinder_mesh: axis must be one of x, y, z"),
        (lambda: ts.cylinder_mesh(1.0, 1.0, (4, 2), grading=2.0, towards=(0, 1, 1)), "towards must be along the axis or perpend"),
    ],
)
def test_refusals(make, text):
    with pytest.raises(ts.MeshError, match=text):
        make()
