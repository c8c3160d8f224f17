"""Figures 11 and 12 of the report: time of the contact points per frame and over tets, on all threads, on one, and interpreted.

One thread is a child process pinned to one core, so that Taichi has no other. The interpreted loop is that of `plain.py`.
"""

import json
import os
import subprocess
import sys
from dataclasses import asdict, dataclass, field

import numpy as np

from taisoft.backend.runtime import open_runtime, threads
from taisoft.collision.surface import SERIAL_BELOW
from taisoft.errors import SimulationError
from taisoft.output.tables import markdown
from taisoft.timing import summarise, usable_cores

from ..collision_cases import Setup, cubes_setup, pile_setup
from ..collision_runs import Rig, clock, repeated
from ..fit import exponent
from .page import COLOURS, Claim, Extent, Part, clearly_less, ms, new_figure, plot_png, timed
from .plain import PlainPoints, candidate_pairs

CONTACT_MODES = "distance_field"  # the report's way
FILM, FRAMES = ("cubes 9", "cubes 5"), (20, 4)  # of figure 11: a cube turns on another; the first has 1,944 triangles
SIZES = ("cubes 5", "cubes 9", "cubes 11", "cubes 15", "cubes 20", "pile 6"), ("cubes 2", "cubes 5")  # full, quick
ROUNDS, PLAIN_ROUNDS = (15, 3), 2
MOST_PLAIN = 15_000  # pairs above which the interpreted loop is left out
TENFOLD, FLAT = 10.0, 0.1  # what the report gained; exponent of a time that does not grow


@dataclass
class Points:
    """A configuration's contact points, each list in wall seconds of the rounds. first: of the first whole search, compiling
    included; plain: of the interpreted loop, empty where it was left out; deepest: by either [m], negative inside."""

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
    """By one number of threads, or on the GPU. frames, plain_frames: of the film, seconds of each frame's rounds."""

    where: str
    frames: list[list[float]]
    sizes: list[Points]
    plain_frames: list[list[float]] = field(default_factory=list)


def setup_of(name: str) -> Setup:
    """ "cubes 5" and "pile 6" are those of `bench collision`."""
    kind, cells = name.split()
    return {"cubes": cubes_setup, "pile": pile_setup}[kind](int(cells))


def contact_seconds(rig: Rig, rounds: int) -> list[float]:
    """Of the contact points of a search, round by round; kernels and buffers are ready."""
    return [rig.phases()["contacts"] for _ in range(rounds)]


def measure_size(rig: Rig, rounds: int, plain: PlainPoints | None) -> Points:
    """A configuration at the middle of its motion; its first search is the rig's."""
    rig.place(0.5)
    begin = clock()
    rig.search()
    first = clock() - begin
    rig.search()
    pairs = candidate_pairs(rig)
    found = Points(rig.setup.name, rig.tets, rig.detection.surface.n_triangles, len(pairs), first, contact_seconds(rig, rounds))
    found.deepest = float(rig.detection.contacts().gap.min())
    if plain is not None and len(pairs) <= MOST_PLAIN:
        contacts: list = []
        found.plain = repeated(lambda: contacts.extend(plain.find(pairs)), PLAIN_ROUNDS)
        found.plain_deepest = min(depth for *_, depth in contacts)
    return found


def measure_film(rig: Rig, frames: int, rounds: int, plain: PlainPoints | None) -> tuple[list[list[float]], list[list[float]]]:
    """Seconds of each frame's rounds of contact points, and of one round of the interpreted loop."""
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
    """Everything in this process, on the threads that it has."""
    k = int(quick)
    runtime = open_runtime(arch, "f32", "the report's contact points")
    n = threads()
    found = Measured("GPU" if arch == "cuda" else f"{n} thread{'s' * (n > 1)}", [], [])
    try:
        for name in SIZES[k]:
            with Rig(setup_of(name), CONTACT_MODES, runtime) as rig:
                loop = PlainPoints(rig) if plain else None
                found.sizes.append(measure_size(rig, ROUNDS[k], loop))
                if name == FILM[k]:
                    found.frames, found.plain_frames = measure_film(rig, FRAMES[k], ROUNDS[k], loop)
    finally:
        runtime.close()
    return found


# --- on one thread ----------------------------------------------------------------------------------------------------

