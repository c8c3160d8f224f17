"""All programs' settings on one work, in rounds, so that a slow minute of the machine affects all; and the fastest."""

from collections.abc import Callable, Iterable, Iterator
from dataclasses import asdict, dataclass, field
from datetime import datetime
from types import ModuleType

import numpy as np

from taisoft.errors import TaisoftError
from taisoft.machine import Timing, summarise
from taisoft.study.results import front

from ..programs.own import NAME as OWN
from ..programs.session import Setting
from ..runner import progress
from .evaluation import Verdict, evaluate
from .references import MODELS
from .scenes import Work

KEPT = ("rounds", "build_seconds", "unconverged", "failure", "date")  # attributes of a row that its record has unchanged
ROUND_SECONDS, ROUND_RUNS = 0.3, 10  # a round repeats a run until this wall time or this number is reached
ENOUGH_SECONDS, ENOUGH_BUILDING = 10.0, 20.0  # wall time of a run and of its building from which it is not repeated


@dataclass
class Row:
    """One setting of one program on one work. rounds: wall seconds per simulated second of every run."""

    work: Work
    setting: Setting
    rounds: list[list[float]] = field(default_factory=list)
    build_seconds: list[float] = field(default_factory=list)
    verdict: Verdict | None = None
    unconverged: int = 0
    failure: str = ""
    date: str = ""  # of its start

    def __str__(self) -> str:
        s = self.setting
        return f"{s.program}, {s.model}, {s}, {1e3 * s.dt:.3g} ms"

    @property
    def timing(self) -> Timing | None:
        """Timing of a simulated second [s]; None if no run ended."""
        runs = [seconds for one in self.rounds for seconds in one]
        return summarise(runs) if runs else None

    @property
    def stood(self) -> bool:
        """Whether it stood, with all steps converged."""
        return self.verdict is not None and self.verdict.stands and not self.unconverged

    @property
    def claimed(self) -> float:
        """Its error, at least the reference's uncertainty; nan without one."""
        known = self.verdict is not None and self.verdict.error is not None
        return max(self.verdict.error, self.verdict.good_to) if known else float("nan")

    def record(self) -> dict:
        """The row as plain data."""
        return {name: getattr(self, name) for name in KEPT} | {
            "work": self.work.key,
            "tets": self.work.tets,
            "setting": asdict(self.setting) | {"model": str(self.setting.model), "dt": self.setting.dt},
            "verdict": self.verdict and asdict(self.verdict),
            "seconds_per_simulated_second": self.timing and asdict(self.timing),
        }


def row_of(work: Work, record: dict) -> Row:
    """The row of a record."""
    numbers = {key: value for key, value in record["setting"].items() if key != "dt"}
    setting = Setting(**numbers | {"model": next(model for model in MODELS if str(model) == numbers["model"])})
    verdict = record["verdict"] and Verdict(**record["verdict"])
    return Row(work, setting, verdict=verdict, **{key: record[key] for key in KEPT})


def measure(work: Work, programs: Iterable[ModuleType], rounds: int, arch: str = "cpu") -> list[Row]:
    """Measure the rows of a work. A row that diverges or is refused records its failure and is skipped from then on."""
    adapters = {program.NAME: program for program in programs}
    date = datetime.now().isoformat(timespec="minutes")
    settings = [setting for program in adapters.values() for setting in program.settings(work, arch)]
    rows = [Row(work, setting, date=date) for setting in settings]
    for number in range(rounds):
        for row in rows:
            if row.failure or (row.rounds and is_expensive(row.rounds[0][0] * work.seconds, row.build_seconds[0])):
                continue
            progress(f"{work.key}, round {number + 1} of {rounds}: {row.setting.program} {row.setting}")
            positions = _round(row, adapters[row.setting.program])
            if positions is not None:
                row.verdict = evaluate(work, row.setting.model, positions)
    return rows


def is_expensive(seconds: float, build_seconds: float) -> bool:
    """Whether a run takes too long [s] to be repeated."""
    return seconds > ENOUGH_SECONDS or build_seconds > ENOUGH_BUILDING


def _round(row: Row, program: ModuleType) -> np.ndarray | None:
    """Run a row once more. The first run returns its positions; the row records a failure."""
    positions = None
    try:
        session = program.Run(row.work, row.setting)
        try:
            row.build_seconds.append(session.build_seconds)
            if row.verdict is None:
                positions, seconds = session.run(follow=True)
                row.unconverged = session.unconverged
                if is_expensive(seconds, session.build_seconds):
                    row.rounds.append([seconds / row.work.seconds])
                    return positions
            row.rounds.append(list(repeat_short(lambda: session.run(follow=False)[1] / row.work.seconds)))
        finally:
            session.close()
    except Exception as error:  # other programs raise exceptions of their own
        if program.NAME == OWN and not isinstance(error, TaisoftError):
            raise
        row.failure = str(error)
        return None
    return positions


def repeat_short(run: Callable[[], float]) -> Iterator[float]:
    """Repeat run() until ROUND_SECONDS or ROUND_RUNS is reached; yields its seconds."""
    total, count = 0.0, 0
    while count == 0 or (total < ROUND_SECONDS and count < ROUND_RUNS):
        seconds = run()
        total, count = total + seconds, count + 1
        yield seconds


def time_ratio(slow: Row, fast: Row) -> Timing | None:
    """Ratio of the times of `slow` and `fast` from the medians of each round; None without runs."""
    pairs = list(zip(slow.rounds, fast.rounds))
    return summarise(np.median(a) / np.median(b) for a, b in pairs) if pairs else None


def fastest_within(rows: list[Row], error: float) -> Row | None:
    """The fastest of these rows with at most this error."""
    timed = [row for row in rows if row.timing is not None]
    best = (timed[k] for k in front([(row.timing.median, row.claimed) for row in timed]))
    return next((row for row in best if row.claimed <= error), None)


def fastest_standing(rows: list[Row]) -> Row | None:
    """The fastest of these rows that stood."""
    stood = [row for row in rows if row.timing is not None and row.stood]
    return min(stood, key=lambda row: row.timing.median, default=None)
