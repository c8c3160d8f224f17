"""Figures 11 and 12 of the report: time of contact points over tets; all threads, one thread, interpreted.

The interpreted loop is the report's first program, in Python, pair by pair: each of two triangles with overlapping boxes is
mapped to the material space of the other's tet by barycentric coordinates, and Frank-Wolfe with steps 2 / (i + 2) finds its
deepest point in the signed distance at rest (report, section 2.3.2). Weakness, as there: tets far from the triangle map it as
well, so most points are found many times. Pairs and distances are those of a `Rig`, so that both do the same work.
"""

from contextlib import closing
from dataclasses import dataclass, field

import numpy as np

from taisoft.backend.runtime import Runtime, open_runtime, threads
from taisoft.collision.colliders import body_grid
from taisoft.collision.surface import SERIAL_BELOW
from taisoft.mesh.sdf import SdfGrid

from ..charts import Panel
from ..collision_cases import Setup, cubes_setup, pile_setup
from ..collision_runs import Rig, on_one_thread
from ..document import exponent, ms, table, timed_cells
from ..kinds import POINTS, watching
from ..runner import clock, repeated
from .page import Claim, Extent, Part, plot_png

FRANK_WOLFE_STEPS, CLOSED = 32, 1e-4  # maximum; duality gap over the triangle's size at which it stops
CONTACT_MODE = "distance_field"  # as in the report
SIZES = ("cubes 5", "cubes 9", "cubes 11", "cubes 15", "cubes 20", "pile 6"), ("cubes 2", "cubes 5")  # full, quick
ROUNDS, PLAIN_ROUNDS = (15, 3), 2
MAX_INTERPRETED = 15_000  # maximum pairs for the interpreted loop
TENFOLD, FLAT = 10.0, 0.1  # the report's speed-up; largest exponent that counts as constant


# --- interpreted --------------------------------------------------------------------------------------------------------


def candidate_pairs(rig: Rig) -> np.ndarray:
    """(k, 2) pairs of triangles of different bodies with overlapping boxes, each pair once."""
    pairs, body = rig.pairs(), rig.detection.topology.body
    return pairs[body[pairs[:, 0]] != body[pairs[:, 1]]]


def sample(grid: SdfGrid, X: np.ndarray) -> tuple[float, np.ndarray]:
    """Trilinear signed distance [m] and gradient (3,) at a material point (3,), clamped to the grid."""
    at = np.clip((X - grid.origin) / grid.spacing, 0.0, np.array(grid.phi.shape) - 1.0)
    i = np.minimum(at.astype(int), np.array(grid.phi.shape) - 2)
    u, v, w = at - i
    f = grid.phi[i[0] : i[0] + 2, i[1] : i[1] + 2, i[2] : i[2] + 2]
    a = f[0] * (1 - u) + f[1] * u
    b = a[0] * (1 - v) + a[1] * v
    along_x = ((f[1] - f[0])[0] * (1 - v) + (f[1] - f[0])[1] * v) @ (1 - w, w)
    along_y = (a[1] - a[0]) @ (1 - w, w)
    return float(b @ (1 - w, w)), np.array([along_x, along_y, b[1] - b[0]]) / grid.spacing


def deepest_point(grid: SdfGrid, corners: np.ndarray) -> tuple[np.ndarray, float]:
    """Weights (3,) and signed distance [m] of the deepest point in a triangle (3,3) of material points, by Frank-Wolfe."""
    values = [sample(grid, X)[0] for X in corners]
    w = np.eye(3)[int(np.argmin(values))]
    best, least = w, min(values)
    size = max(np.linalg.norm(corners[k] - corners[k - 1]) for k in range(3))
    for i in range(FRANK_WOLFE_STEPS):
        phi, gradient = sample(grid, w @ corners)
        if phi < least:
            best, least = w, phi
        slope = corners @ gradient
        k = int(np.argmin(slope))
        if w @ slope - slope[k] <= CLOSED * size:
            break
        w = w + 2.0 / (i + 2.0) * (np.eye(3)[k] - w)
    return best, least


