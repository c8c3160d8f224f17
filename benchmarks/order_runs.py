"""Runs of one case on its meshes: each is built and solved once, which compiles it, then all are timed in turn.

A round times every mesh of a case, so that a slow minute of the machine affects all; ratios are formed per round. A time is that
of the whole solution from the rest shape, without building the scene and compiling kernels. Long solutions are not repeated:
their time is that of the first solution without the first launch of each kernel, and has no spread.
"""

from dataclasses import asdict, dataclass, field

import numpy as np

import taisoft as ts
from taisoft.backend.runtime import Runtime, compile_clock
from taisoft.errors import SimulationError, TaisoftError
from taisoft.machine import Timing, summarise

from .order_cases import Case, Element, Reference
from .reference_cases.motion import parabola_vertex
from .reference_cases.record import label, nearest
from .runner import progress, repeated, timed, without_warnings
from .timed_run import TimedRun, advance

TOLERANCE = 1e-6  # of |residual| / |load|
FALL_SECONDS = 1.2  # the first swing is over
INTEGRATOR = "bdf2"
ROUND_SECONDS, ROUND_RUNS = 0.1, 5  # short solutions are repeated within a round until this wall time or number
ENOUGH_SECONDS = 4.0  # a solution is not repeated once all its runs have taken this long


@dataclass
class Row:
    """One element on one mesh. rounds: median wall seconds per round; error: largest relative error of the measured numbers."""

    case: str
    law: str
    order: int
    degree: int | None
    points: int
    cells: tuple
    tets: int = 0
    nodes: int = 0
    measured: list[float] = field(default_factory=list)
    error: float | None = None
    newton: int = 0
    linear: int = 0
    rounds: list[float] = field(default_factory=list)
    compile_seconds: float = 0.0  # first launches: tracing, compiling and that first run
    field_bytes: int = 0
    failure: str = ""

    @property
    def timing(self) -> Timing | None:
        """Of a solution [s]; None where it was never timed."""
        return summarise(self.rounds) if self.rounds else None

    def record(self) -> dict:
        """As plain data."""
        return asdict(self) | {"seconds": self.timing and asdict(self.timing)}


class Statics:
    """An equilibrium that can be solved repeatedly."""

    def __init__(self, case: Case, scene: ts.Scene, runtime: Runtime):
        self._case, self._body = case, scene.bodies[0]
        settings = {"newton_tolerance": TOLERANCE, "precision": "f64", "arch": runtime.arch}
        self._sim = ts.Simulator(scene, dt=1.0, integrator="static", **settings)

    def first(self, row: Row) -> None:
        """Solve and record the results. Raises SimulationError if there is no equilibrium."""
        report = self._sim.step()
        row.newton, row.linear = report.newton_iterations, report.linear_iterations
        row.field_bytes = sum(self._sim.field_bytes.values())
        if not report.converged or report.n_inverted:
            raise SimulationError(f"not converged: the residual is {report.residual:.1e} of the load")
        row.measured = self._case.read(self._body, self._sim).tolist()

    def again(self) -> None:
        """Solve from the rest shape."""
        self._sim.reset()
        self._sim.step()

    def close(self) -> None:
        """Free the memory."""
        self._sim.close()


class Fall:
    """A fall that can be run repeatedly."""

    def __init__(self, case: Case, scene: ts.Scene, runtime: Runtime):
        self._case, self._body = case, scene.bodies[0]
        self._steps = round(FALL_SECONDS / case.dt)
        self._sim = ts.Simulator(scene, dt=case.dt, integrator=INTEGRATOR, precision="f64", arch=runtime.arch)

    def first(self, row: Row) -> None:
        """Run and record the results. Raises SimulationError if a step fails or does not converge."""
        tip, heights, whole = nearest(self._body.rest_positions, (2, 0, 0)), [], TimedRun()
        for _ in range(self._steps):
            whole += advance(self._sim, 1)
            heights.append(float(self._sim.positions()[tip, 1].mean()))
        row.newton, row.linear = whole.newton_iterations, whole.linear_iterations
        row.field_bytes = sum(self._sim.field_bytes.values())
        if whole.unconverged:
            raise SimulationError(f"{whole.unconverged} of {whole.steps} steps did not converge")
        when, low = parabola_vertex(np.array(heights), self._case.dt)
        row.measured = [low, when]

    def again(self) -> None:
        """Run from the start."""
        self._sim.reset()
        advance(self._sim, self._steps)

    def close(self) -> None:
        """Free the memory."""
        self._sim.close()


def measure_case(case: Case, meshes: dict[Element, tuple], rounds: int, runtime: Runtime) -> tuple[list[Row], Reference]:
    """All rows of a case, and its reference. The row of a mesh that fails records why."""
    rows: list[Row] = []
    runs: list[tuple] = []  # (Statics or Fall, row)
    try:
        for element, chain in meshes.items():
            for cells in chain:
                row = Row(case.name, case.law, element.order, element.degree, element.points, tuple(cells))
                rows.append(row)
                progress(f"{case.name}: order {element.order}, {element.points} points, {label(cells)}")
                _prepare(case, element, row, runs, runtime)
        reference = case.reference or own_reference(case, rows)
        for row in rows:
            set_error(row, reference)
        _time(runs, rounds)
    finally:
        for run, _ in runs:
            run.close()
    return rows, reference


def _prepare(case: Case, element: Element, row: Row, runs: list[tuple], runtime: Runtime) -> None:
    """Build, solve once, record the results and append to `runs`."""
    compiled = compile_clock()
    try:
        with without_warnings():  # order 1 bends too little on coarse meshes, which is measured here
            scene = case.build(row.cells, element)
        row.tets, row.nodes = scene.bodies[0].mesh.n_tets, len(scene.bodies[0].rest_positions)
        run = (Statics if case.dt is None else Fall)(case, scene, runtime)
        runs.append((run, row))  # measure_case closes it
        _, seconds = timed(lambda: run.first(row))
        if seconds > ENOUGH_SECONDS:
            row.rounds.append(seconds)
    except TaisoftError as error:
        row.failure = str(error)
    row.compile_seconds = compile_clock() - compiled


def _time(runs: list[tuple], rounds: int) -> None:
    """Time all successful runs in rounds."""
    for _ in range(rounds):
        for run, row in runs:
            if not row.failure and sum(row.rounds) < ENOUGH_SECONDS:
                row.rounds.append(float(np.median(repeated(run.again, ROUND_RUNS, ROUND_SECONDS, min_rounds=1))))


def own_reference(case: Case, rows: list[Row]) -> Reference:
    """The extrapolated value of the last three order-2 meshes, if the case requires it and they have solutions."""
    solved = [np.array(row.measured) for row in rows if row.degree == 2 and row.measured]
    if not case.extrapolated or len(solved) < 3:
        return Reference((), 0.0, "nothing to take an error from")
    before, last = solved[-2] - solved[-3], solved[-1] - solved[-2]
    limit = solved[-1] + last * last / (before - last)  # of a geometric sequence
    uncertainty = float(np.abs((limit - solved[-1]) / limit).max())  # all of the extrapolation
    return Reference(tuple(limit.tolist()), uncertainty, "the three finest order-2 meshes of this run, extrapolated")


def set_error(row: Row, reference: Reference) -> None:
    """Set the error of a row if there are numbers and a reference."""
    if row.measured and reference.values:
        exact = np.array(reference.values)
        row.error = float(np.abs(np.array(row.measured)[: len(exact)] / exact - 1.0).max())
