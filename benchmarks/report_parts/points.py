"""Figures 11 and 12 of the report: time of contact points per frame and over tets; all threads, one thread, interpreted.

The single thread is a child process pinned to one core. The interpreted loop is the report's first program, in Python, pair by
pair: each of two triangles with overlapping boxes is mapped to the material space of the other's tet by barycentric coordinates,
and Frank-Wolfe with steps 2 / (i + 2) finds its deepest point in the signed distance at rest (report, section 2.3.2). Weakness,
as there: tets far from the triangle map it as well, so most points are found many times. Pairs and distances are those of a
`Rig`, so that both do the same work.
"""

import os
from contextlib import closing
from dataclasses import asdict, dataclass, field

import numpy as np

from taisoft.backend.runtime import open_runtime, threads
from taisoft.collision.colliders import body_grid
from taisoft.collision.surface import SERIAL_BELOW
from taisoft.errors import SimulationError
from taisoft.machine import summarise, usable_cores
from taisoft.mesh.sdf import SdfGrid

from ..collision_cases import Setup, cubes_setup, pile_setup
from ..collision_runs import Rig
from ..document import exponent, ms, table, timed_cells
from ..runner import clock, parse_result, print_result, repeated, run_python
from .page import COLOURS, Claim, Extent, Part, clearly_less, new_figure, plot_png

FRANK_WOLFE_STEPS, CLOSED = 32, 1e-4  # maximum; duality gap over the triangle's size at which it stops
CONTACT_MODE = "distance_field"  # as in the report
FILM, FRAMES = ("cubes 9", "cubes 5"), (20, 4)  # figure 11: a cube turns on another; full run: 1,944 triangles
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

    def find(self, pairs: np.ndarray) -> list[tuple[int, int, np.ndarray, float]]:
        """(triangle, other triangle, weights (3,), signed distance [m]) of all deepest points within the margin."""
        x, margin, found = self._rig.model.state.x.to_numpy(), self._rig.detection.margin, []
        surface = x[self._rig.detection.topology.node]
        for pair in pairs:
            for t, u in (pair, pair[::-1]):
                tet = self._behind[u]
                world = np.vstack([x[tet].T, np.ones(4)])  # of barycentric coordinates: corners, and their sum
                weights = np.linalg.solve(world, np.vstack([surface[self._triangle[t]].T, np.ones(3)]))
                w, phi = deepest_point(self._grids[self._body[u]], weights.T @ self._rest[tet])
                if phi <= margin:
                    found.append((int(t), int(u), w, phi))
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
    plain: list[float] = field(default_factory=list)
    deepest: float = 0.0
    plain_deepest: float = 0.0


@dataclass
class Measured:
    """Results for a number of threads, or the GPU. frames, plain_frames: seconds per frame and round of the film."""

    where: str
    frames: list[list[float]]
    sizes: list[Points]
    plain_frames: list[list[float]] = field(default_factory=list)


def setup_of(name: str) -> Setup:
    """A configuration of `bench collision`, such as "cubes 5" or "pile 6"."""
    kind, cells = name.split()
    return {"cubes": cubes_setup, "pile": pile_setup}[kind](int(cells))


def contact_seconds(rig: Rig, rounds: int) -> list[float]:
    """Seconds of the contact points of a search per round, after warm-up."""
    return [rig.phases()["contacts"] for _ in range(rounds)]


def measure_size(rig: Rig, rounds: int, plain: PlainPoints | None) -> Points:
    """Measure a configuration in the middle of its motion, with the rig's first search."""
    rig.place(0.5)
    begin = clock()
    rig.search()
    first = clock() - begin
    rig.search()
    pairs = candidate_pairs(rig)
    found = Points(rig.setup.name, rig.tets, rig.detection.surface.n_triangles, len(pairs), first, contact_seconds(rig, rounds))
    found.deepest = float(rig.detection.contacts().gap.min())
    if plain is not None and len(pairs) <= MAX_INTERPRETED:
        contacts: list = []
        found.plain = repeated(lambda: contacts.extend(plain.find(pairs)), PLAIN_ROUNDS)
        found.plain_deepest = min(depth for *_, depth in contacts)
    return found


def measure_film(rig: Rig, frames: int, rounds: int, plain: PlainPoints | None) -> tuple[list[list[float]], list[list[float]]]:
    """Seconds of the contact points per frame and round, and of one round of the interpreted loop."""
    compiled, interpreted = [], []
    for k in range(frames):
        rig.place(k / max(frames - 1, 1))
        rig.search()
        compiled.append(contact_seconds(rig, rounds))
        if plain is not None:
            pairs = candidate_pairs(rig)
            interpreted.append(repeated(lambda pairs=pairs: plain.find(pairs), 1))
    return compiled, interpreted


