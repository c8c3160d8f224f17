"""Display options of `taisoft run` for pictures and the window: colours, layers, plots, a caption."""

from argparse import Namespace
from dataclasses import dataclass
from pathlib import Path

from taisoft.errors import SceneError
from taisoft.scene.checks import nearest
from taisoft.view.annotations import Annotations, text_missing
from taisoft.view.colouring import Colouring
from taisoft.view.plots import PLOTS, Plots
from taisoft.view.scene_view import IN_PICTURES, IN_WINDOW, LAYERS


@dataclass(frozen=True)
class DisplayOptions:
    """colour: as in `Offscreen`; layers: names, or None for the defaults; plots: names; caption: the scene's name, or None."""

    colour: str = "body"
    layers: tuple[str, ...] | None = None
    plots: tuple[str, ...] = ()
    caption: str | None = None

    @property
    def in_pictures(self) -> tuple[str, ...]:
        """Layers of pictures."""
        return IN_PICTURES if self.layers is None else self.layers

    @property
    def in_window(self) -> tuple[str, ...]:
        """Layers of the window."""
        return IN_WINDOW if self.layers is None else self.layers

    def annotate(self, plots: Plots | None, colouring: Colouring):
        """Return a function that draws plots and caption on pictures, for `FrameWriter`; None if there are none."""
        if not self.plots and self.caption is None:
            return None
        return Annotations(plots if self.plots else None, self.caption, colouring).draw


def display_options(arguments: Namespace, has_window: bool) -> DisplayOptions:
    """Return the requested display options. Raises SceneError for unknown names and for options that nothing would show."""
    has_pictures = arguments.out is not None and not arguments.no_frames
    needs = "needs --out, the folder to write to, and pictures, so it excludes --no-frames"
    layers, plots = _names("layers", arguments.layers, LAYERS), _names("plots", arguments.plots, PLOTS)
    requested = {"video": arguments.video, "caption": arguments.caption}
    if not has_window:
        requested |= {"layers": layers is not None, "plots": bool(plots)}
    for option, given in requested.items():
        if given and not has_pictures:
            raise SceneError(f"--{option} {needs}")
    if has_pictures and (plots or arguments.caption) and text_missing():
        raise SceneError(f"{'--plots' if plots else '--caption'}: {text_missing()}")
    caption = Path(arguments.scene).stem if arguments.caption else None
    return DisplayOptions(arguments.colour, layers, plots or (), caption)


def check_modelled(shown: DisplayOptions, sim) -> None:
    """Raise SceneError for a layer or plot of a feature that sim does not model."""
    if "contacts" in (shown.layers or ()) and not sim.plan.on["contact_forces"]:
        raise SceneError(f"--layers contacts: contact forces are not modelled ({sim.plan.why('contact_forces')})")
    Plots(sim, shown.plots)


def _names(option: str, text: str | None, known) -> tuple[str, ...] | None:
    """Return the comma-separated names in an option's value; `none` gives (), no value None. Raises SceneError."""
    if text is None:
        return None
    names = tuple(name.strip() for name in text.split(",")) if text.strip() != "none" else ()
    for name in names:
        if name not in known:
            raise SceneError(
                f"--{option} {text}: {name!r} is not a valid name{nearest(name, known)}; there are {', '.join(known)}, and none"
            )
    return names
