"""Light: the same on every renderer, worked out per drawn vertex on the host.

colour = base * (hemisphere of sky and ground light + key light + fill light) * a slight darkening of grazing views that
sets silhouettes off. The lamps ride with the camera, so a turned view is lit as well as the first.
"""

import numpy as np

from taisoft.output.camera import Camera

KEY, FILL = np.array([-0.35, 0.60, 0.72]), np.array([0.85, 0.15, 0.45])  # towards the lamp: right, up, backward
KEY_STRENGTH, FILL_STRENGTH = 0.72, 0.22
SKY, GROUND = np.array([0.44, 0.46, 0.49]), np.array([0.26, 0.25, 0.24])
EDGE_DARKENING = 0.22
BACKGROUND_TOP, BACKGROUND_BOTTOM = np.array([0.95, 0.955, 0.96]), np.array([0.80, 0.81, 0.82])  # sRGB


def lit_colours(x: np.ndarray, normals: np.ndarray, base: np.ndarray, camera: Camera) -> np.ndarray:
    """Colours (n,3) in [0, 1] of vertices at x (n,3) with unit normals (n,3) and base colours (n,3), seen by camera."""
    right, up, forward = camera.axes
    frame = np.array([right, up, -forward])
    light = GROUND + (SKY - GROUND) * (0.5 + 0.5 * normals[:, 1:2])
    for lamp, strength in ((KEY, KEY_STRENGTH), (FILL, FILL_STRENGTH)):
        direction = (lamp / np.linalg.norm(lamp)) @ frame
        light = light + strength * np.clip(normals @ direction, 0.0, None)[:, None]
    to_eye = camera.position - x
    to_eye /= np.linalg.norm(to_eye, axis=1, keepdims=True)
    grazing = (1.0 - np.abs(np.einsum("ij,ij->i", normals, to_eye))) ** 3
    return np.clip(base * light * (1.0 - EDGE_DARKENING * grazing)[:, None], 0.0, 1.0)


def background(size: tuple[int, int]) -> np.ndarray:
    """A neutral upright gradient, uint8 (height, width, 3), for size (width, height)."""
    width, height = size
    mix = np.linspace(0.0, 1.0, height)[:, None] ** 1.5
    column = BACKGROUND_TOP + (BACKGROUND_BOTTOM - BACKGROUND_TOP) * mix
    return np.repeat(np.round(255 * column).astype(np.uint8)[:, None], width, axis=1)
