"""Appearance of bodies and obstacles: their colours, and a body's surface reduced to the nodes on it."""

import numpy as np

# sRGB; distinct hues of similar lightness, so that shading shows the shape
BODY_COLOURS = np.array(
    [
        (0.33, 0.56, 0.80),
        (0.90, 0.55, 0.27),
        (0.42, 0.68, 0.44),
        (0.80, 0.40, 0.42),
        (0.58, 0.50, 0.76),
        (0.85, 0.73, 0.36),
        (0.36, 0.67, 0.68),
        (0.72, 0.53, 0.42),
    ]
)


OBSTACLE_COLOUR = np.array([0.72, 0.72, 0.71])  # sRGB


def body_colour(index: int) -> np.ndarray:
    """Return the sRGB colour (3,) in [0, 1] of the body with the given index; the palette repeats."""
    return BODY_COLOURS[index % len(BODY_COLOURS)]


def linear_rgb(srgb: np.ndarray) -> np.ndarray:
    """Convert sRGB colours (..., 3) to linear Rec. 709, both in [0, 1] (IEC 61966-2-1)."""
    srgb = np.asarray(srgb, dtype=float)
    return np.where(srgb <= 0.04045, srgb / 12.92, ((srgb + 0.055) / 1.055) ** 2.4)


def start_positions(scene) -> np.ndarray:
    """Return the initial positions of the nodes of all bodies, (n,3) [m]."""
    return np.concatenate([body.rest_positions + body.position for body in scene.bodies])


def compact_surface(triangles: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Renumber surface triangles by the nodes that they use.

    triangles: int (t,3) of nodes. Returns (nodes int (s,) ascending, local int (t,3)) with nodes[local] == triangles.
    """
    nodes, local = np.unique(np.asarray(triangles), return_inverse=True)
    return nodes, local.reshape(-1, 3)
