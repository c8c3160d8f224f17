"""Which sides of surfaces count for the overlay, at the start of a step and at iterates, where surfaces may cross:

* far sides of flattened bodies do not, if none cross;
* what slides over a ridge counts on its other side;
* quadratic faces that are bent may overlap where the triangles whose paths are checked do not;
* what overlaps counts only where surfaces are known to cross.
"""

from collections.abc import Iterator
from contextlib import contextmanager

import numpy as np
import taichi as ti

import taisoft as ts
from taisoft.backend.arrays import FieldArena
from taisoft.collision.contacts import MORTAR
from taisoft.collision.detector import Detection
from tests.collision.rotations import rotation
from tests.dynamics.scenes import dynamics

GAP = 1e-3
MATERIAL = ts.Material("st_venant_kirchhoff", young=1e6, density=1.0)


class Search:
    """Searches for the contacts of two bodies at given positions (n,3) each."""

    def __init__(self, made, arena: FieldArena):
        self.m = made.state.model
        self.d = Detection(made.scene, self.m, made.state.layout, made.runtime)
        self.fields = [arena.vectors(name, ti.f64, self.m.n_nodes) for name in ("start", "move")]

    def start(self, *x: np.ndarray, none_cross: bool = True) -> tuple[np.ndarray, ...]:
        """Areas (k,), gaps (k,) and normals (k,3) of mortar contacts at the start of a step."""
        self.m.state.x.from_numpy(np.concatenate(x))
        self.d.find(0.0, 0.01, none_cross=none_cross)
        return self._rows(self.d.buffer, self.d.kept.to_numpy(self.d.counts.contacts))

    def iterate(self, *x: np.ndarray) -> tuple[np.ndarray, ...]:
        """The same at an iterate."""
        start = self.m.state.x.to_numpy()
        for field, values in zip(self.fields, (start, np.concatenate(x) - start)):
            field.from_numpy(values)
        end = self.d.find_at_end(0.0, 0.01, *self.fields, 1.0)
        return self._rows(end.buffer, end.reduction.work.kept.to_numpy(end.reduction.n_kept))

    def _rows(self, buffer, kept: np.ndarray) -> tuple[np.ndarray, ...]:
        at = kept[buffer.data.feature[kept][:, 0] == MORTAR]
        return buffer.data.area[at], buffer.data.gap[at], buffer.data.normal[at]


@contextmanager
def searched(*bodies: tuple[ts.TetMesh, int]) -> Iterator[tuple[Search, list[np.ndarray]]]:
    """A search of bodies of meshes and orders, and their positions at rest."""
    scene, arena = ts.Scene(gravity=(0, 0, 0)), FieldArena()
    for k, (mesh, order) in enumerate(bodies):
        scene.add_body(mesh, MATERIAL, name=f"body {k}", order=order)
    with dynamics(scene, dt=0.01, precision="f64") as made:
        search = Search(made, arena)
        yield search, [np.array(body.rest_positions) for body in scene.bodies]
        search.d.release()
    arena.release()


def test_far_sides_of_flattened_bodies_do_not_count():
    height = 0.002
    with searched(*((ts.box_mesh((k,) * 3, (0.2,) * 3), 1) for k in (1, 2))) as (search, rest):
        low, top = (x * [1, height / 0.2, 1] for x in rest)
        rows = [search.start(low, top + [0, height + GAP, 0])]
        heights = GAP, GAP, 0.5 * GAP, -0.5 * GAP
        rows += [search.iterate(low, top + [0, height + gap, 0]) for gap in heights[1:]]
    for gap, (area, gaps, normal) in zip(heights, rows):
        assert abs(area.sum() - 0.2**2) < 1e-12 and np.abs(gaps - gap).max() < 1e-12
        assert (normal[:, 1] < -0.999).all()


def test_what_slides_over_a_ridge_counts():
    turn, up = np.deg2rad(5), np.array([0.0, 1.0, 0.0])
    with searched((ts.box_mesh((2, 1, 1), (1.0, 0.2, 0.5), (0, -0.1, 0)), 1), (ts.box_mesh((1, 1, 1), (0.2,) * 3), 1)) as (
        search,
        rest,
    ):
        roof, rows = rest[0] - np.abs(rest[0][:, :1]) * np.tan(turn) * up, []
        for side, place in ((-1, search.start), (1, search.iterate)):
            R = rotation(np.array([0.0, 0.0, 1.0]), -side * turn)
            rows.append(place(roof, (rest[1] + [0.15 * side, 0.1 + GAP, 0]) @ R.T))
    for area, gaps, _ in rows:
        assert abs(area.sum() - 0.2**2) < 1e-12 and np.abs(gaps - GAP).max() < 1e-12


def test_bent_quadratic_faces_may_overlap():
    """The upper body's middles hang down; the lower one's vertices follow the triangles between its nodes."""
    meshes = ts.box_mesh((8, 1, 8), (1, 0.3, 1), (0.5, -0.15, 0.5)), ts.box_mesh((2, 1, 2), (1, 0.3, 1), (0.5, 0.15, 0.5))
    with searched((meshes[0], 1), (meshes[1], 2)) as (search, rest):
        places = 0.25 * np.arange(5)
        low, top = (x - 0.02 * np.interp(x[:, :1], places, [0, 1, 0, 1, 0]) * [0, 1, 0] for x in rest)
        found = [search.start(low, top + [0, GAP, 0], none_cross=none_cross) for none_cross in (False, True)]
    assert 1.0 < found[0][0].sum() < 1.01 and np.array_equal(found[0][0], found[1][0])
    assert found[0][1].min() < 0.0  # some of the means overlap


def test_overlaps_count_where_surfaces_cross():
    with searched(*((ts.box_mesh((k,) * 3, (0.2,) * 3), 1) for k in (1, 2))) as (search, (low, top)):
        overlapping = low, top + [0, 0.2 - GAP, 0]
        assert len(search.start(*overlapping)[0]) == 0
        area, gaps, _ = search.start(*overlapping, none_cross=False)
    assert abs(area.sum() - 0.2**2) < 1e-12 and np.abs(gaps + GAP).max() < 1e-12
