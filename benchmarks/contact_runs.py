"""Whole scenes of `contact.py`: films of contact problems, the cost of an explicit step and of its parts, implicit runs.

A film goes on from the first impulse, frame after frame; of each frame the contact problem of its last step is solved by
every solver, from the impulses of the step before and from none. The steps themselves are those of the default solver.
"""

import time
from collections import Counter
from collections.abc import Callable, Iterable, Iterator
from contextlib import ExitStack, contextmanager
from dataclasses import asdict, dataclass, field

import numpy as np

import taisoft as ts
from taisoft.cli.scene_file import load_scene
from taisoft.contact.problem import ContactProblem
from taisoft.dynamics import explicit_contact_stepper

from .contact_captured import GOAL, Outcome, Solvers, clock, make_judge, patched, shown

DT, FPS = 1 / 240, 60.0  # of explicit steps and films [s, 1/s]
LATEST = 2.0  # [s] by which bodies must have met
WARM, COLD = "from the step before", "from none"
ROUNDS, COLD_ROUNDS = 3, 1
SETTINGS = ("integrator", "contact_solver", "contact_tolerance", "newton_tolerance", "linear_tolerance", "dt")
# parts of an explicit step: what is called, where it is looked up
PARTS = {
    "search": ("find", "_measure_closing"),
    "problem": ("begin", "set_free_velocities", "find_factors"),
    "solve": ("colour_contacts", "solve"),
    "elasticity": ("keep_state", "predict", "move"),
}
REST = "rest"


@dataclass
class Film:
    """Frames of an explicit run. outcomes: start -> solver -> of each frame; found: contacts before their reduction."""

    scene: str
    tets: int
    dt: float
    stable_dt: float
    time: list[float] = field(default_factory=list)
    contacts: list[int] = field(default_factory=list)
    found: list[int] = field(default_factory=list)
    outcomes: dict[str, dict[str, list[Outcome]]] = field(default_factory=lambda: {WARM: {}, COLD: {}})

    @property
    def solvers(self) -> list[str]:
        """Names."""
        return list(self.outcomes[WARM])

    def of(self, solver: str, start: str = WARM) -> list[Outcome]:
        """A solver's outcomes, frame by frame."""
        return self.outcomes[start][solver]

    def missed(self, solvers: list[str]) -> int:
        """Solves by these whose residual is above GOAL, by the judge; its sums round otherwise than the kernels'."""
        return sum(not o.residual <= 1.001 * GOAL for name in solvers for start in self.outcomes for o in self.of(name, start))

    def record(self) -> dict:
        """As plain data."""
        return asdict(self)


@dataclass
class StepCost:
    """Explicit steps from the first impulse on. whole: wall seconds of each `step`, its report included; parts: of the same
    steps, done again."""

    scene: str
    solver: str
    whole: list[float]
    parts: dict[str, list[float]]
    contacts: list[int]
    sweeps: list[int]
    residual: float
    problems: list[str]

    def record(self) -> dict:
        """As plain data."""
        return asdict(self)


@dataclass
class Run:
    """An implicit run: lists over its steps with contacts; wall: of all steps, without compiling."""

    scene: str
    settings: str
    status: str
    problems: list[str]
    simulated: float
    wall: float
    seconds: list[float] = field(default_factory=list)
    contacts: list[int] = field(default_factory=list)
    outer: list[int] = field(default_factory=list)
    newton: list[int] = field(default_factory=list)
    linear: list[int] = field(default_factory=list)

    def record(self) -> dict:
        """As plain data."""
        return asdict(self)


# --- explicit ---------------------------------------------------------------------------------------------------------


def open_scene(name: str, arch: str, refine: int | None = None, **settings) -> ts.Simulator:
    """A simulator of a demo's scene in f32, refined so often; settings as they are, else the demo's own."""
    scene, own = load_scene(name, refine=refine)
    settings = settings or {key: own[key] for key in SETTINGS if key in own}
    return ts.Simulator(scene, precision="f32", arch=arch, **settings)


def open_explicit(name: str, arch: str, refine: int | None = None) -> ts.Simulator:
    """The same in explicit steps."""
    return open_scene(name, arch, refine, dt=DT, integrator="symplectic_euler")


def to_first_impulse(sim: ts.Simulator) -> None:
    """From the start until contacts bear something."""
    sim.reset()
    to_impulses(sim)


def to_impulses(sim: ts.Simulator) -> None:
    """Step until contacts bear something, if they do not. Raises SimulationError where that takes too long."""
    last = sim.time + LATEST
    while not sim._dynamics.contact.problem.r.to_numpy()[: sim._dynamics.contact.n_contacts].any():
        if sim.time > last:
            raise ts.SimulationError(f"no contact bears anything within {LATEST:g} s")
        sim.step()


