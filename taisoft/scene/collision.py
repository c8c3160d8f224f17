"""Define a scene's collision detection settings and geometric tests for them.

Contacts with a body are found either by vertex-face and edge-edge proximity of its deformed surface, or through its signed
distance grid at rest, mapped by the tets behind the surface. The grid is smooth, but it rounds off edges and its cells may be
thicker than a sheet. Where the deformation of neighbouring tets differs, the map is discontinuous: in the demo
drop_everything, the ball (radius 0.2 m) and the edge of a step then penetrate by 2 cm. The grid is therefore used only on
request.
"""

import numpy as np

from taisoft.attributes import checked, guarded_record
from taisoft.errors import MeshError, SceneError
from taisoft.mesh.nodes import Nodes
from taisoft.mesh.topology import normals_and_heights, opposite_half_edges
from taisoft.scene import checks

BROAD_PHASES = ("auto", "spatial_hash", "bvh")
CONTACT_MODES = ("auto", "distance_field", "proximity")
CAPACITIES = range(64, 2**31)
SHARP = 60.0  # [degrees] between adjacent face normals above which a convex edge is sharp


@guarded_record(
    "collision settings", "give scene.collision new CollisionSettings({name}=...) before a Simulator takes the scene", eq=True
)
class CollisionSettings:
    """Settings of contact detection. Raises SceneError for numbers outside the rules below."""

    broad_phase: str = checked(
        checks.choice, "auto", allowed=BROAD_PHASES
    )  #: "auto", "spatial_hash" or "bvh"; auto: bvh on the CPU for up to 200 colliders, else the hash
    cell_ratio: float = checked(checks.number, 2.2, above=0.0)  #: edge of a hash cell over the mean surface edge, > 0
    #: distance within which contacts are reported [m], >= 0; None: 0.1 of the mean surface edge
    margin: float | None = checked(checks.number, None, minimum=0.0, unit="m")
    #: gap that contacts keep, over the finest body's mean surface edge, 1e-5 to 0.1; None: 2e-3, in statics where bodies meet
    #: half-spaces alone 2e-5
    offset: float | None = checked(checks.number, None, minimum=1e-5, maximum=0.1)
    k_dop: int = checked(checks.whole, 6, allowed=(6, 14, 18))  #: planes of the boxes of "bvh": 6, 14 or 18
    field_cells: int = checked(
        checks.whole, 32, allowed=range(8, 257)
    )  #: cells of a distance field along a body's longest side, 8 to 256
    #: of the buffers of pairs and contacts, at least 64; None: from the surface
    initial_capacity: int | None = checked(checks.whole, None, allowed=CAPACITIES)
    max_capacity: int | None = checked(checks.whole, None, allowed=CAPACITIES)  #: of any buffer; None: what the memory holds

    def __post_init__(self):
        if (self.initial_capacity or 0) > (self.max_capacity or CAPACITIES.stop):
            rule = f"initial_capacity {self.initial_capacity} must not exceed max_capacity {self.max_capacity}"
            raise SceneError(f"collision settings: {rule}")


def has_sharp_edges(nodes: Nodes) -> bool:
    """Return whether a convex edge of the surface is sharper than SHARP at rest, or parts are joined at an edge."""
    try:
        opposite = opposite_half_edges(nodes.surface)
    except MeshError:
        return True
    return _largest_convex_angle(nodes.positions, nodes.surface, opposite) > SHARP


def principal_extents(positions: np.ndarray, surface: np.ndarray) -> np.ndarray:
    """Return the sides (3,) [m] of the bounding box along the principal axes of the surface's area.

    With s the sum of a triangle's corners v about the centroid, the integral of x x^T is area/12 (sum v v^T + s s^T).
    """
    x = positions[surface]
    area = np.linalg.norm(np.cross(x[:, 1] - x[:, 0], x[:, 2] - x[:, 0]), axis=1)
    x = x - (area @ x.mean(axis=1)) / area.sum()
    corner_sum = x.sum(axis=1)
    moment = np.einsum("t,tki,tkj->ij", area, x, x) + np.einsum("t,ti,tj->ij", area, corner_sum, corner_sum)
    return np.ptp(x.reshape(-1, 3) @ np.linalg.eigh(moment)[1], axis=0)


def _largest_convex_angle(positions: np.ndarray, surface: np.ndarray, opposite: np.ndarray) -> float:
    """Return the largest angle [degrees] between adjacent face normals at a convex edge, rounded to 1e-6."""
    normals, _ = normals_and_heights(positions, surface)
    t, k = np.nonzero(opposite >= 0)
    other, at = np.divmod(opposite[t, k], 3)
    apex = positions[surface[other, (at + 2) % 3]]  # the neighbour's corner opposite the edge
    convex = np.einsum("ex,ex->e", apex - positions[surface[t, k]], normals[t]) < 0
    a, b = normals[t[convex]], normals[other[convex]]
    # arctan2 of sine and cosine, since arccos is inaccurate near 0 and 180 degrees.
    angle = np.arctan2(np.linalg.norm(np.cross(a, b), axis=1), np.einsum("ex,ex->e", a, b))
    return round(float(np.degrees(angle.max(initial=0.0))), 6)
