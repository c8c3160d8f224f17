"""What pictures show, as plain data: `DrawnScene`, which does not change, and `DrawnState`, the scene at one moment.

Pictures, the window and files of states draw from these two and from nothing else. So they are drawn alike beside the simulation,
in another process, and again from the files of a finished run. Positions are kept as displacements in single precision, so that
a picture drawn from a file has the same bytes as one drawn during the run.
"""

from collections.abc import Iterable
from dataclasses import dataclass, field, fields
from functools import cached_property
from typing import Any

import numpy as np
import scipy.sparse as sp

from taisoft.output.viewpoint import framed_points, start_positions
from taisoft.scene.look import Camera, Light
from taisoft.scene.obstacles import Box, Capsule, HalfSpace, MeshObstacle, Obstacle, Sphere

SHAPES = {shape.__name__: shape for shape in (HalfSpace, Sphere, Box, Capsule, MeshObstacle)}
MAX_MARKERS = 500  # per body; of more fixed nodes, evenly selected ones are shown
MAX_CROSSES, MAX_ARROWS, MAX_LOAD_ARROWS = 150, 40, 60  # of an attachment; of a pressure; of a traction
PRESSURE_ARROW, IN_CHANNEL = 0.07, 0.4  # longest arrow over the scene's size, and over the middle extent of the pressed surface
MAX_STROKES, STROKE = 1500, 0.9  # strokes of fibres in a body; their length over the square root of a triangle's area


@dataclass(eq=False, repr=False)
class DrawnBody:
    """What is drawn of a body. Nodes are its own.

    position (3,), rest_positions (n,3) [m]; surface (t,3): nodes of its triangles; colour (3,) sRGB, or None for the palette's;
    fixed (k,): nodes with a marker; loaded: of each traction, nodes (k,3) of the triangles that get an arrow; vertices (v,3) [m],
    triangles and weights (v,n), sparse: a skin that is drawn instead of the surface, else None; strokes: nodes (k,4) of tets, and
    their weights (k,2,4) in the ends of strokes along its fibres, or None.
    """

    name: str
    position: np.ndarray
    rest_positions: np.ndarray
    surface: np.ndarray
    colour: np.ndarray | None
    opacity: float
    fixed: np.ndarray
    loaded: list[np.ndarray]
    vertices: np.ndarray | None = None
    triangles: np.ndarray | None = None
    weights: sp.csr_matrix | None = None
    strokes: tuple[np.ndarray, np.ndarray] | None = None

    @classmethod
    def of(cls, scene, body) -> "DrawnBody":
        """Return what is drawn of a body of a scene."""
        skin, surface = body.riding_skin, np.asarray(body.nodes.surface)
        fixed = [c.nodes for c in scene.constraints(body) if c.path is None] if skin is None else []
        fixed = np.intersect1d(np.concatenate(fixed), surface) if fixed else np.empty(0, dtype=np.int64)
        loaded = [body.mesh.surface[some(t.triangles, MAX_LOAD_ARROWS)] for t in body.loads if t.arrows == "tractions"]
        look = body.colour, body.opacity, some(fixed, MAX_MARKERS), loaded
        drawn = cls(body.name, np.asarray(body.position), np.asarray(body.rest_positions), surface, *look)
        if skin is not None:
            drawn.vertices, drawn.triangles, drawn.weights = skin.surface.vertices, skin.surface.triangles, skin.weights
        if body.fibres is not None and body.skin is None:
            drawn.strokes = _strokes(body)
        return drawn

    @property
    def n_nodes(self) -> int:
        """Number of nodes."""
        return len(self.rest_positions)

    def plain(self) -> dict:
        """Return the fields as plain data."""
        weights = self.weights
        parts = ("data", "indices", "indptr", "shape")
        parts = weights if weights is None else {name: getattr(weights, name) for name in parts}
        return _fields(self) | {"weights": parts, "strokes": None if self.strokes is None else list(self.strokes)}

    @classmethod
    def from_plain(cls, given: dict) -> "DrawnBody":
        """Return the body of `plain`."""
        drawn, parts = cls(**given), given["weights"]
        if parts is not None:
            drawn.weights = sp.csr_matrix((parts["data"], parts["indices"], parts["indptr"]), shape=tuple(parts["shape"]))
        return drawn


