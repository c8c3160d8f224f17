"""The `solver` dict of a scene: arguments of Simulator, and seconds and fps of its run, as far as they can be checked here.

Names of integrators and contact solvers, and what fits what, are checked by the Simulator.
"""

from taisoft.errors import SceneError
from taisoft.scene import checks

MAX_TOLERANCE = {"newton_tolerance": 0.1}  # a residual as large as a tenth of the forces is no solution; others: below 1


def _positive(value, key: str) -> None:
    checks.number(value, key, above=0.0)


def _tolerance(value, key: str) -> None:
    below = MAX_TOLERANCE.get(key.rpartition(".")[2], 1.0)
    if value is not None and checks.number(value, key, above=0.0) >= below:
        raise SceneError(f"{key} must be below {below:g}, not {value!r}")


def _text(value, key: str) -> None:
    if not isinstance(value, str):
        raise SceneError(f"{key} must be a text, not {value!r}")


CHECKS = {
    "dt": _positive,
    "integrator": _text,
    "contact_solver": _text,
    "self_collision": checks.flag,
    "precision": lambda value, key: checks.choice(value, key, ("f32", "f64")),
    "arch": lambda value, key: checks.choice(value, key, ("cpu", "cuda")),
    "allow_unstable": checks.flag,
    "draggable": checks.flag,
    "newton_tolerance": _tolerance,
    "linear_tolerance": _tolerance,
    "contact_tolerance": _tolerance,
    "seconds": _positive,
    "fps": lambda value, key: value is None or _positive(value, key),
}


def check_solver(**solver) -> dict:
    """The settings as they are; raises SceneError with the key first. Keys must be among those of CHECKS."""
    for key, value in solver.items():
        CHECKS[key](value, key)
    return solver
