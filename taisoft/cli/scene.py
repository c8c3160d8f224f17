"""`taisoft scene SCENE --out FILE.toml`: a scene as a scene file; of a mesh file, a scene to start from."""

import math
from argparse import Namespace
from pathlib import Path

import numpy as np

from taisoft.cli.scene_file import load_scene
from taisoft.cli.warnings import printed_warnings
from taisoft.mesh.files import WRITERS, read_mesh
from taisoft.mesh.tet_mesh import TetMesh
from taisoft.scene.material import Material
from taisoft.scene.obstacles import HalfSpace
from taisoft.scene.scene import Scene
from taisoft.scene.toml_writer import write_scene

HEIGHT = 0.25  # of the body's, that it falls
STIFFNESS = 100.0  # Young's modulus in units of the pressure under the body: it sags by about 1 %
DENSITY = 1000.0  # [kg/m^3]
GROUND = "ground"
MESHES = (*WRITERS, ".node", ".ele")


def command(arguments: Namespace) -> int:
    """Writes the file and what it needs beside it, and names them. Raises SceneError for what no file can hold."""
    path = Path(arguments.scene)
    with printed_warnings():
        if path.suffix.lower() in MESHES:
            scene, solver = start_from(read_mesh(path), path.stem)
        else:
            scene, solver = load_scene(arguments.scene, arguments.allow_outside)
    for written in write_scene(arguments.out, scene, solver, arguments.overwrite):
        print(written)
    return 0


def start_from(mesh: TetMesh, name: str) -> tuple[Scene, dict]:
    """A scene in which the mesh falls on the ground, of rubber about as stiff as its size asks for, and its solver dict."""
    scene = Scene(gravity=(0.0, -9.81, 0.0))
    low, high = mesh.vertices.min(axis=0), mesh.vertices.max(axis=0)
    height = float((high - low)[1])
    stiff = STIFFNESS * DENSITY * 9.81 * height
    young = float(f"{stiff:.0e}")  # one digit
    rubber = Material(young=young, poisson=0.4, density=DENSITY, friction=0.5)
    scene.add_body(mesh, rubber, name="body" if name == GROUND else name, position=(0.0, HEIGHT * height - float(low[1]), 0.0))
    scene.add_obstacle(HalfSpace((0.0, 0.0, 0.0), (0.0, 1.0, 0.0)), name=GROUND, friction=0.5)
    fall = math.sqrt(2.0 * HEIGHT * height / 9.81)  # [s]
    fps = 50.0 if fall > 0.05 else float(np.ceil(2.5 / fall))
    return scene, {"dt": 0.5 / fps, "seconds": 100.0 / fps, "fps": fps}
