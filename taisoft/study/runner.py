"""Run a study: plan it, execute the missing runs, and compare each with its reference. No Taichi here: every run is a process."""

from collections.abc import Callable
from dataclasses import asdict, dataclass, field

from taisoft.errors import SceneError, SimulationError
from taisoft.estimation.comparison import Error
from taisoft.machine import summarise, thread_count, usable_cores
from taisoft.many.places import BUDGET_SPENT, CUT_BY_BUDGET, LocalPlace, Place, carry_out
from taisoft.many.store import Store, digest
from taisoft.study import Request, describe, mesh_name
from taisoft.study.accuracy import Reference, Row, error_in_space, finest_own_error, make_reference, row_of
from taisoft.study.results import Study

CHILD = ("-m", "taisoft.cli.study")


@dataclass(frozen=True)
class Task:
    """One run: steps per frame of a setting; timed, or of a reference."""

    setting: dict
    steps: int
    timed: bool

    def __str__(self) -> str:
        return ("" if self.timed else "reference ") + describe(self.setting)


def tasks_of(plan: dict) -> tuple[list[Task], list[Task]]:
    """Return the tasks: for each reference its fine run, then its coarse run; and one for each case that is not refused."""
    frame = plan["frame"]
    references = []
    for reference in plan["references"]:
        for steps in (reference["steps"], reference["steps"] // 2):
            references.append(Task(reference["setting"] | {"dt": frame / steps}, steps, timed=False))
    accepted = [case["setting"] for case in plan["cases"] if not case["refused"]]
    return references, [Task(setting, steps_in(frame, setting["dt"]), timed=True) for setting in accepted]


def steps_in(frame: float, dt: float) -> int:
    """Return the number of steps of dt in a frame, which dt divides."""
    return max(1, round(frame / dt))


@dataclass(frozen=True)
class Outcome:
    """Outcome of a task: a record; without one the status, "failed" or "left out", and the reason."""

    task: Task
    record: dict | None
    status: str = ""
    reason: str = ""


@dataclass
class Runner:
    """Plans and executes a study. places: where runs execute; machines: their descriptions; report: prints a line of progress."""

    request: Request
    places: list[Place]
    machines: list[dict]
    stop_requested: Callable[[], bool]
    seconds_left: Callable[[], float]
    report: Callable[[str], None]
    store: Store = field(default_factory=Store)
    planner: Place = field(default_factory=lambda: LocalPlace(usable_cores(), CHILD))

    def plan(self) -> dict | None:
        """Plan in a child process on this machine, which loads the scene; its time does not count towards the budget.

        Return None if interrupted. Raises SceneError if the scene cannot be studied.
        """
        answers: dict[str, dict] = {}
        requests = [("plan", self._request("plan") | {"request": asdict(self.request)})]
        if carry_out(requests, [self.planner], answers.__setitem__, stop_requested=self.stop_requested):
            return None
        found = answers["plan"]
        if "answer" not in found:
            raise SceneError(found.get("error") or f"the scene {self.request.scene}: {found['crash']}")
        plan = found["answer"]
        if all(case["refused"] for case in plan["cases"]):
            reasons = "; ".join(dict.fromkeys(case["refused"] for case in plan["cases"]))
            raise SceneError(f"no combination of the grid can be run: {reasons}")
        return plan

    def run(self, plan: dict) -> Study:
        """Return the study of a plan. Raises OutputError if a finished run cannot be saved."""
        study = Study(self.request, plan, notes=list(plan["notes"]), machines=self.machines, workers=len(self.places))
        study.kept = self.store.folder is not None
        references, settings = tasks_of(plan)
        keys = [self.key(plan, task) for task in references + settings]
        found = self._carry_out(plan, dict(zip(keys, references + settings)))
        outcomes = [found[key] for key in keys]
        left = [one.reason for one in found.values() if one.status == "left out"]
        study.ended = "; ".join(dict.fromkeys(BUDGET_SPENT if why == CUT_BY_BUDGET else why for why in left))
        study.cut = [str(one.task) for one in outcomes if one.reason == CUT_BY_BUDGET]
        study.notes += self.store.damaged
        made = _add_references(study, outcomes[: len(references)])
        _add_rows(study, outcomes[len(references) :], made)
        _note_differences(study, [one.record for one in found.values() if one.record is not None])
        return study

    def _request(self, action: str) -> dict:
        return {"action": action, "scene": self.request.scene, "allow_outside": self.request.allow_outside}

    def _task(self, plan: dict, task: Task) -> dict:
        """Return the task as `measure` takes it."""
        repeats = self.request.repeats if task.timed else 0
        shared = {key: plan[key] for key in ("fixed", "frame", "frames")}
        return {"setting": task.setting, "steps": task.steps, "repeats": repeats} | shared

    def key(self, plan: dict, task: Task) -> str:
        machines = sorted(self.machines, key=lambda one: one["name"])  # a cluster lists them in any order
        hardware = [machines, thread_count(len(self.places[0].cores))]
        scene = [plan["scenes"][mesh_name(task.setting)], plan["sources"]]
        return digest([self._task(plan, task), scene, plan["code"], hardware])[:32]

    def _carry_out(self, plan: dict, tasks: dict[str, Task]) -> dict[str, Outcome]:
        """Return the outcomes by key, those of finished runs from the store."""
        found = {key: Outcome(task, record) for key, task in tasks.items() if (record := self.store.read(key)) is not None}
        before = f", {len(found)} of them already done" if found else ""
        self.report(f"{len(tasks)} runs of {plan['frame'] * plan['frames']:g} s{before}")

        def done(key: str, answer: dict) -> None:
            if "answer" in answer:
                found[key] = Outcome(tasks[key], self.store.write(key, answer["answer"]))
            else:
                found[key] = Outcome(tasks[key], None, "failed", answer.get("error") or answer["crash"])
            self.report(f"{len(found)} of {len(tasks)}: {tasks[key]}: {found[key].reason or _summary(found[key].record)}")

        common = self._request("run") | {"sources": plan["sources"], "code": plan["code"]}
        requests = []
        for key, task in tasks.items():
            if key not in found:
                scene = plan["scenes"][mesh_name(task.setting)]
                requests.append((key, common | {"digest": scene, "task": self._task(plan, task)}))
        unfinished = carry_out(requests, self.places, done, seconds_left=self.seconds_left, stop_requested=self.stop_requested)
        return found | {key: Outcome(tasks[key], None, "left out", why) for key, why in unfinished.items()}


def _add_references(study: Study, outcomes: list[Outcome]) -> list[Reference | None]:
    """Return each planned reference, or None, with a note, if it is not available."""
    found: list[Reference | None] = []
    for planned, fine, coarse in zip(study.plan["references"], outcomes[::2], outcomes[1::2]):
        try:
            for one in (fine, coarse):
                if one.record is None:
                    raise SimulationError(f"{one.task} is missing: {one.reason}")
            made = make_reference(fine.record, coarse.record, planned["kind"], planned["order_in_time"])
            study.references.append(made)
            study.notes += [f"{fine.task}: {text}" for text in dict.fromkeys(made.problems)]
            found.append(made)
        except SimulationError as error:
            found.append(None)
            study.notes.append(f"{error}; runs that need it have no error")
    if study.plan["space"] is not None:
        study.space = found[study.plan["space"]]
    return found


def _add_rows(study: Study, outcomes: list[Outcome], references: list[Reference | None]) -> None:
    """Add one row per combination, in the order of the grid."""
    runs = iter(outcomes)
    space_error = _space_reference_error(study)
    for case in study.plan["cases"]:
        if case["refused"]:
            study.rows.append(Row(case["setting"], "refused", case["refused"]))
            continue
        run = next(runs)
        if run.record is None:
            study.rows.append(Row(run.task.setting, run.status, run.reason))
            continue
        study.versions = study.versions or run.record["versions"]
        row = row_of(run.record, _own_reference(study.plan, references, run.record))
        row.by_space = study.plan["space"] is not None
        if space_error is not None and run.record["path"] is not None:
            row.in_space_sure = space_error
            try:
                row.in_space = error_in_space(run.record["path"], run.record["bodies"], study.space)
            except SimulationError as error:
                study.notes.append(f"{run.task}: {error}")
        study.rows.append(row)


def _space_reference_error(study: Study) -> Error | None:
    """Return the own error of the reference in space, and note how it was estimated; None, with a note, if unknown."""
    if study.space is None:
        return None
    others = [r for r in study.references if mesh_name(r.setting) != mesh_name(study.space.setting)]
    try:
        error, study.space_error_source = finest_own_error(study.space, others)
        return error
    except SimulationError as error:
        study.notes.append(f"the finest mesh's own error is unknown, so errors in space are not reported: {error}")
        return None


def _own_reference(plan: dict, references: list[Reference | None], record: dict) -> Reference | None:
    """Return the reference on the record's mesh that solves the same equations, or None."""
    mesh = mesh_name(record["task"]["setting"])
    kinds = ("", "explicit" if record.get("explicit", False) else "implicit")
    same = (mesh_name(planned["setting"]) == mesh and planned["kind"] in kinds for planned in plan["references"])
    return next((reference for reference, fits in zip(references, same) if fits), None)


def _note_differences(study: Study, records: list[dict]) -> None:
    """Note the runs' warnings, and that times come from different machines."""
    names = {record["machine"]["name"] for record in records if record["seconds"]}
    if len(names) > 1:
        listed = ", ".join(sorted(names))
        study.notes.append(f"times come from {len(names)} machines ({listed}) and are comparable only if these are alike")
    study.notes += list(dict.fromkeys(f"warning: {text}" for record in records for text in record["warnings"]))


def _summary(record: dict) -> str:
    if record["status"] == "failed":
        return f"failed: {record['problems'][-1]}"
    seconds = record["seconds"]
    return record["status"] + (f", {summarise(seconds).median:.3g} s per simulated second" if seconds else "")
