"""Runs of the scenes of incremental potential contact: each in a process of its own, judged after every step.

A child leaves its record as it goes, so that a run that is killed in a long step is not lost.
"""

import math
import time
from dataclasses import asdict, dataclass, field

import numpy as np

import taisoft as ts
from taisoft.errors import TaisoftError
from taisoft.many.places import CUT_BY_BUDGET
from taisoft.mesh.quality import mean_surface_edge
from taisoft.records import StepReport

from .ipc_cases import find
from .ipc_cases.case import Case
from .ipc_friction import FrictionMeter
from .runner import timed, without_warnings
from .suite import CRASHED, LEFT_OUT, UNFINISHED, leave

OK, DEGRADED, STOPPED, SKIPPED = "ok", "degraded", "stopped", "skipped"
DISTANCE_EVERY = 10  # steps between two measurements of the least distance
NEAR = 0.05  # of the mean surface edge: larger distances are not measured
REPORT_EVERY = 10.0  # [s] after which a child leaves its record again
GRACE = 300.0  # [s] after the budget, for one more step and its judgement


@dataclass(frozen=True)
class Job:
    """What a child runs. budget: [s] of wall time without building. steps: at most so many, None for all of the case.

    tolerance: newton_tolerance and contact_tolerance. friction: whether friction is measured.
    """

    case: str
    size: str
    budget: float
    precision: str = "f64"
    tolerance: float = 1e-4
    steps: int | None = None
    friction: bool = False
    arch: str = "cpu"


@dataclass
class Record:
    """What a run did, as plain data. failed: whether it ended with an error.

    least_distance: [m], every DISTANCE_EVERY steps; None if nothing was nearer than NEAR of an edge. crossed: number of steps
    after which surfaces crossed. newton, cg, substeps: of each step. seconds: of each step without compilation [s].
    creep [1/s], friction_work [J], cut (steps in substeps): see `ipc_friction`; None and 0 unless it is measured.
    """

    job: Job
    nodes: int = 0
    tets: int = 0
    wanted_steps: int = 0
    time: float = 0.0
    newton: list[int] = field(default_factory=list)
    cg: list[int] = field(default_factory=list)
    substeps: list[int] = field(default_factory=list)
    seconds: list[float] = field(default_factory=list)
    compile_seconds: float = 0.0
    least_distance: float | None = None
    crossed: int = 0
    first_crossed: float | None = None
    unconverged: int = 0
    inverted: int = 0
    deep: int = 0
    creep: float | None = None
    friction_work: float | None = None
    cut: int = 0
    status: str = STOPPED
    reason: str = ""
    failed: bool = False

    def add(self, report: StepReport, seconds: float) -> None:
        """Add a step's report and its time [s]."""
        self.time = report.time
        self.newton.append(report.newton_iterations)
        self.cg.append(report.linear_iterations)
        self.substeps.append(report.substeps)
        self.seconds.append(seconds)
        self.unconverged += not report.converged
        self.inverted = max(self.inverted, report.n_inverted)
        self.deep += bool(report.deep)

    @property
    def case(self) -> Case:
        """Its case."""
        return find(self.job.case)

    @property
    def steps(self) -> int:
        """Number of steps done."""
        return len(self.seconds)

    @property
    def faults(self) -> list[str]:
        """What degrades the run, in a few words each."""
        counted = [
            (self.crossed, f"{self.crossed} {'step' if self.crossed == 1 else 'steps'} crossed"),
            (self.unconverged, f"{self.unconverged} not converged"),
            (self.inverted, f"at most {self.inverted} inverted tets"),
            (self.deep, f"{self.deep} with deep penetration"),
        ]
        return [text for count, text in counted if count]

    def end(self, why: str = "", failed: bool = False) -> None:
        """Set status and reason. why: why the run stopped early, empty if it did not. failed: whether by an error."""
        self.failed = failed
        self.status = STOPPED if why else DEGRADED if self.faults else OK
        self.reason = "; ".join([*([why] if why else []), *self.faults])

    @classmethod
    def read(cls, data: dict) -> "Record":
        """The record of plain data, that of `asdict`."""
        return cls(**data | {"job": Job(**data["job"])})


