"""How far runs are from their references: errors in time and in space, and what else tells whether to trust a run.

An error in position is a distance over the largest excursion: the most that any node of the reference is away from its start
at any frame. `max` is the largest over nodes and frames, `rms` the root of the mean square. Errors in time are those to the
reference on the same mesh, over all nodes; errors in space those to the finest mesh's reference, over the nodes that both have
(the places where both start). A reference's own error is the distance between its runs with dt and 2 dt over 2^p - 1, p being
its order in time; for the finest mesh also a third of the distance to the next coarser reference, as of second order in the
mesh width, or all of it where the motion is not smooth.
"""

from dataclasses import dataclass, field

import numpy as np
from scipy.spatial import cKDTree

from taisoft.errors import SimulationError
from taisoft.study.grid import mesh_name
from taisoft.study.store import unpack
from taisoft.timing import Timing, summarise

SAME_PLACE = 1e-9  # of the size, between two nodes that count as one
COARSER = 3.0  # 2^2 - 1
UNCHANGED = 1e-9  # of the momentum, below which a change of it is rounding


@dataclass(frozen=True)
class Error:
    """Distance of two paths over the largest excursion."""

    rms: float
    max: float


@dataclass
class Reference:
    """What others are compared with. path (k,n,3) [m]; own: its own error; problems: why to be careful with it."""

    setting: dict
    path: np.ndarray
    excursion: float  # [m]
    own: Error
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
    """One setting of the study with all that is told of it. Errors are None where there is none to be told."""

    setting: dict
    status: str  # ok | degraded | failed | refused | left out
    reason: str = ""
    seconds: list[float] = field(default_factory=list)  # wall time of a simulated second, a number a repeat
    compile_seconds: float | None = None
    threads: int | None = None
    cores: list[int] = field(default_factory=list)
    machine: str = ""
    nodes: int | None = None
    tets: int | None = None
    steps: int | None = None
    in_time: Error | None = None
    in_time_sure: Error | None = None  # the reference's own error: below it nothing is known
    in_space: Error | None = None
    in_space_sure: Error | None = None
    by_space: bool = False  # whether the error in space is the one that counts
    energy: float | None = None
    energy_kept: bool = False  # whether `energy` is a drift, or an error to the reference
    momentum: float | None = None
    penetration: float | None = None  # over the smallest edge
    contact_residual: float | None = None
    unconverged: int | None = None
    inverted: int | None = None

    @property
    def timing(self) -> Timing | None:
        """Of a simulated second [s]."""
        return summarise(self.seconds) if self.seconds else None

    def error(self, by: str) -> tuple[float, float] | None:
        """The error that counts, and the one below which nothing is known; None where it is not told. by: "rms" | "max"."""
        pair = (self.in_space, self.in_space_sure) if self.by_space else (self.in_time, self.in_time_sure)
        return None if pair[0] is None or pair[1] is None else (getattr(pair[0], by), getattr(pair[1], by))

    def claimed(self, by: str) -> float | None:
        """The error, but not below what its reference is good to."""
        found = self.error(by)
        return None if found is None else max(found)


def distance(path: np.ndarray, other: np.ndarray, excursion: float) -> Error:
    """Of two paths (k,n,3) [m]."""
    squared = ((path - other) ** 2).sum(axis=2)
    return Error(float(np.sqrt(squared.mean())) / excursion, float(np.sqrt(squared.max())) / excursion)


def excursion(path: np.ndarray) -> float:
    """The most that a node of the path (k,n,3) is away from its start [m]."""
    return float(np.sqrt(((path - path[0]) ** 2).sum(axis=2).max()))


def make_reference(fine: dict, coarse: dict, kind: str, order_in_time: int) -> Reference:
    """Of the records of its two runs. Raises SimulationError, saying why, where there is none."""
    for record in (fine, coarse):
        if record["status"] == "failed":
            what, why = record["task"]["setting"], record["problems"][-1]
            raise SimulationError(f"the reference {what['integrator']}, dt = {what['dt']:.3g} s, failed: {why}")
    path = unpack(fine["path"])
    far = excursion(path)
    if far == 0.0:
        raise SimulationError("nothing moves in the reference, so that errors relative to its motion mean nothing")
    own = distance(unpack(coarse["path"]), path, far)
    share = 2.0**order_in_time - 1.0
    energies = np.array(fine["energies"])
    return Reference(
        fine["task"]["setting"], path, far, Error(own.rms / share, own.max / share), energies.sum(axis=1),
        float(np.ptp(energies, axis=0).max()), np.array(fine["momentum"]), fine["bodies"], kind,
        [text for record in (fine, coarse) for text in record["problems"] if not text.startswith("note")],
        fine["steps"], order_in_time,
    )  # fmt: skip


