"""Parts of `gpu.py`, each in a process of its own. Rows are left as they come; their keys are the titles of their columns.

Estimates are those that the design of the GPU path was made with. Scenes are cubes of one metre above each other and the ground,
about to touch, so that nothing overlaps at the start: one for counts, two for times.
"""

import os
from collections.abc import Callable
from contextlib import closing, nullcontext
from dataclasses import dataclass
from functools import partial
from importlib.util import find_spec
from itertools import product
from time import perf_counter

import numpy as np
import taichi as ti

import taisoft as ts
from taisoft import changes
from taisoft.backend import launching
from taisoft.backend.arrays import FieldArena
from taisoft.backend.counters import FILLS, Counts, counting
from taisoft.backend.paths import gpu_path
from taisoft.backend.private import impl
from taisoft.backend.runtime import kernel, open_runtime
from taisoft.backend.team import make_team
from taisoft.dynamics.schemes import EXPLICIT
from taisoft.errors import TaisoftError
from taisoft.machine import usable_cores
from taisoft.records import StepReport
from taisoft.scene.scene import Scene

from .beam import MARGIN, beam_scene, n_tets
from .contact_colouring import measure_crossover
from .kinds import SOLVE, watching
from .launches import Arrays, often
from .runner import HERE, clock, patched, warm_up, without_warnings
from .scaling_bytes import LOOPS
from .suite import leave
from .timed_run import advance

Add = Callable[..., None]  # adds a row, from its entries

GAP, SPEED = 1e-6, 0.1  # between the cubes [m]; at which they approach [m/s]
SMALL, QUICK_CELLS = 5, 2  # cells along a cube
CELLS = {5: (0.8, "6"), 10: (0.5, "12"), 22: (0.5, "10 (15)"), 46: (1.1, "40 (60)")}  # and estimates of both steps [ms]
SHARED = 24  # cells of the cubes on the CPU, whose threads then share linear solves
PLATES, QUICK_PLATES = (8, 32, 64, 128), (4,)
BEAMS = {17: "13", 37: "42 to 68"}  # cells across a beam of 20 n^3 tets, and estimate of a CG iteration [us]
BATCH, WARM, RERUNS, DEAREST = 16, 10, 3, 30
REPEATS, PHASES, SPINS, THREADS = 200, 1000, 1000, 10**6
SOLVES, UPDATES, SEARCHES, LEGS = "find_step_length", "update_multipliers", "update_surface", "check_paths"  # by their kernels


# --- scenes and steps ---------------------------------------------------------------------------------------------------


def falling_cubes(cells: int, number: int = 2) -> Scene:
    """Cubes of 5 cells^3 tets, sliding and about to touch each other and the ground."""
    scene, mesh = ts.Scene(), ts.box_mesh((cells,) * 3, (1, 1, 1))
    rubber = ts.Material(law="stable_neo_hookean", young=1e5, poisson=0.3, density=1000.0, friction=0.5)
    for k in range(number):
        place, velocity = (0.1 * k, 0.5 + GAP + k * (1 + GAP), 0.05 * k), (0.3 * SPEED, -SPEED * (k + 1), 0)
        scene.add_body(mesh, rubber, name=f"cube {k}", position=place, velocity=velocity)
    scene.add_ground(friction=0.5)
    return scene


def opened(scene: Scene, cells: int, integrator: str, arch: str) -> ts.Simulator:
    """A simulator in f32, in steps of 5 ms or MARGIN of the largest stable one, scaled from that of a coarse mesh.

    Finding the highest frequency of a million tets would take minutes on the host.
    """
    dt = 0.005
    if integrator in EXPLICIT:
        with ts.Simulator(falling_cubes(SMALL, 1), dt=1e-6, integrator=integrator, arch=arch) as sim:
            dt = MARGIN * sim.stable_dt * SMALL / cells
    with patched(changes, "check_stability", lambda *_, **__: None):
        return ts.Simulator(scene, dt=dt, integrator=integrator, arch=arch)


