"""Where two bodies with sharp features touch: fourteen cases whose contacts are known from geometry, without Taichi.

Case names after K. Erleben, Methodology for Assessing Mesh-Based Contact Point Methods, ACM TOG 37(3) 2018, art. 39. Body A
comes from above and overlaps B by P; normals point from B to A, so their y is positive everywhere. Spikes have a base of
1 x 1 m and wedges one of 1 x 2 m, 3 m from the tip. A contact's point may lie anywhere between the two surfaces.
"""

from dataclasses import dataclass, replace
from itertools import product

import numpy as np

import taisoft as ts

P = 0.01  # [m] overlap along y
UP = (0.0, 1.0, 0.0)
POINT, NORMAL, DEPTH = 1e-3, 1e-3, 0.02  # tolerances: of the size of A, of a unit vector, of the depth

BOX = ((0, 1, 3, 2), (4, 6, 7, 5), (0, 4, 5, 1), (2, 3, 7, 6), (0, 2, 6, 4), (1, 5, 7, 3))  # corner (i,j,k): 4 i + 2 j + k
WEDGE = ((0, 2, 4), (1, 5, 3), (0, 1, 3, 2), (2, 3, 5, 4), (4, 5, 1, 0))  # both ends of three edges
SPIKE = ((0, 1, 2), (0, 2, 3), (0, 3, 4), (0, 4, 1), (4, 3, 2, 1))  # its tip, then its base


@dataclass(frozen=True)
class Line:
    """Where contacts of one direction are: between two points, each of which must have one; normal (3,), depth [m]."""

    normal: tuple[float, float, float]
    depth: float
    start: tuple[float, float, float]
    stop: tuple[float, float, float]

    def fits(self, point: np.ndarray, normal: np.ndarray, gap: np.ndarray, close: float) -> np.ndarray:
        """(k,) whether contacts are of this line, with points to a distance [m]."""
        way, n = np.subtract(self.stop, self.start), np.asarray(self.normal)
        share = np.clip((point - self.start) @ way / max(way @ way, 1e-30), 0, 1)
        off = point - self.start - share[:, None] * way
        along = off @ n
        near = (np.linalg.norm(off - along[:, None] * n, axis=1) <= close) & (np.abs(along) <= self.depth + close)
        turned = np.abs(normal - n).max(axis=1, initial=0)
        return near & (turned <= NORMAL) & (np.abs(gap + self.depth) <= DEPTH * self.depth)


@dataclass(frozen=True)
class Case:
    """A on B, and what must be found. where: places of A, from which the lines are shifted alike.

    a, b: a mesh, or a shape for an obstacle. lines: where contacts must be. area: x and z of the box that points may lie in
    besides, with the first line's normal and depth; None: on the lines only. field: whether a distance field can tell.
    """

    name: str
    a: ts.TetMesh
    b: object
    lines: tuple[Line, ...]
    area: tuple[tuple[float, float], tuple[float, float]] | None = None
    field: bool = False
    where: tuple[tuple[float, float, float], ...] = ((0.0, 0.0, 0.0),)

    def problems(self, point: np.ndarray, normal: np.ndarray, gap: np.ndarray) -> list[str]:
        """What is wrong with the contacts point (k,3) [m], normal (k,3) and gap (k,) [m] of A, and what is missing."""
        size, allowed, found = np.ptp(self.a.vertices, axis=0).max(), np.zeros(len(point), dtype=bool), []
        for line in self.lines:
            fits = line.fits(point, normal, gap, POINT * size)
            allowed |= fits
            for end in dict.fromkeys((line.start, line.stop)):
                if not (fits & replace(line, start=end, stop=end).fits(point, normal, gap, POINT * size)).any():
                    found.append(f"no contact at {end} along {np.round(line.normal, 3)}")
        if self.area is not None:
            line, (lo, hi) = self.lines[0], np.array(self.area).T
            level = line.fits(point * UP + np.multiply(line.start, (1, 0, 1)), normal, gap, POINT * size)
            plan = point[:, [0, 2]]
            allowed |= level & ((plan >= lo - POINT * size) & (plan <= hi + POINT * size)).all(axis=1)
        for k in np.flatnonzero(~allowed):
            found.append(f"contact at {np.round(point[k], 5)}, normal {np.round(normal[k], 5)}, gap {gap[k]:.6f} is none")
        return found


def fan(vertices, faces, inner) -> ts.TetMesh:
    """The solid within polygons, as tets from a point that sees all of them. faces: corners, outward; convex from the first."""
    triangles = [(face[0], b, c) for face in faces for b, c in zip(face[1:], face[2:])]
    vertices = np.concatenate([[inner], vertices])
    return ts.TetMesh(vertices, [(0, a + 1, b + 1, c + 1) for a, b, c in triangles])


