"""Colours of drawn vertices: by a quantity at the nodes (von Mises stress, contact pressure, speed, ...), and shading.

The scale begins at 0 (stretch: at 1). It ends at 1, 2 or 5 times a power of ten above a running maximum of the 99 % quantile over
the nodes, of pressure and slip over those that have any; a quantile, since stress in a nearly flat tet is unbounded. The running
maximum decays slowly, and the end is lowered only when it is clearly too high. So the scale does not flicker, and recovers after
an impact.

Shading is computed per drawn vertex on the host, so that it is the same in pictures and in the window:
colour = base * (hemisphere of sky and ground light + key light + fill light) * darkening at grazing angles, which emphasizes
silhouettes. The lamps move with the camera, so that every view is lit alike. A scene's own lights replace both: each adds
strength * its colour * max(0, -direction . n).
"""

import math
from collections.abc import Iterable

import numpy as np

from taisoft.errors import OutputError
from taisoft.mesh.placing import UP
from taisoft.output.viewpoint import Viewpoint
from taisoft.scene.checks import choice
from taisoft.view.choices import COLOURS, nodal
from taisoft.view.drawn import DrawnState

QUANTILE = 0.99  # fraction of the nodes whose values lie within the scale
DECAY = 0.998  # factor on the running maximum per picture
LOWER_MARGIN = 1.5  # the end is lowered once this times the running maximum, rounded up, is below it
# sRGB, from low to high
UNKNOWN = np.array([0.55, 0.55, 0.55])  # where the quantity is unknown
GRADIENT = np.array([(0.27, 0.42, 0.80), (0.33, 0.70, 0.78), (0.72, 0.82, 0.45), (0.97, 0.70, 0.27), (0.82, 0.20, 0.17)])

LAMPS = ((np.array([-0.35, 0.60, 0.72]), 0.72), (np.array([0.85, 0.15, 0.45]), 0.22))  # direction (right, up, back), strength
SKY, GROUND = np.array([0.44, 0.46, 0.49]), np.array([0.26, 0.25, 0.24])
EDGE_DARKENING = 0.22
BACKGROUND = np.array([(0.95, 0.955, 0.96), (0.80, 0.81, 0.82)])  # sRGB, at the top and the bottom


def checked_colour(kind: str) -> str:
    """Return the name of a colouring. Raises OutputError unless it is one of COLOURS."""
    return choice(kind, "colour", tuple(COLOURS), OutputError)


class Colouring:
    """Unshaded colours of the drawn vertices of `Surfaces`, by one of COLOURS. Raises OutputError for another name."""

    def __init__(self, surfaces, kind: str = "body"):
        self._surfaces = surfaces
        self._has_errors = kind == "error"
        self.choose(kind)

    def choose(self, kind: str) -> None:
        """Colour by another quantity, with a scale of its own."""
        self.kind, self._colour = checked_colour(kind), COLOURS[kind]
        self._peak, self.span, self._is_fixed = 0.0, 0.0, False

    @property
    def scale(self) -> tuple[str, float, float]:
        """The quantity, its running maximum and the span of the scale, which later pictures depend on."""
        return self.kind, self._peak, self.span

    def resume(self, kind: str, peak: float, span: float) -> None:
        """Continue the `scale` of an earlier run, unless it was of another quantity."""
        if kind == self.kind:
            self._peak, self.span = float(peak), float(span)

    def fix(self, states: Iterable[DrawnState], end: float | None = None) -> None:
        """Keep one scale from now on, up to this end, or for the largest values in these states."""
        if self.kind in nodal():
            largest = (self._largest(self._above(state)) for state in states if end is None)
            self.span, self._is_fixed = round_up(max(self._colour.least_span, *largest)) if end is None else end - self.low, True

    def _above(self, state: DrawnState) -> np.ndarray:
        """Return a state's values (n,) above the scale's lower end."""
        return state.values[self.kind].astype(np.float64) - self.low

    def _largest(self, above: np.ndarray) -> float:
        """Return the quantile of values (n,) above the scale's lower end."""
        finite = above[np.isfinite(above) & ((above > 0.0) | (not self._colour.skips_zero))]
        return float(np.quantile(finite, QUANTILE)) if len(finite) else 0.0

    def choose_next(self) -> None:
        """Colour by the next of COLOURS; by the error only if that was the first choice, since it needs a run with error=True."""
        self.choose(following(tuple(kind for kind in COLOURS if kind != "error" or self._has_errors), self.kind))

    @property
    def low(self) -> float:
        """Lower end of the scale."""
        return self._colour.low

    def base(self, state: DrawnState) -> np.ndarray:
        """Return unshaded colours (n,3) of all drawn vertices, sRGB; the bodies' own as long as the quantity is not known."""
        if self.kind not in state.values:
            return self._surfaces.colours
        above = self._above(state)
        self._peak = max(self._largest(above), DECAY * self._peak, self._colour.least_span)
        if not self._is_fixed and (self._peak > self.span or round_up(LOWER_MARGIN * self._peak) < self.span):
            self.span = round_up(self._peak)
        colours = colours_of(np.nan_to_num(above / self.span))
        colours[np.isnan(above)] = UNKNOWN
        return self._surfaces.coloured(colours)

    @property
    def scale_text(self) -> str:
        """The quantity and what red means, as in "speed, red: 2 m/s or more"; empty for the bodies' own colours."""
        unit = self._colour.unit
        return "" if self.kind == "body" else f"{self._colour.title}, red: {self.low + self.span:g} {unit} or more"

    def legend(self) -> list[tuple[str, np.ndarray]]:
        """Return lines of text from high to low, each with its colour (3,); none for the bodies' own colours."""
        if self.kind == "body" or self.span == 0.0:
            return []
        fractions = np.linspace(1.0, 0.0, 3)
        texts = [f"{self.low + fraction * self.span:10.4g} {self._colour.unit}" for fraction in fractions]
        return list(zip(texts, colours_of(fractions)))