def taken(sim: ts.Simulator, steps: int) -> tuple[list[StepReport], float]:
    """Reports of steps in the largest batches, and their seconds without compilation."""
    reports, compiled, start = [], sim.compile_seconds, clock()
    while (done := sum(report.steps for report in reports)) < steps:
        reports.append(sim.advance(steps - done))
    return reports, clock() - start - (sim.compile_seconds - compiled)


def counted(sim: ts.Simulator, steps: int) -> tuple[Counts, list[StepReport]]:
    """What steps launch and read, and their reports."""
    with counting() as counts:
        reports, _ = taken(sim, steps)
    return counts, reports


def accesses(counts: Counts) -> int:
    """Times that the host accessed the device's memory: each makes it wait."""
    return sum(n for kind, n in counts.accesses.items() if kind != FILLS) + counts.returned.total() + counts.host_arrays.total()


# --- parts --------------------------------------------------------------------------------------------------------------


def count_steps(arch: str, quick: bool, add: Add) -> None:
    """Launches, arrays handed to them and accesses of steps of a cube that slides on the ground, beside their limits."""

    def row(of: str, launches: int, reads: int, counts: Counts, less: Counts | None = None, steps: int = 1, **more) -> None:
        numbers = [np.array([c.launches.total(), c.arrays.total(), accesses(c)]) for c in (counts, less or Counts())]
        of_launches, of_arrays, of_accesses = ((numbers[0] - numbers[1]) / steps).tolist()
        found = {"launches": of_launches, "launches at most": launches, "arrays": of_arrays}
        add({"of": of} | found | {"accesses": of_accesses, "accesses at most": reads} | more)

    cells = QUICK_CELLS if quick else SMALL
    for integrator in ("symplectic_euler", "implicit_euler"):
        with opened(falling_cubes(cells, 1), cells, integrator, arch) as sim:
            taken(sim, WARM * (BATCH if integrator in EXPLICIT else 1))
            if integrator in EXPLICIT:
                (whole, _), (half, _) = counted(sim, BATCH), counted(sim, BATCH // 2)
                n = sim._dynamics.contact.n_contacts
                row("a sub-step", 8, 0, whole, half, BATCH // 2, contacts=n)
                row(f"a batch of {BATCH}", 8 * BATCH, 3, whole, contacts=n)
                continue
            one, (report,) = counted(sim, 1)
            newton, events = report.newton_iterations, one.launches[SOLVES] + one.launches[UPDATES]
            if report.n_contacts and not events:
                raise LookupError(f"neither {SOLVES} nor {UPDATES} is launched any more: name the kernels that stand for them")
            further = max(0, one.launches[SEARCHES] - 1) + max(0, one.launches[LEGS] - 1)
            limits = 50 + 9 * newton + 6 * events + 45 * further, events + 5 * newton + 10
            row("an implicit step", *limits, one, contacts=report.n_contacts, N=newton, E=events, further=further)


@dataclass(frozen=True, eq=False)
class Counter:
    """An array, for kernels."""

    n: object


@kernel
def run_loops(to: ti.template(), loops: ti.template(), a: ti.f64):
    """Run loops, each a kernel of CUDA; the first one uses all arrays."""
    for k in ti.static(range(loops)):
        for i in range(32):
            if ti.static(k == 0):
                for x in ti.static(to.every):
                    x[i] = x[i] + a
            else:
                to.every[0][i] = to.every[0][i] + a


@kernel
def meet(team: ti.template(), counter: ti.template(), blocks: ti.template(), n: ti.i32, over_all: ti.template()):
    """Let the threads of a block, or those of all blocks, wait for each other n times; a spin that does not end is given up."""
    ti.loop_config(serialize=team.alone, block_dim=team.threads)
    for t in range(team.threads * blocks):
        for k in range(n):
            team.sync()
            if ti.static(over_all):
                if t % team.threads == 0:
                    if ti.static(not team.alone):
                        ti.simt.grid.memfence()
                    counter.n[0] += 1  # atomic
                    spins = 0
                    while ti.atomic_add(counter.n[0], 0) < (k + 1) * blocks and spins < SPINS:
                        spins += 1
                team.sync()


@kernel
def run_alone(x: ti.template(), n: ti.i32):
    """A loop on one thread, whose entries depend on the one before."""
    ti.loop_config(serialize=True)
    for i in range(1, n):
        x[i] = 0.5 * x[i] + x[i - 1]


@kernel
def count_all(counter: ti.template(), n: ti.i32, places: ti.i32):
    """Add to a few places, or to many."""
    for i in range(n):
        counter.n[i % places] += 1  # atomic


@kernel
def read_first(x: ti.template()) -> ti.f64:
    """Return a number to the host."""
    return x[0]


def time_launches(packed: bool, arch: str, quick: bool, add: Add) -> None:
    """Launches by arrays and kernels, with arguments one by one or packed as on the CPU."""
    launching.PACK = "1" if packed else launching.PACK
    with closing(open_runtime(arch, "f32")):
        arena = FieldArena()
        for arrays, loops in product((1, 5, 20, 60), (1, 5, 20)):
            if arrays == 1 or loops == 1 or arrays == loops:
                to = Arrays(tuple(arena.field(f"{arrays} {loops} {k}", ti.f64, 32) for k in range(arrays)))
                us = often(partial(run_loops, to, loops, 1.0), 20 if quick else REPEATS)
                add({"arrays": arrays, "kernels": loops, "launch [us]": us, "estimate [us]": f"{15 + 2 * arrays + 6 * loops}"})
        arena.release()


def micro(arch: str, quick: bool, add: Add) -> None:
    """What a launch, a read, a barrier, a loop on one thread and atomics take."""
    time_launches(False, arch, quick, add)
    with closing(open_runtime(arch, "f32")):
        arena, n, many = FieldArena(), 20 if quick else REPEATS, THREADS // 100 if quick else THREADS
        team, x, counter = make_team(arena, "bench"), arena.field("x", ti.f64, many), Counter(arena.field("n", ti.i32, many))
        blocks = 1 if team.alone else 64  # fewer than any such GPU holds at a time, so that none waits for one that is not there

        def meeting(times: int, over_all: bool) -> float:
            def once() -> None:
                counter.n.fill(0)
                meet(team, counter, blocks if over_all else 1, times, over_all)

            return often(once, 3)

        def each(phase: Callable[[int], float], times: int) -> float:
            return (phase(times) - phase(1)) / (times - 1)

        def alone(entries: int) -> float:
            return often(partial(run_alone, x, entries + 1), 2)

        for what, us, estimate in (
            ("a read by the host", lambda: often(lambda: x[0], n), "25"),
            ("a kernel that returns a number", lambda: often(partial(read_first, x), n), ""),
            ("a number of an array written by the host", lambda: often(lambda: x.__setitem__(0, 1.0), n), ""),
            ("a barrier of a block", lambda: each(partial(meeting, over_all=False), PHASES), "1"),
            (f"a barrier of {blocks} blocks", lambda: each(partial(meeting, over_all=True), PHASES), "2"),
            ("an entry of a loop on one thread", lambda: each(alone, many // 100), ""),
            ("an atomic addition to one place", lambda: often(partial(count_all, counter, many, 1), 3) / many, ""),
            ("an atomic addition to a place of its own", lambda: often(partial(count_all, counter, many, many), 3) / many, ""),
        ):
            add({"what": what, "time [us]": us(), "estimate [us]": estimate})
        arena.release()


def tests(arch: str, quick: bool, add: Add) -> None:
    """The tests marked cuda, by pytest in this process."""
    import pytest

    class Results:
        def pytest_runtest_logreport(self, report) -> None:
            if report.when == "call" or report.outcome != "passed":
                why = str(report.longrepr).strip().rpartition("\n")[2] if report.failed else ""
                add({"test": report.nodeid, "outcome": report.outcome, "seconds": report.duration, "why": why})

    os.environ["TI_ADVANCED_OPTIMIZATION"] = "1"  # tests: not else
    # most of their time is compilation
    side_by_side = ["-n", str(min(8, len(usable_cores())))] if find_spec("xdist") else []
    pytest.main(
        ["-q", "-p", "no:cacheprovider", *side_by_side, "-m", "cuda", str(HERE / "tests" / "backend")], plugins=[Results()]
    )


def sizes(integrator: str, arch: str, quick: bool, add: Add) -> None:
    """Steps with contacts of two cubes, from 1,000 to a million tets, then on the CPU of the same machine."""
    explicit = integrator in EXPLICIT
    rows = [(arch, QUICK_CELLS)] if quick else [*product((arch,), CELLS), ("cpu", SHARED)]
    for where, cells in rows:
        named, start = {"tets": 10 * cells**3, "arch": where}, perf_counter()
        try:
            with opened(falling_cubes(cells), cells, integrator, where) as sim:
                build = perf_counter() - start - sim.compile_seconds
                taken(sim, 4 * BATCH if explicit else 3)
                reports, seconds = taken(sim, 4 * BATCH if explicit else 3)
                counts, _ = counted(sim, BATCH if explicit else 1)
                compiled = sim.compile_seconds
        except TaisoftError as error:
            add(named | {"failure": str(error)})
            continue
        steps = sum(report.steps for report in reports)
        mean = {name: sum(getattr(r, f"{name}_iterations") for r in reports) / steps for name in ("newton", "linear", "contact")}
        work = {"sweeps": mean["contact"]}
        if not explicit:
            work = {"Newton": mean["newton"], "CG": mean["linear"], "multiplier updates": mean["contact"]}
        estimate = CELLS[cells][not explicit] if cells in CELLS else "-"
        per = BATCH if explicit else 1
        calls = {"launches": counts.launches.total() / per, "accesses": accesses(counts) / per}
        calls |= {"contacts": max(r.n_contacts for r in reports), "unconverged": sum(not r.converged for r in reports)}
        times = {"step [ms]": 1e3 * seconds / steps, "estimate [ms]": f"{estimate}"}
        add(named | times | calls | work | {"build [s]": build, "compile [s]": compiled})


def profile(arch: str, quick: bool, add: Add) -> None:
    """The kernels of the device that take longest, by Taichi's profiler, at 100,000 tets."""
    os.environ["TI_KERNEL_PROFILER"] = "1"  # read by ti.init
    cells = QUICK_CELLS if quick else 22
    for integrator in ("symplectic_euler", "implicit_euler"):
        with opened(falling_cubes(cells), cells, integrator, arch) as sim:
            taken(sim, 2 * BATCH if integrator in EXPLICIT else 3)
            ti.profiler.clear_kernel_profiler_info()
            reports, _ = taken(sim, BATCH if integrator in EXPLICIT else 1)
            program, spent = impl.get_runtime().prog, {}
            program.sync_kernel_profiler()
            program.update_kernel_profiler()
            for record in program.get_kernel_profiler_records():
                spent.setdefault(record.name, []).append(record.kernel_time)
            steps = sum(report.steps for report in reports)
            for name, times in sorted(spent.items(), key=lambda one: -sum(one[1]))[:DEAREST]:
                each = {
                    "launches a step": len(times) / steps,
                    "us": 1e3 * sum(times) / len(times),
                    "ms a step": sum(times) / steps,
                }
                add({"integrator": integrator, "kernel": name} | each)


def conjugate_gradients(arch: str, quick: bool, add: Add) -> None:
    """Bytes per second of iterations of conjugate gradients in implicit steps of a falling beam without contacts."""
    for n in (QUICK_CELLS,) if quick else BEAMS:
        with ts.Simulator(beam_scene((4 * n, n, n), "SNH"), dt=0.01, integrator="bdf2", arch=arch) as sim:
            warm_up(sim)
            run = advance(sim, 3)
            sim.reset()
            with watching() as spend:
                seconds = spend(partial(advance, sim, 3)).seconds[SOLVE] / run.linear_iterations
            moved = sum(sim.field_bytes.get(name, 0) for names in LOOPS["iteration"] for name in names)
        row = {"tets": n_tets((4 * n, n, n)), "step [ms]": 1e3 * run.seconds / 3, "CG": run.linear_iterations / 3}
        row |= {"iteration [us]": 1e6 * seconds, "estimate [us]": BEAMS.get(n, "-")}
        add(row | {"MB": 1e-6 * moved, "GB/s": 1e-9 * moved / seconds})


def reruns(arch: str, quick: bool, add: Add) -> None:
    """Final states of reruns."""
    for integrator, dt, seconds in (("symplectic_euler", 1e-3, 0.2), ("implicit_euler", 0.005, 0.1)):
        ends = []
        with ts.Simulator(falling_cubes(QUICK_CELLS if quick else 4), dt=dt, integrator=integrator, arch=arch) as sim:
            start = sim.positions()
            for _ in range(RERUNS):
                sim.reset()
                taken(sim, round(seconds / dt))
                ends.append(sim.positions())
        spread = max(float(np.abs(end - ends[0]).max()) for end in ends) / float(np.abs(ends[0] - start).max())
        same = "yes" if all((end == ends[0]).all() for end in ends) else "no"
        add({"integrator": integrator, "runs": RERUNS, "same bits": same, "largest difference / excursion": spread})


def sweeps(arch: str, quick: bool, add: Add) -> None:
    """Serial and coloured Gauss-Seidel on two plates."""
    for n in QUICK_PLATES if quick else PLATES:
        with closing(open_runtime(arch, "f32", "the benchmark of sweeps")) as runtime:
            (point,) = measure_crossover((n,), runtime)
        serial, coloured = point.serial, point.coloured
        row = {
            "contacts": point.contacts,
            "colours": point.colours,
            "serial [us a contact]": 1e6 * serial.per_sweep / point.contacts,
        }
        row |= {"estimate [us]": "3.6", "coloured sweep [us]": 1e6 * coloured.per_sweep, "estimate of it [us]": "13 to 30"}
        row |= {"serial [ms]": 1e3 * serial.median, "coloured [ms]": 1e3 * coloured.median, "sweeps": serial.sweeps}
        add(row | {"coloured sweeps": coloured.sweeps, "residual": max(serial.residual, coloured.residual)})


@dataclass(frozen=True)
class Part:
    """A part. seconds: time limit; run: adds its rows; counts: whether it needs no clock of a device, so the CPU runs it, too."""

    title: str
    seconds: float
    run: Callable[[str, bool, Add], None]
    counts: bool = False


PARTS = {
    "micro": Part("Launches, reads, barriers, loops on one thread, atomics", 40.0, micro),
    "tests": Part("Tests marked cuda", 60.0, tests),
    "explicit": Part("Explicit steps with contacts", 85.0, partial(sizes, "symplectic_euler")),
    "implicit": Part("Implicit steps with contacts", 110.0, partial(sizes, "implicit_euler")),
    "counts": Part("Counts of steps", 30.0, count_steps, counts=True),
    "profile": Part("Kernels of 100,000 tets that take longest", 45.0, profile),
    "cg": Part("Conjugate gradients", 25.0, conjugate_gradients),
    "reruns": Part("Reruns", 25.0, reruns, counts=True),
    "sweeps": Part("Sweeps over contacts", 30.0, sweeps),
    "packed": Part("Launches with packed arguments", 20.0, partial(time_launches, True)),
}


def answer(request: dict) -> dict:
    """In a child: the rows of a part and its seconds."""
    rows, start = [], perf_counter()

    def add(row: dict) -> None:
        rows.append(row)
        leave(request, {"rows": rows})

    on_gpu = request["arch"] == "cuda"
    with without_warnings(), nullcontext() if on_gpu else gpu_path():
        PARTS[request["part"]].run(request["arch"], request["quick"], add)
    return {"rows": rows, "seconds": perf_counter() - start}
