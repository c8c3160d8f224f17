"""Richardson extrapolation: the error of a run from its difference to runs with other steps or meshes, and their observed order.

A method of order p errs by about C h^p in steps, or on meshes, of size h. Two runs with h and r h then differ by |r^p - 1| times
the error of the first. Of three runs with h, 2 h and 4 h the successive differences have the ratio 2^p, which shows p.
Where the ratio is too small the runs are too coarse for an estimate, or their paths part, as after impacts.
"""

import math

import numpy as np

from taisoft.dynamics.schemes import SECOND_ORDER
from taisoft.scene.key_frames import NodePath
from taisoft.scene.loads import LoadPath
from taisoft.scene.scene import Scene

MESH_ORDER = 2  # of positions in the mesh width; corners and contacts keep quadratic tets near it too
MIN_ORDER = 0.4  # observed orders below it allow no extrapolation: the error would be over three times the difference


def nominal_order(integrator: str, scene: Scene, touches: bool) -> int:
    """Order in time that the integrator has in this scene. touches: whether contact forces are simulated."""
    return 2 if integrator in SECOND_ORDER and is_smooth(scene, touches) else 1


def is_smooth(scene: Scene, touches: bool) -> bool:
    """Whether second-order methods keep their order.

    They do not with contacts, tendons that may slacken, velocity-dependent forces, or paths, which may jump.
    """
    materials = [body.composition.first for body in scene.bodies]
    constraints = [constraint for body in scene.bodies for constraint in body.constraints]
    prescribed = any(one.path is not None for one in (*constraints, *scene.loads))
    damped = any(material.mass_damping or material.stiffness_damping for material in materials)
    damped = damped or any(one.damping for one in scene.connections)
    prescribed = prescribed or any(scene.moves(one) for one in scene.connections)
    slackens = any(tendon.given == "length" for tendon in scene.tendons)
    return not (prescribed or damped or touches or slackens)


def may_jump(scene: Scene) -> bool:
    """Whether forces may change suddenly: with nodes that are released, and with functions of time, but not with key frames."""
    constraints = [constraint for body in scene.bodies for constraint in body.constraints]
    paths = [one.path for one in (*constraints, *scene.loads) if one.path is not None]
    return any(not isinstance(path, (NodePath, LoadPath)) or path.frames.release for path in paths)


def error_over_difference(ratio: float, order: float) -> float:
    """Error of a run over its difference to another one. ratio: the other's step, or mesh width, over the run's."""
    return 1.0 / abs(ratio**order - 1.0)


def observed_order(fine: float, coarse: float, most: float) -> float | None:
    """Order seen in the differences of runs with h and 2 h (fine), and with 2 h and 4 h (coarse).

    most: the nominal order; a higher one may be chance. None if the order is below MIN_ORDER.
    """
    if not coarse >= 2.0**MIN_ORDER * fine > 0.0:
        return None
    return min(most, math.log2(coarse / fine))


def agreement(fine: np.ndarray, coarse: np.ndarray, negligible: float) -> int:
    """Number of comparisons, from the first on, over which the differences show an order, or are negligible.

    fine, coarse: (k,) sums of squared distances at each comparison, as for `observed_order`; negligible: a sum at each.
    """
    near, far = np.cumsum(fine), np.cumsum(coarse)
    few = near <= negligible * np.arange(1, len(near) + 1)
    seen = np.flatnonzero(few | (far >= 4.0**MIN_ORDER * near))
    return int(seen[-1]) + 1 if len(seen) else 0
