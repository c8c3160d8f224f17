"""A study on a Dask cluster: each worker of it is a place that carries out one run at a time, in a process of its own.

Workers on one machine share its cores evenly, so that timed runs share none; all places have as many cores as the poorest one.
A worker needs this taisoft and the scene under the same name; both are checked before every run. Dask hands Python objects
around unencrypted: use a cluster whose network you trust.
"""

import threading
import time
import uuid
from contextlib import suppress

from taisoft.errors import SceneError
from taisoft.output.report import machine
from taisoft.study.workers import LOOK_EVERY, LocalPlace
from taisoft.timing import usable_cores

CONNECT_SECONDS = 10
ASK_EVERY = 2.0  # [s] between two looks at which workers are alive

_running: dict[str, LocalPlace] = {}  # on a worker: what it carries out, by name
_lock = threading.Lock()


class ClusterPlace:
    """One worker of a Dask cluster; see `taisoft.study.workers.Place`."""

    def __init__(self, client, address: str, cores: list[int]):
        self.cores, self._client, self._address = cores, client, address
        self._future, self._name, self._asked = None, "", 0.0

    def start(self, request: dict) -> None:
        """See Place."""
        self._name = uuid.uuid4().hex
        self._future = self._client.submit(
            serve, request, self.cores, self._name, workers=[self._address], allow_other_workers=False, pure=False, retries=0
        )

    def poll(self) -> dict | None:
        """See Place."""
        if self._future is None:
            return None
        if not self._future.done():
            return self._gone()
        future, self._future = self._future, None
        if future.status == "finished":
            return future.result()
        if future.status == "error":
            return {"crash": f"the worker {self._address}: {type(future.exception()).__name__}: {future.exception()}"}
        return {"lost": f"the worker {self._address} is gone"}

    def stop(self) -> None:
        """See Place. Dask ends no task that has begun, so the worker is asked to."""
        if self._future is not None:
            with suppress(Exception):  # whatever Dask raises where worker or scheduler are gone: then nothing is left to end
                self._client.run(end, self._name, workers=[self._address], on_error="ignore")
                self._future.cancel()
            self._future = None

    def _gone(self) -> dict | None:
        """Asked now and then, since Dask keeps a task waiting for a worker that will not come back."""
        if time.monotonic() - self._asked < ASK_EVERY:
            return None
        self._asked = time.monotonic()
        try:
            alive = self._address in self._client.scheduler_info(n_workers=-1)["workers"]
        except Exception as error:  # Dask's own and Tornado's kinds
            return {"lost": f"the scheduler does not answer ({type(error).__name__})"}
        if alive:
            return None
        self._future = None
        return {"lost": f"the worker {self._address} is gone"}


def serve(request: dict, cores: list[int], name: str) -> dict:
    """On a worker: carry out a request in a child process."""
    place = LocalPlace(cores)
    with _lock:
        _running[name] = place
        place.start(request)
    while True:
        with _lock:
            answer = place.poll() if name in _running else {"crash": "it was stopped"}
            if answer is not None:
                _running.pop(name, None)
                return answer
        time.sleep(LOOK_EVERY)


def end(name: str) -> None:
    """On a worker: end what `serve` carries out under that name."""
    with _lock:
        if place := _running.pop(name, None):
            place.stop()


def facts() -> dict:
    """On a worker: its machine and its cores."""
    return {"machine": machine(), "cores": usable_cores()}


def connect(address: str):
    """A client of the scheduler at that address. Raises SceneError, in one sentence, where there is none."""
    try:
        from distributed import Client
    except ImportError:
        raise SceneError("--scheduler needs the package distributed, which is missing: pip install 'taisoft[cluster]'") from None
    try:
        return Client(address, timeout=CONNECT_SECONDS, set_as_default=False)
    except (OSError, ValueError, TimeoutError) as error:
        raise SceneError(f"--scheduler {address}: no Dask scheduler answers there ({type(error).__name__})") from None


def cluster_places(client) -> tuple[list[ClusterPlace], list[dict]]:
    """A place for each worker, and the machines they are on. Raises SceneError where there is none, or no core for each."""
    try:
        found = client.run(facts)
    except Exception as error:  # what a worker raises comes through as it is
        raise SceneError(f"the cluster's workers cannot run taisoft: {type(error).__name__}: {error}") from None
    if not found:
        raise SceneError("the cluster has no worker")
    places = []
    for name in dict.fromkeys(one["machine"]["name"] for one in found.values()):
        own = {address: one["cores"] for address, one in found.items() if one["machine"]["name"] == name}
        cores = sorted(set().union(*own.values()))
        each = len(cores) // len(own)
        if each == 0:
            raise SceneError(f"{len(own)} workers on {name} share {len(cores)} cores: timed runs need one each")
        places += [(address, cores[k * each : (k + 1) * each]) for k, address in enumerate(own)]
    least = min(len(cores) for _, cores in places)
    machines = {one["machine"]["name"]: one["machine"] for one in found.values()}
    return [ClusterPlace(client, address, cores[:least]) for address, cores in places], list(machines.values())