def measure_here(quick: bool, arch: str, plain: bool) -> Measured:
    """Measure everything in this process, on its threads."""
    k = int(quick)
    with closing(open_runtime(arch, "f32", "the report's contact points")) as runtime:
        n = threads()
        found = Measured("GPU" if arch == "cuda" else f"{n} thread{'s' * (n > 1)}", [], [])
        for name in SIZES[k]:
            with Rig(setup_of(name), CONTACT_MODE, runtime) as rig:
                loop = PlainPoints(rig) if plain else None
                found.sizes.append(measure_size(rig, ROUNDS[k], loop))
                if name == FILM[k]:
                    found.frames, found.plain_frames = measure_film(rig, FRAMES[k], ROUNDS[k], loop)
    return found


# --- on one thread ----------------------------------------------------------------------------------------------------

CHILD = "from taisoft.cli.scene_file import load_shipped; load_shipped('benchmarks', 'report_parts.points').answer({!r})"


def answer(quick: bool) -> None:
    """The child: measure everything on one core."""
    os.sched_setaffinity(0, usable_cores()[:1])
    print_result(asdict(measure_here(quick, "cpu", plain=False)))


def measure_on_one_thread(quick: bool) -> Measured:
    """Measure in a child process pinned to one core. Raises SimulationError on failure."""
    if not hasattr(os, "sched_setaffinity"):
        raise SimulationError("this system cannot pin a process to one core, so one thread cannot be measured")
    lines = run_python("the process on one thread", "-c", CHILD.format(quick))
    found = parse_result(lines[-1])
    return Measured(**found | {"sizes": [Points(**p) for p in found["sizes"]]})


# --- what it says -----------------------------------------------------------------------------------------------------


def claims_of(many: Measured, one: Measured) -> list[Claim]:
    """Claims of figures 11 and 12. many: on all threads, or on the GPU."""
    here = f"on {many.where}"
    per_frame = [np.median(p) / np.median(c) for c, p in zip(many.frames, many.plain_frames)]
    faster = all(clearly_less(c, p) for c, p in zip(many.frames, many.plain_frames))
    ratios = [
        (p, q, np.median(p.plain) / np.median(q.seconds), np.median(q.seconds) / np.median(p.seconds))
        for p, q in zip(many.sizes, one.sizes)
        if p.plain
    ]
    by_compiling, by_threads = [r[2] for r in ratios], [r[3] for r in ratios]
    tets = [p.tets for p, *_ in ratios]
    grown, _ = exponent(tets, [np.median(p.seconds) for p, *_ in ratios])
    plain, _ = exponent(tets, [np.median(p.plain) for p, *_ in ratios])
    flat = grown < FLAT
    span = f"from {tets[0]:,} to {tets[-1]:,} tets"
    steady = float(np.median([s for p in many.sizes for s in p.seconds]))
    slow = all(p.first > 10 * np.median(p.seconds) for p in many.sizes)
    return [
        Claim(
            "in every frame the parallel computation is faster than the plain one, up to tenfold (figure 11).",
            faster and max(per_frame) >= TENFOLD,
            f"{here} the contact points of a frame take {min(per_frame):,.0f} to {max(per_frame):,.0f} times less than in the "
            "interpreted loop over the same pairs.",
        ),
        Claim(
            "parallel execution causes this speed-up.",
            min(by_threads) > max(by_compiling),
            f"compiled for one thread they take {min(by_compiling):,.0f} to {max(by_compiling):,.0f} times less than "
            f"interpreted; {here} they are {min(by_threads):.2f} to {max(by_threads):.2f} times as fast as that.",
            ""
            if min(by_threads) > max(by_compiling)
            else "Compilation instead of interpretation gains most, as it would in a GPU kernel; "
            f"below {SERIAL_BELOW:,} triangles the CPU uses one thread, since waking others takes longer.",
        ),
        Claim(
            "the parallel computation is slow at its start, and steady afterwards (figure 11).",
            slow,
            f"the first search takes {min(p.first for p in many.sizes):.1f} to {max(p.first for p in many.sizes):.1f} s, its "
            f"contact points {ms(steady)} ms afterwards.",
            "Here the start compiles kernels, there it moved data.",
        ),
        Claim(
            "its time stays near zero however many tets there are, while the plain one's grows (figure 12).",
            flat and plain > FLAT,
            f"{span} the time grows like tets^{grown:.2f} {here}, like tets^{plain:.2f} interpreted.",
            ""
            if flat
            else "On any machine, work grows with the pairs of near triangles on touching surfaces, about tets^(2/3); it is "
            "near zero only in comparison with the interpreted loop.",
        ),
    ]


