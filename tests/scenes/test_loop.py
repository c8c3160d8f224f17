"""The manual's loop (docs/tutorials/loop.md), whose own run takes implicit steps: the same with explicit ones."""

import re
from pathlib import Path

import pytest

import taisoft as ts

PAGE = Path(__file__).parents[2] / "docs" / "tutorials" / "loop.md"


def test_a_gripper_slips_at_the_force_of_coulombs_law_in_explicit_steps_too():
    code = "".join(re.findall(r"^```python\n(.*?)^```", PAGE.read_text(encoding="utf-8"), re.DOTALL | re.MULTILINE))
    names = {}
    exec(code[: code.index("with ts.Simulator(")], names)
    with ts.Simulator(names["scene"], dt=1 / (4 * names["RATE"]), integrator="symplectic_euler") as sim:
        grip = names["drive"](sim)[-1][2]
    assert grip == pytest.approx(names["weight"] / (2 * names["FRICTION"]), rel=0.02)
