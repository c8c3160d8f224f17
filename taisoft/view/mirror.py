"""What the view knows of a simulation in another process: its scene as plain data, and its latest state.

`describe_scene` lists what is drawn and picked of a scene, without its paths, which are functions; the state then brings the
poses of moving obstacles, the tractions along paths, connections and pressures. `MirrorScene` and `MirrorSimulation` have the
attributes of `Scene` and `Simulator` that pictures need, so that both are drawn alike.
"""

from dataclasses import fields
from types import SimpleNamespace

import numpy as np
import scipy.sparse as sp

from taisoft.errors import OutputError, SceneError, SimulationError, reworded
from taisoft.records import Energies
from taisoft.scene import checks
from taisoft.scene.loads import value_at
from taisoft.scene.obstacles import Box, Capsule, HalfSpace, MeshObstacle, Obstacle, Sphere
from taisoft.view.connection_layer import ConnectionMarks
from taisoft.view.plots import ENERGIES
from taisoft.view.scene_view import MAX_CONTACTS

ELSEWHERE = "in the other process"  # stands for a path
SHAPES = {shape.__name__: shape for shape in (HalfSpace, Sphere, Box, Capsule, MeshObstacle)}


def describe_scene(scene, marks: ConnectionMarks) -> dict:
    """Return what the view needs of a scene, as plain data for `MirrorScene`. marks: of its connections and pressures."""
    return {
        "gravity": np.asarray(scene.gravity),
        "up": scene.up,
        "background": scene.background,
        "lights": None if scene.lights is None else [vars(one) for one in scene.lights],
        "connections": [{"owners": list(one.owners)} for one in scene.connections],
        "marks": [marks.attached, marks.pressed, marks.strokes],
        "bodies": [
            {
                "name": body.name,
                "colour": body.colour,
                "opacity": body.opacity,
                "position": np.asarray(body.position),
                "rest_positions": np.asarray(body.rest_positions),
                "n_nodes": body.n_nodes,
                "nodes": {"surface": np.asarray(body.nodes.surface)},
                "mesh": {"surface": np.asarray(body.mesh.surface)},
                "riding_skin": body.riding_skin and _describe_skin(body.riding_skin),
                "constraints": [
                    {"nodes": c.nodes, "path": None if c.path is None else ELSEWHERE} for c in scene.constraints(body)
                ],
                "tractions": [{"triangles": t.triangles, "path": None, "value": np.zeros(3)} for t in body.tractions],
            }
            for body in scene.bodies
        ],
        "obstacles": [
            {
                "name": o.name,
                "look": {"colour": o.colour, "opacity": o.opacity},
                "shape": type(o.shape).__name__,
                "fields": {field.name: getattr(o.shape, field.name) for field in fields(o.shape)},
                "pose": None if o.path is None else o.pose(0.0),
            }
            for o in scene.obstacles
        ],
    }


def _describe_skin(skin) -> dict:
    weights, surface = skin.weights, skin.surface
    parts = {name: getattr(weights, name) for name in ("data", "indices", "indptr", "shape")}
    return {"weights": parts, "surface": {"vertices": surface.vertices, "triangles": surface.triangles}}


def _namespace(value):
    """Return nested plain data with the entries of its dicts as attributes."""
    if isinstance(value, dict):
        return SimpleNamespace(**{key: _namespace(inner) for key, inner in value.items()})
    return [_namespace(inner) for inner in value] if isinstance(value, list) else value


class MirrorScene:
    """A scene from its description: `bodies` with what is drawn of them, and `obstacles`, whose paths give the latest poses."""

    def __init__(self, description: dict):
        self.bodies, self.connections = (_namespace(description[name]) for name in ("bodies", "connections"))
        for skin in (body.riding_skin for body in self.bodies if body.riding_skin):
            parts = skin.weights
            skin.weights = sp.csr_matrix((parts.data, parts.indices, parts.indptr), shape=parts.shape)
        self.gravity, self.up, self.background = (description[name] for name in ("gravity", "up", "background"))
        self.lights = _namespace(description["lights"])
        self.obstacles = [Obstacle(SHAPES[o["shape"]](**o["fields"]), o["name"], **o["look"]) for o in description["obstacles"]]
        self.poses = {}
        self.take_poses({o["name"]: o["pose"] for o in description["obstacles"] if o["pose"] is not None})

    def take_poses(self, poses: dict) -> None:
        """Take over the poses of the obstacles that move, by name: more may, once they are commanded."""
        for obstacle in self.obstacles:
            if obstacle.name in poses and obstacle.name not in self.poses:
                checks.store(obstacle, path=lambda _, name=obstacle.name: self.poses[name])
        at_rest = dict.fromkeys(self.poses, (np.zeros(3), np.eye(3)))  # those whose commands a reset has ended
        self.poses |= at_rest | poses

    @staticmethod
    def constraints(body: SimpleNamespace) -> list:
        """Return the constraints of a body."""
        return body.constraints


