"""Studies on a Dask cluster: each worker executes one run at a time, in a separate process.

The cores of a machine are divided evenly among its workers, so that timed runs do not share cores. Every worker uses as many
cores as the smallest one has. A worker needs this taisoft and the scene under the same name; both are checked before every run.
Dask sends Python objects unencrypted: use only a cluster on a trusted network.
"""

import threading
import time
import uuid
from contextlib import suppress

from taisoft.errors import SceneError
from taisoft.output.report import machine
from taisoft.study.workers import POLL_INTERVAL, LocalPlace
from taisoft.timing import usable_cores

CONNECT_SECONDS = 10
ALIVE_CHECK_INTERVAL = 2.0  # [s]

_running: dict[str, LocalPlace] = {}  # on a worker: its current runs, by name
_lock = threading.Lock()


class ClusterPlace:
    """One worker of a Dask cluster; see `taisoft.study.workers.Place`."""

    def __init__(self, client, address: str, cores: list[int]):
        self.cores, self._client, self._address = cores, client, address
        self._future, self._name, self._last_check = None, "", 0.0

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
            return self._check_alive()
        future, self._future = self._future, None
        if future.status == "finished":
            return future.result()
        if future.status == "error":
            return {"crash": f"the worker {self._address}: {type(future.exception()).__name__}: {future.exception()}"}
        return {"lost": f"the worker {self._address} is gone"}

    def stop(self) -> None:
        """See Place. Dask cannot stop a running task, so a second task stops it on the worker."""
        if self._future is not None:
            with suppress(Exception):  # Dask may raise anything if worker or scheduler are gone; nothing is then left to stop
                self._client.run(stop_run, self._name, workers=[self._address], on_error="ignore")
                self._future.cancel()
            self._future = None

    def _check_alive(self) -> dict | None:
        """Check periodically that the worker is alive, because Dask keeps a task waiting for a lost worker."""
        if time.monotonic() - self._last_check < ALIVE_CHECK_INTERVAL:
            return None
        self._last_check = time.monotonic()
        try:
            alive = self._address in self._client.scheduler_info(n_workers=-1)["workers"]
        except Exception as error:  # Dask and Tornado have their own exception types
            return {"lost": f"the scheduler does not answer ({type(error).__name__})"}
        if alive:
            return None
        self._future = None
        return {"lost": f"the worker {self._address} is gone"}


def serve(request: dict, cores: list[int], name: str) -> dict:
    """Execute a request in a child process (runs on a worker)."""
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
        time.sleep(POLL_INTERVAL)


def stop_run(name: str) -> None:
    """Stop the run that `serve` started under this name (runs on a worker)."""
    with _lock:
        if place := _running.pop(name, None):
            place.stop()


def worker_info() -> dict:
    """Return the worker's machine and cores (runs on a worker)."""
    return {"machine": machine(), "cores": usable_cores()}


def connect(address: str):
    """Return a client of the scheduler at this address. Raises SceneError if there is none."""
    try:
        from distributed import Client
    except ImportError:
        raise SceneError("--scheduler needs the package distributed, which is missing: pip install 'taisoft[cluster]'") from None
    try:
        return Client(address, timeout=CONNECT_SECONDS, set_as_default=False)
    except (OSError, ValueError, TimeoutError) as error:
        raise SceneError(f"--scheduler {address}: no Dask scheduler answers there ({type(error).__name__})") from None


def cluster_places(client) -> tuple[list[ClusterPlace], list[dict]]:
    """Return one place per worker, and their machines. Raises SceneError without workers or with fewer cores than workers."""
    try:
        workers = client.run(worker_info)
    except Exception as error:  # exceptions of the workers are re-raised here unchanged
        raise SceneError(f"the cluster's workers cannot run taisoft: {type(error).__name__}: {error}") from None
    if not workers:
        raise SceneError("the cluster has no worker")
    places = []
    for name in dict.fromkeys(info["machine"]["name"] for info in workers.values()):
        own = {address: info["cores"] for address, info in workers.items() if info["machine"]["name"] == name}
        cores = sorted(set().union(*own.values()))
        each = len(cores) // len(own)
        if each == 0:
            raise SceneError(f"{len(own)} workers on {name} share {len(cores)} cores: each timed run needs its own")
        places += [(address, cores[k * each : (k + 1) * each]) for k, address in enumerate(own)]
    n_cores = min(len(cores) for _, cores in places)
    machines = {info["machine"]["name"]: info["machine"] for info in workers.values()}
    return [ClusterPlace(client, address, cores[:n_cores]) for address, cores in places], list(machines.values())
