"""What a study is asked for and what it found."""

from dataclasses import asdict, dataclass, field

from taisoft.study import pareto
from taisoft.study.accuracy import Reference, Row
from taisoft.study.grid import AXES


@dataclass
class Request:
    """What a study is asked for. axes: name -> values, of those given; by: the error that counts, "max" or "rms"."""

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

    def of_plan(self) -> dict:
        """What the plan depends on."""
        keys = ("axes", "seconds", "reference_dt", "reference_integrator", "reference_refine")
        return {key: getattr(self, key) for key in keys}


@dataclass
class Study:
    """What a study found.

    rows: one a combination; notes: sentences that a reader must know; ended: why it is not complete; cut: the runs that the end
    of the budget stopped.
    """

    request: Request
    plan: dict
    rows: list[Row] = field(default_factory=list)
    references: list[Reference] = field(default_factory=list)
    space: Reference | None = None
    space_told_by: str = ""
    notes: list[str] = field(default_factory=list)
    machines: list[dict] = field(default_factory=list)
    workers: int = 1  # runs at a time
    versions: dict = field(default_factory=dict)
    ended: str = ""
    cut: list[str] = field(default_factory=list)
    kept: bool = False  # whether finished runs are kept, so that a study can go on

    def judged(self) -> list[Row]:
        """The rows that have a time and an error."""
        return [row for row in self.rows if row.seconds and row.claimed(self.request.by) is not None]

    def points(self) -> list[tuple[float, float]]:
        """(time, error) of the judged rows."""
        return [(row.timing.median, row.claimed(self.request.by)) for row in self.judged()]

    def front(self) -> list[Row]:
        """The rows that no other is better than in both, by rising time."""
        return [self.judged()[k] for k in pareto.front(self.points())]

    def cheapest(self) -> Row | None:
        """The fastest row within the tolerance."""
        k = pareto.cheapest(self.points(), self.request.tolerance)
        return None if k is None else self.judged()[k]

    def nearest(self) -> Row | None:
        """The row of least error."""
        k = pareto.nearest(self.points())
        return None if k is None else self.judged()[k]


def describe(task: dict) -> str:
    """A setting in short: what is always told, and of the rest what is not the default."""
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
    """All of a study's numbers for study.json."""
    front = study.front()
    rows = [
        asdict(row) | {
            "seconds_per_simulated_second": row.timing, "error": row.claimed(study.request.by), "on_front": row in front,
            "below_reference": below_reference(row, study.request.by),
        }
        for row in study.rows
    ]  # fmt: skip
    references = [
        {
            "setting": r.setting, "steps": r.steps, "excursion": r.excursion, "own_error": r.own, "kind": r.kind,
            "order_in_time": r.order_in_time, "problems": r.problems, "in_space": r is study.space,
        }
        for r in study.references
    ]  # fmt: skip
    cheapest, nearest = study.cheapest(), study.nearest()
    return {
        "request": asdict(study.request), "frame": study.plan["frame"], "frames": study.plan["frames"], "rows": rows,
        "references": references, "cheapest": cheapest and cheapest.setting, "nearest": nearest and nearest.setting,
        "notes": study.notes, "ended": study.ended, "machines": study.machines, "workers": study.workers,
        "versions": study.versions, "scene_digest": study.plan["scenes"]["refine 0"], "code_digest": study.plan["code"],
    }  # fmt: skip


def below_reference(row: Row, by: str) -> bool:
    """Whether the row's error is below what its reference is good to."""
    found = row.error(by)
    return found is not None and found[0] < found[1]
