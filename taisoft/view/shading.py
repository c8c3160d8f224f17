"""Shading, computed per drawn vertex on the host, so that it is the same for every renderer.

colour = base * (hemisphere of sky and ground light + key light + fill light) * darkening at grazing angles, which emphasizes
silhouettes. The lamps move with the camera, so that every view is lit alike.
"""

import numpy as np

from taisoft.output.camera import Camera

KEY, FILL = np.array([-0.35, 0.60, 0.72]), np.array([0.85, 0.15, 0.45])  # directions to the lamps: right, up, backward
KEY_STRENGTH, FILL_STRENGTH = 0.72, 0.22
SKY, GROUND = np.array([0.44, 0.46, 0.49]), np.array([0.26, 0.25, 0.24])
EDGE_DARKENING = 0.22
BACKGROUND_TOP, BACKGROUND_BOTTOM = np.array([0.95, 0.955, 0.96]), np.array([0.80, 0.81, 0.82])  # sRGB


def lit_colours(x: np.ndarray, normals: np.ndarray, base: np.ndarray, camera: Camera) -> np.ndarray:
    """Return shaded colours (n,3) in [0, 1] of vertices x (n,3) with unit normals (n,3) and base colours (n,3) for a camera."""
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
    """Return a neutral vertical gradient, uint8 (height, width, 3), for size (width, height)."""
    width, height = size
    mix = np.linspace(0.0, 1.0, height)[:, None] ** 1.5
    column = BACKGROUND_TOP + (BACKGROUND_BOTTOM - BACKGROUND_TOP) * mix
    return np.repeat(np.round(255 * column).astype(np.uint8)[:, None], width, axis=1)
