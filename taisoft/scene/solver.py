"""Validate a scene's `solver` dict: arguments of Simulator, and the run's seconds and fps.

The Simulator itself validates names of integrators and contact solvers and their combinations.
"""

from taisoft.errors import SceneError
from taisoft.scene import checks

MAX_TOLERANCE = {"newton_tolerance": 0.1}  # a residual of a tenth of the forces is no solution; others: 1


def _positive(value, key: str) -> None:
    checks.number(value, key, above=0.0)


def _tolerance(value, key: str) -> None:
    limit = MAX_TOLERANCE.get(key.rpartition(".")[2], 1.0)
    if value is not None and checks.number(value, key, above=0.0) >= limit:
        raise SceneError(f"{key} must be below {limit:g}, not {value!r}")


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
    """Return the settings unchanged. Raises SceneError, whose text starts with the key. Keys must be in CHECKS."""
    for key, value in solver.items():
        CHECKS[key](value, key)
    return solver
