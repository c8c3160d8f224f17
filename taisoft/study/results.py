"""The request for a study and its results."""

from dataclasses import asdict, dataclass, field

from taisoft.study import pareto
from taisoft.study.accuracy import Reference, Row
from taisoft.study.grid import AXES


@dataclass
class Request:
    """Request for a study. axes: name -> values, only the axes given; by: the error used, "max" or "rms"."""

    scene: str
    axes: dict[str, list] = field(default_factory=dict)
    allow_outside: bool = False
    seconds: float | None = None
    reference_dt: float | None = None
    reference_integrator: str | None = None
    reference_refine: int = 0
    repeats: int = 3
    tolerance: float = 0.01
    by: str = "max"

    def for_plan(self) -> dict:
        """Return what the plan depends on."""
        keys = ("axes", "seconds", "reference_dt", "reference_integrator", "reference_refine")
        return {key: getattr(self, key) for key in keys}


@dataclass
class Study:
    """Results of a study.

    rows: one per combination; notes: sentences for the reader; ended: why it is incomplete; cut: runs that were stopped when
    the budget was spent.
    """

    request: Request
    plan: dict
    rows: list[Row] = field(default_factory=list)
    references: list[Reference] = field(default_factory=list)
    space: Reference | None = None
    space_error_source: str = ""  # how the error of `space` was estimated
    notes: list[str] = field(default_factory=list)
    machines: list[dict] = field(default_factory=list)
    workers: int = 1  # runs at a time
    versions: dict = field(default_factory=dict)
    ended: str = ""
    cut: list[str] = field(default_factory=list)
    kept: bool = False  # whether finished runs are kept, so that a study can continue

    def comparable_rows(self) -> list[Row]:
        """Return the rows that have a time and an error."""
        return [row for row in self.rows if row.seconds and row.resolved_error(self.request.by) is not None]

    def points(self) -> list[tuple[float, float]]:
        """Return (time, error) of the comparable rows."""
        return [(row.timing.median, row.resolved_error(self.request.by)) for row in self.comparable_rows()]

    def front(self) -> list[Row]:
        """Return the rows of the Pareto front, by rising time."""
        return [self.comparable_rows()[k] for k in pareto.front(self.points())]

    def cheapest(self) -> Row | None:
        """Return the fastest row within the tolerance, or None."""
        k = pareto.cheapest(self.points(), self.request.tolerance)
        return None if k is None else self.comparable_rows()[k]

    def nearest(self) -> Row | None:
        """Return the row of least error, or None."""
        k = pareto.nearest(self.points())
        return None if k is None else self.comparable_rows()[k]


def describe(task: dict) -> str:
    """Return a short description of a setting: integrator, dt, precision, and the rest if not default."""
    setting = task["setting"]
    words = [setting["integrator"], f"dt = {setting['dt']:.4g} s", setting["precision"]]
    if setting["order"] is not None:
        words.append(f"order {setting['order']}")
    if setting["refine"]:
        words.append(f"refine {setting['refine']}")
    defaults = {"contact_solver": "auto", "arch": "cpu"}
    rest = [key for key in AXES if key not in ("dt", "integrator", "precision", "order", "refine")]
    words += [f"{key} {setting[key]}" for key in rest if setting[key] != defaults.get(key)]
    return ("" if task.get("timed", True) else "reference ") + ", ".join(words)


def plain(study: Study) -> dict:
    """Return a study as plain data for study.json."""
    front = study.front()
    rows = [
        asdict(row)
        | {
            "seconds_per_simulated_second": row.timing,
            "error": row.resolved_error(study.request.by),
            "on_front": row in front,
            "below_reference": below_reference(row, study.request.by),
        }
        for row in study.rows
    ]
    references = [
        {
            "setting": r.setting,
            "steps": r.steps,
            "excursion": r.excursion,
            "own_error": r.own_error,
            "kind": r.kind,
            "order_in_time": r.order_in_time,
            "problems": r.problems,
            "in_space": r is study.space,
        }
        for r in study.references
    ]
    cheapest, nearest = study.cheapest(), study.nearest()
    return {
        "request": asdict(study.request),
        "frame": study.plan["frame"],
        "frames": study.plan["frames"],
        "rows": rows,
        "references": references,
        "cheapest": cheapest and cheapest.setting,
        "nearest": nearest and nearest.setting,
        "notes": study.notes,
        "ended": study.ended,
        "machines": study.machines,
        "workers": study.workers,
        "versions": study.versions,
        "scene_digest": study.plan["scenes"]["refine 0"],
        "code_digest": study.plan["code"],
    }


def below_reference(row: Row, by: str) -> bool:
    """Return whether the row's error is below its reference's own error."""
    pair = row.error(by)
    return pair is not None and pair[0] < pair[1]