@dataclass(eq=False, repr=False)
class DrawnScene:
    """What is drawn of a scene. Nodes are counted through all bodies where nothing else is said.

    obstacles: of those read from plain data, paths stay at their start; framed (k,3) [m]: what the automatic camera shows from
    the start on; attached (k,): nodes with a cross; pressed: of each pressure, nodes (k,3) of some triangles, and its longest
    arrow [m].
    """

    up: str
    bodies: list[DrawnBody]
    obstacles: list[Obstacle]
    background: np.ndarray | None
    lights: tuple[Light, ...] | None
    camera: Camera | None
    framed: np.ndarray
    attached: np.ndarray
    pressed: list[tuple[np.ndarray, float]]
    rows: dict[str, slice] = field(init=False)  #: of the nodes of each body
    start: np.ndarray = field(init=False)  #: positions (n,3) [m] of all nodes
    size: float = field(init=False)  #: diagonal of the bodies' bounding box at the start [m]

    def __post_init__(self):
        ends = np.cumsum([0, *(body.n_nodes for body in self.bodies)]).tolist()
        self.rows = {body.name: slice(*pair) for body, pair in zip(self.bodies, zip(ends, ends[1:]))}
        self.start = start_positions(self)
        self.size = float(np.linalg.norm(np.ptp(self.start, axis=0)))

    @classmethod
    def of(cls, scene) -> "DrawnScene":
        """Return what is drawn of a scene, which may be this already."""
        if isinstance(scene, cls):
            return scene
        starts = scene.first_nodes
        attached = [starts[one.a] + some(one.nodes, MAX_CROSSES) for one in scene.attachments]
        look = scene.background, scene.lights, scene.camera, framed_points(scene)
        marks = np.concatenate([np.zeros(0, dtype=np.int64), *attached]), []
        drawn = cls(scene.up, [DrawnBody.of(scene, body) for body in scene.bodies], list(scene.obstacles), *look, *marks)
        for body, _, load in with_arrows(scene, "pressures"):
            corners = body.mesh.surface[load.triangles]
            extent = np.sort(np.ptp(body.mesh.vertices[np.unique(corners)], axis=0))[1]
            longest = min(PRESSURE_ARROW * drawn.size, IN_CHANNEL * float(extent))
            drawn.pressed.append((some(corners, MAX_ARROWS) + starts[body.name], longest))
        return drawn

    def plain(self) -> dict:
        """Return it as plain data: nested dicts and lists of numbers, texts and arrays."""
        given = {name: value for name, value in _fields(self).items() if name not in ("rows", "start", "size")}
        return given | {
            "bodies": [body.plain() for body in self.bodies],
            "obstacles": [_plain_obstacle(one) for one in self.obstacles],
            "lights": None if self.lights is None else [_fields(one) for one in self.lights],
            "camera": None if self.camera is None else _fields(self.camera),
            "pressed": [list(one) for one in self.pressed],
        }

    def looks(self) -> dict:
        """Return background, lights, camera, colours and opacities as plain data."""
        given = self.plain()
        ones = [[one["name"], one["colour"], one["opacity"]] for one in (*given["bodies"], *given["obstacles"])]
        return {name: given[name] for name in ("background", "lights", "camera")} | {"ones": ones}

    @classmethod
    def from_plain(cls, given: dict) -> "DrawnScene":
        """Return the scene of `plain`."""
        drawn = cls(**given | {"bodies": [DrawnBody.from_plain(one) for one in given["bodies"]]})
        drawn.obstacles = [_obstacle(**one) for one in given["obstacles"]]
        drawn.lights = None if given["lights"] is None else tuple(Light(**one) for one in given["lights"])
        drawn.camera = None if given["camera"] is None else Camera(**given["camera"])
        return drawn


