"""Reports of steps and runs: plain records, without Taichi."""

from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass, field, fields

from taisoft.display import PROBLEMS_SHOWN, percent, run_html
from taisoft.errors import SimulationError, no_memory


@dataclass
class Energies:
    """Energies of a state [J]."""

    kinetic: float  #: [J]
    elastic: float  #: [J], 0 at rest
    gravity: float  #: -sum m g.x [J], 0 at the origin
    loads: float = 0.0  #: -sum f.x of forces, tractions and a drag, 0 at the origin, and p V of pressures on closed surfaces [J]
    dissipated: float = 0.0  #: by Maxwell branches since the start [J]

    @property
    def total(self) -> float:
        """Kinetic + elastic + gravity [J], without loads."""
        return self.kinetic + self.elastic + self.gravity


@dataclass
class StepReport:
    """Result of one step. A batch of explicit sub-steps gives one report: extremes over its sub-steps, the rest at its end."""

    time: float  #: at the end of the step [s]
    steps: int = 1  #: steps of size dt that this report covers
    substeps: int = 1  #: of an implicit step; more than one if it did not converge or bodies would have passed each other
    newton_iterations: int = 0  #: with those of rejected parts
    linear_iterations: int = 0  #: of conjugate gradients, counted alike
    multigrid_solves: int = 0  #: linear systems that multigrid preconditioned
    contact_iterations: int = 0  #: sweeps of explicit steps, multiplier updates of implicit ones
    residual: float = 0.0  #: relative residual of the implicit equations, 0 for explicit steps
    contact_residual: float = 0.0  #: residual of the contact laws, |p - prox(p - f u)| / |p|
    n_contacts: int = 0  #: contacts of the step
    dropped_contacts: int = 0  #: triangles under inverted tets, whose contacts a distance field cannot give
    max_penetration: float = 0.0  #: of the contacts found, and how far crossing triangles must part [m]
    crossings: int = 0  #: pairs of surface triangles that cross by more than 0.1 % of the finer side's mean surface edge
    deep: int = 0  #: 1 where something is deeper than 2 % of the finer side's mean surface edge, else 0
    misplaced: float = 0.0  #: largest part of a pair's contact force that acts along wrong normals, see docs/contacts.md
    contact_error: str = ""  #: what contact normals that do not hold at the step's end falsify, a sentence, if that is noteworthy
    min_volume_ratio: float = 1.0  #: smallest J = det F
    n_inverted: int = 0  #: tets with J <= 0
    kinetic: float = 0.0  #: [J]
    elastic: float = 0.0  #: [J]
    gravity: float = 0.0  #: [J]
    loads: float = 0.0  #: of dead loads, -sum f.x [J]
    dissipated: float = 0.0  #: by Maxwell branches since the start [J]
    converged: bool = True  #: residuals are within their tolerances
    on_budget: int = 0  #: 1 where the step ended at its budget of wall time before it converged, else 0
    last_correction: float = 0.0  #: displacement by such a step's last iteration and by holding back, about its error [m]
    problems: list[str] = field(default_factory=list)  #: sentences
    details: dict[str, float] = field(default_factory=dict)  #: of a run with `details`, at the end, by heading in steps.csv

    def to_dict(self) -> dict:
        """Return a row of steps.csv: the fields by name, problems joined with '; ', and the details by heading."""
        own = {f.name: getattr(self, f.name) for f in fields(self) if f.name != "details"}
        return own | {"problems": "; ".join(self.problems)} | self.details

    def __repr__(self) -> str:
        counts = {"Newton iterations": self.newton_iterations, "substeps": self.substeps - 1 and self.substeps}
        counts |= {"contacts": self.n_contacts, "inverted tets": self.n_inverted}
        texts = [f"{n} {name}" for name, n in counts.items() if n]
        texts += [f"residual {self.residual:.2g}"] if self.residual else []
        texts += [f"min J {self.min_volume_ratio:.4g}", f"kinetic {self.kinetic:.4g} J", f"elastic {self.elastic:.4g} J"]
        end = "" if self.converged else ", on budget" if self.on_budget else ", not converged"
        return f"StepReport(t = {self.time:.6g} s: {', '.join(texts)}{end})"


ERROR_KINDS = ("time", "space", "solver")  # fields of the following records


def headings(reports: list[StepReport]) -> list[str]:
    """Return the headings of all details of reports, in the order of their first appearance."""
    return list(dict.fromkeys(heading for report in reports for heading in report.details))


@dataclass
class BodyError:
    """Estimated errors of a body's positions, as in `ErrorEstimate`. None where one is unknown."""

    time: float | None = None  #: of the steps
    space: float | None = None  #: of the mesh; needs `error_mesh`
    solver: float | None = None  #: of the solvers' tolerances

    @property
    def total(self) -> float | None:
        """Sum of the errors that are known; None without the error in time."""
        return None if self.time is None else self.time + (self.space or 0.0) + (self.solver or 0.0)


