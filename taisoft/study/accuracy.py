"""Errors of runs relative to their references, in time and in space, and other measures of a run's quality.

An error in position is a distance divided by the largest excursion: the largest distance of any node of the reference from its
start at any frame. `max` is the maximum over nodes and frames, `rms` the root mean square. Errors in time compare with the
reference on the same mesh, over all nodes. Errors in space compare with the finest mesh's reference, over the nodes that start
at the same place in both. A reference's own error is the distance between its runs with dt and 2 dt divided by 2^p - 1, where p
is its order in time. For the finest mesh it is also at least a third of the distance to the next coarser reference (second
order in the mesh width), or all of it if the motion is not smooth.
"""

from dataclasses import dataclass, field

import numpy as np

from taisoft.errors import SimulationError
from taisoft.estimation.comparison import Error, distance, largest_excursion, shared_nodes
from taisoft.machine import Timing, summarise
from taisoft.study import mesh_name

RICHARDSON = 3.0  # 2^2 - 1
ROUNDING = 1e-9  # relative change of momentum that counts as rounding
OF_RECORD = ("unconverged", "compile_seconds", "steps", "nodes", "tets", "threads")
EXTREMES = {"penetration": "max_penetration", "contact_residual": "contact_residual", "inverted": "n_inverted"}
# of a row; energy is a drift where it is kept, else relative to the reference, and penetration is over the smallest edge
NUMBERS = ("energy", "energy_kept", "momentum", *EXTREMES, *OF_RECORD, "machine")


@dataclass
class Reference:
    """A run that others are compared with. path: (k,n,3) [m]; own_error: its estimated error; problems: reasons for caution."""

    setting: dict
    path: np.ndarray
    excursion: float  # [m]
    own_error: Error
    energy: np.ndarray  # (k,) total [J]
    energy_scale: float  # [J]
    momentum: np.ndarray  # (k,3) [kg m/s]
    bodies: list
    kind: str = ""
    problems: list[str] = field(default_factory=list)
    steps: int = 0
    order_in_time: int = 2


@dataclass
class Row:
    """Results of one setting of the study. Errors and numbers, those of NUMBERS, are None if unknown."""

    setting: dict
    status: str  # ok | degraded | failed | refused | left out
    reason: str = ""
    seconds: list[float] = field(default_factory=list)  # wall time per simulated second [s], one number per repeat
    cores: list[int] = field(default_factory=list)
    in_time: Error | None = None
    in_time_sure: Error | None = None  # the reference's own error: smaller errors are not resolved
    in_space: Error | None = None
    in_space_sure: Error | None = None
    by_space: bool = False  # whether `error` is the error in space
    numbers: dict = field(default_factory=lambda: dict.fromkeys(NUMBERS) | {"energy_kept": False})

    @property
    def timing(self) -> Timing | None:
        """Wall time per simulated second [s]."""
        return summarise(self.seconds) if self.seconds else None

    def error(self, by: str) -> tuple[float, float] | None:
        """Return the setting's error and its reference's own error, or None if unknown. by: "rms" | "max"."""
        pair = (self.in_space, self.in_space_sure) if self.by_space else (self.in_time, self.in_time_sure)
        return None if pair[0] is None or pair[1] is None else (getattr(pair[0], by), getattr(pair[1], by))

    def resolved_error(self, by: str) -> float | None:
        """Return the error, but at least the reference's own error."""
        pair = self.error(by)
        return None if pair is None else max(pair)


def make_reference(fine: dict, coarse: dict, kind: str, order_in_time: int) -> Reference:
    """Build a reference from the records of its fine and coarse runs.

    Raises SimulationError if a run failed or nothing moves.
    """
    for record in (fine, coarse):
        if record["status"] == "failed":
            setting, reason = record["task"]["setting"], record["problems"][-1]
            raise SimulationError(f"the reference {setting['integrator']}, dt = {setting['dt']:.3g} s, failed: {reason}")
    path = fine["path"]
    excursion = largest_excursion(path)
    if excursion == 0.0:
        raise SimulationError("nothing moves in the reference, so errors relative to its motion are undefined")
    difference = distance(coarse["path"], path, excursion)
    divisor = 2.0**order_in_time - 1.0
    energies = np.array(fine["energies"])
    return Reference(
        setting=fine["task"]["setting"],
        path=path,
        excursion=excursion,
        own_error=Error(difference.rms / divisor, difference.max / divisor),
        energy=energies.sum(axis=1),
        energy_scale=float(np.ptp(energies, axis=0).max()),
        momentum=np.array(fine["momentum"]),
        bodies=fine["bodies"],
        kind=kind,
        problems=[text for record in (fine, coarse) for text in record["problems"] if not text.startswith("note")],
        steps=fine["steps"],
        order_in_time=order_in_time,
    )


