"""Which bodies constraints and connections hold, as statics needs it where nothing can touch."""

import numpy as np

from taisoft.errors import SceneError
from taisoft.mesh.topology import linked_groups
from taisoft.scene.scene import Scene


def check_held(scene: Scene) -> None:
    """Raise SceneError unless every body is held along every axis. Those that connections join hold each other."""
    names = [one.name for one in scene.colliders]
    links = [(names.index(one.owners[0]), names.index(other)) for one in scene.connections for other in one.owners]
    group = linked_groups(*np.array(links, dtype=np.int64).reshape(-1, 2).T, len(names))[1]
    held = np.zeros((len(names), 3), dtype=bool)  # of each group
    held[group[len(scene.bodies) :]] = True  # obstacles
    for body, k in zip(scene.bodies, group):
        for constraint in body.constraints:
            held[k] |= constraint.axes
    for body, k in zip(scene.bodies, group):
        if missing := "".join(np.array(list("xyz"))[~held[k]]):
            raise SceneError(f"body '{body.name}': nothing holds it along {missing}, so it has no static state")