@dataclass
class Quantity(BodyError):
    """A quantity at the end of a run, and its estimated errors in the same unit, see `Simulator.run`."""

    value: float | None = None  #: None if it could not be measured; the notes say why
    unit: str = ""  #: such as "N"; of a function it is unknown, ""
    orders: dict[str, float] = field(default_factory=dict)  #: that three levels showed, by the kind of error
    notes: list[str] = field(default_factory=list)  #: reasons for what is unknown, sentences

    def __str__(self) -> str:
        known = [f"{kind} {getattr(self, kind):.2g}" for kind in ERROR_KINDS if getattr(self, kind) is not None]
        value = "unknown" if self.value is None else f"{self.value:.6g}{self.unit and ' '}{self.unit}"
        return value + (f", errors: {', '.join(known)}" if known else "")

    def __repr__(self) -> str:
        return f"Quantity({self})"


@dataclass
class ErrorEstimate(BodyError):
    """Estimated error of a run's positions: the largest distance of a node from its exact place at any compared time.

    All errors are relative to the largest excursion, the largest distance of any node from its start. None where an error could
    not be estimated; the notes give the reason. See `Simulator.run`.
    """

    excursion: float = 0.0  #: [m]
    order: float | None = None  #: in time, as observed, or assumed if one companion has a smaller step
    agree_until: float | None = None  #: where the paths of different steps part: time until which they agree [s]
    time_until_then: float | None = None  #: error in time up to `agree_until`
    spread_after: dict[str, float] = field(default_factory=dict)  #: afterwards: by body, change of its mean position by the step
    bodies: dict[str, BodyError] = field(default_factory=dict)  #: by name
    energies: Energies | None = None  #: errors in time at the last comparison, energy minus exact energy [J]
    companions: list[str] = field(default_factory=list)  #: how the errors were estimated, a sentence each
    notes: list[str] = field(default_factory=list)  #: reasons for caution, sentences
    wall_seconds: float = 0.0  #: of the companions, without compile time [s]; not in the run's

    def __repr__(self) -> str:
        known = [f"{kind} {percent(getattr(self, kind))} %" for kind in ERROR_KINDS if getattr(self, kind) is not None]
        return f"ErrorEstimate({', '.join(known) or 'nothing known'}; relative to an excursion of {self.excursion:.4g} m)"


@dataclass
class RunReport:
    """Result of a run."""

    status: str = "ok"  #: "ok", "degraded" or "failed"
    problems: list[str] = field(default_factory=list)  #: sentences; those that begin with "note:" or "warning:" keep it "ok"
    steps: int = 0  #: steps of dt taken
    sim_seconds: float = 0.0  #: simulated time [s]
    wall_seconds: float = 0.0  #: without compile time [s]
    compile_seconds: float = 0.0  #: spent starting Taichi and compiling kernels [s]
    interrupted: bool = False  #: `stop`, or a signal of the command line, ended the run early
    step_reports: list[StepReport] = field(default_factory=list)  #: one a step; of explicit runs one a frame
    dt: float | None = None  #: of its steps [s]
    dt_requested: float | None = None  #: that the simulator had, where the run changed it to fit the frames [s]
    trial_seconds: float = 0.0  #: wall time of the trials of a run with a tolerance, without compile time [s]
    error_estimate: ErrorEstimate | None = None  #: of a run with error=True or a tolerance
    quantities: dict[str, Quantity] = field(default_factory=dict)  #: of a run with `quantities`, at its end, by name

    def degrade(self, *problems: str) -> None:
        """Add problems to a run, which is then no longer "ok"."""
        self.problems += problems
        self.status = "degraded" if self.status == "ok" else self.status

    @contextmanager
    def failing(self, what: str) -> Iterator[None]:
        """Let an error of the block end the run as "failed". what: needs the memory that the system may refuse."""
        try:
            yield
        except (SimulationError, MemoryError) as failure:
            self.status = "failed"
            self.problems.append(str(no_memory(what, failure) if isinstance(failure, MemoryError) else failure))

    def to_dicts(self) -> list[dict]:
        """Return the rows of steps.csv, which pandas.DataFrame takes."""
        absent = dict.fromkeys(headings(self.step_reports), 0.0)
        return [report.to_dict() | absent | report.details for report in self.step_reports]

    def __repr__(self) -> str:
        """One line, and the first problems."""
        steps = f"{self.steps} steps" + (f" of {self.dt:.6g} s" if self.dt is not None else "")
        walls = f"{self.wall_seconds:.2f} s of wall time, {self.compile_seconds:.2f} s to compile"
        early = ", ended early" if self.interrupted else ""
        lines = [f"RunReport: {self.status}{early}, {self.sim_seconds:.6g} s in {steps}, {walls}"]
        lines += [f"  {text}" for text in self.problems[:PROBLEMS_SHOWN]]
        lines += [f"  and {len(self.problems) - PROBLEMS_SHOWN} more problems"] if len(self.problems) > PROBLEMS_SHOWN else []
        lines += [f"  {self.error_estimate!r}"] if self.error_estimate is not None else []
        lines += [f"  {name} = {quantity}" for name, quantity in self.quantities.items()]
        return "\n".join(lines)

    def _repr_html_(self) -> str:
        return run_html(self)
