"""Lines over a picture: wireframes of the bodies' surfaces, contacts with normals and impulses, and arrows of tractions.

Lines are moved along their rays towards the eye, so that they cover the same pixels: wireframes just enough to lie in front of
their own surface, contacts and arrows so far that nothing hides them.
"""

import numpy as np

from taisoft.errors import OutputError
from taisoft.mesh.topology import triangle_edges
from taisoft.output.camera import Camera

LAYERS = ("wires", "contacts", "tractions", "fixed_nodes")
IN_WINDOW, IN_PICTURES = ("tractions", "fixed_nodes"), ("fixed_nodes",)  # shown by default
MAX_MARK_LINES = 4000  # largest number of lines of contacts and arrows, besides the wires
ON_SURFACE, IN_FRONT = 0.996, 0.1  # fractions of the distance from the eye
NORMAL, IMPULSE, ARROW, HEAD = 0.04, 0.15, 0.10, 0.3  # lengths relative to the scene's size; HEAD relative to its arrow
MAX_ARROWS = 60  # of one traction
DECAY = 0.99  # factor on the running maximum of impulses per picture
WIRE_COLOUR, NORMAL_COLOUR = np.array([0.12, 0.14, 0.18]), np.array([0.10, 0.55, 0.25])  # sRGB
IMPULSE_COLOUR, TRACTION_COLOUR = np.array([0.85, 0.12, 0.12]), np.array([0.55, 0.15, 0.65])


class Layers:
    """Optional layers beside the surfaces.

    shown: name -> whether it is visible, initially those in `names`; n_segments: largest number of lines that `lines` returns.
    Raises OutputError for an unknown name.
    """

    def __init__(self, scene, names: tuple[str, ...] = IN_WINDOW):
        for name in names:
            if name not in LAYERS:
                raise OutputError(f"layer '{name}' is unknown: it must be one of {', '.join(LAYERS)}")
        self.shown = {name: name in names for name in LAYERS}
        starts = np.cumsum([0] + [body.n_nodes for body in scene.bodies])
        self._edges = np.concatenate([triangle_edges(np.asarray(b.nodes.surface))[0] + n for b, n in zip(scene.bodies, starts)])
        self.n_segments = len(self._edges) + MAX_MARK_LINES
        points = np.concatenate([body.rest_positions + body.position for body in scene.bodies])
        self._size = float(np.linalg.norm(points.max(axis=0) - points.min(axis=0)))
        self._peak = 0.0  # [N s]
        self._loaded = [  # per traction, nodes (k,3) of the triangles that get an arrow
            body.mesh.surface[t.triangles[:: -(-len(t.triangles) // MAX_ARROWS)]] + n
            for body, n in zip(scene.bodies, starts)
            for t in body.tractions
        ]

    @property
    def has_lines(self) -> bool:
        """Whether a layer of lines is visible; fixed nodes are drawn as triangles of the surfaces."""
        return any(self.shown[name] for name in LAYERS if name != "fixed_nodes")

    def lines(self, sim, camera: Camera) -> tuple[np.ndarray, np.ndarray]:
        """Return the ends (2k,3) [m] of the lines, as drawn for this camera, and their colours (2k,3)."""
        x = sim.positions()
        marks = self._contact_lines(sim) if self.shown["contacts"] else []
        if self.shown["tractions"]:
            tractions = [t.value for body in sim.scene.bodies for t in body.tractions]  # the present values
            longest = max((float(np.linalg.norm(t)) for t in tractions), default=0.0) or 1.0
            for corners, traction in zip(self._loaded, tractions):
                arrow = ARROW * self._size / longest * traction
                marks.append((_arrows(x[corners].mean(axis=1), arrow, camera), TRACTION_COLOUR))
        marks = [(camera.nearer(ends, IN_FRONT), colour) for ends, colour in marks]
        if self.shown["wires"]:  # last, since lines beyond the renderer's limit are dropped from the end
            marks.append((camera.nearer(x[self._edges].reshape(-1, 3), ON_SURFACE), WIRE_COLOUR))
        ends = [np.empty((0, 3)), *(part for part, _ in marks)]
        return np.concatenate(ends), np.concatenate([np.empty((0, 3)), *(np.tile(c, (len(part), 1)) for part, c in marks)])

    def _contact_lines(self, sim) -> list[tuple[np.ndarray, np.ndarray]]:
        """Return lines of normals with a fixed length, and of impulses relative to the recent maximum."""
        found = sim.contacts()
        k = slice(0, MAX_MARK_LINES // 4)
        point, normal, impulse = found.point[k], found.normal[k], found.impulse[k]
        self._peak = max(DECAY * self._peak, float(np.linalg.norm(impulse, axis=1).max(initial=0.0)))
        relative = impulse / self._peak if self._peak > 0.0 else 0.0 * impulse
        return [
            (_segments(point, point + NORMAL * self._size * normal), NORMAL_COLOUR),
            (_segments(point, point + IMPULSE * self._size * relative), IMPULSE_COLOUR),
        ]


def _segments(a: np.ndarray, b: np.ndarray) -> np.ndarray:
    """Return the ends (2k,3) of lines from a (k,3) to b (k,3)."""
    return np.stack([a, b], axis=1).reshape(-1, 3)


def _arrows(tips: np.ndarray, arrow: np.ndarray, camera: Camera) -> np.ndarray:
    """Return the lines of arrows (3,) that end at tips (k,3): a shaft and two head strokes in the picture's plane."""
    side = np.cross(arrow, camera.forward)
    return np.concatenate(
        [_segments(tips - arrow, tips)] + [_segments(tips - HEAD * (arrow + s * 0.5 * side), tips) for s in (-1.0, 1.0)]
    )
