"""`taisoft scene SCENE --out FILE.toml`: a scene as a scene file."""

from argparse import Namespace

from taisoft.cli.scene_file import load_scene
from taisoft.scene.toml_writer import write_scene


def command(arguments: Namespace) -> int:
    """Writes the file and what it needs beside it, and names them. Raises SceneError for what no file can hold."""
    scene, solver = load_scene(arguments.scene, arguments.allow_outside)
    for path in write_scene(arguments.out, scene, solver, arguments.overwrite):
        print(path)
    return 0
