"""Run a study: plan it, execute the missing runs, and collect the results. No Taichi here: every run is a process."""

from collections.abc import Callable
from dataclasses import dataclass, field

from taisoft.errors import SceneError, SimulationError
from taisoft.study.accuracy import Error, Reference, Row, error_in_space, finest_own_error, make_reference, row_of
from taisoft.study.grid import mesh_name, tasks_of
from taisoft.study.results import Request, Study, describe
from taisoft.study.store import NoStore, Store, digest, unpack
from taisoft.study.workers import BUDGET_SPENT, CUT_BY_BUDGET, LocalPlace, Place, carry_out
from taisoft.timing import summarise, usable_cores

EXPLICIT_KINDS = {True: "explicit", False: "implicit"}


@dataclass(frozen=True)
class Outcome:
    """Outcome of a task: a record, or why there is none: it failed without one, or was left out."""

    task: dict
    record: dict | None
    failed: str
    left_out: str


@dataclass
class Runner:
    """Plans and executes a study. places: where runs execute; machines: their descriptions; report: prints a line of progress."""

    request: Request
    places: list[Place]
    machines: list[dict]
    stop_requested: Callable[[], bool]
    seconds_left: Callable[[], float]
    report: Callable[[str], None]
    store: Store | NoStore = field(default_factory=NoStore)
    planner: Place = field(default_factory=lambda: LocalPlace(usable_cores()))

    def run(self, plan: dict) -> Study:
        """Return the study of a plan. Raises OutputError if a finished run cannot be saved."""
        study = Study(self.request, plan, notes=list(plan["notes"]), machines=self.machines, workers=len(self.places))
        study.kept = isinstance(self.store, Store)
        references, settings = tasks_of(plan)
        tasks = [*references, *settings]
        keys = [self._key(plan, task) for task in tasks]
        records, failed, unfinished = self._carry_out(plan, dict(zip(keys, tasks)))
        study.ended = "; ".join(dict.fromkeys(BUDGET_SPENT if why == CUT_BY_BUDGET else why for why in unfinished.values()))
        study.cut = [describe(task) for key, task in zip(keys, tasks) if unfinished.get(key) == CUT_BY_BUDGET]
        study.notes += self.store.damaged
        outcomes = [Outcome(task, records.get(k), failed.get(k, ""), unfinished.get(k, "")) for k, task in zip(keys, tasks)]
        made = self._references(study, outcomes[: len(references)])
        self._rows(study, outcomes[len(references) :], made)
        _note_differences(study, records)
        return study

    def plan(self) -> dict | None:
        """Plan in a child process on this machine, which loads the scene; its time does not count towards the budget.

        Return None if interrupted. Raises SceneError if the scene cannot be studied.
        """
        answers: list[dict] = []
        request = self._request("plan") | {"request": self.request.for_plan()}

        def done(_: str, answer: dict) -> None:
            answers.append(answer)

        unfinished = carry_out(
            [("plan", request)], [self.planner], done, seconds_left=lambda: 1.0, stop_requested=self.stop_requested
        )
        if unfinished:
            return None
        if "answer" not in answers[0]:
            raise SceneError(answers[0].get("error") or f"the scene {self.request.scene}: {answers[0]['crash']}")
        plan = answers[0]["answer"]
        if all(case["refused"] for case in plan["cases"]):
            reasons = "; ".join(dict.fromkeys(case["refused"] for case in plan["cases"]))
            raise SceneError(f"no combination of the grid can be run: {reasons}")
        return plan

    def _request(self, do: str) -> dict:
        return {"do": do, "scene": self.request.scene, "allow_outside": self.request.allow_outside}

    def _task(self, plan: dict, task: dict) -> dict:
        """Return the task as `measure` takes it."""
        shared = {"fixed": plan["fixed"], "frame": plan["frame"], "frames": plan["frames"]}
        repeats = self.request.repeats if task["timed"] else 0
        return {"setting": task["setting"], "steps": task["steps"], "repeats": repeats} | shared

    def _key(self, plan: dict, task: dict) -> str:
        machines = sorted(self.machines, key=lambda one: one["name"])  # a cluster lists them in any order
        hardware = [machines, len(self.places[0].cores)]
        scene = [plan["scenes"][mesh_name(task["setting"])], plan["sources"]]
        return digest([self._task(plan, task), scene, plan["code"], hardware])[:32]

    def _carry_out(self, plan: dict, tasks: dict[str, dict]) -> tuple[dict, dict, dict]:
        """Return by key: records, old ones included; errors of runs without a record; reasons of unfinished runs."""
        records, failed = {}, {}
        for key in tasks:
            if (record := self.store.read(key)) is not None:
                records[key] = record
        before = f", {len(records)} of them already done" if records else ""
        self.report(f"{len(tasks)} runs of {plan['frame'] * plan['frames']:g} s{before}")
        missing = [key for key in tasks if key not in records]

        def done(key: str, answer: dict) -> None:
            if "answer" in answer:
                records[key] = self.store.write(key, answer["answer"])
            else:
                failed[key] = answer.get("error") or answer["crash"]
            result = failed.get(key) or _summary(records[key])
            self.report(f"{len(records) + len(failed)} of {len(tasks)}: {describe(tasks[key])}: {result}")

        common = self._request("run") | {"sources": plan["sources"], "code": plan["code"]}
        requests = []
        for key in missing:
            scene = plan["scenes"][mesh_name(tasks[key]["setting"])]
            requests.append((key, common | {"digest": scene, "task": self._task(plan, tasks[key])}))
        unfinished = carry_out(requests, self.places, done, seconds_left=self.seconds_left, stop_requested=self.stop_requested)
        return records, failed, unfinished

    def _references(self, study: Study, outcomes: list[Outcome]) -> list[Reference | None]:
        """Return each planned reference, or None, with a note, if it is not available."""
        found: list[Reference | None] = []
        for planned, fine, coarse in zip(study.plan["references"], outcomes[::2], outcomes[1::2]):
            try:
                for one in (fine, coarse):
                    if one.record is None:
                        raise SimulationError(f"{describe(one.task)} is missing: {one.failed or one.left_out}")
                made = make_reference(fine.record, coarse.record, planned["kind"], planned["order_in_time"])
                study.references.append(made)
                study.notes += [f"{describe(fine.task)}: {text}" for text in dict.fromkeys(made.problems)]
                found.append(made)
            except SimulationError as error:
                found.append(None)
                study.notes.append(f"{error}; runs that need it have no error")
        if study.plan["space"] is not None:
            study.space = found[study.plan["space"]]
        return found

    def _rows(self, study: Study, outcomes: list[Outcome], references: list[Reference | None]) -> None:
        """Add one row per combination, in the order of the grid."""
        runs = iter(outcomes)
        space_error, study.space_error_source = _space_reference_error(study)
        for case in study.plan["cases"]:
            if case["refused"]:
                study.rows.append(Row(case["setting"], "refused", case["refused"]))
                continue
            run = next(runs)
            record = run.record
            if record is None:
                study.rows.append(Row(run.task["setting"], "failed" if run.failed else "left out", run.failed or run.left_out))
                continue
            study.versions = study.versions or record["versions"]
            row = row_of(record, _own_reference(study.plan, references, record))
            row.by_space = study.plan["space"] is not None
            if study.space is not None and space_error is not None and record["path"] is not None:
                row.in_space, row.in_space_sure = _in_space(study, record), space_error
            study.rows.append(row)


