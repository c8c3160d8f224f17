"""An interactive view of a run: bodies and obstacles in 3-D, to be turned and played in a notebook or in a static page.

Drawn in the browser by viser (extra `notebook`), whose recorder and player it uses. The server that records a scene listens only
on this machine and only while a page is made. A page holds viewer (0.8 MB) and frames.
"""

import contextlib
import html
import math
from collections.abc import Iterator
from importlib.util import find_spec

import numpy as np
import rich

from taisoft.errors import OutputError
from taisoft.output.appearance import compact_surface, linear_rgb, obstacle_colour, obstacle_surfaces
from taisoft.output.viewpoint import Viewpoint, camera_viewpoint
from taisoft.scene.obstacles import HalfSpace
from taisoft.view.colouring import Colouring
from taisoft.view.notebook import FramesOnPage
from taisoft.view.sampling import Sampler
from taisoft.view.scene_view import Surfaces

HEIGHT = 420  # of the view in a notebook [pixels]
SCALE_STYLE = "position: fixed; left: 8px; bottom: 8px; font: 13px monospace; pointer-events: none; z-index: 1000"
MISSING = "an interactive view needs the package viser: pip install 'taisoft[notebook]'"


@contextlib.contextmanager
def _quiet() -> Iterator[None]:
    """Suppress what viser prints, by rich, about a server that nobody has to visit."""
    console = rich.get_console()
    before, console.quiet = console.quiet, True
    try:
        yield
    finally:
        console.quiet = before


class InteractiveView(FramesOnPage):
    """Bodies and obstacles over time, in 3-D.

    `sim.run(seconds, on_frame=view)` adds a frame each; `view(sim)` adds the present state. colour: as for `Simulator.picture`,
    on a scale that grows. All frames are of one scene. Raises OutputError for another colour, or without the extra `notebook`.
    """

    def __init__(self, colour: str = "stress"):
        if find_spec("viser") is None:
            raise OutputError(MISSING)
        super().__init__(colour, HEIGHT)
        self._frames: list[tuple[np.ndarray, np.ndarray]] = []  # vertices and colours of bodies
        self._moved: list[dict[int, np.ndarray]] = []  # vertices of the obstacles that move, by number
        self._scene = None

    def __call__(self, sim, _index: int = 0, _report=None) -> None:
        """Add sim's present state. Raises OutputError if it has another scene than the first frame."""
        if self._scene is None:
            self._scene, self._sampler, self._obstacles = sim.scene, Sampler(sim.scene), obstacle_surfaces(sim.scene)
            self._surfaces = Surfaces(self._sampler.drawn)
            self._used, self._faces = compact_surface(self._surfaces.body_triangles)
            self._colouring = Colouring(self._surfaces, self.colour)
        if sim.scene is not self._scene:
            raise OutputError("an interactive view shows one scene: make another one for another simulator")
        state = self._sampler.state(sim, kinds=[self.colour])
        x, colours = self._surfaces.of_bodies(state)[0], linear_rgb(self._colouring.base(state))
        self._frames.append((x[self._used].astype(np.float32), np.round(255 * colours[self._used]).astype(np.uint8)))
        moving = ((number, one) for number, one in enumerate(self._obstacles) if one.obstacle.path is not None)
        self._moved.append({number: one.at(sim.time).astype(np.float32) for number, one in moving})
        self.scales.append(self._colouring.scale_text)
        self.times.append(sim.time)

    def as_html(self) -> str:
        """Return a page with the view, which any browser shows without a network. Raises OutputError if there is no frame."""
        if not self._frames:
            raise OutputError("the view holds no frame: pass it to sim.run(seconds, on_frame=view)")
        import viser

        with _quiet():
            server = viser.ViserServer(host="127.0.0.1", port=0, verbose=False)
            try:
                page = self._recorded(server).as_html()
            finally:
                server.stop()
        before, end, after = page.rpartition("</body>")  # scripts before it may hold such a text, too
        return before + self._scale_html() + end + after

    def _scale_html(self) -> str:
        """Return a line over the view that says what red means in the last frame, and whether earlier ones had another scale."""
        text = self.scales[-1] + (", at the end" if len(set(self.scales)) > 1 else "")
        return f'<div style="{SCALE_STYLE}">{html.escape(text)}</div>' if text else ""

    def _recorded(self, server):
        """Put the frames on a server; return viser's recording of them.

        Frames are meshes of their own, of which one is visible at a time: viser changes vertices in place, but no colours.
        """
        import trimesh

        drawn = self._sampler.drawn
        camera = camera_viewpoint(drawn, self.times[0], drawn.start) or Viewpoint.framing(drawn.framed, up=drawn.up)
        server.scene.set_up_direction(f"+{self._scene.up}")
        server.initial_camera.position, server.initial_camera.look_at = tuple(camera.position), tuple(camera.target)
        server.initial_camera.fov = math.radians(camera.fov)
        recording = server.get_scene_serializer()
        meshes = [trimesh.Trimesh(x, self._faces, vertex_colors=colours, process=False) for x, colours in self._frames]
        frames = [server.scene.add_mesh_trimesh(f"/frames/{k}", mesh, visible=k == 0) for k, mesh in enumerate(meshes)]
        handles = self._add_obstacles(server)
        for k in range(1, len(frames)):
            recording.insert_sleep(self.times[k] - self.times[k - 1])
            frames[k].visible, frames[k - 1].visible = True, False
            for number in handles.keys() & {*self._moved[k - 1], *self._moved[k]}:
                handles[number].vertices = self._moved[k].get(number, self._obstacles[number].vertices.astype(np.float32))
        return recording

    def _add_obstacles(self, server) -> dict[int, object]:
        """Put the obstacles on a server at the first frame's time; return the handles of those that have triangles, by number."""
        handles = {}
        for number, surface in enumerate(self._obstacles):
            if len(surface.triangles) == 0:
                continue
            x, faces = self._moved[0].get(number, surface.vertices.astype(np.float32)), surface.triangles.astype(np.uint32)
            side = "front" if isinstance(surface.obstacle.shape, HalfSpace) else "double"  # walls do not hide what they hold
            colour = tuple(np.round(255 * obstacle_colour(surface.obstacle)).astype(int).tolist())
            added = server.scene.add_mesh_simple(f"/obstacles/{number}", x, faces, color=colour, flat_shading=True, side=side)
            handles[number] = added
        return handles
