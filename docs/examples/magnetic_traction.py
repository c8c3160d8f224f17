"""Traction of a uniform field B [T] on the poles of a magnetised body: (M . n) B per reference area [Pa].

M [A/m] is the magnetisation at rest and n the outward normal there, so on a whole surface the forces have no sum, and the torque
volume M cross B at rest. The field of the body itself is left out.
"""

from typing import ClassVar

import numpy as np

from taisoft.fem import loads as forces
from taisoft.fem.reference import triangle_areas
from taisoft.scene import checks
from taisoft.scene.loads import BodyLoad, load_kind, value_or_path


@load_kind("magnetic_traction")
class MagneticTraction(BodyLoad):
    """A dead load on surface triangles; its value is the field B [T]."""

    items: ClassVar[str] = "triangles"
    own: ClassVar[tuple[str, ...]] = ("magnetisation",)
    triangles: np.ndarray  #: (k,) rows of mesh.surface
    magnetisation: np.ndarray  #: (3,) [A/m]

    @classmethod
    def of(cls, body, what, where, magnetic_traction, magnetisation):
        """magnetic_traction: B (3,) [T], its path or `KeyFrames`."""
        triangles = body.select_triangles(where, what)
        value = value_or_path(magnetic_traction, what, cls.kind, cls.shapes)
        return cls(triangles=triangles, magnetisation=checks.vector(magnetisation, f"{what}: magnetisation"), **value)


def weights(body, load) -> tuple[np.ndarray, np.ndarray]:
    """Nodes (k,), and the integrals (k,) of M . n at each, which times B are its force."""
    a, b, c = np.moveaxis(body.mesh.vertices[body.mesh.surface[load.triangles]], 1, 0)
    normals = np.cross(b - a, c - a)
    poles = (normals / np.linalg.norm(normals, axis=1, keepdims=True)) @ load.magnetisation
    total = sum(pole * triangle_areas(body, load.triangles[poles == pole]) for pole in np.unique(poles))
    nodes = np.flatnonzero(total)
    return nodes, total[nodes]


forces.WEIGHTS["magnetic_traction"] = weights
