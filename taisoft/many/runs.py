"""`run_many`: one function for many parameters, each run in a process, into one table."""

import inspect
import io
import json
import os
import signal
import sys
import threading
import time
from collections.abc import Callable, Iterable, Iterator, Mapping
from contextlib import ExitStack, closing, contextmanager
from functools import cache
from pathlib import Path

import numpy as np

from taisoft import processes
from taisoft.errors import OutputError, SceneError, value_text
from taisoft.files import write_bytes
from taisoft.machine import PACKAGES, THREADS, machine, thread_count, usable_cores, versions
from taisoft.many.cluster import cluster_places, connect
from taisoft.many.make import COLUMNS, Make, make_of
from taisoft.many.places import LocalPlace, Place, carry_out
from taisoft.many.results import Results, Row
from taisoft.many.store import Store, digest, digests
from taisoft.output.folder import FolderLock, check_free, make_folder
from taisoft.output.report import Bar, clock_text, json_text
from taisoft.scene import checks

CHILD = ("-m", "taisoft.many.make")
KIND, TABLE, REPORT = "taisoft many", "table.csv", "many.json"
FAILURES_SHOWN = 5  # while it runs


def run_many(
    make: Callable[..., Mapping],
    parameters: Iterable[Mapping],
    workers: int | None = None,
    cluster: str | None = None,
    out: str | Path | None = None,
    *,
    progress: bool = True,
) -> Results:
    """Call `make(**one)` for each of many parameters, in processes that share the cores, and return one table.

    make: a function at the top level of a module or script, which every process imports. It builds and runs one simulation and
    returns a mapping from names to numbers, texts, None or arrays; a `RunReport` among them sets the row's status and problems.
    parameters: mappings of its arguments: numbers, texts, booleans, None, and lists of them. workers: processes at a time
    (default: one for each core); each has as many threads as cores are left for it, or TAISOFT_THREADS. cluster: address of a
    Dask scheduler, whose workers take the place of processes here. out: folder for table.csv, many.json and a file for each
    finished row; rows finished there by the same source of `make` and the same taisoft are not run again. progress: shown on
    stderr.

    An exception or a process that ends is a row with status "failed", and the others go on; with `out`, such rows are tried
    again by the next call. Values do not depend on workers, threads, order or what else ran in a process. Ctrl-C keeps what is
    finished and raises KeyboardInterrupt. Raises SceneError for invalid arguments, OutputError if `out` cannot be used.
    """
    if processes.serving:
        rule = "in a script, call it under `if __name__ == '__main__':`, which they leave out"
        raise SceneError(f"run_many was called in one of its own processes: {rule}")
    function, given = make_of(make), _checked(make, parameters)
    workers = None if workers is None else checks.whole(workers, "workers", range(1, 1025))
    if workers is not None and cluster is not None:
        raise SceneError("workers are processes of this machine, and a cluster has its own: give one of them")
    with ExitStack() as stack:
        client = None if cluster is None else stack.enter_context(closing(connect(cluster, "cluster")))
        threads = thread_count(1) if os.environ.get(THREADS) else None
        many = Many(function, given, Store() if out is None else _store(Path(out), function, stack))
        there = (
            _places(workers, threads, len(many.waiting)) if client is None else cluster_places(client, CHILD, False, threads)[0]
        )
        many.run(there, progress, None if out is None else Path(out))
        return many.results()


def _checked(make: Callable, parameters: Iterable[Mapping]) -> list[dict]:
    """Return the parameters as plain data. Raises SceneError for the first that cannot be passed to make."""
    if isinstance(parameters, Mapping | str) or not isinstance(parameters, Iterable):
        raise SceneError("parameters must be a list of mappings, such as [{'young': 1e5}, {'young': 2e5}]")
    found, signature = [], inspect.signature(make)
    for k, one in enumerate(parameters):
        if not isinstance(one, Mapping):
            raise SceneError(f"parameters[{k}] must be a mapping from names of arguments to values, not {value_text(one)}")
        try:
            signature.bind(**one)
        except TypeError as error:
            raise SceneError(f"parameters[{k}] do not fit {make.__qualname__}{signature}: {error}") from None
        if own := [name for name in one if name in COLUMNS]:
            raise SceneError(f"parameters[{k}]: '{own[0]}' is a column of every table: give the argument another name")
        found.append({name: _plain(value, f"parameters[{k}]['{name}']") for name, value in one.items()})
    return found


def _plain(value, name: str):
    """Return a value as numbers, texts, booleans, None and lists. Raises SceneError for others."""
    value = value.tolist() if isinstance(value, np.ndarray | np.generic) else value
    if isinstance(value, list | tuple):
        return [_plain(one, f"{name}[{k}]") for k, one in enumerate(value)]
    if value is None or isinstance(value, bool | int | float | str):
        return value
    kinds = "a number, a text, a boolean, None or a list of them"
    raise SceneError(f"{name} must be {kinds}, not {value_text(value)}: let make build the rest")


def _store(out: Path, make: Make, stack: ExitStack) -> Store:
    """Return the store of finished rows in a folder, which is locked. Raises OutputError for a folder of other results."""
    check_free(out, overwrite=False)
    if (out / "study.json").exists():
        raise OutputError(f"the folder {out} holds a study: name another folder")
    path = out / REPORT
    try:
        found = json.loads(path.read_bytes())["make"]
    except FileNotFoundError:
        found = make.name
    except (OSError, ValueError, KeyError, TypeError, RecursionError):
        raise OutputError(f"{path} was not written by run_many: name another folder") from None
    if found != make.name:
        raise OutputError(f"the folder {out} holds runs of {found}, not of {make.name}: name another folder")
    folder = make_folder(out)
    stack.enter_context(closing(FolderLock(folder)))
    return Store(folder)