class PlainPoints:
    """Contact points of a rig's pairs by the interpreted loop."""

    def __init__(self, rig: Rig):
        d = rig.detection
        self._rig, self._body, self._triangle = rig, d.topology.body, d.topology.triangle
        bodies = rig.scene.bodies
        self._grids = [body_grid(b, rig.scene.collision.field_cells, 2.0 * d.margin) for b in bodies]
        starts = np.cumsum([0] + [b.n_nodes for b in bodies])
        self._behind = np.concatenate([b.nodes.boundary_tets + n for b, n in zip(bodies, starts)])
        self._rest = np.concatenate([b.nodes.positions for b in bodies])

    def find(self, pairs: np.ndarray) -> list[float]:
        """Signed distances [m] of all deepest points within the margin."""
        x, margin, found = self._rig.model.state.x.to_numpy(), self._rig.detection.margin, []
        corners = x[self._rig.detection.topology.node]
        for pair in pairs:
            for t, u in (pair, pair[::-1]):
                tet = self._behind[u]
                world = np.vstack([x[tet].T, np.ones(4)])  # of barycentric coordinates: corners, and their sum
                weights = np.linalg.solve(world, np.vstack([corners[self._triangle[t]].T, np.ones(3)]))
                _, phi = deepest_point(self._grids[self._body[u]], weights.T @ self._rest[tet])
                if phi <= margin:
                    found.append(phi)
        return found


# --- measured -----------------------------------------------------------------------------------------------------------


@dataclass
class Points:
    """Contact points of a configuration; lists are wall seconds per round. first: first whole search with compilation; plain:
    interpreted loop, empty if left out; deepest, plain_deepest: signed distance [m]."""

    setup: str
    tets: int
    triangles: int
    pairs: int
    first: float
    seconds: list[float]
    deepest: float
    plain: list[float] = field(default_factory=list)
    plain_deepest: float = 0.0

    @property
    def median(self) -> float:
        """Median time [s]."""
        return float(np.median(self.seconds))


def setup_of(name: str) -> Setup:
    """A configuration of `bench collision`, such as "cubes 5" or "pile 6"."""
    kind, cells = name.split()
    return {"cubes": cubes_setup, "pile": pile_setup}[kind](int(cells))


def measure_size(name: str, runtime: Runtime, quick: bool, interpret: bool) -> Points:
    """Measure a configuration in the middle of its motion."""
    with Rig(setup_of(name), CONTACT_MODE, runtime) as rig:
        rig.place(0.5)
        begin = clock()
        rig.search()
        first, pairs = clock() - begin, candidate_pairs(rig)
        with watching() as spend:
            seconds = [spend(rig.search).seconds[POINTS] for _ in range(ROUNDS[quick])]
        deepest = float(rig.detection.contacts().gap.min())
        found = Points(name, rig.tets, rig.detection.surface.n_triangles, len(pairs), first, seconds, deepest)
        if interpret and len(pairs) <= MAX_INTERPRETED:
            loop, depths = PlainPoints(rig), []
            found.plain = repeated(lambda: depths.extend(loop.find(pairs)), PLAIN_ROUNDS)
            found.plain_deepest = min(depths)
    return found


def measure_all(extent: Extent) -> tuple[str, list[Points], list[Points]]:
    """Where it ran, and all configurations on all threads, or on the GPU, and on one thread of the processor."""
    quick = extent.quick
    with closing(open_runtime(extent.arch, "f32", "the report's contact points")) as runtime:
        where = "the GPU" if extent.arch == "cuda" else f"{threads()} threads"
        many = [measure_size(name, runtime, quick, interpret=True) for name in SIZES[quick]]
    with closing(open_runtime("cpu", "f32", "the report's contact points")) as runtime, on_one_thread():
        return where, many, [measure_size(name, runtime, quick, interpret=False) for name in SIZES[quick]]


# --- what it says -------------------------------------------------------------------------------------------------------


