"""Validate and apply run-time changes of a scene's numbers to the simulator's own copy of the scene."""

import difflib
from dataclasses import replace

import numpy as np

from taisoft.attributes import thawed
from taisoft.errors import SceneError
from taisoft.scene import checks
from taisoft.scene.body import Body

CHANGEABLE = ("young", "poisson", "density", "mass_damping", "stiffness_damping")
LOADS = {"force": "forces", "traction": "tractions"}  # kind of load -> the body's list of them


def change_material(body: Body, numbers: dict[str, float], on: dict[str, bool]) -> None:
    """Replace numbers of a body's material. The law and damping that is compiled out cannot change at run time.

    Warnings point to the line of the caller's caller. Raises SceneError.
    """
    for name, value in numbers.items():
        if name not in CHANGEABLE:
            near = difflib.get_close_matches(name, CHANGEABLE, 1)
            hint = f" (did you mean {near[0]}?)" if near else ""
            raise SceneError(f"body '{body.name}': {name} cannot change while it runs{hint}; {', '.join(CHANGEABLE)} can")
        if name in on and not on[name] and value != 0.0:
            raise SceneError(
                f"body '{body.name}': {name} was 0 everywhere at the start and is not modelled; "
                "start with a small value to change it later"
            )
    try:
        material = replace(body.material, **numbers)
    except SceneError as error:
        raise SceneError(f"body '{body.name}': {error}") from None
    with thawed(body):
        body.material = material
    if "poisson" in numbers:
        body.warn_locking(stacklevel=3)


def change_load(body: Body, kind: str, index: int, value) -> None:
    """Set the value of a body's load `index`, counted from 0 in the order added. kind: a key of LOADS.

    value: (3,) [N], or (k,3) for the k nodes of a force; (3,) [Pa] for a traction. Raises SceneError.
    """
    loads = getattr(body, LOADS[kind])
    what = f"body {body.name!r}: set_{kind}"
    if not loads:
        raise SceneError(f"{what}: it has no {kind}: give it one of 0 by body.add_{kind} before the Simulator is made")
    if isinstance(index, (bool, np.bool_)) or not isinstance(index, (int, np.integer)) or not 0 <= index < len(loads):
        raise SceneError(f"{what}: index must be a whole number from 0 to {len(loads) - 1}, not {index!r}")
    old = loads[index]
    shapes = ((3,), (len(old.nodes), 3)) if kind == "force" else ((3,),)
    new = replace(old, value=checks.array(value, f"{what}: {kind} {index}", shapes))
    with thawed(body):
        getattr(body, LOADS[kind])[index] = new
