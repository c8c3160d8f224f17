"""What pictures and the window show of a scene: triangles of surfaces, lines over them, and the camera that follows the bodies.

Normals are those of `taisoft/output/smoothing.py`. A second-order face is drawn as four flat triangles between its six nodes.
Obstacles are drawn with back-face culling, so that a bin's walls show only their inner sides.
"""

from dataclasses import replace

import numpy as np

from taisoft.output.appearance import ObstacleSurface, ShownBodies, body_colours, capsule, obstacle_colour, obstacle_surfaces
from taisoft.output.smoothing import smoothing_groups, vertex_normals
from taisoft.output.viewpoint import MAX_WIDENING, WHOLE, Viewpoint, camera_viewpoint
from taisoft.scene import checks
from taisoft.scene.look import Camera, check_follow
from taisoft.scene.obstacles import HalfSpace
from taisoft.view.colouring import Colouring, lit_colours
from taisoft.view.drawn import DrawnBody, DrawnScene, DrawnState
from taisoft.view.ground import Square, finite_points
from taisoft.view.layers import Layers
from taisoft.view.sampling import Sampler

MARKER_COLOUR = np.array([0.20, 0.22, 0.26])  # sRGB
MARKER_FACETS = (12, 3)  # around its axis, and from the equator to a pole
MARKER_SIZE = 0.16  # radius in units of the mean edge length of the body's surface


class SceneView:
    """A scene as it is drawn: its surfaces, their colours, its layers, and a camera.

    scene: a Scene, which is read once, or what is drawn of one; size: (width, height) in pixels; camera: fixed if given, else the
    scene's own, else it frames all bodies at the start, and where they fall on a ground, and moves back, never nearer, when a
    body would leave the picture; colour: of the bodies, one of COLOURS; layers: names of visible LAYERS. Raises OutputError for
    unknown names.
    """

    def __init__(self, scene, size: tuple[int, int], camera: Viewpoint | None, colour: str, layers: tuple[str, ...]):
        self._sampler = None if isinstance(scene, DrawnScene) else Sampler(scene)
        self.scene = scene if self._sampler is None else self._sampler.drawn
        if camera is not None and not isinstance(camera, Viewpoint):
            camera = check_follow(checks.instance(camera, "camera", Camera), self.scene.bodies)
            self.scene, camera = replace(self.scene, camera=camera), None
        self._has_own = camera is None and self.scene.camera is not None  # whether the scene's camera is used
        self.camera = camera or camera_viewpoint(self.scene, 0.0, self.scene.start)
        self._widest = 0.0  # largest automatic distance [m]; 0: the camera does not move back
        if self.camera is None:
            self.look_from(size)
        self.surfaces = Surfaces(self.scene)
        self.layers = Layers(self.scene, layers)
        self.colouring = Colouring(self.surfaces, colour)

    def look_from(self, size: tuple[int, int], **angles: float) -> None:
        """Frame what the scene shows from the start on, from angles [deg] as of `Viewpoint`; the camera moves back as before."""
        self._has_own = False
        self.camera = Viewpoint.framing(self.scene.framed, size, self._free(size), up=self.scene.up, **angles)
        self._widest = MAX_WIDENING * self.camera.distance

    def _free(self, size: tuple[int, int]) -> tuple[float, float, float, float]:
        """Return the part of a picture of this size in which the bodies are framed, as for `Viewpoint.framing`."""
        return WHOLE

    def sampled(self, sim) -> DrawnState:
        """Return the present state of a simulation of the scene, with what is visible; a `DrawnState` as it is."""
        if isinstance(sim, DrawnState):
            return sim
        visible = [name for name, shown in self.layers.shown.items() if shown]
        return self._sampler.state(sim, visible, [self.colouring.kind], energies=False)

    def _drawn(self, state: DrawnState, size: tuple[int, int]) -> tuple[np.ndarray, np.ndarray, tuple[np.ndarray, np.ndarray]]:
        """Move the camera if needed; return vertices and lit colours (n,3), and the lines of the layers."""
        self.surfaces.with_markers = self.layers.shown["fixed_nodes"]
        bodies = self.surfaces.of_bodies(state)
        if self._has_own:
            self.camera = camera_viewpoint(self.scene, state.time, state.x)
        self.camera = self.camera.widened(bodies[0], size, self._widest, self._free(size))
        x, normals = self.surfaces.with_obstacles(bodies, state, self.camera.position)
        colours = lit_colours(x, normals, self.colouring.base(state), self.camera, self.scene.lights, self.scene.up)
        return x, colours, self.layers.lines(state, self.camera)


