"""A place that executes the rows of `run_many` in this process."""

from taisoft.many import make
from taisoft.nested import from_json, to_json


class InProcess:
    """Counts its requests. crash: what all end with."""

    requests: list[dict] = []
    crash = ""

    def __init__(self, cores, child, threads):
        self.cores, self.threads = cores, threads

    def execute(self, request: dict) -> dict:
        self.requests.append(request["parameters"])
        answer = {"crash": self.crash} if self.crash else make.answer(from_json(to_json(request)))
        return from_json(to_json(answer))

    def stop(self) -> None:
        pass