def spike(tip: float, up: bool = False, half: float = 0.5, height: float = 3.0) -> ts.TetMesh:
    """A pyramid with its tip at height `tip` on the y axis, pointing down, or up."""
    base = tip + (-height if up else height)
    corners = [(-half, base, -half), (-half, base, half), (half, base, half), (half, base, -half)]
    vertices = [(0, tip, 0), *(corners if up else corners[::-1])]
    return fan(vertices, SPIKE, (0, 0.4 * tip + 0.6 * base, 0))


def wedge(ridge: float, up: bool = False, along: str = "z") -> ts.TetMesh:
    """A prism with its ridge at height `ridge` above or below an axis, from -1 to 1 m along it, pointing down, or up."""
    base = ridge + (-3.0 if up else 3.0)
    half = -0.5 if up else 0.5
    section = [(0.0, ridge), (half, base), (-half, base)]  # x, y; anticlockwise seen from z
    vertices = np.array([(x, y, z) for x, y in section for z in (1.0, -1.0)])
    middle = np.array([0.0, 0.4 * ridge + 0.6 * base, 0.0])
    if along == "x":  # turned about y
        vertices = vertices[:, [2, 1, 0]] * (1, 1, -1)
    return fan(vertices, WEDGE, middle)


def frustum() -> ts.TetMesh:
    """A block of height 1 m whose top is 1 x 1 m and whose bottom is 1.5 x 1.5 m."""
    vertices = [(i * w, y, k * w) for i, (y, w), k in product((-1, 1), ((-0.5, 0.75), (0.5, 0.5)), (-1, 1))]
    return fan(vertices, BOX, (0, 0, 0))


def grooved() -> ts.TetMesh:
    """A block of 2 x 1 x 4 m with a groove along z, whose walls go from (+-0.5, 0.5) to (0, 0)."""
    section = [(0, 0), (-0.5, 0.5), (-1, 0.5), (-1, -0.5), (1, -0.5), (1, 0.5), (0.5, 0.5)]  # anticlockwise seen from z
    n = len(section)
    vertices = [(x, y, z) for z in (2.0, -2.0) for x, y in section]
    sides = [(k, n + k, n + (k + 1) % n, (k + 1) % n) for k in range(n)]
    return fan(vertices, [tuple(range(n)), (n, *range(2 * n - 1, n, -1)), *sides], (0, -0.25, 0))


def holed() -> ts.TetMesh:
    """A block of 2 x 1 x 2 m with a square hole of 1 x 1 m from top to bottom."""
    block = ts.box_mesh((3, 1, 3), (3, 1, 3), pattern="six")
    middle = block.vertices[block.tets].mean(axis=1)
    tets = block.tets[(np.abs(middle[:, [0, 2]]) > 0.5).any(axis=1)]
    vertices = block.vertices.copy()
    vertices[:, [0, 2]] = np.clip(vertices[:, [0, 2]], -1, 1)  # walls of 0.5 m
    return ts.TetMesh(vertices, tets)


def plane(cells: int = 8, size: float = 4.0) -> ts.MeshObstacle:
    """A square of the plane y = 0, facing up, of many triangles."""
    i, k = (index.ravel() for index in np.meshgrid(np.arange(cells + 1), np.arange(cells + 1), indexing="ij"))
    vertices = np.stack([i, 0 * i, k], axis=1) * (size / cells) - (size / 2, 0, size / 2)
    a = np.flatnonzero((i < cells) & (k < cells))
    b, c, d = a + 1, a + cells + 1, a + cells + 2
    return ts.MeshObstacle(vertices, np.concatenate([np.stack([a, b, d], axis=1), np.stack([a, d, c], axis=1)]))


def level(x: float, z: float, x1: float | None = None, z1: float | None = None, y: float = 0.0) -> Line:
    """Contacts straight up, of depth P: at a point, or between two of one height."""
    return Line(UP, P, (x, y, z), (x if x1 is None else x1, y, z if z1 is None else z1))


def _walls(ends: tuple[float, float]) -> tuple[Line, Line]:
    """Of what stands in the groove, from one z to another."""
    s = np.sqrt(0.5)
    return tuple(Line((x * s, s, 0.0), P * s, (0.0, -P, ends[0]), (0.0, -P, ends[1])) for x in (1, -1))