def _places(workers: int | None, threads: int | None, n_runs: int) -> list[LocalPlace]:
    """Return places that share the cores of this machine. workers, threads: their number and that of each, if given."""
    cores = usable_cores()
    workers = workers or max(1, min(n_runs, len(cores) // (threads or 1)))
    threads = threads or max(1, len(cores) // workers)
    return [LocalPlace(cores, CHILD, threads) for _ in range(workers)]


class Many:
    """Rows to run: each is executed once for equal parameters, or taken from the store."""

    def __init__(self, make: Make, parameters: list[dict], store: Store):
        self._make, self._store = make, store
        self._request, self._notes, self._seen = make.request(), [], {}
        self._keys = [digest([make.name, one])[:32] for one in parameters]
        self._rows: dict[str, Row] = {}
        self.waiting = dict(zip(self._keys, parameters))
        self._reuse()

    def results(self) -> Results:
        """Return all rows, in the order of the parameters."""
        return Results([self._rows[key] for key in self._keys], self._notes)

    def run(self, there: list[Place], progress: bool, out: Path | None) -> None:
        """Run what is not done, and write table.csv and many.json, also after an interruption."""
        n, threads = len(there), there[0].threads
        how = f"{n} worker{'s' * (n > 1)} with {threads} thread{'s' * (threads > 1)} each"
        done, total = len(self._rows), len(self._rows) + len(self.waiting)
        before = f"{done} of them already done, " if self.waiting else "all of them already done"
        plan = f"{total} runs, " + (before if done else "") + (how if self.waiting else "")
        bar = Bar(total, "taisoft", sys.stderr if progress else io.StringIO(), "{} of {} runs")
        for text in (plan, *self._notes):
            bar.say(text)
        start, failures = time.perf_counter(), []
        bar.show(done, "starting; a new kind of scene compiles first", start)

        def finished(key: str, answer: dict) -> None:
            row = self._rows[key] = self._row(key, answer)
            if row.status == "failed":
                failures.append(key)
                if len(failures) <= FAILURES_SHOWN:
                    given = ", ".join(f"{name}={value_text(value)}" for name, value in row.parameters.items())
                    bar.say(f"failed: {given}: {'; '.join(row.problems)}")
            n, now = len(self._rows), time.perf_counter()
            text = f"{clock_text((now - start) * (total - n) / (n - done))} left"
            bar.show(n, f"{len(failures)} failed, {text}" if failures else text, now)

        requests = [(key, self._request | {"parameters": one}) for key, one in self.waiting.items()]
        left = dict.fromkeys(self.waiting, "it was interrupted")
        try:
            with _interruption() as interrupted:
                left = carry_out(requests, there, finished, stop_requested=interrupted)
        except Exception as error:  # of a file that cannot be written, or a source that was changed
            left = dict.fromkeys(self.waiting, str(error))
            raise
        finally:
            bar.close()
            is_empty = not self._rows
            for key, why in left.items():
                self._rows.setdefault(key, Row(self.waiting[key], problems=[why]))
            if out is not None and not (left and is_empty):
                results = self.results()
                results.write(out / TABLE)
                record = {"kind": KIND, "make": self._make.name, "runs": total, "status": results.counts(), "processes": how}
                record |= {
                    "notes": self._notes,
                    "versions": versions(*PACKAGES),
                    "machine": machine(named=True),
                    "digest": results.digest(),
                }
                write_bytes(out / REPORT, json_text(record).encode())

    def _reuse(self) -> None:
        """Take over finished rows of the same source and taisoft."""
        current = cache(lambda name: digests(Path(self._make.folder), [name])[name])
        other = 0
        for key in list(self.waiting):
            if (record := self._store.read(key)) is None:
                continue
            is_same = all(current(name) == found for name, found in record["sources"].items())
            if is_same and record["code"] == self._request["code"]:
                self._rows[key] = _row(self.waiting.pop(key), record)
                self._seen |= record["sources"]
            else:
                other += 1
        if other:
            files = f"{Path(self._make.file).name}, of modules beside it or of taisoft"
            self._notes.append(f"{other} rows were done by another version of {files} and are run again")
        self._notes += self._store.damaged

    def _row(self, key: str, answer: dict) -> Row:
        """Return the row of an answer, and keep it unless the function raised."""
        if "error" in answer:
            raise SceneError(answer["error"])
        if "crash" in answer:
            return Row(self.waiting[key], "failed", [answer["crash"]])
        record = answer["answer"]
        for name, found in record["sources"].items():
            if self._seen.setdefault(name, found) != found:
                raise SceneError(f"{name} was changed while {self._make.name} ran: call run_many again")
        if not record["raised"]:
            self._store.write(key, record)
        return _row(self.waiting[key], record)


@contextmanager
def _interruption() -> Iterator[Callable[[], bool]]:
    """Yield a function that tells whether Ctrl-C was pressed, and raise KeyboardInterrupt at the end, or at a second Ctrl-C.

    So it does not part what belongs together, such as a row and its file. Another handler of the caller's stays.
    """
    pressed: list[bool] = []

    def press(*arguments) -> None:
        if pressed:
            signal.default_int_handler(*arguments)
        pressed.append(True)

    is_main = threading.current_thread() is threading.main_thread()
    before = signal.getsignal(signal.SIGINT)
    if is_ours := is_main and before is signal.default_int_handler:
        signal.signal(signal.SIGINT, press)
    try:
        yield lambda: bool(pressed)
    finally:
        if is_ours:
            signal.signal(signal.SIGINT, before)
    if pressed:
        raise KeyboardInterrupt


def _row(parameters: dict, record: dict) -> Row:
    names = ("status", "problems", "values", "arrays", "wall_seconds")
    return Row(parameters, **{name: record[name] for name in names})
