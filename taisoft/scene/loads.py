"""Loads: values, constant or along a path, and the kinds of loads that act on a body.

A kind of load on nodes or surface triangles is one class of `BodyLoad`, registered by `load_kind`. What it is given, where it
acts, how scene files and checkpoints hold it, what a running simulation may change, and what pictures show follow from the class;
the forces of a dead load on nodes from its row of `WEIGHTS` in `taisoft.fem.loads`.
"""

import inspect
from collections.abc import Callable
from dataclasses import dataclass
from typing import TYPE_CHECKING, ClassVar

import numpy as np

from taisoft.attributes import guarded_record
from taisoft.errors import SceneError, SimulationError, reworded
from taisoft.mesh.distances import is_closed
from taisoft.scene import checks
from taisoft.scene.key_frames import KeyFrames

if TYPE_CHECKING:
    from taisoft.scene.body import Body

LOAD_KINDS: dict[str, type["BodyLoad"]] = {}  # by kind; a body's loads are counted in this order
RESERVED = ("fix", "move", "activate", "mesh", "material", "materials", "curve", "skin")  # keys of bodies in scene files
DEAD, FOLLOWER = "loads", "pressure"  # features of a plan: loads that do not follow the motion, and those that do


@dataclass(frozen=True, eq=False, kw_only=True)
class Load:
    """What all loads have: a value, constant or along a path."""

    value: np.ndarray | None  #: in one of `shapes`, in the unit of the load; None if it follows a path
    path: Callable | None = None  #: t [s] -> such a value
    path_shape: tuple[int, ...] | None = None  #: of all values along the path
    shapes: ClassVar[tuple[tuple[int, ...], ...]] = ((3,),)  #: those that its values may have
    given = "value"  # what its value is; no annotation, since that of a cavity or a tendon is a field

    @property
    def given_value(self):
        """Its value or path, as it was given."""
        return self.value if self.path is None else self.path.frames if isinstance(self.path, LoadPath) else self.path


@dataclass(frozen=True, eq=False)
class ScalarLoad(Load):
    """A load that is one number."""

    given = "number"
    shapes: ClassVar[tuple[tuple[int, ...], ...]] = ((),)


@dataclass(frozen=True, eq=False, kw_only=True)
class BodyLoad(Load):
    """A load on nodes or surface triangles of a body.

    Its class has `of(body, what, where, ...)`, which makes it: where as in `Body.fix`, or for triangles as in `add_traction`,
    then the load's own arguments, which `Body.add_load` and scene files take. what: start of messages. Those in `own` are fields;
    of the others one is given, whose name is `given`, and holds value or path.
    """

    kind: ClassVar[str]  #: its name for `Body.add_load`, `Simulator.set_load` and in scene files
    items: ClassVar[str]  #: what it acts on, and its field for these: "nodes" or "triangles"
    feature: ClassVar[str] = DEAD  #: of the plan
    arrows: ClassVar[str] = ""  #: layer of pictures that shows it; "": none
    own: ClassVar[tuple[str, ...]] = ()  #: arguments besides `where` and the value

    @property
    def ids(self) -> np.ndarray:
        """Ids (k,) of its nodes, or rows of mesh.surface."""
        return getattr(self, self.items)

    @property
    def arguments(self) -> dict:
        """What `Body.add_load` was given, with ids instead of a function."""
        return {**{name: getattr(self, name) for name in self.own}, "where": self.ids, self.given: self.given_value}

    @property
    def numbers(self) -> tuple[str, ...]:
        """The arguments that may change."""
        return (self.given,)

    def shown(self, value: np.ndarray) -> np.ndarray:
        """Return the traction (3,) or the pressure [Pa] that its arrows show. value: its value at a time."""
        return value

    def check_value(self, what: str) -> None:
        """Raise SceneError for a value that the load must not have; of a path, at t = 0."""