def run(job: Job, report=lambda record: None) -> Record:
    """Run a job in this process. report: called with the unfinished record from time to time."""
    case, record = find(job.case), Record(job)
    try:
        with without_warnings():
            scene = case.build(job.size)
    except TaisoftError as error:
        record.status, record.reason = SKIPPED, str(error)
        return record
    record.nodes = sum(body.n_nodes for body in scene.bodies)
    record.tets = sum(body.mesh.n_tets for body in scene.bodies)
    record.wanted_steps = case.steps if job.steps is None else min(job.steps, case.steps)
    try:
        with without_warnings(), simulator(case, job, scene) as sim:
            try:
                _advance(sim, case, job, record, report)
            finally:
                record.compile_seconds = sim.compile_seconds
    except (TaisoftError, MemoryError) as error:
        record.end(str(error) or type(error).__name__, failed=True)
    return record


def simulator(case: Case, job: Job, scene: ts.Scene) -> ts.Simulator:
    """The simulator of a job."""
    tolerances = {"newton_tolerance": job.tolerance, "contact_tolerance": job.tolerance}
    return ts.Simulator(
        scene, dt=case.dt, integrator="implicit_euler", self_collision=True, precision=job.precision, arch=job.arch, **tolerances
    )


def _advance(sim: ts.Simulator, case: Case, job: Job, record: Record, report) -> None:
    from .judge import Judge  # needs ipctk

    judge = Judge(sim, self_collision=True)
    near = NEAR * mean_surface_edge([(b.rest_positions, b.nodes.surface) for b in sim.scene.bodies])
    meter = FrictionMeter(sim) if job.friction else None
    start = printed = time.monotonic()
    while record.steps < record.wanted_steps:
        step, seconds = timed(sim.step)
        record.add(step, seconds)
        if meter is not None:
            meter.add(step.substeps)
            record.creep, record.friction_work, record.cut = meter.creep, meter.work, meter.cut
        if judge.crossings():
            record.crossed += 1
            record.first_crossed = sim.time if record.first_crossed is None else record.first_crossed
        if record.steps % DISTANCE_EVERY == 1:
            distances = (record.least_distance, judge.least_distance(near))
            record.least_distance = min([one for one in distances if one is not None and one < near], default=None)
        now = time.monotonic()
        if record.crossed and case.stop_at_crossing:
            return record.end(f"surfaces cross at t = {sim.time:.3g} s")
        if now - start > job.budget and record.steps < record.wanted_steps:
            return record.end(f"budget of {job.budget:g} s")
        if now - printed > REPORT_EVERY:
            printed, record.compile_seconds = now, sim.compile_seconds
            report(record)
    return record.end()


def answer(request: dict) -> dict:
    """In a child: the record of a job, which it leaves from time to time."""
    job = Job(**{key: value for key, value in request.items() if key != UNFINISHED})
    return asdict(run(job, lambda record: leave(request, asdict(record))))


def record_of(job: Job, found: dict) -> Record:
    """The record of a job that a child answered, or left when it crashed or was killed GRACE [s] after the budget."""
    if LEFT_OUT not in found:
        return Record.read(found)
    record, why = Record.read(found[UNFINISHED]) if UNFINISHED in found else Record(job), found[LEFT_OUT]
    killed = why == CUT_BY_BUDGET
    why = f"killed in a step that outlasted the budget of {job.budget:g} s by {GRACE:g} s" if killed else why
    record.end(why, failed=killed or found[CRASHED])
    return record


def mean(values: list) -> float:
    """The mean, nan of nothing."""
    return float(np.mean(values)) if values else math.nan