def describe_state(sim, marks: ConnectionMarks, layers: set[str]) -> dict:
    """Return what the view needs of sim's present state besides positions and nodal values.

    marks: as for `describe_scene`; layers: those that are visible. Raises OutputError if a path fails.
    """
    with reworded((SceneError, SimulationError), "the scene cannot be shown: ", raised=OutputError):
        poses = {o.name: o.pose(sim.time) for o in sim.scene.obstacles if o.path is not None}
        loads = [(t, body.name) for body in sim.scene.bodies for t in body.tractions if "tractions" in layers]
        tractions = [value_at(t, sim.time, name) for t, name in loads]
        segments = marks.segments(sim) if "connections" in layers else None
        pressures = marks.pressures(sim) if "pressures" in layers else []
    energies = sim.energies()
    state = {
        "time": sim.time,
        "step_count": sim.step_count,
        "energies": [float(getattr(energies, name)) for name in ENERGIES],
        "poses": poses,
        "tractions": tractions,
    }
    if "contacts" in layers:
        found, k = sim.contacts(), slice(0, MAX_CONTACTS)
        state["contacts"] = {name: getattr(found, name)[k] for name in ("point", "normal", "impulse")}
    if "pressures" in layers:
        state["pressures"] = pressures
    return state | {"segments": segments}


class MirrorSimulation:
    """The latest state of a simulation, with those attributes of `Simulator` and of `ConnectionMarks` that pictures need.

    nodal_values: (n_nodes,) of the quantity `nodal_kind`, None until they are known.
    """

    def __init__(self, description: dict, n_nodes: int):
        self.scene, (self.attached, self.pressed, self.strokes) = MirrorScene(description), description["marks"]
        self._segments, self._pressures = None, [0.0] * len(self.pressed)
        self.time, self.step_count = 0.0, 0
        self._energies, self._contacts = Energies(0.0, 0.0, 0.0), None
        ends = np.cumsum([0] + [body.n_nodes for body in self.scene.bodies])
        self._rows = {body.name: slice(*pair) for body, pair in zip(self.scene.bodies, zip(ends, ends[1:]))}
        self._x = np.zeros((n_nodes, 3))
        self.nodal_kind, self.nodal_values = "body", None

    def take(self, state: dict, x: np.ndarray, values: np.ndarray) -> None:
        """Take over a state; x (n,3) and values (n,) are copied."""
        self.time, self.step_count = state["time"], state["step_count"]
        self._energies, self._x = Energies(*state["energies"]), x.copy()
        self.scene.take_poses(state["poses"])
        tractions = [t for body in self.scene.bodies for t in body.tractions]
        for traction, value in zip(tractions, state["tractions"]):
            traction.value = value
        self._contacts = state.get("contacts")
        self._segments, self._pressures = state["segments"], state.get("pressures", self._pressures)
        self.nodal_kind = state["colour"]
        self.nodal_values = None if self.nodal_kind == "body" else values.copy()

    def positions(self, body: str | None = None) -> np.ndarray:
        """Return node positions (n,3) [m] of a body, or of all."""
        return self._x if body is None else self._x[self._rows[body]]

    def energies(self) -> Energies:
        """Return the energies [J]."""
        return self._energies

    def contacts(self) -> SimpleNamespace:
        """Return the contacts' point, normal and impulse, (k,3) each."""
        none = dict.fromkeys(("point", "normal", "impulse"), np.empty((0, 3)))
        return SimpleNamespace(**(self._contacts or none))

    def segments(self, _sim) -> tuple[np.ndarray, np.ndarray] | None:
        """Return ends (k,2,3) [m] and tensions (k,) [N] of the connections drawn as lines; None without any."""
        return self._segments

    def pressures(self, _sim) -> list[float]:
        """Return the pressures [Pa], in the order of `pressed`."""
        return self._pressures

    def values_of(self, kind: str, _sim=None) -> np.ndarray | None:
        """Return the quantity at the nodes (n_nodes,), or None until the simulation has sent it."""
        return self.nodal_values if kind == self.nodal_kind else None
