"""Loads of a body, constant or along a path: tractions and pressures on surface triangles, forces on nodes."""

from collections.abc import Callable
from dataclasses import dataclass
from typing import ClassVar

import numpy as np

from taisoft.attributes import guarded_record
from taisoft.errors import SceneError, SimulationError, reworded
from taisoft.scene import checks
from taisoft.scene.key_frames import KeyFrames

LOADS = {  # kind of load -> the body's list of them
    "force": "forces",
    "traction": "tractions",
    "pressure": "pressures",
    "cavity": "cavities",
}


@dataclass(frozen=True, eq=False, kw_only=True)
class Load:
    """What all loads have: a value, constant or along a path."""

    kind: ClassVar[str]
    value: np.ndarray | None  #: in one of `shapes`, in the unit of the load; None if it follows a path
    path: Callable | None = None  #: t [s] -> such a value
    path_shape: tuple[int, ...] | None = None  #: of all values along the path
    shapes: ClassVar[tuple[tuple[int, ...], ...]] = ((3,),)  #: those that its values may have


@guarded_record("traction", "call sim.set_traction(body, index, value) in a simulation")
class Traction(Load):
    """A dead load on surface triangles, its value a force per reference area [Pa]."""

    kind: ClassVar[str] = "traction"
    triangles: np.ndarray  #: (k,) int64 rows of mesh.surface


@guarded_record("force", "call sim.set_force(body, index, value) in a simulation")
class NodalForce(Load):
    """A dead load on nodes: a total force (3,) [N] distributed by lumped mass, or one force per node (k,3) [N]."""

    kind: ClassVar[str] = "force"
    nodes: np.ndarray  #: (k,) int64 node ids
    where: Callable | None = None  #: as in `Constraint`

    @property
    def shapes(self) -> tuple[tuple[int, ...], ...]:
        """A total, or one for each node."""
        return ((3,), (len(self.nodes), 3))


@dataclass(frozen=True, eq=False)
class ScalarLoad(Load):
    """A load that is one number."""

    kind: ClassVar[str] = "number"
    shapes: ClassVar[tuple[tuple[int, ...], ...]] = ((),)


@guarded_record("pressure", "call sim.set_pressure(body, index, value) in a simulation")
class Pressure(ScalarLoad):
    """A follower load on surface triangles: its value [Pa] pushes along the deformed inward normal."""

    kind: ClassVar[str] = "pressure"
    triangles: np.ndarray  #: (k,) int64 rows of mesh.surface
    closed: bool  #: whether these have no border; the load then has a potential

    @property
    def has_potential(self) -> bool:
        """Whether its work does not depend on the path that the body takes."""
        return self.closed


@guarded_record("cavity", "call sim.set_cavity(name, value) in a simulation")
class Cavity(ScalarLoad):
    """A closed inner surface with a fluid of given pressure [Pa], or an incompressible one of given volume [m^3], its value."""

    name: str
    triangles: np.ndarray  #: (k,) int64 rows of mesh.surface
    given: str  #: "pressure" or "volume"
    rest_volume: float  #: [m^3]

    @property
    def kind(self) -> str:
        """What its value is."""
        return self.given

    @property
    def has_potential(self) -> bool:
        """Whether energies count the work of its fluid: that of a given volume is left out."""
        return self.given == "pressure"


@guarded_record("activation", "call sim.set_activation(body, value) in a simulation")
class Activation(ScalarLoad):
    """How active the fibres of a body are, or those of one of its regions: from 0 to 1."""

    kind: ClassVar[str] = "activation"
    region: int | None = None  #: its id; None: all tets


@dataclass(frozen=True, eq=False)
class LoadPath:
    """Key frames as a path of a load: t [s] -> value (3,), their translations in the unit of the load, or a number, theirs."""

    frames: KeyFrames

    def __post_init__(self):
        if self.frames.rotations is not None or self.frames.release or self.frames.pivot is not None:
            raise SceneError("key frames: a load has translations only, which are its values; not rotations, pivot or release")

    def __call__(self, t: float) -> np.ndarray | float:
        return self.frames(t)[0] if self.frames.values is None else self.frames.value_at(t)


def either(what: str, **two) -> tuple:
    """Return name and value of the one of two arguments that is given. Raises SceneError if both or neither are."""
    given = [(name, value) for name, value in two.items() if value is not None]
    if len(given) != 1:
        raise SceneError(f"{what}: give either a {' or a '.join(two)}")
    return given[0]


def value_or_path(load, what: str, kind: str, shapes: tuple[tuple[int, ...], ...]) -> dict:
    """Return the fields value, path and path_shape of a load given as a value, a function of time, or `KeyFrames`.

    what: start of messages; kind: "force" or "traction"; shapes: those that a value may have, () for a number. Raises SceneError.
    """
    if isinstance(load, KeyFrames):
        if (load.values is None) != (() not in shapes):
            raise SceneError(f"{what}: {kind}: key frames need {'values' if () in shapes else 'translations'} here")
        with reworded(SceneError, f"{what}: {kind}: "):
            load = LoadPath(load)
    if not callable(load):
        return {"value": checks.array(load, f"{what}: {kind}", shapes)}
    return {"value": None, "path": load, "path_shape": _along(load, 0.0, what, kind, shapes).shape}


def value_at(load: Load, t: float, what: str) -> np.ndarray:
    """Return a load's value at t [s], (3,) or (k,3). what: start of messages. Raises SimulationError if its path fails."""
    if load.path is None:
        return load.value
    with reworded(SceneError, raised=SimulationError):
        return _along(load.path, t, what, load.kind, (load.path_shape,))


def _along(path: Callable, t: float, what: str, kind: str, shapes: tuple[tuple[int, ...], ...]) -> np.ndarray:
    """Return the value of a load's path at t [s], a copy, since a path may reuse its array."""
    value = checks.path_value(path, t, what, kind, shapes)
    if value is None:
        raise SceneError(f"{what}: the path must give a {kind} at t = {t:g}, not None")
    return value
