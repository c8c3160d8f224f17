"""Read and write the looks of a scene file: background, lights and camera, and colours and opacities."""

import numpy as np

from taisoft.scene.look import Camera, Light, check_follow, colour_of
from taisoft.scene.scene import Scene
from taisoft.scene.tables import Table, arguments_of
from taisoft.scene.toml_values import fields_of

LOOK_KEYS = ("background", "lights", "camera")


def read_look(scene: Scene, tables: Table) -> None:
    """Set background, lights and camera of a scene whose bodies are there. Raises SceneError."""
    if "background" in tables:
        with tables.located_errors("scene: "):
            scene.background = tables.values["background"]
    if "lights" in tables:
        lights = [one.make(Light, "light: ") for one in tables.listed("lights", *arguments_of(Light))]
        with tables.located_errors("scene: "):
            scene.lights = lights
    if "camera" in tables:
        scene.camera = tables.made("camera", Camera, "camera: ")
        with tables.located_errors():
            check_follow(scene.camera, scene.bodies)


def look_tables(scene: Scene) -> dict:
    """Return the entries of a scene's looks that are set."""
    tables: dict = {}
    if scene.background is not None:
        two = [colour_value(colour) for colour in scene.background]
        tables["background"] = two[0] if np.array_equal(*scene.background) else two
    if scene.lights is not None:
        tables["lights"] = [fields_of(one) | {"colour": colour_value(one.colour)} for one in scene.lights] or ()
    if scene.camera is not None:
        tables["camera"] = fields_of(scene.camera)
    return tables


def look_of(part) -> dict:
    """Return colour and opacity of a body or an obstacle where they are set."""
    colour = {} if part.colour is None else {"colour": colour_value(part.colour)}
    return colour | ({} if part.opacity == 1.0 else {"opacity": part.opacity})


def colour_value(colour: np.ndarray) -> str | np.ndarray:
    """Return a colour as "#rrggbb" if that is exactly the same one, else its numbers."""
    text = "#" + "".join(f"{round(255.0 * value):02x}" for value in colour)
    return text if np.array_equal(colour_of(text, ""), colour) else colour
