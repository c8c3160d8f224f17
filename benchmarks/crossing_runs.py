"""Runs of `taisoft bench crossings`: simulators whose every state is judged, each run in its own process, stored by its inputs.

A run is a group and a name. Its record has the number of judged states and of those that cross, the first crossing, the largest
depth, the least distance of states that do not cross, sums over its steps, and how the run ended.
"""

import time
from dataclasses import dataclass, field, replace

import numpy as np

from taisoft import Simulator
from taisoft.cli.scene_file import load_module, shipped_files
from taisoft.errors import TaisoftError
from taisoft.records import RunReport, StepReport
from taisoft.scene.scene import Scene

from . import crossing_shots
from .crossing_heaps import folded_strip, make_heap
from .hard_cases import VARIANTS
from .hard_cases.case import REFUSED, Session
from .runner import without_warnings

DEMOS, HARD, HEAPS, SHOTS, JITTERED = GROUPS = ("demos", "hard", "heaps", "shots", "jittered")
N_HEAPS, N_STARTS = 200, 10
JITTER = 1e-4  # [m], largest displacement along each axis of a jittered start
FOLD = "fold"
FOLD_SETTINGS, FOLD_STEPS = {"dt": 1 / 60, "integrator": "implicit_euler", "self_collision": True}, 150
TWISTED, SQUEEZED = "S1", ("S4 corotational", "S4 stable_neo_hookean")  # jittered hard cases
DISTANCE_EVERY = 10  # judged states
NEAR = 1e-3  # [m], up to which least distances are measured


@dataclass
class Watch:
    """Judgement of all states of one or more simulators. first: of the first one that crosses."""

    states: int = 0
    crossing: int = 0
    starts_crossing: int = 0  # first states, before any step, that cross
    first: dict | None = None
    most: int = 0  # crossings in one state
    deepest: float = 0.0  # [m]
    least: float = NEAR  # [m], of every tenth state that does not cross; NEAR if it is larger
    contacts: int = 0  # the engine's, in one step
    newton: int = 0  # most iterations of a converged step
    newton_iterations: int = 0  # of all steps, as are the next two
    linear_iterations: int = 0
    substeps: int = 0
    tunnelled: int | None = None  # first step after which something has got through, or into, something else; of shots only
    unconverged: int = 0
    inverted: int = 0
    judge_seconds: float = 0.0
    simulators: int = 0
    names: dict[str, int] = field(default_factory=dict)  # states in which two sides cross, by their names

    def begin(self, sim: Simulator, judge) -> None:
        """Judge the start of a simulator."""
        self.simulators += 1
        self.starts_crossing += judge.crossings() > 0

    def count(self, report: StepReport) -> None:
        """Add to the sums."""
        self.newton_iterations += report.newton_iterations
        self.linear_iterations += report.linear_iterations
        self.substeps += report.substeps

    def look(self, sim: Simulator, judge, report: StepReport) -> None:
        """Judge the state after a step."""
        clock = time.perf_counter()
        self.states += 1
        self.unconverged += not report.converged
        self.newton = max(self.newton, report.newton_iterations if report.converged else 0)
        self.contacts = max(self.contacts, report.n_contacts)
        self.inverted = max(self.inverted, report.n_inverted)
        found = judge.find()
        if found.count:
            self.crossing += 1
            self.most, self.deepest = max(self.most, found.count), max(self.deepest, found.depth)
            pairs = [" and ".join(pair) if pair[0] != pair[1] else f"{pair[0]} and itself" for pair in found.names]
            for pair in pairs:
                self.names[pair] = self.names.get(pair, 0) + 1
            if self.first is None:
                where = {"step": sim.step_count, "time": sim.time, "count": found.count, "depth": found.depth, "names": pairs}
                self.first = where | {"converged": report.converged, "substeps": report.substeps}
        elif self.states % DISTANCE_EVERY == 0:
            self.least = min(self.least, judge.least_distance(self.least))
        self.judge_seconds += time.perf_counter() - clock


class JudgedSimulator(Simulator):
    """A simulator that takes one step, or sub-step of an explicit integrator, at a time and has each state judged by `watch`."""

    def __init__(self, *arguments, watch: Watch, **settings):
        super().__init__(*arguments, **settings)
        self._watch, self._judge = watch, None

    def advance(self, n: int) -> StepReport:
        """See Simulator; takes one step, or `n` where nothing can touch, which is not judged."""
        if not self.touches:
            report = super().advance(n)
            self._watch.count(report)
            return report
        if self._judge is None:
            from .judge import Judge  # needs ipctk

            self._judge = Judge(self, self.settings.self_collision)
            self._watch.begin(self, self._judge)
        report = super().advance(1)
        self._watch.count(report)
        self._watch.look(self, self._judge, report)
        return report


class ShotSimulator(JudgedSimulator):
    """A simulator of a shot: each state is also judged by sides, and by vertices inside something else."""

    def __init__(self, shot: crossing_shots.Shot, *, watch: Watch, arch: str):
        super().__init__(shot.scene, watch=watch, arch=arch, **shot.settings)
        self._passed = shot.passed
        if shot.velocities is not None:
            self.set_state(velocities=shot.velocities)

    def advance(self, n: int) -> StepReport:
        """See JudgedSimulator."""
        report = super().advance(n)
        if self._watch.tunnelled is None and (self._judge.inside() or self._passed(self)):
            self._watch.tunnelled = self.step_count
        return report