def claims_of(where: str, many: list[Points], one: list[Points]) -> list[Claim]:
    """Claims of figures 11 and 12."""
    both = [(p, q) for p, q in zip(many, one) if p.plain]
    tets, plain = [p.tets for p, _ in both], [float(np.median(p.plain)) for p, _ in both]
    gains = [slow / p.median for slow, (p, _) in zip(plain, both)]
    by_compiling = [slow / q.median for slow, (_, q) in zip(plain, both)]
    by_threads = [q.median / p.median for p, q in both]
    first = [p.first for p in many]
    grown, grown_plain = exponent(tets, [p.median for p, _ in both])[0], exponent(tets, plain)[0]
    return [
        Claim(
            "the parallel computation is always faster than the plain one, up to tenfold (figure 11).",
            min(gains) > 1.0 and max(gains) >= TENFOLD,
            f"on {where} it takes {min(gains):,.0f} to {max(gains):,.0f} times less than the loop over the same pairs.",
        ),
        Claim(
            "parallel execution causes this speed-up.",
            min(by_threads) > max(by_compiling),
            f"compiled for one thread they take {min(by_compiling):,.0f} to {max(by_compiling):,.0f} times less than "
            f"interpreted; on {where} they are {min(by_threads):.2f} to {max(by_threads):.2f} times as fast as that.",
            f"Below {SERIAL_BELOW:,} triangles the CPU uses one thread, since waking others takes longer.",
        ),
        Claim(
            "the parallel computation is slow at its start, and steady afterwards (figure 11).",
            all(p.first > 10 * p.median for p in many),
            f"the first search takes {min(first):.2g} to {max(first):.2g} s, the first of all compiles kernels.",
        ),
        Claim(
            "its time stays near zero however many tets there are, while the plain one's grows (figure 12).",
            grown < FLAT < grown_plain,
            f"{tets[0]:,} to {tets[-1]:,} tets: it grows like tets^{grown:.2f} on {where}, tets^{grown_plain:.2f} interpreted.",
            "Work grows with the pairs of near triangles on touching surfaces, about tets^(2/3).",
        ),
    ]


def size_table(where: str, many: list[Points], one: list[Points]) -> str:
    """A row per configuration."""

    def faster(pair: tuple[Points, Points]) -> str:
        return f"{np.median(pair[0].plain) / pair[0].median:,.0f}" if pair[0].plain else "-"

    columns = (
        ("<scene", "{[0].setup}"),
        *((name, f"{{[0].{name}:,}}") for name in ("tets", "triangles", "pairs")),
        (f"{where} [ms]", lambda pair: timed_cells(pair[0].seconds)[0]),
        ("spread", lambda pair: timed_cells(pair[0].seconds)[1]),
        ("one thread [ms]", lambda pair: timed_cells(pair[1].seconds)[0]),
        ("spread", lambda pair: timed_cells(pair[1].seconds)[1]),
        ("interpreted [ms]", lambda pair: ms(np.median(pair[0].plain)) if pair[0].plain else "-"),
        ("times faster", faster),
        ("deepest [mm]", lambda pair: f"{1e3 * pair[0].deepest:.4f}"),
        ("interpreted", lambda pair: f"{1e3 * pair[0].plain_deepest:.4f}" if pair[0].plain else "-"),
    )
    return table(zip(many, one), columns)


def draw(where: str, many: list[Points], one: list[Points]) -> bytes:
    """Figure 12."""
    panel = Panel("contact points; squares: the pile", "tets", "ms", log="xy")
    for k, (label, found) in enumerate(((where, many), ("one thread", one))):
        for kind, line in (("cubes", "o-"), ("pile", "s-")):
            own = [p for p in found if p.setup.startswith(kind)]
            panel.curve([p.tets for p in own], [1e3 * p.median for p in own], label, k, line)
    plain = [p for p in many if p.plain]
    panel.curve([p.tets for p in plain], [1e3 * np.median(p.plain) for p in plain], "interpreted", 2)
    return plot_png(panel)


def measure(extent: Extent) -> Part:
    """Contact points on all threads, on one, and interpreted."""
    where, many, one = measure_all(extent)
    part = Part(
        "points",
        "Contact points, parallel and not",
        "section 3.1.2, figures 11 and 12",
        "contact points alone of searches through distance fields (Frank-Wolfe), bodies as in `taisoft bench collision`, in f32: "
        "compiled for all threads, compiled for one, and an interpreted NumPy loop over the same pairs, where these are at most "
        f"{MAX_INTERPRETED:,}. Equal deepest points show that both do the same.",
        claims_of(where, many, one),
        [size_table(where, many, one)],
        {"points.png": draw(where, many, one)},
    )
    part.short.append("figure 11 is over frames, here sizes take their place.")
    if extent.arch == "cpu":
        part.short.append(f"the report has a GPU, this run {where} of a processor; `--arch cuda` runs it on a GPU.")
    if left := [p.setup for p in many if not p.plain]:
        part.short.append(f"the interpreted loop was left out for {', '.join(left)}, so the ratios end below.")
    return part