def following(names: tuple[str, ...], name: str) -> str:
    """Return the name after this one, cyclically."""
    return names[(names.index(name) + 1) % len(names)]


def colours_of(fractions: np.ndarray) -> np.ndarray:
    """Return sRGB colours (n,3) of fractions (n,) of the scale, clamped to [0, 1]."""
    knots = np.linspace(0.0, 1.0, len(GRADIENT))
    return np.column_stack([np.interp(fractions, knots, GRADIENT[:, k]) for k in range(3)])


def round_up(value: float) -> float:
    """Round a value up to 1, 2 or 5 times a power of ten."""
    power = 10.0 ** math.floor(math.log10(value))
    return next((k * power for k in (1.0, 2.0, 5.0) if k * power >= value * (1.0 - 1e-12)), 10.0 * power)


def lit_colours(x: np.ndarray, normals: np.ndarray, base: np.ndarray, camera: Viewpoint, lights=None, up=None) -> np.ndarray:
    """Return shaded colours (n,3) in [0, 1] of vertices x (n,3) with unit normals (n,3) and base colours (n,3) for a camera.

    lights: of the scene, or None for the lamps of the camera; up: axis of the scene, from which the sky shines, None for the
    camera's.
    """
    frame = camera.axes * [[1.0], [1.0], [-1.0]]
    light = GROUND + (SKY - GROUND) * (0.5 + 0.5 * normals @ UP[up or camera.up])[:, None]
    if lights is None:
        lamps = [((lamp / np.linalg.norm(lamp)) @ frame, strength) for lamp, strength in LAMPS]
    else:
        lamps = [(-one.direction, one.strength * one.colour) for one in lights]
    for direction, strength in lamps:
        light = light + strength * np.clip(normals @ direction, 0.0, None)[:, None]
    to_eye = camera.position - x
    to_eye /= np.linalg.norm(to_eye, axis=1, keepdims=True)
    grazing = (1.0 - np.abs(np.einsum("ij,ij->i", normals, to_eye))) ** 3
    return np.clip(base * light * (1.0 - EDGE_DARKENING * grazing)[:, None], 0.0, 1.0)


def background(size: tuple[int, int], colours: np.ndarray | None = None) -> np.ndarray:
    """Return a vertical gradient, uint8 (height, width, 3), for size (width, height).

    colours: sRGB (2,3) at the top and the bottom; by default light grey.
    """
    width, height = size
    top, bottom = BACKGROUND if colours is None else colours
    mix = np.linspace(0.0, 1.0, height)[:, None] ** 1.5
    column = top + (bottom - top) * mix
    return np.repeat(np.round(255 * column).astype(np.uint8)[:, None], width, axis=1)
