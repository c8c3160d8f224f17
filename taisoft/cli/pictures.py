"""Options of pictures and films, which `taisoft run` and `taisoft draw` share."""

import tomllib
from argparse import Namespace
from pathlib import Path

from taisoft.errors import OutputError, SceneError, reworded
from taisoft.output.viewpoint import MAX_ELEVATION
from taisoft.scene import checks
from taisoft.scene.look import Camera
from taisoft.scene.tables import Table
from taisoft.scene.toml import parsed
from taisoft.view.annotations import text_missing
from taisoft.view.choices import IN_PICTURES, LAYERS
from taisoft.view.offscreen import SIZE, checked_size
from taisoft.view.pictures import PictureOptions


def picture_options(arguments: Namespace, plots: tuple[str, ...] = (), name: str | None = None) -> PictureOptions:
    """Return what the given options say of pictures. name: of the scene, by default its file's.

    Raises SceneError for a value that is none, and without needed packages.
    """
    if arguments.view is not None and arguments.camera is not None:
        raise SceneError("--view gives the automatic camera's direction, so it excludes --camera")
    if (plots or arguments.caption) and text_missing():
        raise SceneError(f"{'--plots' if plots else '--caption'}: {text_missing()}")
    layers, size = names_of("layers", arguments.layers, LAYERS), SIZE if arguments.size is None else _size_of(arguments.size)
    drawn = {"colour": arguments.colour, "layers": IN_PICTURES if layers is None else layers, "plots": plots}
    caption = (name or Path(arguments.scene).stem) if arguments.caption else None
    return PictureOptions(**drawn, caption=caption, size=size, view=_view_of(arguments.view))


def slowness(arguments: Namespace) -> float:
    """Return film time over simulated time. Raises SceneError."""
    if arguments.slow is not None and not arguments.video:
        raise SceneError("--slow is the speed of the film, so it needs --video")
    return checks.number(1.0 if arguments.slow is None else arguments.slow, "--slow", above=0.0)


def camera_of(text: str) -> Camera:
    """Return the camera of --camera: a .toml file with a table [camera], or the keys of that table. Raises SceneError."""
    if text.strip().endswith(".toml"):
        file = Path(text.strip())
        with reworded(SceneError, "--camera "):
            tables = parsed(file)
    else:
        file = Path("--camera")
        try:
            tables = tomllib.loads(f"camera = {{ {text} }}")
        except ValueError:
            example = "'position = [3, 2, 4], target = [0, 0.5, 0], fov = 30'"
            raise SceneError(f"--camera {text}: write a .toml file, or keys as in {example}") from None
    if "camera" not in tables:
        raise SceneError(f"--camera {text}: the file has no table [camera]")
    return Table(file, "", tables, list(tables)).made("camera", Camera, "camera: ")


def _view_of(angles: list[float] | None) -> tuple[float, float] | None:
    """Return azimuth and elevation [deg]. Raises SceneError if they are not finite, or the view is from straight above."""
    if angles is None:
        return None
    azimuth = checks.number(angles[0], "--view: azimuth")
    elevation = checks.number(angles[1], "--view: elevation")
    if abs(elevation) > MAX_ELEVATION:
        raise SceneError(f"--view: the elevation must be from -{MAX_ELEVATION:g} to {MAX_ELEVATION:g} degrees, not {elevation:g}")
    return azimuth, elevation


def _size_of(text: str) -> tuple[int, int]:
    """Return width and height [pixels] of a text such as 640x360. Raises SceneError."""
    width, x, height = text.partition("x")
    if not (x and width.isdecimal() and height.isdecimal()):
        raise SceneError(f"--size {text}: write width and height in pixels, such as 640x360")
    with reworded(OutputError, f"--size {text}: ", raised=SceneError):
        return checked_size((int(width), int(height)))


def names_of(option: str, text: str | None, known) -> tuple[str, ...] | None:
    """Return the comma-separated names in an option's value; `none` gives (), no value None. Raises SceneError."""
    if text is None:
        return None
    if text.strip() == "none":
        return ()
    return tuple(checks.choice(name.strip(), f"--{option} {text}: each name", tuple(known)) for name in text.split(","))
