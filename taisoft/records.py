"""Reports of steps and runs: plain records, without Taichi."""

from dataclasses import dataclass, field


@dataclass
class Energies:
    """Energies of a state [J]. elastic is 0 at rest; gravity = -sum m g.x and loads = -sum f.x are 0 at the origin."""

    kinetic: float
    elastic: float
    gravity: float
    loads: float = 0.0  # of forces, tractions and the present force of a drag

    @property
    def total(self) -> float:
        """Kinetic + elastic + gravity [J], without loads."""
        return self.kinetic + self.elastic + self.gravity


@dataclass
class StepReport:
    """Result of one step. A batch of explicit sub-steps gives one report: extremes over its sub-steps, the rest at its end."""

    time: float  # at the end of the step [s]
    steps: int = 1  # steps of dt that this report covers
    substeps: int = 1  # of an implicit step; above 1 if it did not converge or bodies would have passed through each other
    # iterations include those of abandoned attempts; those on a subset of nodes count by its fraction, see `dynamics.elimination`
    newton_iterations: int = 0
    linear_iterations: int = 0
    contact_iterations: int = 0
    residual: float = 0.0  # relative residual of the implicit equations, 0 for explicit steps
    contact_residual: float = 0.0
    n_contacts: int = 0
    dropped_contacts: int = 0
    max_penetration: float = 0.0  # [m], of the detected contacts and of crossing triangles: how far these must separate
    crossings: int = 0  # pairs of surface triangles that cross by more than 0.1 % of the finer side's mean surface edge
    deep: int = 0  # 1 if a penetration exceeds 2 % of the finer side's mean surface edge, else 0
    min_volume_ratio: float = 1.0  # smallest J = det F
    n_inverted: int = 0  # tets with J <= 0
    kinetic: float = 0.0  # [J]
    elastic: float = 0.0  # [J]
    gravity: float = 0.0  # [J]
    loads: float = 0.0  # [J] of dead loads: -sum f.x
    converged: bool = True
    problems: list[str] = field(default_factory=list)


@dataclass
class RunReport:
    """Result of a run. status: ok | degraded | failed; problems says why it is not ok."""

    status: str = "ok"
    problems: list[str] = field(default_factory=list)
    steps: int = 0
    sim_seconds: float = 0.0
    wall_seconds: float = 0.0  # without compile time
    compile_seconds: float = 0.0
    interrupted: bool = False  # a signal ended the run early
    step_reports: list[StepReport] = field(default_factory=list)
    dt: float | None = None  # of its steps [s]
    dt_requested: float | None = None  # the simulator's dt before the run changed it to fit the frames [s]
