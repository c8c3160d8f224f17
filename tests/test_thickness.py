"""Meshes whose linear tets bend too stiffly are found, from their geometry alone, and adding such a body warns:

* thin sheets and slender bars of one layer, of two long ones, straight or curved, structured or not; no compact bodies, no fine
  ones, and no body with a thin part of less than half its surface;
* whatever the mesh's place, size and turn, and the order of its vertices and tets;
* thickness and layers are those of the grid; the estimate of the stiffness is what statics give;
* the warning names the caller's line, and copies of a scene do not repeat it.
"""

import warnings

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from rotations import rotation

import taisoft as ts
from taisoft.mesh.thickness import coarse_bending, measure_thickness
from taisoft.scene.refine import refined, with_order

RUBBER = ts.Material()
SHEET = ts.sheet_mesh((12, 12), (1.0, 0.02, 1.0))
BAR = ts.box_mesh((12, 1, 1), (12.0, 1.0, 1.0))
FINE = ts.box_mesh((12, 3, 3), (4.0, 1.0, 1.0))


def curved(mesh: ts.TetMesh) -> ts.TetMesh:
    """A sheet of length 1 rolled into three quarters of a tube."""
    x, y, z = mesh.vertices.T
    angle, radius = 1.5 * np.pi * x, y + 1.0 / (1.5 * np.pi)
    return ts.TetMesh(np.stack([radius * np.sin(angle), radius * np.cos(angle), z], axis=1), mesh.tets)


def joined(*meshes: ts.TetMesh) -> ts.TetMesh:
    starts = np.cumsum([0, *(mesh.n_verts for mesh in meshes)])
    tets = [mesh.tets + start for mesh, start in zip(meshes, starts)]
    return ts.TetMesh(np.concatenate([mesh.vertices for mesh in meshes]), np.concatenate(tets))


def irregular(mesh: ts.TetMesh) -> ts.TetMesh:
    """Every vertex moved along the sheet by up to a quarter of a cell."""
    moved = mesh.vertices.copy()
    moved[:, [0, 2]] += np.random.default_rng(4).uniform(-0.25 / 12, 0.25 / 12, (len(moved), 2))
    return ts.TetMesh(moved, mesh.tets)


CUBES = joined(*(ts.box_mesh((1, 1, 1), (1.0, 1.0, 1.0), (1.5 * k, 0.0, 0.0)) for k in range(12)))
UNEVEN = joined(ts.box_mesh((3, 3, 3), (3.0, 3.0, 3.0)), ts.box_mesh((6, 1, 1), (6.0, 0.5, 1.0), (5.0, 0.0, 0.0)))

COARSE = {
    "sheet": (SHEET, 1),
    "irregular sheet": (irregular(SHEET), 1),
    "tube": (curved(SHEET), 1),
    "bar": (BAR, 1),
    "kuhn": (ts.box_mesh((12, 1, 1), (12.0, 1.0, 1.0), pattern="six"), 1),
    "fine along": (ts.box_mesh((40, 1, 1), (4, 1, 1)), 1),
    "plate": (ts.box_mesh((4, 1, 4), (2.0, 0.5, 2.0)), 1),
    "long cells": (ts.box_mesh((6, 2, 2), (12.0, 1.0, 1.0)), 2),
    "wide bar": (ts.box_mesh((12, 1, 3), (12.0, 1.0, 3.0)), 1),
    "two bars": (joined(BAR, curved(SHEET)), 1),
}
RIGHT = {
    "cell": ts.box_mesh((1, 1, 1), (1.0, 1.0, 1.0)),
    "two cells": ts.box_mesh((2, 1, 1), (2.0, 1.0, 1.0)),
    "fine": FINE,
    "two layers": ts.box_mesh((20, 2, 2), (10.0, 1.0, 1.0)),
    "fine sheet": ts.sheet_mesh((12, 4, 12), (1.0, 0.2, 1.0)),
    "tet": ts.TetMesh([[0, 0, 0], [1, 0, 0], [0, 1, 0], [0, 0, 1]], [[0, 1, 2, 3]]),
    "cubes in a row": CUBES,
    "coarse ball": ts.ball_mesh(1.0, 2),
    "ball": ts.ball_mesh(1.0, 6),
    "large cube and thin bar": UNEVEN,
}


@pytest.mark.parametrize("name", COARSE)
def test_thin_meshes_of_few_layers_are_found(name):
    mesh, layers = COARSE[name]
    found = coarse_bending(mesh)
    assert found is not None and found.layers == pytest.approx(layers, rel=0.05) and found.stiffness >= 2.0


@pytest.mark.parametrize("name", RIGHT)
def test_other_meshes_are_not(name):
    assert coarse_bending(RIGHT[name]) is None


def test_a_mesh_of_others(shared):
    assert coarse_bending(ts.read_mesh(shared / "meshes" / "mat20x20.msh")).layers == pytest.approx(1.0)
    assert coarse_bending(ts.read_mesh(shared / "meshes" / "bunny.msh")) is None


@pytest.mark.parametrize("pattern", ["five", "six"])
def test_thickness_and_layers_are_the_grids(pattern):
    mesh = ts.box_mesh((5, 2, 3), (5.0, 1.0, 6.0), pattern=pattern)
    thickness, layers = measure_thickness(mesh, np.arange(len(mesh.surface)))
    corners = mesh.vertices[mesh.surface]
    axis = np.ptp(corners, axis=1).argmin(axis=1)  # that a triangle's normal lies along
    assert thickness == pytest.approx(np.array([5.0, 1.0, 6.0])[axis])
    assert layers == pytest.approx(np.array([5.0, 2.0, 3.0])[axis])


