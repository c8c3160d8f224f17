"""Loads of a body, constant or along a path: tractions and pressures on surface triangles, forces on nodes."""

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np

from taisoft.attributes import guarded_record
from taisoft.errors import SceneError, SimulationError
from taisoft.scene import checks
from taisoft.scene.key_frames import KeyFrames


@guarded_record("traction", "call sim.set_traction(body, index, value) in a simulation")
@dataclass(frozen=True, eq=False)
class Traction:
    """A dead load on surface triangles."""

    triangles: np.ndarray  #: (k,) int64 rows of mesh.surface
    value: np.ndarray | None  #: (3,) force per reference area [Pa]; None if it follows a path
    path: Callable | None = None  #: t [s] -> such a value

    def __post_init__(self):
        checks.store(self, triangles=self.triangles, value=self.value)

    @property
    def shapes(self) -> tuple[tuple[int, ...], ...]:
        """Shapes that its values may have."""
        return ((3,),)


@guarded_record("force", "call sim.set_force(body, index, value) in a simulation")
@dataclass(frozen=True, eq=False)
class NodalForce:
    """A dead load on nodes: a total force distributed by lumped mass, or one force per node."""

    nodes: np.ndarray  #: (k,) int64 node ids
    value: np.ndarray | None  #: (3,) total force, or (k,3) one per node [N]; None if it follows a path
    where: Callable | None = None  #: as in `Constraint`
    path: Callable | None = None  #: t [s] -> such a value

    def __post_init__(self):
        checks.store(self, nodes=self.nodes, value=self.value)

    @property
    def shapes(self) -> tuple[tuple[int, ...], ...]:
        """Shapes that its values may have."""
        return ((3,), (len(self.nodes), 3))


@dataclass(frozen=True, eq=False)
class ScalarLoad:
    """A load that is one number."""

    value: np.ndarray | None  #: (), in the unit of the load; None if it follows a path
    path: Callable | None = None  #: t [s] -> such a number

    def __post_init__(self):
        checks.store(self, value=self.value)

    @property
    def shapes(self) -> tuple[tuple[int, ...], ...]:
        """Shapes that its values may have."""
        return ((),)


@guarded_record("pressure", "call sim.set_pressure(body, index, value) in a simulation")
@dataclass(frozen=True, eq=False, kw_only=True)
class Pressure(ScalarLoad):
    """A follower load on surface triangles: its value [Pa] pushes along the deformed inward normal."""

    triangles: np.ndarray  #: (k,) int64 rows of mesh.surface
    closed: bool  #: whether these have no border; the load then has a potential

    def __post_init__(self):
        checks.store(self, value=self.value, triangles=self.triangles)

    @property
    def has_potential(self) -> bool:
        """Whether its work does not depend on the path that the body takes."""
        return self.closed


@guarded_record("cavity", "call sim.set_cavity(name, value) in a simulation")
@dataclass(frozen=True, eq=False, kw_only=True)
class Cavity(ScalarLoad):
    """A closed inner surface with a fluid of given pressure [Pa], or an incompressible one of given volume [m^3], its value."""

    name: str
    triangles: np.ndarray  #: (k,) int64 rows of mesh.surface
    given: str  #: "pressure" or "volume"
    rest_volume: float  #: [m^3]

    def __post_init__(self):
        checks.store(self, value=self.value, triangles=self.triangles)

    @property
    def has_potential(self) -> bool:
        """Whether energies count the work of its fluid: that of a given volume is left out."""
        return self.given == "pressure"


@dataclass(frozen=True, eq=False)
class LoadPath:
    """Key frames as a path of a load: t [s] -> value (3,), their translations in the unit of the load, or a number, theirs."""

    frames: KeyFrames

    def __post_init__(self):
        if self.frames.rotations is not None or self.frames.release or self.frames.pivot is not None:
            raise SceneError("key frames: a load has translations only, which are its values; not rotations, pivot or release")

    def __call__(self, t: float) -> np.ndarray | float:
        return self.frames(t)[0] if self.frames.values is None else self.frames.value_at(t)


def value_and_path(load, what: str, shapes: tuple[tuple[int, ...], ...]) -> tuple[np.ndarray | None, Callable | None]:
    """Return (value, None) or (None, path) of a load given as a value, a function of time, or `KeyFrames`. Raises SceneError.

    shapes: those that a value may have; () for a number.
    """
    if isinstance(load, KeyFrames):
        if (load.values is None) != (() not in shapes):
            raise SceneError(f"{what}: key frames need {'values' if () in shapes else 'translations'} here")
        try:
            load = LoadPath(load)
        except SceneError as error:
            raise SceneError(f"{what}: {error}") from None
    if not callable(load):
        return checks.array(load, what, shapes), None
    try:
        start = load(0.0)
    except Exception as error:
        raise SceneError(f"{what}: the path failed at t = 0: {type(error).__name__}: {error}") from error
    checks.array(start, f"{what} at t = 0", shapes)
    return None, load


def value_at(load: Traction | NodalForce, t: float, what: str) -> np.ndarray:
    """Return a load's value at t [s], (3,) or (k,3). what: start of messages. Raises SimulationError if its path fails."""
    if load.path is None:
        return load.value
    try:
        value = np.array(load.path(t), dtype=np.float64)  # a copy, since a path may reuse its array
    except Exception as error:  # a user's function may raise anything
        raise SimulationError(f"{what}: its path failed at t = {t:g} s: {type(error).__name__}: {error}") from error
    if value.shape not in load.shapes or not np.isfinite(value).all():
        given = value.tolist() if value.size < 10 else value.shape
        rule = f"finite, of shape {' or '.join(map(str, load.shapes))}"
        raise SimulationError(f"{what}: its path gave {given} at t = {t:g} s: it must be {rule}")
    return value