class JudgedSession(Session):
    """A hard case's variant whose simulators are judged. jitter: number of a random start, None for the variant's own."""

    def __init__(self, case, variant, arch: str, watch: Watch, jitter: int | None = None):
        super().__init__(case, variant, arch)
        self._watch, self._jitter = watch, jitter

    def simulator(self, scene: Scene, **changes) -> Simulator:
        """See Session."""
        sim = JudgedSimulator(scene, arch=self.arch, watch=self._watch, **self.variant.settings | changes)
        if self._jitter is not None:
            jitter_start(sim, self._jitter)
        return sim


def jitter_start(sim: Simulator, number: int) -> None:
    """Displace all nodes that are not prescribed at random; number: which start."""
    x = sim.positions()
    free = np.ones(len(x), dtype=bool)
    start = 0
    for body in sim.scene.bodies:
        for constraint in body.constraints:
            free[start + constraint.nodes] = False
        start += body.n_nodes
    sim.set_state(x + free[:, None] * np.random.default_rng(number).uniform(-JITTER, JITTER, x.shape))


def names_of(group: str, count: int | None = None) -> list[str]:
    """The names of a group's runs; count: of heaps, of shots of each kind, or of starts of each jittered scene."""
    if group == DEMOS:
        return list(shipped_files("demos"))
    if group == HARD:
        return [name for name, (_, variant) in VARIANTS.items() if variant.must.end != REFUSED]
    if group == HEAPS:
        return [f"heap {k:03d}" for k in range(N_HEAPS if count is None else count)]
    if group == SHOTS:
        return crossing_shots.names(crossing_shots.N_SHOTS if count is None else count)
    starts = range(N_STARTS if count is None else min(count, N_STARTS))
    return [f"{scene}, start {k}" for scene in (FOLD, TWISTED, *SQUEEZED) for k in starts]


def run(group: str, name: str, arch: str, steps: int | None = None) -> dict:
    """Run and judge in this process; returns the record. steps: at most, of heaps, shots and folds."""
    clock, watch = time.perf_counter(), Watch()
    ended = {"status": REFUSED, "problems": [], "settings": "", "kinds": []}
    with without_warnings():
        try:
            by = {DEMOS: _demo, HARD: _hard, HEAPS: _heap, SHOTS: _shot, JITTERED: _jittered}[group]
            ended |= by(name, arch, watch, steps)
        except TaisoftError as error:
            ended["problems"] = [str(error)]
    ended["problems"] = list(dict.fromkeys(ended["problems"]))
    seen = {key: value for key, value in vars(watch).items() if key != "names"}
    return {"group": group, "name": name, **ended, **seen, "names": watch.names, "seconds": time.perf_counter() - clock}


def settings_text(settings: dict) -> str:
    """Integrator, dt and precision in words."""
    dt = settings["dt"]
    step = f"1/{1.0 / dt:.0f} s" if abs(1.0 / dt - round(1.0 / dt)) < 1e-6 and 1.0 / dt < 1e4 else f"{dt:.3g} s"
    return f"{settings.get('integrator', 'implicit_euler')}, {step}, {settings.get('precision', 'f32')}"


def _ended(result: RunReport, settings: dict) -> dict:
    return {"status": result.status, "problems": result.problems, "settings": settings_text(settings)}


def _demo(name: str, arch: str, watch: Watch, _: int | None) -> dict:
    demo = load_module(shipped_files("demos")[name])
    settings = dict(demo.solver)
    length = {key: settings.pop(key) for key in ("seconds", "fps")}
    with JudgedSimulator(demo.build(), watch=watch, arch=arch, **settings) as sim:
        return _ended(sim.run(**length), settings)


def _heap(name: str, arch: str, watch: Watch, steps: int | None) -> dict:
    heap = make_heap(int(name.removeprefix("heap ")))
    known = {"settings": settings_text(heap.settings), "kinds": heap.kinds}
    with JudgedSimulator(heap.scene, watch=watch, arch=arch, **heap.settings) as sim:
        return _ended(sim.run(min(heap.steps, steps or heap.steps) * sim.dt, fps=None), heap.settings) | known


def _shot(name: str, arch: str, watch: Watch, steps: int | None) -> dict:
    shot = crossing_shots.make_shot(name)
    with ShotSimulator(shot, watch=watch, arch=arch) as sim:
        steps = min(crossing_shots.STEPS, steps or crossing_shots.STEPS)
        return _ended(sim.run(steps * sim.dt, fps=None), shot.settings)


def _session(session: Session) -> dict:
    record = session.record()
    return {key: record[key] for key in ("status", "problems")} | {"settings": settings_text(session.variant.settings)}


def _hard(name: str, arch: str, watch: Watch, _: int | None) -> dict:
    return _session(JudgedSession(*VARIANTS[name], arch, watch))


def _jittered(name: str, arch: str, watch: Watch, steps: int | None) -> dict:
    scene, _, number = name.partition(", start ")
    if scene == FOLD:
        with JudgedSimulator(folded_strip(), watch=watch, arch=arch, **FOLD_SETTINGS) as sim:
            jitter_start(sim, int(number))
            return _ended(sim.run(min(FOLD_STEPS, steps or FOLD_STEPS) * sim.dt, fps=None), FOLD_SETTINGS)
    if scene == TWISTED:  # whose own starts are random
        case, variant = VARIANTS[f"{TWISTED}: B, start 0"]
        variant = replace(variant, parameters=variant.parameters | {"seed": int(number)})
        return _session(JudgedSession(case, variant, arch, watch))
    return _session(JudgedSession(*VARIANTS[scene.replace(" ", ": ")], arch, watch, int(number)))


def answer(request: dict) -> dict:
    """In a child: the record of a run."""
    return run(request["group"], request["name"], request["arch"], request["steps"])
