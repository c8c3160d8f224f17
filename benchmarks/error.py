"""Estimated against true errors: twelve scenes of smooth motion, impacts and friction, and contact forces with references.

taisoft bench error [--only NAME ...] [--quick] [--budget SECONDS] [--keep DIR] [--out [FILE.json]]

Each scene runs once with error=True and error_mesh="refined" (`taisoft.estimation`), in single precision. True errors are
distances to other runs at the frames, over the largest excursion: in time to one with a sixteenth of the step in double
precision; of the solvers to one with the same step, tolerances of 1e-9 and 1e-8 of the contact laws, in double precision; in
space, at the nodes of the first mesh, to one on the mesh refined twice with the steps of the first, or of its companion if they
are explicit. An excursion is the largest distance of a node from its start. Ratio: estimate over truth. Companions: their wall
time over the run's, without that on the refined mesh. Forces: see `error_quantities`. Exit status: 0, or 1 if too many ratios are
outside their limits or a case could not be measured. --only force: contact forces alone.
"""

import math
import sys
from dataclasses import asdict, dataclass, field

import numpy as np

import taisoft as ts
from taisoft.display import percent
from taisoft.estimation.comparison import distance, largest_excursion, shared_nodes
from taisoft.records import ERROR_KINDS
from taisoft.scene.refine import refined

from .document import Limit, begin, table
from .error_cases import CASES, CONTACT, SMOOTH, Case, estimate_columns, path_of
from .error_quantities import FORCES, Force, ForceRow, force_limits, force_row, force_table
from .runner import without_warnings
from .suite import LEFT_OUT, chosen, runs_of, suite_options, suite_parser

STEPS_A_FRAME = 4  # of implicit runs: companions with four times the step then meet every frame
EXPLICIT_FPS = 1000.0  # frames per second of explicit runs [1/s]
TRUTH = 16  # the run's dt over that of the truth in time
EXACT = {"newton_tolerance": 1e-9, "contact_tolerance": 1e-8}
RANGES = {SMOOTH: (0.5, 2.0), CONTACT: (0.3, 5.0)}  # of estimate over truth in time
SPACE = (0.3, 5.0)
LEAST = 0.2  # of every estimate over truth
ENOUGH = 10 / 12  # fraction of the scenes within the ranges
QUICK = ("hanging beam", "incline")
EVERY: dict[str, Case | Force] = {case.name: case for case in CASES} | {str(force): force for force in FORCES}


@dataclass
class Row:
    """A scene's estimates, true errors [over the excursion] and costs. what: time, space, solver."""

    name: str
    kind: str
    integrator: str
    tets: int
    steps: int
    status: str
    order: float | None
    estimated: dict[str, float | None]
    true: dict[str, float]
    companions: float  # wall time of the companions over that of the run
    notes: list[str] = field(default_factory=list)

    def ratio(self, what: str) -> float:
        """Estimate over truth; nan if either is unknown or zero."""
        estimate, truth = self.estimated[what], self.true[what]
        return estimate / truth if estimate is not None and truth > 0.0 else math.nan


def fps_of(case: Case) -> float:
    """Frames per second."""
    return EXPLICIT_FPS if case.dt is None else 1.0 / (STEPS_A_FRAME * case.dt)


def step_of(case: Case) -> float:
    """The step [s] of a case."""
    if case.dt is not None:
        return case.dt
    with ts.Simulator(case.build(), dt=1e-9, integrator=case.integrator) as sim:
        return 0.9 * sim.stable_dt


def measured(case: Case) -> Row:
    """Run a scene, its companions and its truths."""
    dt, path = step_of(case), []
    with ts.Simulator(case.build(), dt=dt, integrator=case.integrator) as sim:
        warm = sim.run(case.seconds, fps=fps_of(case))  # compiled, so that times compare
        sim.reset()
        result = sim.run(case.seconds, fps=fps_of(case), error=True)
        sim.reset()
        with_mesh = sim.run(
            case.seconds,
            on_frame=lambda sim, *_: path.append(sim.positions()),
            fps=fps_of(case),
            error=True,
            error_mesh="refined",
        )
        dt, bodies = sim.dt, [[b.name, b.n_nodes] for b in sim.scene.bodies]
        tets = sum(b.mesh.n_tets for b in sim.scene.bodies)
    estimate, path = with_mesh.error_estimate, np.array(path)
    return Row(
        name=case.name,
        kind=case.kind,
        integrator=case.integrator,
        tets=tets,
        steps=warm.steps,
        status=with_mesh.status,
        order=estimate.order,
        estimated={what: getattr(estimate, what) for what in ERROR_KINDS},
        true=true_errors(case, dt, path, bodies),
        companions=result.error_estimate.wall_seconds / result.wall_seconds,
        notes=estimate.notes,
    )