def in_space_sure(finest: Reference, others: list[Reference]) -> tuple[Error, str]:
    """What the finest reference is good to, and by what that was told."""
    others = [other for other in others if other is not finest]
    if not others:
        return finest.own, "its error in time alone"
    other = max(others, key=lambda one: _nearness(one, finest))
    near, smooth = compare(other, finest), finest.order_in_time == 2  # which is 1 where methods lose their order
    share = COARSER if smooth else 1.0
    own = Error(max(finest.own.rms, near.rms / share), max(finest.own.max, near.max / share))
    return own, f"{'a third of ' if smooth else ''}the distance to the reference with {mesh_name(other.setting)}"


def _nearness(one: Reference, finest: Reference) -> tuple:
    """Is larger for the mesh that comes before the finest: of the same elements where there is one, the most refined."""
    return one.setting["order"] == finest.setting["order"], one.setting["refine"], one.path.shape[1], one.kind == finest.kind


def compare(coarse: Reference, finest: Reference) -> Error:
    """Of two references, at the nodes that both have."""
    return error_in_space(coarse.path, coarse.bodies, finest)


def error_in_space(path: np.ndarray, bodies: list, finest: Reference) -> Error:
    """Of a path (k,n,3) on another mesh with these [name, nodes] of its bodies, at the nodes that the finest mesh has too.

    Raises SimulationError for a body that shares no node with it.
    """
    own, theirs = shared_nodes(path[0], bodies, finest.path[0], finest.bodies)
    return distance(path[:, own], finest.path[:, theirs], finest.excursion)


def shared_nodes(start: np.ndarray, bodies: list, other: np.ndarray, others: list) -> tuple[np.ndarray, np.ndarray]:
    """Ids in both meshes of the nodes that start (n,3), (m,3) [m] at the same place in the same body."""
    own, theirs, first, second = [], [], 0, 0
    for (name, n), (_, m) in zip(bodies, others):
        size = float(np.ptp(other[second : second + m], axis=0).max())
        far, at = cKDTree(other[second : second + m]).query(start[first : first + n])
        same = np.flatnonzero(far <= SAME_PLACE * size)
        if not len(same):
            raise SimulationError(f"body {name!r}: no node of one mesh is one of the other, so that they cannot be compared")
        own.append(first + same)
        theirs.append(second + at[same])
        first, second = first + n, second + m
    return np.concatenate(own), np.concatenate(theirs)


def row_of(record: dict, reference: Reference | None) -> Row:
    """A finished run beside the reference on its mesh; without one the errors stay unknown."""
    task = record["task"]
    row = Row(
        task["setting"], record["status"], "; ".join(record["problems"]), record["seconds"], record.get("compile_seconds"),
        record["threads"], record["cores"], record["machine"]["name"], record["nodes"], record["tets"], record.get("steps"),
        unconverged=record.get("unconverged"),
    )  # fmt: skip
    if extremes := record.get("extremes"):
        row.inverted = _most(extremes, "n_inverted")
        row.contact_residual = _most(extremes, "contact_residual")
        deepest = _most(extremes, "max_penetration")
        row.penetration = None if deepest is None else deepest / record["smallest_edge"]
    if record["path"] is None or reference is None:
        return row
    energy, momentum = np.array(record["energies"], float).sum(axis=1), np.array(record["momentum"], float)
    row.in_time, row.in_time_sure = distance(unpack(record["path"]), reference.path, reference.excursion), reference.own
    row.energy_kept = record["keeps_energy"]
    wanted = energy[0] if row.energy_kept else reference.energy
    row.energy = _relative(np.abs(energy - wanted).max(), reference.energy_scale)
    row.momentum = _momentum_error(record, momentum, reference)
    return row


def _momentum_error(record: dict, momentum: np.ndarray, reference: Reference) -> float | None:
    """Of momentum (k,3) [kg m/s], to the law where nothing holds the bodies, else to the reference, over the
    reference's largest change from the start, or its momentum where that does not change."""
    wanted = reference.momentum
    if record["momentum_rate"] is not None:
        times = np.arange(len(momentum))[:, None] * record["task"]["frame"]
        wanted = momentum[0] + times * np.array(record["momentum_rate"])
    most = np.linalg.norm(reference.momentum, axis=1).max()
    change = np.linalg.norm(reference.momentum - reference.momentum[0], axis=1).max()
    scale = change if change > UNCHANGED * most else most
    return _relative(np.linalg.norm(momentum - wanted, axis=1).max(), scale)


def _relative(value: float, scale: float) -> float | None:
    return float(value / scale) if scale > 0.0 else None


def _most(extremes: dict, name: str):
    return extremes[name].get("max")
