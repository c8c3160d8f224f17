"""The keys and mouse buttons of the live window: one table for the window, its panel and the manual."""

from dataclasses import dataclass

import taichi as ti

from taisoft.view.choices import nodal

CYCLED = [name for name in nodal() if name != "error"]  # the error needs a run that estimates it


@dataclass(frozen=True)
class Key:
    """Keys with the same action. names: GGUI's; label: as printed on them; help: in the panel, text: in the manual."""

    names: tuple[str, ...]
    label: str
    action: str
    help: str
    text: str


KEYS = (
    Key((ti.ui.SPACE,), "Space", "pause", "pause", "pause or continue"),
    Key(("s", ti.ui.RIGHT), "S, right arrow", "step", "step", "one step"),
    Key(("r",), "R", "reset", "restart", "restart"),
    Key((ti.ui.UP,), "Up arrow", "faster", "faster", "run twice as fast, up to 16 times real time"),
    Key((ti.ui.DOWN,), "Down arrow", "slower", "slower", "run half as fast"),
    Key(("x",), "X", "unbound", "as fast as possible", "run as fast as the solver can, or bound to the clock again"),
    Key(("b",), "B", "budget", "budget", "end steps on a budget of wall time, or solve them"),
    Key(("h",), "H", "frame", "frame the bodies", "frame the bodies"),
    Key(("l",), "L", "follow", "follow them", "the camera follows the bodies, or stays"),
    Key(("v",), "V", "colour", "colours", f"colour bodies by {', '.join(CYCLED)} or body"),
    Key(("w",), "W", "wires", "wires", "wires"),
    Key(("c",), "C", "contacts", "contacts", "contacts: normals green, impulses red"),
    Key(("t",), "T", "tractions", "tractions", "tractions"),
    Key(("f",), "F", "fixed_nodes", "fixed nodes", "fixed nodes"),
    Key(("d",), "D", "shadows", "shadows", "shadows on half-spaces"),
    Key(("i",), "I", "screenshot", "picture", "write a picture, without the panel, to `out/window-1.png`"),
    Key((ti.ui.ESCAPE,), "Escape", "close", "end", "end"),
)
MOUSE = (
    ("left button on a body", "drag the body by a damped spring"),
    ("left button beside the bodies, or with Ctrl", "turn the view"),
    ("right button", "zoom"),
    ("middle button", "shift the view"),
)
ACTIONS = {name: key.action for key in KEYS for name in key.names}
