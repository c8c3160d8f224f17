"""Layers of pictures and the window for connections, pressures and fibres.

Springs and tendons are drawn as bands, coloured from low to high by the size of their tension relative to the recent maximum, and
attached nodes as crosses; attachments by springs have a line from each node to its place, too. Arrows show pressures: they point
along the force, with lengths relative to the recent maximum of pressures. Strokes show fibres at the surface: they lie in
triangles, move with the tets there, and are shorter where fibres leave the surface.
"""

import numpy as np

from taisoft.output.viewpoint import Viewpoint
from taisoft.view.colouring import colours_of
from taisoft.view.drawn import DrawnState

ATTACHED_COLOUR, PRESSURE_COLOUR = np.array([0.93, 0.50, 0.08]), np.array([0.90, 0.10, 0.55])  # sRGB
BAND = (-1.0, 0.0, 1.0)  # parallel lines of a band,
BAND_WIDTH = 1.0 / 550.0  # of the picture's height from one to the next
CROSS = 0.008  # of the scene's size
HEAD = 0.3  # of an arrow, over its length
DECAY = 0.99  # factor on the running maxima per picture


class ConnectionLayer:
    """Lines of connections. peak: recent maximum of tensions [N], which scales their colours."""

    def __init__(self):
        self.peak = 0.0

    def lines(self, state: DrawnState, camera: Viewpoint) -> list[tuple[np.ndarray, np.ndarray]]:
        """Return ends (2k,3) [m] and colours, one or (2k,3), of parts of the layer."""
        found, scene = [], state.scene
        if state.segments is not None:
            ends, tension = state.segments[0], np.abs(state.segments[1])
            self.peak = max(DECAY * self.peak, float(tension.max(initial=0.0)))
            colours = colours_of(tension / self.peak if self.peak > 0.0 else np.zeros(len(tension)))
            found.append((_bands(ends, camera), np.repeat(np.tile(colours, (len(BAND), 1)), 2, axis=0)))
        if len(scene.attached):
            right, up, _ = CROSS * scene.size * camera.axes
            places = state.x[scene.attached]
            strokes = [np.stack([places - s, places + s], axis=1).reshape(-1, 3) for s in (right + up, right - up)]
            found.append((np.concatenate(strokes), ATTACHED_COLOUR))
        return found


class PressureLayer:
    """Arrows of pressures and of the fluid in cavities. peak: recent maximum of pressures [Pa], which scales them."""

    def __init__(self):
        self.peak = 0.0

    def lines(self, state: DrawnState, camera: Viewpoint) -> list[tuple[np.ndarray, np.ndarray]]:
        """Return ends (2k,3) [m] and the colour of the arrows."""
        self.peak, found = max([DECAY * self.peak, *map(abs, state.pressures)]), []
        for pressure, (corners, longest) in zip(state.pressures, state.scene.pressed):
            if pressure == 0.0:
                continue
            a, b, c = (state.x[corners[:, k]] for k in range(3))
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
