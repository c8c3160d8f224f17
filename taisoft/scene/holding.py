"""Which bodies constraints and connections hold, as statics needs it where nothing can touch."""

import numpy as np

from taisoft.errors import SceneError
from taisoft.scene.scene import Scene


def check_held(scene: Scene) -> None:
    """Raise SceneError unless every body is held along every axis. Those that connections join hold each other."""
    held = {body.name: np.any([c.axes for c in body.constraints], axis=0) for body in scene.bodies if body.constraints}
    for names in _connected(scene):
        together = np.any([held.get(name, np.zeros(3, dtype=bool)) for name in names], axis=0)
        held |= dict.fromkeys(names, together | any(name not in [body.name for body in scene.bodies] for name in names))
    for body in scene.bodies:
        constrained = held.get(body.name, np.zeros(3, dtype=bool))
        if not constrained.all():
            missing = "".join(a for a, is_constrained in zip("xyz", constrained, strict=True) if not is_constrained)
            raise SceneError(f"body '{body.name}': nothing holds it along {missing}, so it has no static state")


def _connected(scene: Scene) -> list[set[str]]:
    """Return the names of bodies and obstacles that connections join, a set for each group."""
    groups: list[set[str]] = []
    for one in scene.connections:
        joined = [group for group in groups if group & set(one.owners)]
        groups = [group for group in groups if group not in joined] + [set(one.owners).union(*joined)]
    return groups
