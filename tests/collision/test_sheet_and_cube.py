"""A cube on a thin sheet, flat or sagging, with gaps and with penetrations below the sheet's thickness:

* every vertex of the cube near the sheet's upper side has a contact there, and the lower side has none;
* gaps are those of the two surfaces to a millimetre (by proximity: to rounding), normals those of the sheet to a few degrees; a
  distance field rounds the cube's edges, so contacts of the sheet's triangles with it have larger tolerances;
* two thin sheets on each other touch with the sides that face each other.
"""

from itertools import product

import numpy as np
import pytest

import taisoft as ts
from tests.collision.rotations import rotation

THICKNESS, MARGIN = 0.05, 0.02  # [m]
COLUMNS = np.linspace(-2.0, 2.0, 21)  # x of the sheet's vertices [m]
TILTS = {"flat": np.eye(3), "tilted": rotation((0.4, 0.1, 1.0), np.radians(8.0))}
GAPS = (0.002, -0.001, -0.005)  # of the cube's lowest vertices [m]


def top(x: np.ndarray, sag: float) -> np.ndarray:
    """Height of the sheet's upper side [m]."""
    return np.interp(x, COLUMNS, 0.5 * THICKNESS - sag * (1 - (COLUMNS / 2) ** 2))


def from_sheet(p: np.ndarray, sag: float) -> tuple[np.ndarray, np.ndarray]:
    """Signed distances (k,) [m] of points (k,3) to the upper side, and its normals there (k,3)."""
    a = np.stack([COLUMNS, top(COLUMNS, sag)], axis=1)
    edge = np.diff(a, axis=0)
    length = np.linalg.norm(edge, axis=1)
    fraction = np.clip(np.einsum("ksx,sx->ks", p[:, None, :2] - a[:-1], edge) / length**2, 0, 1)
    distances = np.linalg.norm(p[:, None, :2] - a[:-1] - fraction[:, :, None] * edge, axis=2)
    k = np.argmin(distances, axis=1)
    normal = np.stack([-edge[:, 1], edge[:, 0], 0 * length], axis=1)[k] / length[k, None]
    distance = distances.min(axis=1)
    return np.where(p[:, 1] > top(p[:, 0], sag), distance, -distance), normal


class Pair:
    """Sheet and cube in a simulator, the sheet first, so that it is side a of contacts."""

    def __init__(self, collision: str):
        scene = ts.Scene(gravity=(0, 0, 0))
        scene.contact_forces = False
        scene.collision = ts.CollisionSettings(margin=MARGIN)
        sheet = ts.sheet_mesh((20, 2, 10), (4.0, THICKNESS, 4.0))
        self.cube = ts.box_mesh((4, 4, 4), (1.0, 1.0, 1.0))
        soft = ts.Material(young=1e3)
        scene.add_body(sheet, soft, name="sheet", collision=collision)
        scene.add_body(self.cube, soft, name="cube", position=(0, 3, 0), collision=collision)
        assert collision != "auto" or [b.contact_mode for b in scene.bodies] == ["proximity", "proximity"]
        self.sheet = sheet.vertices
        self.sim = ts.Simulator(scene, dt=1e-4, integrator="symplectic_euler", precision="f64")

    def place(self, sag: float, tilt: np.ndarray, gap: float) -> np.ndarray:
        """Put the cube's lowest vertices at a gap [m] over the sheet; returns its vertices (n,3) [m]."""
        self.sim.set_state(positions=self.sheet - sag * (1 - (self.sheet[:, :1] / 2) ** 2) * (0, 1, 0), body="sheet")
        x = self.cube.vertices @ tilt.T + (0.03, 0.0, 0.04)
        low, high = -3.0, 3.0
        for _ in range(60):
            middle = 0.5 * (low + high)
            if from_sheet(x + (0, middle, 0), sag)[0].min() < gap:
                low = middle
            else:
                high = middle
        x = x + (0, high, 0)
        self.sim.set_state(positions=x, body="cube")
        return x


@pytest.fixture(scope="module", params=["auto", "distance_field"])
def pair(request):
    made = Pair(request.param)
    yield made, 1e-9 if request.param == "auto" else 1e-3  # and the tolerance of its gaps [m]
    made.sim.close()


@pytest.mark.parametrize("sag, tilt, gap", list(product((0.0, 0.3), TILTS, GAPS)))
def test_the_cube_touches_the_upper_side(pair, sag, tilt, gap):
    made, tolerance = pair
    x = made.place(sag, TILTS[tilt], gap)
    c = made.sim.detect_contacts()
    assert set(c.body_a) == {"sheet"} and set(c.body_b) == {"cube"}
    assert c.unmapped == 0
    to_sheet, normal = from_sheet(c.point, sag)
    local = (c.point - x.mean(axis=0)) @ TILTS[tilt]
    to_cube = -local[:, 1] - 0.5  # from its lower side
    rounded = c.kind == "face_field"
    assert (np.abs(to_sheet + to_cube - c.gap) < np.where(rounded, 2e-3, 1e-3)).all()
    # normals are those of the sheet, or of the cube's lower side or edge
    deviation = np.degrees(np.arccos(np.clip(-np.einsum("kx,kx->k", c.normal, normal), -1, 1)))
    assert (deviation < np.where(rounded, 35.0, 5.0 if tilt == "flat" else 15.0)).all()
    assert c.gap.min() == pytest.approx(gap, abs=tolerance) and c.gap.max() <= MARGIN + 1e-9
    # each vertex of the cube near the sheet has a contact
    distance, normal = from_sheet(x, sag)
    near = np.flatnonzero(distance < 0.9 * MARGIN)
    for i in near:
        own = np.linalg.norm(c.point - (x[i] - 0.5 * distance[i] * normal[i]), axis=1) < 2e-3
        assert own.any(), f"vertex at {x[i]}, {distance[i]} m from the sheet, has no contact"
        assert np.abs(c.gap[own] - distance[i]).min() < tolerance


def test_thin_sheets_touch_with_the_sides_that_face_each_other():
    """With a margin above their thickness."""
    scene = ts.Scene(gravity=(0, 0, 0))
    scene.contact_forces = False
    scene.collision = ts.CollisionSettings(margin=0.03)
    soft, (low, high) = ts.Material(young=1e3), (ts.sheet_mesh((n, n), (size, 0.02, size)) for n, size in ((5, 1.0), (4, 0.7)))
    scene.add_body(low, soft, name="low")
    scene.add_body(high, soft, name="high", position=(0.01, 0.1, 0.02))
    with ts.Simulator(scene, dt=1e-4, integrator="symplectic_euler", precision="f64") as sim:
        start = sim.positions("high")
        for gap in (0.004, -0.001):
            x = start + (0, gap - 0.08, 0)
            sim.set_state(positions=x, body="high")
            c = sim.detect_contacts()
            assert np.abs(c.gap - gap).max() < 1e-9 and np.abs(c.normal + (0, 1, 0)).max() < 1e-9
            assert np.abs(c.point[:, 1] - 0.01 - 0.5 * gap).max() < 1e-9
            for p in x[high.vertices[:, 1] < 0]:
                assert np.abs(c.point - (p[0], 0.01 + 0.5 * gap, p[2])).max(axis=1).min() < 1e-9