def _in_space(study: Study, record: dict) -> Error | None:
    """Return the record's error in space; None, with a note, if the two meshes cannot be compared."""
    try:
        return error_in_space(unpack(record["path"]), record["bodies"], study.space)
    except SimulationError as error:
        study.notes.append(f"{describe(record['task'])}: {error}")
        return None


def _space_reference_error(study: Study) -> tuple[Error | None, str]:
    """Return the own error of the reference in space and how it was estimated; None, with a note, if unknown."""
    if study.space is None:
        return None, ""
    mesh = [study.space.setting[key] for key in ("refine", "order")]
    others = [r for r in study.references if [r.setting[key] for key in ("refine", "order")] != mesh]
    try:
        return finest_own_error(study.space, others)
    except SimulationError as error:
        study.notes.append(f"the finest mesh's own error is unknown, so errors in space are not reported: {error}")
        return None, ""


def _own_reference(plan: dict, references: list[Reference | None], record: dict) -> Reference | None:
    """Return the reference on the record's mesh that solves the same equations, or None."""
    setting, kind = record["task"]["setting"], EXPLICIT_KINDS[record.get("explicit", False)]
    for planned, reference in zip(plan["references"], references):
        same = all(planned["setting"][key] == setting[key] for key in ("refine", "order"))
        if same and planned["kind"] in ("", kind):
            return reference
    return None


def _note_differences(study: Study, records: dict) -> None:
    """Note the runs' warnings, and that times come from different machines."""
    names = {record["machine"]["name"] for record in records.values() if record["seconds"]}
    if len(names) > 1:
        listed = ", ".join(sorted(names))
        study.notes.append(f"times come from {len(names)} machines ({listed}) and are comparable only if these are alike")
    study.notes += list(dict.fromkeys(f"warning: {text}" for record in records.values() for text in record["warnings"]))


def _summary(record: dict) -> str:
    if record["status"] == "failed":
        return f"failed: {record['problems'][-1]}"
    seconds = record["seconds"]
    return record["status"] + (f", {summarise(seconds).median:.3g} s per simulated second" if seconds else "")