def size_table(many: Measured, one: Measured) -> str:
    """A row per configuration."""
    columns = (
        ("<scene", "{[0].setup}"),
        *((name, f"{{[0].{name}:,}}") for name in ("tets", "triangles", "pairs")),
        (f"{many.where} [ms]", lambda pair: timed_cells(pair[0].seconds)[0]),
        ("spread", lambda pair: timed_cells(pair[0].seconds)[1]),
        (f"{one.where} [ms]", lambda pair: timed_cells(pair[1].seconds)[0]),
        ("spread", lambda pair: timed_cells(pair[1].seconds)[1]),
        ("interpreted [ms]", lambda pair: timed_cells(pair[0].plain)[0] if pair[0].plain else "-"),
        ("spread", lambda pair: timed_cells(pair[0].plain)[1] if pair[0].plain else "-"),
        ("times faster", lambda pair: f"{np.median(pair[0].plain) / np.median(pair[0].seconds):,.0f}" if pair[0].plain else "-"),
        ("deepest [mm]", lambda pair: f"{1e3 * pair[0].deepest:.4f}"),
        ("interpreted", lambda pair: f"{1e3 * pair[0].plain_deepest:.4f}" if pair[0].plain else "-"),
    )
    return table(zip(many.sizes, one.sizes), columns)


def draw(many: Measured, one: Measured) -> bytes:
    """Figure 11 on the left, 12 on the right."""
    figure, ((frames, sizes),) = new_figure(2)
    for k, (m, line) in enumerate(((many, "-"), (one, "--"))):
        frames.plot([1e3 * np.median(f) for f in m.frames], line, color=COLOURS[k], label=m.where)
        for kind, marker in (("cubes", "o"), ("pile", "s")):
            own = [p for p in m.sizes if p.setup.startswith(kind)]
            times = [1e3 * np.median(p.seconds) for p in own]
            sizes.plot([p.tets for p in own], times, f"{marker}{line}", ms=4, color=COLOURS[k])
    frames.plot([1e3 * np.median(f) for f in many.plain_frames], color=COLOURS[2], label="interpreted")
    plain = [p for p in many.sizes if p.plain]
    sizes.plot([p.tets for p in plain], [1e3 * np.median(p.plain) for p in plain], "o-", ms=4, color=COLOURS[2])
    frames.set(title="contact points of each frame", xlabel="frame", ylabel="ms", yscale="log")
    frames.legend(fontsize="small", frameon=False)
    sizes.set(title="over tets; squares: the pile", xlabel="tets", ylabel="ms", xscale="log", yscale="log")
    return plot_png(figure)


def measure(extent: Extent) -> Part:
    """Measure in this process and in a child on one thread."""
    many = measure_here(extent.quick, extent.arch, plain=True)
    one = measure_on_one_thread(extent.quick)
    part = Part(
        "points",
        "Contact points, parallel and not",
        "section 3.1.2, figures 11 and 12",
        "contact points alone of searches through distance fields (Frank-Wolfe), bodies as in `taisoft bench collision`, in "
        "f32: compiled on all threads, compiled on one (a process that has one core), and an interpreted NumPy loop over the "
        f"same pairs, which is not run on more than {MAX_INTERPRETED:,}. Equal deepest points show that both do the same.",
        claims_of(many, one),
        [size_table(many, one)],
        {"points.png": draw(many, one)},
    )
    if extent.arch == "cpu":
        part.short.append(f"the report has a GPU, this run {many.where} of a processor; `--arch cuda` runs it on a GPU.")
    if left := [p.setup for p in many.sizes if not p.plain]:
        part.short.append(f"the interpreted loop was left out for {', '.join(left)}, so the ratios end below.")
    part.times = {f"{p.setup}, all threads": summarise(p.seconds) for p in many.sizes}
    part.times |= {f"{p.setup}, one thread": summarise(p.seconds) for p in one.sizes}
    part.times |= {f"{p.setup}, interpreted": summarise(p.plain) for p in many.sizes if p.plain}
    return part
