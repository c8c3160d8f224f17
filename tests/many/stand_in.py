"""A place that executes the rows of `run_many` in this process."""

import threading

from taisoft.many import make
from taisoft.nested import from_json, to_json


class InProcess:
    """Counts its requests. crash: what all end with."""

    requests: list[dict] = []
    crash = ""
    lock = threading.Lock()  # random numbers and the environment are the process's

    def __init__(self, cores, child, threads):
        self.cores, self.threads = cores, threads

    def execute(self, request: dict) -> dict:
        with self.lock:
            self.requests.append(request["parameters"])
            answer = {"crash": self.crash} if self.crash else make.answer(from_json(to_json(request)))
            return from_json(to_json(answer))

    def stop(self) -> None:
        pass