def load_kind(kind: str, call: str = "") -> Callable[[type], type]:
    """Return a decorator that makes a class a frozen record and registers it as a kind of load.

    kind: see `BodyLoad`; call: that changes its value during a run, by default `set_load`.
    """

    def register(cls: type) -> type:
        if kind in RESERVED:
            raise SceneError(f"load kind {kind!r}: scene files have another use for this name")
        if cls.feature == DEAD and isinstance(cls.shapes, tuple) and () in cls.shapes:
            raise SceneError(
                f"load kind {kind!r}: the values of a dead load have shape (3,): its forces on nodes are weights times them"
            )
        if cls.arrows and cls.items != "triangles":
            raise SceneError(f"load kind {kind!r}: arrows are drawn on triangles")
        call_now = call or f"sim.set_load(body, {kind!r}, index, value)"
        cls.kind, cls.set_by, cls.signature = kind, f"call {call_now}", inspect.signature(cls.of)
        if "given" not in cls.__annotations__:
            cls.given = kind
        LOAD_KINDS[kind] = guarded_record(kind, f"{cls.set_by} in a simulation")(cls)
        return LOAD_KINDS[kind]

    return register


@load_kind("traction", "sim.set_traction(body, index, value)")
class Traction(BodyLoad):
    """A dead load on surface triangles, its value a force per reference area [Pa]."""

    items: ClassVar[str] = "triangles"
    arrows: ClassVar[str] = "tractions"
    triangles: np.ndarray  #: (k,) int64 rows of mesh.surface

    @classmethod
    def of(cls, body: "Body", what: str, where, traction) -> "Traction":
        """The load of `add_traction`."""
        return cls(triangles=body.select_triangles(where, what), **value_or_path(traction, what, "traction", cls.shapes))


@load_kind("force", "sim.set_force(body, index, value)")
class NodalForce(BodyLoad):
    """A dead load on nodes: a total force (3,) [N] distributed by lumped mass, or one force per node (k,3) [N]."""

    items: ClassVar[str] = "nodes"
    nodes: np.ndarray  #: (k,) int64 node ids
    where: Callable | None = None  #: as in `Constraint`

    @property
    def shapes(self) -> tuple[tuple[int, ...], ...]:
        """A total, or one for each node."""
        return ((3,), (len(self.nodes), 3))

    @classmethod
    def of(cls, body: "Body", what: str, where, force) -> "NodalForce":
        """The load of `add_force`."""
        nodes = body.select_nodes(where, what)
        value = value_or_path(force, what, "force", ((3,), (len(nodes), 3)))
        return cls(nodes=nodes, where=where if callable(where) else None, **value)


@load_kind("pressure", "sim.set_pressure(body, index, value)")
class Pressure(BodyLoad, ScalarLoad):
    """A follower load on surface triangles: its value [Pa] pushes along the deformed inward normal."""

    items: ClassVar[str] = "triangles"
    feature: ClassVar[str] = FOLLOWER
    arrows: ClassVar[str] = "pressures"
    triangles: np.ndarray  #: (k,) int64 rows of mesh.surface
    closed: bool  #: whether these have no border; the load then has a potential

    @property
    def has_potential(self) -> bool:
        """Whether its work does not depend on the path that the body takes."""
        return self.closed

    @classmethod
    def of(cls, body: "Body", what: str, where, pressure) -> "Pressure":
        """The load of `add_pressure`."""
        triangles = body.select_triangles(where, what)
        value = value_or_path(pressure, what, "pressure", cls.shapes)
        return cls(triangles=triangles, closed=is_closed(body.mesh.surface[triangles]), **value)


