"""Layers of pictures and the window: lines beside the surfaces.

They show contacts, with normals of a fixed length and impulses; tractions and pressures as arrows along the force; springs and
tendons as bands, coloured from low to high by the size of their tension, and attached nodes as crosses; fibres as strokes in
triangles of the surface, which move with the tets there and are shorter where fibres leave it; and the wires of surfaces.
Impulses, pressures and tensions are drawn relative to their recent maxima.

Lines are moved along their rays towards the eye, so that they cover the same pixels: wireframes and strokes just enough to lie in
front of their own surface, all others so far that nothing hides them.
"""

import numpy as np

from taisoft.errors import OutputError
from taisoft.mesh.topology import triangle_edges
from taisoft.output.appearance import ShownBodies
from taisoft.output.viewpoint import Viewpoint
from taisoft.scene.checks import choice
from taisoft.view.choices import IN_WINDOW, LAYERS
from taisoft.view.colouring import colours_of
from taisoft.view.drawn import DrawnScene, DrawnState
from taisoft.view.sampling import MAX_CONTACTS

MAX_MARK_LINES = 4 * MAX_CONTACTS  # largest number of lines of contacts and arrows, besides the wires
ON_SURFACE, IN_FRONT = 0.996, 0.1  # fractions of the distance from the eye
NORMAL, IMPULSE, ARROW, CROSS = 0.04, 0.15, 0.10, 0.008  # lengths relative to the scene's size
BAND = (-1.0, 0.0, 1.0)  # parallel lines of a band,
BAND_WIDTH = 1.0 / 550.0  # of the picture's height from one to the next
HEAD = 0.3  # of an arrow, over its length
DECAY = 0.99  # factor on the running maxima per picture
WIRE_COLOUR, NORMAL_COLOUR = np.array([0.12, 0.14, 0.18]), np.array([0.10, 0.55, 0.25])  # sRGB
IMPULSE_COLOUR, TRACTION_COLOUR = np.array([0.85, 0.12, 0.12]), np.array([0.55, 0.15, 0.65])
ATTACHED_COLOUR, PRESSURE_COLOUR = np.array([0.93, 0.50, 0.08]), np.array([0.90, 0.10, 0.55])
FIBRE_COLOUR = np.array([0.38, 0.06, 0.10])
Lines = list[tuple[np.ndarray, np.ndarray]]  # ends (2k,3) [m], and colours, one or (2k,3), of parts of a layer