CHILD = "from taisoft.cli.scene_file import load_shipped; load_shipped('benchmarks', 'report_parts.points').answer({!r})"


def answer(quick: bool) -> None:
    """In the child: everything on its first core alone, told as JSON in its last line."""
    os.sched_setaffinity(0, usable_cores()[:1])
    print(json.dumps(asdict(measure_here(quick, "cpu", plain=False))))


def measure_on_one_thread(quick: bool) -> Measured:
    """The same in a child process. Raises SimulationError where it fails."""
    if not hasattr(os, "sched_setaffinity"):
        raise SimulationError("this system pins no process to one core, so that one thread cannot be measured")
    done = subprocess.run([sys.executable, "-c", CHILD.format(quick)], capture_output=True, text=True)
    if done.returncode:
        told = done.stderr.strip().splitlines() or ["no reason given"]
        raise SimulationError(f"the process on one thread failed: {told[-1]}")
    told = json.loads(done.stdout.splitlines()[-1])
    return Measured(**told | {"sizes": [Points(**p) for p in told["sizes"]]})


# --- what it says -----------------------------------------------------------------------------------------------------


def claims_of(many: Measured, one: Measured) -> list[Claim]:
    """Figures 11 and 12. many: on all threads, or on the GPU."""
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
            "it is running in parallel that gains this.",
            min(by_threads) > max(by_compiling),
            f"compiled for one thread they take {min(by_compiling):,.0f} to {max(by_compiling):,.0f} times less than "
            f"interpreted; {here} they are {min(by_threads):.2f} to {max(by_threads):.2f} times as fast as that.",
            ""
            if min(by_threads) > max(by_compiling)
            else "Most is gained by not interpreting, which a GPU kernel does not "
            f"either; below {SERIAL_BELOW:,} triangles one thread does it all on the CPU, since waking others costs more.",
        ),
        Claim(
            "the parallel computation is slow at its start, and steady afterwards (figure 11).",
            slow,
            f"the first search takes {min(p.first for p in many.sizes):.1f} to {max(p.first for p in many.sizes):.1f} s, its "
            f"contact points {ms(steady)} ms afterwards.",
            "Here the start is compiling the kernels, there it was moving data.",
        ),
        Claim(
            "its time stays near zero however many tets there are, while the plain one's grows (figure 12).",
            flat and plain > FLAT,
            f"{span} the time grows like tets^{grown:.2f} {here}, like tets^{plain:.2f} interpreted.",
            ""
            if flat
            else "Work grows with the pairs of near triangles on the surfaces that touch, about tets^(2/3), on any "
            "machine; near zero it looks beside the interpreted loop.",
        ),
    ]


def size_table(many: Measured, one: Measured) -> str:
    """A row a configuration."""
    lines = []
    for p, q in zip(many.sizes, one.sizes):
        plain = timed(p.plain) if p.plain else ("-", "-")
        gain = f"{np.median(p.plain) / np.median(p.seconds):,.0f}" if p.plain else "-"
        depth = f"{1e3 * p.deepest:.4f}", f"{1e3 * p.plain_deepest:.4f}" if p.plain else "-"
        sizes = (f"{n:,}" for n in (p.tets, p.triangles, p.pairs))
        lines.append((p.setup, *sizes, *timed(p.seconds), *timed(q.seconds), *plain, gain, *depth))
    headings = (
        "scene",
        "tets",
        "triangles",
        "pairs",
        f"{many.where} [ms]",
        "spread",
        f"{one.where} [ms]",
        "spread",
        "interpreted [ms]",
        "spread",
        "times faster",
        "deepest [mm]",
        "interpreted",
    )
    return markdown(headings, lines, left=(0,))


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
    """In this process and in a child on one thread."""
    many = measure_here(extent.quick, extent.arch, plain=True)
    one = measure_on_one_thread(extent.quick)
    part = Part(
        "points",
        "Contact points, parallel and not",
        "section 3.1.2, figures 11 and 12",
        "contact points alone of searches through distance fields (Frank-Wolfe), bodies as in `taisoft bench collision`, in "
        "f32: compiled on all threads, compiled on one (a process that has one core), and an interpreted NumPy loop over the "
        f"same pairs, which is not run on more than {MOST_PLAIN:,}. The deepest point of both tells that they do the same.",
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