@load_kind("cavity", "sim.set_cavity(name, value)")
class Cavity(BodyLoad, ScalarLoad):
    """A closed inner surface with a fluid of given pressure [Pa], or an incompressible one of given volume [m^3], its value."""

    items: ClassVar[str] = "triangles"
    feature: ClassVar[str] = FOLLOWER
    arrows: ClassVar[str] = "pressures"
    own: ClassVar[tuple[str, ...]] = ("name",)
    name: str
    triangles: np.ndarray  #: (k,) int64 rows of mesh.surface
    rest_volume: float  #: [m^3]
    given: str = "pressure"  #: or "volume": what its value is

    @property
    def has_potential(self) -> bool:
        """Whether energies count the work of its fluid: that of a given volume is left out."""
        return self.given == "pressure"

    @classmethod
    def of(cls, body: "Body", what: str, where, pressure=None, volume=None, name: str | None = None) -> "Cavity":
        """The load of `add_cavity`."""
        given, content = either(what, pressure=pressure, volume=volume)
        name = checks.free_name(name, f"{body.name} cavity ", [one.name for one in body.cavities], f"{what}: name")
        triangles = body.select_triangles(where, what)
        if not is_closed(body.mesh.surface[triangles]):
            raise SceneError(f"{what}: the chosen triangles have a border: they must enclose the cavity")
        for other in body.cavities:
            if len(shared := np.intersect1d(triangles, other.triangles)):
                raise SceneError(f"{what}: surface triangle {shared[0]} of cavity {name!r} belongs to cavity {other.name!r}")
        rest_volume = body.enclosed_volume(triangles)
        if rest_volume <= 0.0:
            raise SceneError(f"{what}: the normals of the chosen triangles point outward: they must point into the cavity")
        value = value_or_path(content, what, given, cls.shapes)
        cavity = cls(name=name, triangles=triangles, given=given, rest_volume=rest_volume, **value)
        cavity.check_value(what)
        return cavity

    def check_value(self, what: str) -> None:
        """Raise SceneError if a volume is not above 0; of a path, at t = 0."""
        start = self.value if self.path is None else self.path(0.0)
        if self.given == "volume" and float(start) <= 0.0:
            raise SceneError(f"{what}: volume must be above 0, not {float(start):g}")


SHIPPED_LOADS = tuple(LOAD_KINDS)


@guarded_record("activation", "call sim.set_activation(body, value) in a simulation")
class Activation(ScalarLoad):
    """How active the fibres of a body are, or those of one of its regions: from 0 to 1."""

    given = "activation"
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
    found = [(name, value) for name, value in two.items() if value is not None]
    if len(found) != 1:
        raise SceneError(f"{what}: give either a {' or a '.join(two)}")
    return found[0]


def value_or_path(load, what: str, given: str, shapes: tuple[tuple[int, ...], ...]) -> dict:
    """Return the fields value, path and path_shape of a load given as a value, a function of time, or `KeyFrames`.

    what: start of messages; given: what it is, such as "force"; shapes: those that a value may have, () for a number.
    Raises SceneError.
    """
    if isinstance(load, KeyFrames):
        if (load.values is None) != (() not in shapes):
            raise SceneError(f"{what}: {given}: key frames need {'values' if () in shapes else 'translations'} here")
        with reworded(SceneError, f"{what}: {given}: "):
            load = LoadPath(load)
    if not callable(load):
        return {"value": checks.array(load, f"{what}: {given}", shapes)}
    return {"value": None, "path": load, "path_shape": _along(load, 0.0, what, given, shapes).shape}


def value_at(load: Load, t: float, what: str) -> np.ndarray:
    """Return a load's value at t [s], (3,) or (k,3). what: start of messages. Raises SimulationError if its path fails."""
    if load.path is None:
        return load.value
    with reworded(SceneError, raised=SimulationError):
        return _along(load.path, t, what, load.given, (load.path_shape,))


def _along(path: Callable, t: float, what: str, given: str, shapes: tuple[tuple[int, ...], ...]) -> np.ndarray:
    """Return the value of a load's path at t [s], a copy, since a path may reuse its array."""
    value = checks.path_value(path, t, what, given, shapes)
    if value is None:
        raise SceneError(f"{what}: the path must give a {given} at t = {t:g}, not None")
    return value
