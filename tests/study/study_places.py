"""Places of a study without child processes: runs in this process, or of a fake program."""

import numpy as np

from taisoft.cli.study import answer
from taisoft.nested import from_json, to_json


class InProcess:
    """Carries out requests in this process."""

    cores = [0]

    def __init__(self):
        self.requests = []

    def execute(self, request: dict) -> dict:
        self.requests.append(request)
        return from_json(to_json(answer(request)))

    def stop(self) -> None:
        pass


class Pendulum(InProcess):
    """Records of an oscillator, x'' = -x, solved by implicit Euler, or by the trapezoidal rule for any other integrator.

    failing: dt -> problem of a run that fails; crashing: dt -> message about a process that ended without an answer.
    """

    def __init__(self, plan: dict, failing=(), crashing=()):
        super().__init__()
        self.plan, self.failing, self.crashing = plan, dict(failing), dict(crashing)

    def execute(self, request: dict) -> dict:
        self.requests.append(request)
        if request["action"] == "plan":
            return {"answer": self.plan}
        dt = request["task"]["setting"]["dt"]
        return {"crash": self.crashing[dt]} if dt in self.crashing else {"answer": self._record(request["task"])}

    def _record(self, task: dict) -> dict:
        setting, A, eye = task["setting"], np.array([[0.0, 1.0], [-1.0, 0.0]]), np.eye(2)
        h = setting["dt"]
        euler = setting["integrator"] == "implicit_euler"
        step = np.linalg.inv(eye - h * A) if euler else np.linalg.solve(eye - h / 2 * A, eye + h / 2 * A)
        states = [np.array([1.0, 0.0])]
        for _ in range(task["frames"]):
            states.append(np.linalg.matrix_power(step, task["steps"]) @ states[-1])
        x, v = np.array(states).T
        path = np.zeros((len(x), 2, 3))
        path[:, 1, 0] = x
        problem = self.failing.get(h)
        energies = np.stack([v**2 / 2, x**2 / 2, 0 * x], axis=1).tolist()
        momentum = np.stack([v, 0 * v, 0 * v], axis=1).tolist()
        extremes = {name: {"max": 0.0} for name in ("n_inverted", "contact_residual", "max_penetration")}
        return {
            "task": task,
            "status": "failed" if problem else "ok",
            "problems": [problem] if problem else [],
            "warnings": [],
            "seconds": [] if problem else [0.1 / h * (1.0 + 0.1 * k) for k in range(task["repeats"])],
            "compile_seconds": 1.0,
            "threads": 1,
            "cores": [0],
            "machine": {"name": "here"},
            "versions": {},
            "nodes": 2,
            "tets": 1,
            "steps": task["steps"] * task["frames"],
            "unconverged": 0,
            "explicit": False,
            "extremes": extremes,
            "smallest_edge": 1.0,
            "keeps_energy": True,
            "momentum_rate": None,
            "bodies": [["mass", 2]],
            "energies": energies,
            "momentum": momentum,
            "path": None if problem else path,
        }
