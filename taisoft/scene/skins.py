"""Skins: surfaces that ride in the tets of a body, drawn and written instead of the tets' own, and touched on request.

Each vertex moves as the point of the body's elements at which it lies at rest. `embed` is a method of `Body`.
"""

from typing import TYPE_CHECKING

import numpy as np
import scipy.sparse as sp

from taisoft.attributes import guarded_record, thawed
from taisoft.errors import SceneError
from taisoft.mesh import nodes as mesh_nodes
from taisoft.mesh.surface_mesh import SurfaceMesh, as_surface
from taisoft.scene import checks
from taisoft.scene.locate import locate, weight_matrix

if TYPE_CHECKING:
    from taisoft.scene.body import Body

MAX_OUTSIDE = 0.5  # heights of the nearest tet by which a vertex may lie outside of the body


@guarded_record("skin", "add another body")
class Skin:
    """A surface that rides in the tets of a body."""

    surface: SurfaceMesh  #: at rest, in the coordinates of body.rest_positions
    contact: bool  #: whether it is touched instead of the tets' own surface
    weights: sp.csr_matrix  #: (v, n): vertices are these sums of the nodes of the body's tets


def embed(self: "Body", surface: SurfaceMesh, contact: bool = False, colour=None, opacity: float | None = None) -> Skin:
    """Let a surface ride in the body's tets, and return it as a skin.

    surface: in the coordinates of the mesh; each vertex lies in the body, or outside by at most half the height of the nearest
    tet. Pictures, the window and USD show it instead of the tets' surface. contact: whether it is also what touches and is
    touched; it must then be closed, and its vertices follow the nodes of the tets in all results. colour, opacity: set those of
    the body. Raises SceneError.
    """
    what = self._check_open("embed")
    surface = as_surface(surface)
    if not isinstance(surface, SurfaceMesh):
        raise SceneError(f"{what}: surface must be a SurfaceMesh (see ts.read_surface), not {type(surface).__name__}")
    if self.skin is not None:
        raise SceneError(f"{what}: it has a skin already")
    contact = checks.flag(contact, f"{what}: contact")
    if contact and (faults := surface.faults()):
        raise SceneError(f"{what}: a skin that is touched must bound a solid: {faults[0]}")
    if contact and self.contact_mode == "distance_field":
        raise SceneError(f'{what}: a skin that is touched has no distance field: set collision="proximity"')
    nodes, weights, outside = locate(self, surface.vertices)
    far = int(np.argmax(outside))
    if outside[far] > MAX_OUTSIDE:
        raise SceneError(
            f"{what}: vertex {far} lies outside of the body, by {outside[far]:.2g} times {self.extent}: at most {MAX_OUTSIDE:g} "
            "is allowed; place surface and mesh alike, by ts.place"
        )
    matrix = weight_matrix(nodes, weights, self.n_nodes)
    matrix.eliminate_zeros()
    self.colour = self.colour if colour is None else colour
    self.opacity = self.opacity if opacity is None else opacity
    with thawed(self):
        self.skin = Skin(surface, contact, matrix)
        if contact:
            self.nodes = mesh_nodes.embed(self.nodes, surface.vertices, surface.triangles, matrix)
            if self.velocity.ndim == 2:
                self.velocity = np.concatenate([self.velocity, matrix @ self.velocity])
    return self.skin