class Surfaces:
    """All drawn surfaces as one triangle mesh of fixed topology and colours.

    scene: a Scene, which is read once, or what is drawn of one. triangles: int32 (t,3) of drawn vertices, and body_triangles
    those of bodies without markers; colours: float (n,3), unshaded sRGB; opacities: (n,).
    """

    def __init__(self, scene):
        scene = DrawnScene.of(scene)
        self._shown = ShownBodies(scene)
        surfaces = zip(scene.bodies, self._shown.surfaces, body_colours(scene))
        self._bodies = [_BodySurface(body, *surface, colour) for body, surface, colour in surfaces]
        fixed = [o.shape for o in scene.obstacles if isinstance(o.shape, HalfSpace) and o.path is None]
        self._obstacles = [_RigidSurface(surface, fixed) for surface in obstacle_surfaces(scene)]
        nodes = [body.nodes + start for body, start in zip(self._bodies, self._shown.starts)]
        self._nodes = np.concatenate(nodes)  # shown vertices of the drawn ones, or at whose place they are
        self._markers = np.flatnonzero(np.concatenate([body.is_marker for body in self._bodies]))
        self._balls, self._radii = (np.concatenate([getattr(b, name) for b in self._bodies]) for name in ("balls", "radii"))
        self.with_markers = True  # of fixed nodes
        parts = [*self._bodies, *self._obstacles]
        firsts = np.cumsum([0] + [len(part.colours) for part in parts])  # drawn vertex of each part
        self.triangles = np.concatenate([part.triangles + n for part, n in zip(parts, firsts)]).astype(np.int32)
        self.colours = np.concatenate([part.colours for part in parts])
        opacities = [one.opacity for one in (*scene.bodies, *scene.obstacles)]
        self.opacities = np.repeat(opacities, np.diff(firsts))
        self.n_of_bodies = int(firsts[len(self._bodies)])  # drawn vertices of bodies, which come first
        self.body_triangles = np.concatenate([part.own_triangles + n for part, n in zip(self._bodies, firsts)]).astype(np.int32)
        ranges = [slice(*ends) for ends in zip(firsts[len(self._bodies) :], firsts[len(self._bodies) + 1 :])]
        self._half_spaces = [(at, part) for at, part in zip(ranges, self._obstacles) if part.is_half_space]

    def half_spaces(self, x: np.ndarray, poses: dict) -> list[tuple[slice, np.ndarray]]:
        """Return, for every half-space, its range of drawn vertices and the vertices (k,3) [m] of its square.

        x: (n,3) [m], of which the first are the bodies' drawn vertices; poses: as of `DrawnState`.
        """
        bodies = finite_points(x[: self.n_of_bodies])
        return [(at, part.at(poses, bodies)) for at, part in self._half_spaces]

    def coloured(self, colours: np.ndarray) -> np.ndarray:
        """Return colours (n,3) of all drawn vertices, given colours (n_nodes,3) of the bodies' nodes."""
        all_colours = self.colours.copy()
        all_colours[: self.n_of_bodies] = np.clip(self._shown.of(colours), 0.0, 1.0)[self._nodes]
        all_colours[self._markers] = self.colours[self._markers]
        return all_colours

    def of_bodies(self, state: DrawnState) -> tuple[np.ndarray, np.ndarray]:
        """Return positions [m] and unit normals of the bodies' drawn vertices, each float64 (n,3)."""
        x = self._shown.of(state.x)[self._nodes]
        normals = vertex_normals(x, self.body_triangles)
        x[self._markers] += self.with_markers * self._radii[:, None] * self._balls
        normals[self._markers] = self._balls
        return x, normals

    def with_obstacles(
        self, bodies: tuple[np.ndarray, np.ndarray], state: DrawnState, eye: np.ndarray
    ) -> tuple[np.ndarray, np.ndarray]:
        """Return positions and normals of all drawn vertices: those from `of_bodies`, then the obstacles'.

        eye: position (3,) [m], for culling.
        """
        finite = finite_points(bodies[0]) if self._obstacles else bodies[0]
        parts = [bodies, *(obstacle.vertices(state.poses, finite, eye) for obstacle in self._obstacles)]
        return np.concatenate([x for x, _ in parts]), np.concatenate([n for _, n in parts])


