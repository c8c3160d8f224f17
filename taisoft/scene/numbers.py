"""The numbers of a scene that a simulator can change while it runs, by what to call each; and how two scenes differ in them."""

import dataclasses
import reprlib

from taisoft.scene.changes import LOADS
from taisoft.scene.scene import Scene

Numbers = dict[str, float | list | None]


def scene_numbers(scene: Scene) -> Numbers:
    """Plain data: gravity, all numbers of every material, values of loads, friction and restitution set for pairs."""
    numbers: Numbers = {"gravity": scene.gravity.tolist()}
    for body in scene.bodies:
        for name, value in dataclasses.asdict(body.material).items():
            if name != "law":
                numbers[f"body {body.name!r}: {name}"] = value
        for kind, loads in LOADS.items():
            for i, load in enumerate(getattr(body, loads)):
                numbers[f"body {body.name!r}: {kind} {i}"] = load.value.tolist()
    for names, (friction, restitution) in scene.contact_pairs.items():
        pair = " and ".join(repr(name) for name in sorted(names))
        numbers |= {f"contact of {pair}: friction": friction, f"contact of {pair}: restitution": restitution}
    return numbers


def numbers_differ(before: Numbers, now: Numbers) -> str:
    """A sentence about the first number in which a scene now differs from the one before; empty where none does."""
    for name in before | now:
        old, new = before.get(name), now.get(name)
        if old == new:
            continue
        if _rows(old) and _rows(new) and len(old) == len(new):  # one force for each node
            row = next(i for i, pair in enumerate(zip(old, new)) if pair[0] != pair[1])
            name, old, new = f"{name}, row {row}", old[row], new[row]
        return f"{name} is {_told(new)} in this scene and was {_told(old)} at the start of the saved run"
    return ""


def _rows(value) -> bool:
    return isinstance(value, list) and bool(value) and isinstance(value[0], list)


def _told(value) -> str:
    return "not set" if value is None else reprlib.repr(value)
