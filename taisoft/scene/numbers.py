"""Collect, by name, the numbers of a scene that may change at run time, and compare two such sets."""

import dataclasses
import reprlib

from taisoft.scene.changes import LOADS
from taisoft.scene.scene import Scene

Numbers = dict[str, float | list | None]


def scene_numbers(scene: Scene) -> Numbers:
    """Return as plain data gravity, all material numbers, load values, and friction and restitution set for pairs."""
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


def first_difference(before: Numbers, now: Numbers) -> str:
    """Return a sentence about the first difference between two scenes' numbers; "" if there is none."""
    for name in before | now:
        old, new = before.get(name), now.get(name)
        if old == new:
            continue
        if _is_nested(old) and _is_nested(new) and len(old) == len(new):  # one force per node
            row = next(i for i, pair in enumerate(zip(old, new)) if pair[0] != pair[1])
            name, old, new = f"{name}, row {row}", old[row], new[row]
        return f"{name} is {_number_text(new)} in this scene and was {_number_text(old)} at the start of the saved run"
    return ""


def _is_nested(value) -> bool:
    return isinstance(value, list) and bool(value) and isinstance(value[0], list)


def _number_text(value) -> str:
    return "not set" if value is None else reprlib.repr(value)