class _BodySurface:
    """Topology of a body's drawn surface, with balls as markers of fixed nodes.

    triangles, and own_triangles without markers, of drawn vertices; nodes: of each drawn vertex, for a marker that in its middle;
    is_marker; balls (m,3), radii (m,): offsets of the markers' vertices, as unit vectors, and their lengths [m]; colours.
    """

    def __init__(self, body: DrawnBody, rest: np.ndarray, surface: np.ndarray, colour: np.ndarray):
        nodes, corners = smoothing_groups(rest, surface)
        edges = rest[surface] - rest[np.roll(surface, 1, axis=1)]
        marked = body.fixed
        ball, ball_triangles = capsule(0.0, 1.0, *MARKER_FACETS)
        counts = len(nodes), len(ball) * len(marked)
        starts = len(nodes) + len(ball) * np.arange(len(marked))
        markers = (starts[:, None, None] + ball_triangles).reshape(-1, 3)
        self.own_triangles, self.triangles = corners, np.concatenate([corners, markers])
        self.colours = np.repeat([colour, MARKER_COLOUR], counts, axis=0)
        self.nodes, self.is_marker = np.concatenate([nodes, np.repeat(marked, len(ball))]), np.repeat([False, True], counts)
        self.balls = np.tile(ball, (len(marked), 1))
        self.radii = np.full(counts[1], MARKER_SIZE * float(np.linalg.norm(edges, axis=2).mean()))


class _RigidSurface:
    """Surface of an obstacle. Triangles share no vertices, so that each can be culled. fixed: half-spaces that do not move."""

    def __init__(self, surface: ObstacleSurface, fixed: list[HalfSpace]):
        shape = surface.obstacle.shape
        self._surface, self.is_half_space = surface, isinstance(shape, HalfSpace)
        self._square: Square | None = None
        if self.is_half_space and surface.obstacle.path is None:
            self._square = Square(shape, surface.vertices, [other for other in fixed if other is not shape])
        self._nodes, self._corners = smoothing_groups(surface.vertices, surface.triangles)
        self._drawn: tuple | None = None  # the last vertices and eye, and what was drawn for them
        self.triangles = np.arange(self._corners.size).reshape(-1, 3)
        self.colours = np.tile(obstacle_colour(surface.obstacle), (self._corners.size, 1))

    def at(self, poses: dict, bodies: np.ndarray) -> np.ndarray:
        """Return the vertices (n,3) [m], with obstacles at poses, as of `DrawnState`, and bodies at (m,3) [m], all finite."""
        pose = poses.get(self._surface.obstacle.name)
        if pose is not None:
            return self._surface.placed(*pose)
        return self._surface.vertices if self._square is None else self._square.below(bodies)

    def vertices(self, poses: dict, bodies: np.ndarray, eye: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        x = self.at(poses, bodies)
        if self._drawn is None or not (np.array_equal(x, self._drawn[0]) and np.array_equal(eye, self._drawn[1])):
            self._drawn = x, eye, self._culled(x[self._nodes], eye)
        return self._drawn[2]

    def _culled(self, x: np.ndarray, eye: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        corners, normals = x[self._corners], vertex_normals(x, self._corners)[self._corners]
        a, b, c = np.moveaxis(corners, 1, 0)
        back_facing = np.einsum("ti,ti->t", np.cross(b - a, c - a), eye - a) <= 0
        corners[back_facing] = a[back_facing, None]  # triangles of zero area are invisible
        return corners.reshape(-1, 3), normals.reshape(-1, 3)