def measure_film(name: str, sim: ts.Simulator, frames: int, solvers: Solvers) -> Film:
    """A film of so many frames; those whose contacts need no impulse are left out."""
    tets = sum(body.mesh.n_tets for body in sim.scene.bodies)
    film = Film(name, tets, sim.dt, sim.stable_dt)
    known: list[ContactProblem] = []

    def look(p: ContactProblem) -> None:
        if p not in known:  # the first, or one with more room
            known.append(p)
            solvers.outcomes(p, p.r.to_numpy(), 1)  # compiles
        if make_judge(p)(np.zeros((int(p.count[0]), 3))) == 0.0:
            return
        for start, rounds, r in ((WARM, ROUNDS, p.r.to_numpy()), (COLD, COLD_ROUNDS, np.zeros((p.capacity, 3)))):
            for solver, outcome in solvers.outcomes(p, r, rounds).items():
                film.outcomes[start].setdefault(solver, []).append(outcome)
        film.time.append(sim.time)
        film.contacts.append(int(p.count[0]))
        film.found.append(sim._dynamics.contact.detection.counts.found)

    to_first_impulse(sim)
    per_frame = max(1, round(1 / (FPS * sim.dt)))
    for _ in range(frames):
        for _ in range(per_frame - 1):
            sim.step()
        with shown(look):
            sim.step()
    return film


class Stopwatch:
    """Seconds by part, each call's own: what a call spends in another part counts there; and calls by name."""

    def __init__(self) -> None:
        self.spent: Counter[str] = Counter()
        self.calls: Counter[str] = Counter()
        self._inner: list[float] = []  # of the calls under way: seconds spent in calls inside

    def timed(self, call: Callable, part: str) -> Callable:
        """The call, timed."""

        def run(*arguments, **named):
            self.calls[getattr(call, "__name__", part)] += 1
            begin = clock()
            self._inner.append(0.0)
            try:
                return call(*arguments, **named)
            finally:
                whole = clock() - begin
                self.spent[part] += whole - self._inner.pop()
                if self._inner:
                    self._inner[-1] += whole

        return run

    @contextmanager
    def on(self, places: Iterable[tuple[str, object, str]]) -> Iterator[None]:
        """Times calls meanwhile. places: part, and the owner and the name under which what is called is looked up."""
        with ExitStack() as stack:
            for part, owner, name in places:
                stack.enter_context(patched(owner, name, self.timed(getattr(owner, name), part)))
            yield


def explicit_places(sim: ts.Simulator) -> list[tuple[str, object, str]]:
    """Where the parts of the simulator's explicit steps are called, for `Stopwatch.on`."""
    contact = sim._dynamics.contact
    owners = {"find": contact.detection, "_measure_closing": contact, "begin": contact}
    return [(part, owners.get(name, explicit_contact_stepper), name) for part, names in PARTS.items() for name in names]


def measure_step(name: str, sim: ts.Simulator, steps: int) -> StepCost:
    """What a step costs from the first impulse on; then the same steps again for their parts."""
    to_first_impulse(sim)
    cost = StepCost(name, sim._dynamics.stepper.method, [], {part: [] for part in (*PARTS, REST)}, [], [], 0.0, [])
    for _ in range(steps):
        begin = clock()
        report = sim.step()
        cost.whole.append(clock() - begin)
        cost.contacts.append(report.n_contacts)
        cost.sweeps.append(report.contact_iterations)
        cost.residual = max(cost.residual, report.contact_residual)
        cost.problems += report.problems
    to_first_impulse(sim)
    watch = Stopwatch()
    with watch.on(explicit_places(sim)):
        for _ in range(steps):
            watch.spent.clear()
            begin = clock()
            sim.step()
            whole = clock() - begin
            for part in PARTS:
                cost.parts[part].append(watch.spent[part])
            cost.parts[REST].append(whole - sum(watch.spent.values()))
    return cost


# --- implicit ---------------------------------------------------------------------------------------------------------


def measure_run(name: str, sim: ts.Simulator, seconds: float) -> Run:
    """Some seconds of the demo's own implicit steps."""
    spent: list[float] = []
    plain = sim.advance

    def advance(n: int):
        begin, compiled = time.perf_counter(), sim.compile_seconds
        report = plain(n)
        spent.append(time.perf_counter() - begin - (sim.compile_seconds - compiled))
        return report

    with patched(sim, "advance", advance):
        done = sim.run(seconds, fps=None)
    s = sim.settings
    run = Run(name, f"{s.integrator}, dt = {1e3 * s.dt:.3g} ms", done.status, done.problems, done.sim_seconds, done.wall_seconds)
    for report, took in zip(done.step_reports, spent):
        if report.n_contacts:
            run.seconds.append(took)
            run.contacts.append(report.n_contacts)
            run.outer.append(report.contact_iterations)
            run.newton.append(report.newton_iterations)
            run.linear.append(report.linear_iterations)
    return run