@dataclass(eq=False, repr=False)
class DrawnState:
    """A scene at one moment.

    displacement (n,3) [m], float32, of all nodes since the start; values: quantities of `taisoft.view.choices.COLOURS` at the
    nodes (n,); energies [J]; poses: of the obstacles that move, translation (3,) [m] and rotation (3,3) by name; tractions (3,)
    [Pa] and pressures [Pa], in the scene's order; segments: ends (k,2,3) [m] and tensions (k,) [N] of springs and tendons;
    contacts: point (k,3) [m], normal and impulse (k,3) [N s] by name. What nothing draws is empty.
    """

    scene: DrawnScene
    time: float
    displacement: np.ndarray
    step_count: int = 0
    values: dict[str, np.ndarray] = field(default_factory=dict)
    energies: dict[str, float] = field(default_factory=dict)
    poses: dict[str, tuple[np.ndarray, np.ndarray]] = field(default_factory=dict)
    tractions: list[np.ndarray] = field(default_factory=list)
    pressures: list[float] = field(default_factory=list)
    segments: tuple[np.ndarray, np.ndarray] | None = None
    contacts: dict[str, np.ndarray] = field(default_factory=dict)

    @classmethod
    def at_start(cls, scene: DrawnScene) -> "DrawnState":
        """Return a scene as it is before it is simulated. Raises SceneError if a path fails."""
        poses = {one.name: one.pose(0.0) for one in scene.obstacles if one.path is not None}
        return cls(scene, 0.0, np.zeros(scene.start.shape, np.float32), poses=poses)

    @cached_property
    def x(self) -> np.ndarray:
        """Positions (n,3) [m] of all nodes."""
        return self.scene.start + self.displacement

    def positions(self, body: str) -> np.ndarray:
        """Return the positions (n,3) [m] of a body's nodes."""
        return self.x[self.scene.rows[body]]

    def plain(self) -> dict:
        """Return it as plain data, without the scene and the arrays over the nodes, displacement and values."""
        given = {name: value for name, value in _fields(self).items() if name not in ("scene", "displacement", "values")}
        poses, segments = {name: list(pose) for name, pose in self.poses.items()}, self.segments
        return given | {"poses": poses, "segments": None if segments is None else list(segments)}


def with_arrows(scene, layer: str) -> Iterable[tuple[Any, int, Any]]:
    """Return (body, index, load) of all loads that a layer shows; index: among those of its kind in its body."""
    for body in scene.bodies:
        yield from ((body, index, load) for _, index, load in body.numbered_loads if load.arrows == layer)


def _fields(record) -> dict:
    return {one.name: getattr(record, one.name) for one in fields(record)}


def some(items: np.ndarray, most: int) -> np.ndarray:
    """Return items, of more than `most` evenly selected ones."""
    return items[:: -(-len(items) // most) or 1]


def _plain_obstacle(one: Obstacle) -> dict:
    pose = None if one.path is None else list(one.pose(0.0))
    shape = {"shape": type(one.shape).__name__, "fields": _fields(one.shape), "pose": pose}
    return shape | {"name": one.name, "colour": one.colour, "opacity": one.opacity}


def _obstacle(shape: str, fields: dict, pose: list | None, **given) -> Obstacle:
    path = None if pose is None else lambda _: pose
    return Obstacle(SHAPES[shape](**fields), path=path, **given)


def _strokes(body) -> tuple[np.ndarray, np.ndarray]:
    """Nodes (k,4) of tets, and their weights (k,2,4) in the ends of strokes along a body's fibres in triangles of its surface."""
    mesh = body.mesh
    chosen = some(np.flatnonzero(body.fibres[mesh.surface_tets].any(axis=1)), MAX_STROKES)
    a, b, c = np.moveaxis(mesh.vertices[mesh.surface[chosen]], 1, 0)
    normal, tets = np.cross(b - a, c - a), mesh.tets[mesh.surface_tets[chosen]]
    area = np.linalg.norm(normal, axis=1, keepdims=True)
    direction, normal = body.fibres[mesh.surface_tets[chosen]], normal / area
    along = direction - (direction * normal).sum(axis=1, keepdims=True) * normal
    half = 0.5 * STROKE * np.sqrt(0.5 * area) * along
    ends = (a + b + c)[:, None] / 3.0 + half[:, None] * np.array([-1.0, 1.0])[:, None]
    corners = mesh.vertices[tets]
    Dm_inv = np.linalg.inv(corners[:, 1:] - corners[:, :1])
    weights = (ends - corners[:, :1]) @ Dm_inv
    return tets, np.concatenate([1.0 - weights.sum(axis=2, keepdims=True), weights], axis=2)
