"""Surfaces for the tests of the broad phases and of what follows them, and what NumPy says of them."""

from collections.abc import Iterator
from contextlib import contextmanager
from types import SimpleNamespace

import numpy as np

from taisoft.backend.arrays import FieldArena
from taisoft.collision.candidates import EDGES, WHOLE, Buffer, Candidates, Pairs, entries, pair_entries, pairs_of
from taisoft.collision.colliders import make_topology
from taisoft.collision.surface import build_surface, update_surface
from taisoft.fem.state import GO
from tests.backend.lanes import opened

NEAR = Pairs()  # a visitor of all near pairs


@contextmanager
def surface_of(
    parts: list[tuple[np.ndarray, np.ndarray]],
    soft=None,
    self_on=None,
    move=None,
    margin: float = 0.1,
    serial: bool | None = None,
) -> Iterator[SimpleNamespace]:
    """The surface of colliders, each (vertices (v,3), triangles (t,3)), with boxes up to date: surface, topology, x, move,
    margin, arena, runtime. soft, self_on: (colliders,), all and none where None; move: (n_verts,3) [m], 0 where None."""
    x = np.concatenate([vertices for vertices, _ in parts]).astype(np.float64)
    topology = make_topology([(triangles, np.arange(len(vertices))) for vertices, triangles in parts])
    soft = np.ones(len(parts), dtype=bool) if soft is None else np.asarray(soft)
    self_on = np.zeros(len(parts), dtype=bool) if self_on is None else np.asarray(self_on)
    move = np.zeros_like(x) if move is None else move
    arena = FieldArena()
    with opened("f64") as runtime:
        properties = {"soft": soft, "self_on": self_on, "mode": np.zeros(len(soft))}
        properties |= dict.fromkeys(("thickness", "edge"), np.full(len(soft), np.inf)) | {"padding": 0.0, "margin": 0.0}
        surface = build_surface(topology, x, properties, runtime, arena, serial)
        made = SimpleNamespace(surface=surface, topology=topology, soft=soft, self_on=self_on, margin=margin, arena=arena)
        made.runtime, made.row = runtime, Buffer("near", entries, 64, None, surface.chunks, arena)
        made.pairs = Buffer("pairs", pair_entries, 64, None, surface.chunks, arena)
        place(made, x, move)
        yield made
    for part in (made.row, made.pairs, arena):
        part.release()


def place(made: SimpleNamespace, x: np.ndarray, move: np.ndarray | None = None) -> None:
    """Put the vertices somewhere and bring the boxes up to date."""
    made.x, made.move = x, np.zeros_like(x) if move is None else move
    made.surface.x.from_numpy(made.x)
    made.surface.move.from_numpy(made.move)
    made.surface.padding[0] = 0.5 * made.margin
    update_boxes(made)


def update_boxes(made: SimpleNamespace) -> None:
    """Bring the boxes up to date with the vertices of the surface."""
    s = made.surface
    s.run[GO] = 0  # they stay
    update_surface(s, s.x, s.move, False, s.move, 1.0, made.margin, True)
    s.run[GO] = 1


def visited_pairs(made: SimpleNamespace, broad, visitor: Pairs = NEAR, out: Buffer | None = None) -> np.ndarray:
    """(k,2) pairs t < u of a broad phase that the visitor accepts, in the order found."""
    return pairs_of(made.surface, broad.near(), made.row, visitor, out or made.pairs)


def row_pairs(candidates: Candidates) -> np.ndarray:
    """(k,2) pairs t < u, ascending; checks that rows hold both directions, ascending, each once."""
    start, end, entry = (f.to_numpy() for f in (candidates.start, candidates.end, candidates.entry))
    rows = [entry[a:b] for a, b in zip(start, end)]
    assert all((np.diff(row) > 0).all() for row in rows)
    both = np.stack([np.repeat(np.arange(len(rows)), [len(r) for r in rows]), np.concatenate([[], *rows])], axis=1).astype(int)
    up, down = both[both[:, 0] < both[:, 1]], both[both[:, 0] > both[:, 1]][:, ::-1]
    assert np.array_equal(up, down[np.lexsort((down[:, 1], down[:, 0]))]) and 2 * len(up) == len(both)
    return up


def near_pairs(made: SimpleNamespace, q: int = WHOLE) -> np.ndarray:
    """(k,2) triangles t and u that may touch, ascending: the swept, grown boxes of t, or of its corner q < 3, and of u overlap.
    q = EDGES: those that are to be tested for edges; WHOLE: of pairs in one collider, those with t < u."""
    t, body = made.topology.triangle, made.topology.body
    ends = np.concatenate([made.x[t], (made.x + made.move)[t]], axis=1)
    finite, own = np.isfinite(ends).all(axis=(1, 2)), ends if q > 2 else ends[:, [q, 3 + q]]
    grown, meet = 0.5 * made.margin, finite[:, None] & finite
    with np.errstate(invalid="ignore"):
        meet &= (own.min(axis=1)[:, None] - grown <= ends.max(axis=1) + grown).all(axis=2)
        meet &= (ends.min(axis=1) - grown <= own.max(axis=1)[:, None] + grown).all(axis=2)
    shared = (t[:, None, :, None] == t[None, :, None, :]).any(axis=(2, 3))
    same = body[:, None] == body[None]
    meet &= np.where(same, made.self_on[body][:, None] & ~shared, made.soft[body][:, None] | made.soft[body][None])
    if q == EDGES:
        sharp = made.surface.sharp.to_numpy()
        meet &= (sharp != 0) & (np.triu(np.ones_like(meet), 1) | (sharp & 7 == 0))
    elif q == WHOLE:
        meet &= ~same | np.triu(np.ones_like(meet), 1)
    return np.argwhere(meet)