class Layers:
    """Optional layers beside the surfaces.

    shown: name -> whether it is visible, initially those in `names`; n_segments: largest number of lines that `lines` returns;
    peaks: recent maxima of "impulse" [N s], "tension" [N] and "pressure" [Pa]. Raises OutputError for an unknown name.
    """

    def __init__(self, scene, names: tuple[str, ...] = IN_WINDOW):
        for name in names:
            choice(name, "layer", LAYERS, OutputError)
        self.shown = {name: name in names for name in LAYERS}
        self.peaks = dict.fromkeys(("impulse", "tension", "pressure"), 0.0)
        scene = DrawnScene.of(scene)
        self._shown = ShownBodies(scene)
        surfaces = zip(self._shown.surfaces, self._shown.starts)
        self._edges = np.concatenate([triangle_edges(triangles)[0] + n for (_, triangles), n in surfaces])
        firsts = {body.name: scene.rows[body.name].start for body in scene.bodies}
        self._strokes = [(firsts[b.name] + b.strokes[0], b.strokes[1]) for b in scene.bodies if b.strokes is not None]
        self._loaded = [firsts[body.name] + corners for body in scene.bodies for corners in body.loaded]
        self.n_segments = len(self._edges) + MAX_MARK_LINES + sum(len(nodes) for nodes, _ in self._strokes)

    def lines(self, state: DrawnState, camera: Viewpoint) -> tuple[np.ndarray, np.ndarray]:
        """Return the ends (2k,3) [m] of the lines, as drawn for this camera, and their colours (2k,3)."""
        ends, colours = [np.empty((0, 3))], [np.empty((0, 3))]
        for name in LAYERS:
            if self.shown[name] and name != "fixed_nodes":  # which belong to the surfaces
                for part, colour in getattr(self, f"_{name}")(state, camera):
                    ends.append(camera.nearer(part, ON_SURFACE if name in ("fibres", "wires") else IN_FRONT))
                    colours.append(np.broadcast_to(colour, part.shape))
        return np.concatenate(ends), np.concatenate(colours)

    def _peak(self, name: str, sizes: np.ndarray) -> float:
        """Return the recent maximum of sizes (k,) of which these are the present ones, 1 if all are 0."""
        self.peaks[name] = max(DECAY * self.peaks[name], float(np.max(sizes, initial=0.0)))
        return self.peaks[name] or 1.0

    def _contacts(self, state: DrawnState, _camera: Viewpoint) -> Lines:
        if not state.contacts:
            return []
        size, (point, normal, impulse) = state.scene.size, (state.contacts[name] for name in ("point", "normal", "impulse"))
        relative = impulse / self._peak("impulse", np.linalg.norm(impulse, axis=1))
        return [
            (_segments(point, point + NORMAL * size * normal), NORMAL_COLOUR),
            (_segments(point, point + IMPULSE * size * relative), IMPULSE_COLOUR),
        ]

    def _tractions(self, state: DrawnState, camera: Viewpoint) -> Lines:
        longest = max((float(np.linalg.norm(t)) for t in state.tractions), default=0.0) or 1.0
        arrow = [ARROW * state.scene.size / longest * traction for traction in state.tractions]
        tips = [state.x[corners].mean(axis=1) for corners in self._loaded]
        return [(_arrows(*one, camera), TRACTION_COLOUR) for one in zip(tips, arrow)]

    def _pressures(self, state: DrawnState, camera: Viewpoint) -> Lines:
        peak, found = self._peak("pressure", np.abs(state.pressures)), []
        for pressure, (corners, longest) in zip(state.pressures, state.scene.pressed):
            if pressure == 0.0:
                continue
            a, b, c = (state.x[corners[:, k]] for k in range(3))
            normal = np.cross(b - a, c - a)
            normal /= np.maximum(np.linalg.norm(normal, axis=1, keepdims=True), np.finfo(float).tiny)
            arrow = -longest * pressure / peak * normal
            # a push ends at the surface, a pull begins there
            tips = (a + b + c) / 3.0 + (arrow if pressure < 0.0 else 0.0)
            found.append((_arrows(tips, arrow, camera), PRESSURE_COLOUR))
        return found

    def _connections(self, state: DrawnState, camera: Viewpoint) -> Lines:
        found, scene = [], state.scene
        if state.segments is not None:
            ends, tension = state.segments[0], np.abs(state.segments[1])
            colours = colours_of(tension / self._peak("tension", tension))
            found.append((_bands(ends, camera), np.repeat(np.tile(colours, (len(BAND), 1)), 2, axis=0)))
        if len(scene.attached):
            right, up, _ = CROSS * scene.size * camera.axes
            places = state.x[scene.attached]
            strokes = [_segments(places - s, places + s) for s in (right + up, right - up)]
            found.append((np.concatenate(strokes), ATTACHED_COLOUR))
        return found

    def _fibres(self, state: DrawnState, _camera: Viewpoint) -> Lines:
        return [((weights @ state.x[nodes]).reshape(-1, 3), FIBRE_COLOUR) for nodes, weights in self._strokes]

    def _wires(self, state: DrawnState, _camera: Viewpoint) -> Lines:
        return [(self._shown.of(state.x)[self._edges].reshape(-1, 3), WIRE_COLOUR)]


def _segments(a: np.ndarray, b: np.ndarray) -> np.ndarray:
    """Return the ends (2k,3) of lines from a (k,3) to b (k,3)."""
    return np.stack([a, b], axis=1).reshape(-1, 3)


def _bands(ends: np.ndarray, camera: Viewpoint) -> np.ndarray:
    """Return ends (2k,3) of parallel lines, one set of all segments (n,2,3) after the other, side by side in the picture."""
    across = np.cross(ends[:, 1] - ends[:, 0], camera.forward)
    across /= np.maximum(np.linalg.norm(across, axis=1, keepdims=True), np.finfo(float).tiny)
    depth = (ends - camera.position) @ camera.forward
    offset = (2.0 * camera.slope * BAND_WIDTH * depth)[:, :, None] * across[:, None]
    return np.concatenate([(ends + s * offset).reshape(-1, 3) for s in BAND])


def _arrows(tips: np.ndarray, arrow: np.ndarray, camera: Viewpoint) -> np.ndarray:
    """Return the lines of arrows (3,) or (k,3) that end at tips (k,3): a shaft and two head strokes in the picture's plane."""
    side = np.cross(arrow, camera.forward)
    starts = [arrow, *(HEAD * (arrow + s * 0.5 * side) for s in (-1.0, 1.0))]
    return np.concatenate([_segments(tips - one, tips) for one in starts])