def finest_own_error(finest: Reference, others: list[Reference]) -> tuple[Error, str]:
    """Estimate the finest reference's own error; also return how it was estimated."""
    others = [other for other in others if other is not finest]
    if not others:
        return finest.own_error, "its error in time alone"

    def closeness(one: Reference) -> tuple:  # the same element order first, then the most refined mesh
        return one.setting["order"] == finest.setting["order"], one.setting["refine"], one.path.shape[1], one.kind == finest.kind

    other = max(others, key=closeness)
    smooth = finest.order_in_time == 2  # it is 1 where contacts or paths reduce the order of the method
    difference, divisor = error_in_space(other.path, other.bodies, finest), RICHARDSON if smooth else 1.0
    own = Error(max(finest.own_error.rms, difference.rms / divisor), max(finest.own_error.max, difference.max / divisor))
    return own, f"{'a third of ' if smooth else ''}the distance to the reference with {mesh_name(other.setting)}"


def error_in_space(path: np.ndarray, bodies: list, finest: Reference) -> Error:
    """Return the error of a path (k,n,3) on another mesh, at the nodes that it shares with the finest mesh.

    bodies: [name, n_nodes] of each body. Raises SimulationError for a body that shares no node.
    """
    own, theirs = shared_nodes(path[0], bodies, finest.path[0], finest.bodies)
    return distance(path[:, own], finest.path[:, theirs], finest.excursion)


def row_of(record: dict, reference: Reference | None) -> Row:
    """Compare a finished run with the reference on its mesh; without a reference the errors stay None."""
    row = Row(record["task"]["setting"], record["status"], "; ".join(record["problems"]), record["seconds"], record["cores"])
    numbers = row.numbers
    numbers |= {name: record.get(name) for name in OF_RECORD} | {"machine": record["machine"]["name"]}
    if extremes := record.get("extremes"):
        numbers |= {name: extremes[key].get("max") for name, key in EXTREMES.items()}
        if numbers["penetration"] is not None:
            numbers["penetration"] /= record["smallest_edge"]
    if record["path"] is None or reference is None:
        return row
    row.in_time, row.in_time_sure = distance(record["path"], reference.path, reference.excursion), reference.own_error
    energy, numbers["energy_kept"] = np.array(record["energies"], float).sum(axis=1), record["keeps_energy"]
    expected = energy[0] if record["keeps_energy"] else reference.energy
    numbers["energy"] = _relative(np.abs(energy - expected).max(), reference.energy_scale)
    numbers["momentum"] = momentum_error(record, np.array(record["momentum"], float), reference)
    return row


def momentum_error(record: dict, momentum: np.ndarray, reference: Reference) -> float | None:
    """Return the relative error of momentum (k,3) [kg m/s], or None if the scale is zero.

    It compares with the law of momentum if the bodies are free, else with the reference. The scale is the reference's largest
    change of momentum, or its largest momentum if that does not change.
    """
    expected = reference.momentum
    if record["momentum_rate"] is not None:
        times = np.arange(len(momentum))[:, None] * record["task"]["frame"]
        expected = momentum[0] + times * np.array(record["momentum_rate"])
    largest = np.linalg.norm(reference.momentum, axis=1).max()
    change = np.linalg.norm(reference.momentum - reference.momentum[0], axis=1).max()
    scale = change if change > ROUNDING * largest else largest
    return _relative(np.linalg.norm(momentum - expected, axis=1).max(), scale)


def _relative(value: float, scale: float) -> float | None:
    return float(value / scale) if scale > 0.0 else None