def brute_pairs(made: SimpleNamespace) -> np.ndarray:
    """(k,2) pairs t < u, ascending, that may touch and whose swept, grown boxes overlap."""
    pairs = near_pairs(made)
    return pairs[pairs[:, 0] < pairs[:, 1]]


def soup(rng: np.random.Generator, n: int, size: float = 0.3) -> tuple[np.ndarray, np.ndarray]:
    """n triangles in a unit cube that share vertices at random, with needles and points among them."""
    vertices = rng.random((n, 3))
    triangles = rng.integers(0, n, (n, 3))
    centre = rng.random((n, 3))
    own = np.arange(3 * n).reshape(n, 3)
    free = (centre[:, None] + size * (rng.random((n, 3, 3)) - 0.5)).reshape(-1, 3)
    free[own[::7, 1]] = free[own[::7, 0]]  # needles
    free[own[::11, 1]] = free[own[::11, 2]] = free[own[::11, 0]]  # points
    used = rng.random(n) < 0.1  # a few large ones on common vertices
    return np.concatenate([free, vertices]), np.where(used[:, None], 3 * n + triangles, own)


EMPTY = (np.zeros((3, 3)), np.zeros((0, 3), dtype=int))
SINGLE = (np.array([[0.4, 0.5, 0.5], [0.6, 0.5, 0.5], [0.5, 0.6, 0.7]]), np.array([[0, 1, 2]]))


def colliders(rng: np.random.Generator) -> dict:
    """Soft bodies: two triangle soups, a sheet, an empty mesh, one triangle. Obstacles: two sheets, an empty mesh."""
    parts = [soup(rng, 110), soup(rng, 70, 0.1), sheet(4), EMPTY, SINGLE, sheet(3), sheet(2), EMPTY]
    return {"parts": parts, "soft": np.arange(8) < 5, "self_on": np.isin(np.arange(8), (0, 2, 3))}


def scatter(rng: np.random.Generator, made: SimpleNamespace, kind: int) -> None:
    """Place the vertices about `made.x0`: by `kind % 5` at random, permuted, some far away, some not finite; move them at random.
    Every third time, triangles that share no vertex shrink by a factor of up to 1000."""
    x = made.x0 + 0.1 * rng.standard_normal(made.x0.shape)
    if kind % 5 == 1:
        x = rng.permutation(x)
    move = rng.choice([0.0, 0.1, 0.5]) * rng.standard_normal(x.shape)
    if kind % 5 == 2:
        some = rng.random(len(x)) < 0.1
        x[some] += 10.0 ** rng.uniform(2, 300, (some.sum(), 1)) * rng.standard_normal((some.sum(), 3))
    if kind % 5 == 3:
        bad = rng.integers(0, len(x), 9)
        x[bad[:3]], x[bad[3:5]], move[bad[5:7]], move[bad[7:]] = np.nan, np.inf, np.nan, -np.inf
    if kind % 3 == 1:
        t = made.topology.triangle
        own = t[np.bincount(t.ravel(), minlength=len(x))[t].max(axis=1) == 1]
        with np.errstate(invalid="ignore"):
            x[own] = x[own[:, :1]] + 10.0 ** rng.uniform(-3, 0, (len(own), 1, 1)) * (x[own] - x[own[:, :1]])
    made.margin = float(rng.choice([0.0, 0.02, 0.2]))
    place(made, x, move)


def sheet(n: int, size: float = 1.0) -> tuple[np.ndarray, np.ndarray]:
    """A flat square of n x n cells in the xz-plane, two triangles each."""
    i, j = np.meshgrid(np.arange(n + 1), np.arange(n + 1), indexing="ij")
    vertices = np.stack([i.ravel(), 0 * i.ravel(), j.ravel()], axis=1) * (size / n)
    a = (i[:-1, :-1] * (n + 1) + j[:-1, :-1]).ravel()
    b, c, d = a + 1, a + n + 1, a + n + 2
    return vertices, np.concatenate([np.stack([a, b, c], axis=1), np.stack([b, d, c], axis=1)])


def separation(X: np.ndarray) -> np.ndarray:
    """Largest gap (k,) between the shadows of two triangles X (k,6,3) on an axis, over all axes that can separate them,
    degenerate ones too: the sign of the gap is exact for integers. Lengths are in units of the largest entry of each axis."""
    a, b = X[:, :3], X[:, 3:]
    ea, eb = np.roll(a, -1, axis=1) - a, np.roll(b, -1, axis=1) - b
    w = a[:, :1] - b[:, :1]
    edges = np.concatenate([ea, eb], axis=1)
    normals = [np.cross(ea[:, :1], ea[:, 1:2]), np.cross(eb[:, :1], eb[:, 1:2])]
    normals += [np.cross(ea[:, i : i + 1], eb) for i in range(3)]
    normals = np.concatenate(normals, axis=1)
    in_plane = [np.cross(normals, edges[:, i : i + 1]) for i in range(6)]
    axes = np.concatenate([normals, *in_plane, edges, np.cross(edges, np.cross(w, edges)), w], axis=1)
    shadow = np.einsum("inf,ikf->ikn", X, axes)
    gap = np.maximum(
        shadow[:, :, :3].min(axis=2) - shadow[:, :, 3:].max(axis=2), shadow[:, :, 3:].min(axis=2) - shadow[:, :, :3].max(axis=2)
    )
    length = np.abs(axes).max(axis=2)
    return np.where(length > 0, gap / np.where(length > 0, length, 1), -np.inf).max(axis=1, initial=-np.inf)