def _rims() -> tuple[Line, ...]:
    """Of the spike in the hole: each rim pushes it inward and up."""
    lines, s = [], 1 / np.sqrt(5)
    for x, z in ((1, 0), (-1, 0), (0, 1), (0, -1)):
        start, stop = (0.5 * (x - z), 0.5, 0.5 * (z - x)), (0.5 * (x + z), 0.5, 0.5 * (z + x))
        lines.append(Line((-2 * s * x, s, -2 * s * z), P * s, start, stop))
    return tuple(lines)


def cases() -> dict[str, Case]:
    """By name; some come in more than one way."""
    ground, rest = ts.HalfSpace((0, 0, 0), UP), ts.box_mesh((8, 1, 8), (4, 0.5, 4), (0, -0.25, 0))
    # over edges, vertices and faces: the cells are 0.5 m wide
    way = tuple((x, 0.0, z) for z in (0.0, 0.03) for x in (-0.25, -0.1, -0.01, 0.0, 0.01, 0.25, 0.4, 0.5))
    tip, ridge, top = level(0, 0), level(0, -1, 0, 1), 0.5
    corners = tuple(level(x, z, y=top) for x in (-0.5, 0.5) for z in (-0.5, 0.5))
    square = ((-0.5, 0.5), (-0.5, 0.5))
    cube = ts.box_mesh((1, 1, 1), (1, 1, 1), (0, 1 - P, 0))
    ball = ts.ball_mesh(0.5, 8)
    lifted = ts.TetMesh(ball.vertices + (0, 1 - P, 0), ball.tets)
    aside = ts.TetMesh(cube.vertices + (0.5, 0, 0.5), cube.tets)
    shared = tuple(level(x, z, y=top) for x in (0, 0.5) for z in (0, 0.5))
    cliff = ts.box_mesh((1, 1, 1), (1.5, 1.5, 1.5), (0, 1.25 - P, 0))
    slab = ts.box_mesh((1, 1, 1), (2.0, 0.5, 2.0), (0.0, 0.25 - P, 0.0), "six")
    pole = (level(0, 0, y=0.5),)
    made = (
        Case("spike_on_plane", spike(-P), ground, (tip,), field=True),
        Case("wedge_on_plane", wedge(-P), ts.Box((0, -1, 0), (3, 1, 3)), (ridge,), field=True),
        Case("sliding_spike", spike(-P), rest, (tip,), field=True, where=way),
        Case("sliding_spike_on_triangles", spike(-P), plane(), (tip,), where=way),
        Case("sliding_wedge", wedge(-P), rest, (ridge,), field=True, where=way),
        Case("sliding_wedge_on_triangles", wedge(-P), plane(), (ridge,), where=way),
        Case("spike_on_spike", spike(-P), spike(0, up=True), (tip,)),
        Case("spike_on_wedge", spike(-P), wedge(0, up=True), (tip,)),
        Case("wedge_on_wedge_crossed", wedge(-P, along="x"), wedge(0, up=True), (tip,)),
        Case("wedge_on_wedge_parallel", wedge(-P), wedge(0, up=True), (ridge,)),
        Case("spike_in_hole", spike(-0.5 - P, half=0.75, height=1.5), holed(), _rims(), field=True),
        Case("spike_in_crack", spike(-P), grooved(), _walls((0, 0))),
        Case("wedge_in_crack", wedge(-P), grooved(), _walls((-1, 1))),
        Case("cliff_edges", cliff, frustum(), corners, square, field=True),
        Case("internal_edges", cube, ts.box_mesh((6, 1, 6), (2, 1, 2)), corners, square, field=True),
        Case("ball_on_ball", lifted, ball, pole, field=True),
        Case("ball_on_sphere", lifted, ts.Sphere((0, 0, 0), 0.5), pole, field=True),
        Case("box_on_box_offset", aside, ts.box_mesh((1, 1, 1), (1, 1, 1)), shared, ((0, 0.5), (0, 0.5)), field=True),
        Case("spike_on_capsule", spike(-P), ts.Capsule((-1, -0.2, 0), (1, -0.2, 0), 0.2), (tip,)),
        Case("slab_on_sphere", slab, ts.Sphere((0.3, -0.4, -0.5), 0.4), (level(0.3, -0.5),)),
        Case("slab_on_capsule", slab, ts.Capsule((-0.6, -0.5, 0.1), (0.4, -0.2, 0.2), 0.2), (level(0.4, 0.2),)),
        Case("box_on_box_obstacle", aside, ts.Box((0, 0, 0), (0.5, 0.5, 0.5)), shared, ((0, 0.5), (0, 0.5))),
    )
    return {case.name: case for case in made}
