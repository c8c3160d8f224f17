"""Richardson extrapolation: the error of a run from its difference to runs with other steps or meshes, and their observed order.

A method of order p errs by about C h^p in steps, or on meshes, of size h. Two runs with h and r h then differ by |r^p - 1| times
the error of the first. Of three runs with h, 2 h and 4 h the successive differences have the ratio 2^p, which shows p. With h,
a h and a b h it is (b^p - 1) / (1 - a^-p), which grows with p too.
Where the ratio is too small the runs are too coarse for an estimate, or their paths part, as after impacts.
"""

import numpy as np

from taisoft.dynamics.schemes import SECOND_ORDER
from taisoft.scene.key_frames import NodePath
from taisoft.scene.loads import LoadPath
from taisoft.scene.scene import Scene

MESH_ORDER = 2  # of positions in the mesh width; corners and contacts keep quadratic tets near it too
MIN_ORDER = 0.4  # observed orders below it allow no extrapolation: the error would be over three times the difference
BISECTIONS = 40  # that find an order


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


def difference_ratio(order: float, near: float, far: float) -> float:
    """Ratio of the differences of runs with near h and near far h, and with h and near h."""
    return (far**order - 1.0) / (1.0 - near**-order)


def observed_order(fine: float, coarse: float, most: float, near: float = 2.0, far: float = 2.0) -> float | None:
    """Order seen in the differences of runs with h and near h (fine), and with near h and near far h (coarse).

    most: the nominal order; a higher one may be chance. None if the order is below MIN_ORDER.
    """
    if not coarse >= difference_ratio(MIN_ORDER, near, far) * fine > 0.0:
        return None
    low, high = MIN_ORDER, most
    for _ in range(BISECTIONS):
        middle = 0.5 * (low + high)
        low, high = (middle, high) if difference_ratio(middle, near, far) * fine <= coarse else (low, middle)
    return high


def agreement(fine: np.ndarray, coarse: np.ndarray, negligible: float) -> int:
    """Number of comparisons, from the first on, over which the differences show an order, or are negligible.

    fine, coarse: (k,) sums of squared distances at each comparison, as for `observed_order`; negligible: a sum at each.
    """
    near, far = np.cumsum(fine), np.cumsum(coarse)
    few = near <= negligible * np.arange(1, len(near) + 1)
    seen = np.flatnonzero(few | (far >= 4.0**MIN_ORDER * near))
    return int(seen[-1]) + 1 if len(seen) else 0