def true_errors(case: Case, dt: float, path: np.ndarray, bodies: list) -> dict[str, float]:
    """True errors of a path (k,n,3) [m] over the excursion of the run with the smallest steps."""
    explicit = case.dt is None
    exact = {} if explicit else {"newton_tolerance": EXACT["newton_tolerance"]}
    if case.kind == CONTACT:
        exact["contact_tolerance"] = EXACT["contact_tolerance"]
    run = {"integrator": case.integrator, "seconds": case.seconds, "fps": fps_of(case)}
    truth, _ = path_of(case.build(), dt / TRUTH, precision="f64", **run, **exact)
    solved, _ = path_of(case.build(), dt, precision="f64", **run, **exact)
    fine, fine_bodies = path_of(refined(refined(case.build())), dt / 4 if explicit else dt, **run)
    excursion = largest_excursion(truth)
    own, theirs = shared_nodes(path[0], bodies, fine[0], fine_bodies)
    k = min(len(one) for one in (path, truth, solved, fine))  # a failed run is shorter
    return {
        "time": distance(path[:k], truth[:k], excursion).max,
        "space": distance(path[:k, own], fine[:k, theirs], excursion).max,
        "solver": distance(path[:k], solved[:k], excursion).max,
    }


def row_table(rows: list[Row]) -> str:
    """A row per scene: estimate, truth and ratio of each kind of error."""

    columns = (
        ("<scene", lambda r: r.name),
        ("<integrator", lambda r: r.integrator),
        ("tets", lambda r: f"{r.tets:,}"),
        ("steps", lambda r: f"{r.steps:,}"),
        *estimate_columns("time", "%", percent),
        ("order", lambda r: "-" if r.order is None else f"{r.order:.2f}"),
        *estimate_columns("space", "%", percent),
        *estimate_columns("solver", "%", percent),
        ("companions / run", lambda r: f"{r.companions:.2g}"),
    )
    return table(rows, columns, [f"{row.name}: {note}" for row in rows for note in row.notes])


def find_limits(rows: list[Row]) -> list[Limit]:
    """How many scenes are within the ranges, and the smallest ratio of all."""

    def within(what: str, chosen: list[Row], low: float, high: float) -> Limit:
        inside = sum(low <= row.ratio(what) <= high for row in chosen)
        name = "/".join(sorted({row.kind for row in chosen}))
        return Limit(f"{what}, {name}: fraction within {low:g} to {high:g}", inside / len(chosen), ENOUGH, at_least=True)

    found = []
    for kind, (low, high) in RANGES.items():
        if chosen := [row for row in rows if row.kind == kind]:
            found.append(within("time", chosen, low, high))
    found.append(within("space", rows, *SPACE))
    ratios = [ratio for row in rows for what in ("time", "space") if not math.isnan(ratio := row.ratio(what))]
    return [*found, Limit("smallest estimate over truth, time and space", min(ratios, default=math.nan), LEAST, at_least=True)]


def answer(request: dict) -> dict:
    """In a child: the row of a scene or a force."""
    case = EVERY[request["name"]]
    with without_warnings():
        return asdict(measured(case) if isinstance(case, Case) else force_row(case))


def main(argv: list[str] | None = None) -> int:
    """Measure and print. Raises OutputError if a file cannot be written."""
    parser = suite_parser("error", __doc__, f"only {' and '.join(QUICK)}")
    options = suite_options(parser, argv, answer, arch=False)
    requests = chosen(parser, options.only, {name: {"name": name} for name in (QUICK if options.quick else EVERY)})
    document, numbers = begin("Estimated against true errors", options.arch, "f32")
    with runs_of("error", options, "error*.py", "reference_cases/record.py", "reference_cases/pressing.py") as runs:
        found = [one for one in runs.records(requests, lambda _: "measured") if LEFT_OUT not in one]
    rows = [Row(**one) for one in found if "quantity" not in one]
    forces = [ForceRow(**one) for one in found if "quantity" in one]
    if rows:
        document.add(row_table(rows))
    if forces:
        document.add(f"## Contact forces, f64\n\n{force_table(forces)}")
    limits = [*(find_limits(rows) if rows else ()), *(force_limits(forces) if forces else ())]
    return runs.finish(document, options, numbers | {"precision": "f32", "rows": rows, "forces": forces}, limits)


if __name__ == "__main__":
    sys.exit(main())
