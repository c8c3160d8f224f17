"""Layers of pictures and the window for connections, pressures and fibres.

Springs and tendons are drawn as bands, coloured from low to high by the size of their tension relative to the recent maximum, and
attached nodes as crosses; attachments by springs have a line from each node to its place, too. Arrows show pressures: they point
along the force, with lengths relative to the recent maximum of pressures. Strokes show fibres at the surface: they lie in
triangles, move with the tets there, and are shorter where fibres leave the surface.
"""

import numpy as np

from taisoft.output.connection_lines import ConnectionLines
from taisoft.output.viewpoint import Viewpoint
from taisoft.scene.loads import Cavity, value_at
from taisoft.view.colouring import colours_of

ATTACHED_COLOUR, PRESSURE_COLOUR = np.array([0.93, 0.50, 0.08]), np.array([0.90, 0.10, 0.55])  # sRGB
BAND = (-1.0, 0.0, 1.0)  # parallel lines of a band,
BAND_WIDTH = 1.0 / 550.0  # of the picture's height from one to the next
CROSS = 0.008  # of the scene's size
# Longest arrow, of the scene's size, and of the middle extent of the pressed surface, so that it fits a channel; head of an arrow
PRESSURE_ARROW, IN_CHANNEL, HEAD = 0.07, 0.4, 0.3
MAX_SEGMENTS, MAX_CROSSES, MAX_ARROWS = 400, 150, 40  # segments in all; crosses of an attachment; arrows of a pressure
MAX_STROKES, STROKE = 1500, 0.9  # strokes of fibres in a body; their length over the square root of a triangle's area
DECAY = 0.99  # factor on the running maxima per picture


