"""Former names do not return: the code uses the standard terms of the field.

Only identifiers are checked, as Python's tokenizer finds them; comments and strings may use the words.
"""

import io
import re
import tokenize
from pathlib import Path

import pytest

import taisoft

PACKAGE = Path(taisoft.__file__).parent
FORMER = {  # former name: the standard term
    "led": "prescribed",
    "led_nodes": "prescribed_nodes",
    "leads": "has_prescribed",
    "let_go": "release",
    "letting_go": "releasing",
    "told": "message, report or warnings",
    "told_warnings": "printed_warnings",
    "tell_locking": "warn_locking",
    "World": "SimulationState",
    "Motion": "DirichletConditions",
    "Pull": "DragSpring",
    "Grip": "Drag",
    "pullable": "draggable",
    "pulled": "dragged",
    "Stretch": "TimedRun",
    "Strip": "PlotOverlay",
    "Ask": "Request",
    "Left": "Interrupted",
    "Shown": "DisplayOptions",
    "SUNK": "DEEP_PENETRATION",
    "SANK": "NOTICEABLE_PENETRATION",
    "sinking": "relative_penetration",
    "HASTE": "MAX_CLOSING_RATIO",
    "survey": "measure_closing",
    "find_way": "find_displacement",
    "way_out": "exit_direction",
    "STANDOFF": "CONTACT_OFFSET",
    "standoff": "contact_offset",
    "short_of_goal": "gap_minus_target",
    "carry": "obstacle_displacement",
    "lag": "tangential_offset",
    "misfit": "prox_residual",
    "go_beyond": "_extrapolate",
    "against": "_restart_test",
    "obey": "_apply_verdict",
    "sticks_out": "in_normal_cone",
    "hit_by": "contact_mode",
    "unfinite": "nonfinite",
    "fence": "safe_reading",
    "read_fenced": "read_by_meshio",
    "scene_marks": "scene_fingerprint",
    "MAX_PARTS": "MAX_SUBSTEPS",
}


def identifiers(path: Path) -> set[str]:
    """All names in a file's code, and the name of the file."""
    tokens = tokenize.generate_tokens(io.StringIO(path.read_text(encoding="utf-8")).readline)
    return {token.string for token in tokens if token.type == tokenize.NAME} | {path.stem}


@pytest.mark.parametrize("path", sorted(PACKAGE.rglob("*.py")), ids=lambda path: str(path.relative_to(PACKAGE)))
def test_no_former_names(path):
    found = identifiers(path) & set(FORMER)
    assert not found, "; ".join(f"{name}: use {FORMER[name]}" for name in sorted(found))


def test_the_scan_finds_identifiers_only(tmp_path):
    path = tmp_path / "fence.py"
    path.write_text('def told(standoff):  # of a carry\n    """The goal is told."""\n    return f"{standoff} survey"\n')
    assert {"told", "standoff", "fence"} <= identifiers(path) and not {"carry", "goal", "survey"} & identifiers(path)


def test_tests_use_the_public_interface_of_a_simulator():
    """Those of internals build a Dynamics of their own (`scenes.dynamics`)."""
    private = re.compile(r"\bsim\._(?!_)|\._(dynamics|host)\b")
    text = {
        path.name: path.read_text(encoding="utf-8") for path in Path(__file__).parents[1].rglob("*.py") if path != Path(__file__)
    }
    assert not {name: found[0] for name, content in text.items() if (found := private.findall(content))}
