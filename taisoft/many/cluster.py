"""Places on the workers of a Dask cluster.

Every worker of a machine has its share of the cores, and all use as many as the smallest share. Workers need this taisoft and the
user's files under the same names, which each request's child checks. Dask sends Python objects unencrypted: use only a cluster on
a trusted network.
"""

import time
import uuid
from contextlib import suppress

from taisoft.errors import SceneError
from taisoft.machine import machine, require, usable_cores
from taisoft.many.places import POLL_INTERVAL, LocalPlace

CONNECT_SECONDS = 10  # to a cluster's scheduler
ALIVE_CHECK_INTERVAL = 2.0  # [s]


class ClusterPlace:
    """One worker of a Dask cluster, which has a LocalPlace. child, threads: of that."""

    def __init__(self, client, address: str, cores: list[int], child: tuple[str, ...], threads: int | None = None):
        self.cores, self.threads, self._client, self._address = cores, threads, client, address
        self._local, self._name, self._future = (cores, child, threads), uuid.uuid4().hex, None

    def execute(self, request: dict) -> dict:
        """See Place."""
        there = {"workers": [self._address], "allow_other_workers": False, "pure": False, "retries": 0}
        future = self._future = self._client.submit(run_on_worker, request, self._name, self._local, **there)
        checked = time.monotonic()
        while not future.done():
            time.sleep(POLL_INTERVAL)
            if time.monotonic() - checked > ALIVE_CHECK_INTERVAL:
                if why := self._lost():
                    self._future = None  # nothing can be stopped there
                    return {"lost": why}
                checked = time.monotonic()
        if future.status == "finished":
            return future.result()
        if future.status == "error":
            return {"crash": f"the worker {self._address}: {type(future.exception()).__name__}: {future.exception()}"}
        return {"lost": f"the worker {self._address} is gone"}

    def stop(self) -> None:
        """See Place. Dask cannot stop a running task, so a second task stops it on the worker."""
        if self._future is not None:
            with suppress(Exception):  # Dask may raise anything if worker or scheduler are gone; nothing is then left to stop
                self._client.run(stop_on_worker, self._name, workers=[self._address], on_error="ignore")
                self._future.cancel()
            self._future = None

    def _lost(self) -> str:
        """Return why nothing can be expected of the worker, or "": Dask keeps a task waiting for a lost worker."""
        try:
            alive = self._address in self._client.scheduler_info(n_workers=-1)["workers"]
        except Exception as error:  # Dask and Tornado have their own exception types
            return f"the scheduler does not answer ({type(error).__name__})"
        return "" if alive else f"the worker {self._address} is gone"


_places: dict[str, LocalPlace] = {}  # on a worker: its places, by name


def run_on_worker(request: dict, name: str, local: tuple) -> dict:
    """Execute a request on a cluster's worker, in its place of this name, which LocalPlace(*local) makes."""
    return _places.setdefault(name, LocalPlace(*local)).execute(request)


def stop_on_worker(name: str) -> None:
    """Stop the place of that name."""
    if place := _places.pop(name, None):
        place.stop()


def _worker_info() -> dict:
    return {"machine": machine(named=True), "cores": usable_cores()}


def connect(address: str, argument: str):
    """Return a client of the scheduler at this address. argument: gives it, in messages. Raises SceneError if there is none."""
    distributed = require("distributed", argument, "cluster", SceneError)
    try:
        return distributed.Client(address, timeout=CONNECT_SECONDS, set_as_default=False)
    except (OSError, ValueError, TimeoutError) as error:
        raise SceneError(f"{argument} {address}: no Dask scheduler answers there ({type(error).__name__})") from None


def cluster_places(
    client, child: tuple[str, ...], timed: bool = True, threads: int | None = None
) -> tuple[list[ClusterPlace], list[dict]]:
    """Return one place per worker, and their machines. timed: as in LocalPlace without `threads`, else with these, or all.

    Raises SceneError without workers or, if timed, with fewer cores than workers.
    """
    try:
        workers = client.run(_worker_info)
    except Exception as error:  # exceptions of the workers are re-raised here unchanged
        raise SceneError(f"the cluster's workers cannot run taisoft: {type(error).__name__}: {error}") from None
    if not workers:
        raise SceneError("the cluster has no worker")
    machines = {info["machine"]["name"]: info["machine"] for info in workers.values()}
    places = []
    for name in machines:
        own = {address: info["cores"] for address, info in workers.items() if info["machine"]["name"] == name}
        cores = sorted(set().union(*own.values()))
        each = len(cores) // len(own)
        if each == 0 and timed:
            raise SceneError(f"{len(own)} workers on {name} share {len(cores)} cores: each timed run needs its own")
        places += [(address, cores[k * each : (k + 1) * each] or cores[:1]) for k, address in enumerate(own)]
    n = min(len(cores) for _, cores in places)
    threads = None if timed else threads or n
    return [ClusterPlace(client, address, cores[:n], child, threads) for address, cores in places], list(machines.values())