class ConnectionMarks:
    """What is drawn of the connections and pressures of a scene, and their present values.

    attached: (k,) attached nodes; pressed: nodes (k,3) of some triangles under each pressure, and its longest arrow [m].
    strokes: of each body with fibres and without a skin, nodes (k,4) of tets and their weights (k,2,4) in the ends of strokes.
    """

    def __init__(self, scene, size: float):
        """size: of the scene [m]."""
        exact, starts = scene.exact_attachments, scene.first_nodes
        self._lines = None
        if scene.has_springs:
            self._lines = ConnectionLines(scene, [one for one in scene.connections if one not in exact])
            ends, line = self._lines.segments
            step = -(-len(ends) // MAX_SEGMENTS)
            self._ends, self._line = ends[::step], line[::step]
        chosen = [starts[one.a] + one.nodes[:: -(-len(one.nodes) // MAX_CROSSES)] for one in scene.attachments]
        self.attached = np.concatenate([np.zeros(0, dtype=np.int64), *chosen])
        self._loads, self.pressed = [], []
        for body in scene.bodies:
            keyed = [(load, (body.name, index)) for index, load in enumerate(body.pressures)]
            for load, key in [*keyed, *((load, load.name) for load in body.cavities)]:
                corners = body.mesh.surface[load.triangles]
                extent = np.sort(np.ptp(body.mesh.vertices[np.unique(corners)], axis=0))[1]
                self._loads.append((load, key))
                longest = min(PRESSURE_ARROW * size, IN_CHANNEL * float(extent))
                self.pressed.append((corners[:: -(-len(corners) // MAX_ARROWS)] + starts[body.name], longest))
        fibrous = [body for body in scene.bodies if body.fibres is not None and body.skin is None]
        self.strokes = [_strokes(body, starts[body.name]) for body in fibrous]

    def segments(self, sim) -> tuple[np.ndarray, np.ndarray] | None:
        """Return ends (k,2,3) [m] and tensions (k,) [N] of springs, tendons and attachments by springs; None without any."""
        if self._lines is None:
            return None
        return self._lines.points(sim.positions(), sim.time)[self._ends], self._lines.tensions(sim)[self._line]

    def pressures(self, sim) -> list[float]:
        """Return the present pressures [Pa], in the order of `pressed`; those of cavities may be found by the simulation."""
        found = []
        for load, key in self._loads:
            if isinstance(load, Cavity):
                found.append(float(sim.cavity_pressure(key)))
                continue
            name, index = key
            found.append(float(value_at(sim.scene.body(name).pressures[index], sim.time, f"body {name!r}: pressure {index}")))
        return found


def _strokes(body, first: int) -> tuple[np.ndarray, np.ndarray]:
    """Nodes (k,4) of tets, and their weights (k,2,4) in the ends of strokes along a body's fibres in triangles of its surface.

    first: the body's first node.
    """
    mesh, chosen = body.mesh, np.arange(len(body.mesh.surface))
    chosen = chosen[body.fibres[mesh.surface_tets].any(axis=1)]
    chosen = chosen[:: -(-len(chosen) // MAX_STROKES) or 1]
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
    return first + tets, np.concatenate([1.0 - weights.sum(axis=2, keepdims=True), weights], axis=2)


class ConnectionLayer:
    """Lines of connections. marks: `ConnectionMarks`; size: of the scene [m]; peak: recent maximum of tensions [N], which scales
    their colours."""

    def __init__(self, marks, size: float):
        self._marks, self._size, self.peak = marks, size, 0.0

    def lines(self, sim, x: np.ndarray, camera: Viewpoint) -> list[tuple[np.ndarray, np.ndarray]]:
        """Return ends (2k,3) [m] and colours, one or (2k,3), of parts of the layer. x: (n_nodes,3) [m]."""
        found, segments = [], self._marks.segments(sim)
        if segments is not None:
            ends, tension = segments[0], np.abs(segments[1])
            self.peak = max(DECAY * self.peak, float(tension.max(initial=0.0)))
            colours = colours_of(tension / self.peak if self.peak > 0.0 else np.zeros(len(tension)))
            found.append((_bands(ends, camera), np.repeat(np.tile(colours, (len(BAND), 1)), 2, axis=0)))
        if len(self._marks.attached):
            right, up, _ = CROSS * self._size * camera.axes
            places = x[self._marks.attached]
            strokes = [np.stack([places - s, places + s], axis=1).reshape(-1, 3) for s in (right + up, right - up)]
            found.append((np.concatenate(strokes), ATTACHED_COLOUR))
        return found


class PressureLayer:
    """Arrows of pressures and of the fluid in cavities. marks: `ConnectionMarks`; peak: recent maximum of pressures [Pa], which
    scales them."""

    def __init__(self, marks):
        self._marks, self.peak = marks, 0.0

    def lines(self, sim, x: np.ndarray, camera: Viewpoint) -> list[tuple[np.ndarray, np.ndarray]]:
        """Return ends (2k,3) [m] and the colour of the arrows. x: (n_nodes,3) [m]."""
        pressures = self._marks.pressures(sim)
        self.peak, found = max([DECAY * self.peak, *map(abs, pressures)]), []
        for pressure, (corners, longest) in zip(pressures, self._marks.pressed):
            if pressure == 0.0:
                continue
            a, b, c = (x[corners[:, k]] for k in range(3))
            normal = np.cross(b - a, c - a)
            normal /= np.maximum(np.linalg.norm(normal, axis=1, keepdims=True), np.finfo(float).tiny)
            arrow = -longest * pressure / self.peak * normal
            # a push ends at the surface, a pull begins there
            tips = (a + b + c) / 3.0 + (arrow if pressure < 0.0 else 0.0)
            found.append((arrows(tips, arrow, camera), PRESSURE_COLOUR))
        return found


def _bands(ends: np.ndarray, camera: Viewpoint) -> np.ndarray:
    """Ends (2k,3) of parallel lines, one set of all segments (n,2,3) after the other, side by side in the picture."""
    across = np.cross(ends[:, 1] - ends[:, 0], camera.forward)
    across /= np.maximum(np.linalg.norm(across, axis=1, keepdims=True), np.finfo(float).tiny)
    depth = (ends - camera.position) @ camera.forward
    offset = (2.0 * camera.slope * BAND_WIDTH * depth)[:, :, None] * across[:, None]
    return np.concatenate([(ends + s * offset).reshape(-1, 3) for s in BAND])


def arrows(tips: np.ndarray, arrow: np.ndarray, camera: Viewpoint) -> np.ndarray:
    """Return the lines of arrows (3,) or (k,3) that end at tips (k,3): a shaft and two head strokes in the picture's plane."""
    side = np.cross(arrow, camera.forward)
    starts = [arrow, *(HEAD * (arrow + s * 0.5 * side) for s in (-1.0, 1.0))]
    return np.concatenate([np.stack([tips - one, tips], axis=1).reshape(-1, 3) for one in starts])