def test_behind_many_tets_nothing_is_thin():
    mesh = ts.box_mesh((1, 40, 1), (1.0, 1.0, 1.0))
    thickness, layers = measure_thickness(mesh, np.arange(len(mesh.surface)))
    ends = np.ptp(mesh.vertices[mesh.surface][:, :, 1], axis=1) == 0.0
    assert np.isinf(thickness[ends]).all() and np.isinf(layers[ends]).all() and thickness[~ends] == pytest.approx(1.0)


@settings(max_examples=25, deadline=None)
@given(st.sampled_from([SHEET, BAR, FINE, COARSE["tube"][0], COARSE["two bars"][0], CUBES]), st.integers(0, 2**32 - 1))
def test_place_size_turn_and_order_change_nothing(mesh, seed):
    dice = np.random.default_rng(seed)
    turned = mesh.vertices @ rotation(dice.normal(size=3), dice.uniform(0, np.pi)).T
    moved = 10.0 ** dice.uniform(-4, 4) * (turned + dice.normal(size=3))
    order, tets = dice.permutation(mesh.n_verts), dice.permutation(mesh.tets)
    places = np.empty(mesh.n_verts, dtype=np.int64)
    places[order] = np.arange(mesh.n_verts)
    turns = np.array([[0, 1, 2, 3], [1, 2, 0, 3], [3, 2, 1, 0], [2, 3, 0, 1]])[dice.integers(0, 4, mesh.n_tets)]
    other = ts.TetMesh(moved[order], places[np.take_along_axis(tets, turns, axis=1)])
    one, two = coarse_bending(mesh), coarse_bending(other)
    assert (one is None) == (two is None)
    if one is not None:
        assert two.stiffness == pytest.approx(one.stiffness, rel=1e-6) and two.layers == pytest.approx(one.layers, rel=1e-6)


def test_the_estimate_is_what_statics_give():
    """Cantilevers, 10 long and 1 thick, against Timoshenko's beam."""
    cases = {"1": (10, 1), "1 long": (4, 1), "1 six": (10, 1), "2": (20, 2), "2 long": (10, 2)}
    young, poisson, force = 1e6, 0.3, 0.1
    scene = ts.Scene(gravity=(0, 0, 0))
    for name, (along, across) in cases.items():
        mesh = ts.box_mesh((along, across, across), (10.0, 1.0, 1.0), pattern="six" if "six" in name else "five")
        with warnings.catch_warnings():
            warnings.simplefilter("ignore")
            body = scene.add_body(mesh, ts.Material(young=young, poisson=poisson), name=name)
        body.fix(lambda X: X[:, 0] < -4.999)
        body.add_force(lambda X: X[:, 0] > 4.999, (0.0, -force, 0.0))
    result = ts.solve_static(scene)
    right = force * 10.0**3 / (3.0 * young / 12.0) + force * 10.0 / (5.0 / 6.0 * young / (2.0 + 2.0 * poisson))
    for body in scene.bodies:
        tip = body.rest_positions[:, 0] > 4.999
        stiffness = -right / (result.positions(body.name) - body.rest_positions)[tip, 1].mean()
        found = coarse_bending(body.mesh)
        if found is None:
            assert stiffness < 2.0, body.name
        else:
            assert 2.0 < stiffness and 0.6 < found.stiffness / stiffness < 1.4, (body.name, stiffness)
    assert [body.name for body in scene.bodies if coarse_bending(body.mesh) is None] == ["2"]


def told(call) -> list[warnings.WarningMessage]:
    with warnings.catch_warnings(record=True) as found:
        warnings.simplefilter("always")
        call()
    return found


def test_adding_a_thin_body_warns_once_with_the_callers_line():
    scene = ts.Scene()
    found = told(lambda: scene.add_body(SHEET, RUBBER, name="mat"))
    said = "body 'mat': about 1 linear tet lies through its thickness, and it bends about 30 times too stiffly: "
    assert [str(one.message) for one in found] == [said + "order=2 bends correctly"] and found[0].filename == __file__
    found = told(lambda: scene.add_body(ts.box_mesh((6, 2, 2), (12, 1, 1)), ts.Material(poisson=0.495), name="bar"))
    assert [one.filename for one in found] == [__file__] * 2
    assert "body 'bar': about 2 linear tets lie through its thickness" in str(found[1].message)
    assert told(lambda: scene.add_body(SHEET, RUBBER, order=2)) == []
    assert told(lambda: scene.add_body(FINE, RUBBER)) == []
    assert told(scene.snapshot) == told(lambda: refined(scene)) == told(lambda: with_order(with_order(scene, 2), 1)) == []
    assert len(told(lambda: scene.add_body(SHEET, RUBBER))) == 1  # another body of the same mesh


def test_a_scene_file_warns_once_a_body(tmp_path):
    ts.write_mesh(tmp_path / "a.msh", SHEET)
    body = "[bodies.{}]\nmaterial = {{}}\nmesh = {{ file = 'a.msh' }}\n"
    (tmp_path / "scene.toml").write_text(body.format("one") + body.format("two"))
    found = told(lambda: ts.read_scene(tmp_path / "scene.toml"))
    assert [str(one.message).split(":")[0] for one in found] == ["body 'one'", "body 'two'"]


def test_a_new_poissons_ratio_warns_with_the_callers_line():
    scene = ts.Scene()
    scene.add_body(FINE, RUBBER, name="bar")
    with ts.Simulator(scene, dt=0.01, integrator="implicit_euler") as sim:
        found = told(lambda: sim.set_material("bar", poisson=0.495))
        assert [one.filename for one in found if "lock" in str(one.message)] == [__file__]
