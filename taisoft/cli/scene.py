"""`taisoft scene SCENE --out FILE.toml`: writes a scene file of a scene, or a starting scene for a mesh file."""

import math
from argparse import Namespace
from pathlib import Path

import numpy as np

from taisoft.cli.scene_file import load_scene
from taisoft.cli.warnings import printed_warnings
from taisoft.mesh.files import WRITERS, read_mesh
from taisoft.mesh.tet_mesh import TetMesh
from taisoft.scene.body import Material
from taisoft.scene.obstacles import HalfSpace
from taisoft.scene.scene import Scene
from taisoft.scene.toml_writer import write_scene

DROP = 0.25  # over the body's height
RELATIVE_STIFFNESS = 100.0  # Young's modulus over the pressure under the body: it sags by about 1 %
DENSITY = 1000.0  # [kg/m^3]
GROUND = "ground"
MESH_SUFFIXES = (*WRITERS, ".node", ".ele")


def command(arguments: Namespace) -> int:
    """Write the scene file and the files it needs, and print their names. Raises SceneError if no file can hold the scene."""
    path = Path(arguments.scene)
    with printed_warnings():
        if path.suffix.lower() in MESH_SUFFIXES:
            scene, solver = start_from(read_mesh(path), path.stem)
        else:
            scene, solver = load_scene(arguments.scene, arguments.allow_outside)
    for written in write_scene(arguments.out, scene, solver, arguments.overwrite):
        print(written)
    return 0


def start_from(mesh: TetMesh, name: str) -> tuple[Scene, dict]:
    """Return a scene in which the mesh, of rubber with stiffness scaled to its size, falls on the ground; and its solver dict."""
    scene = Scene(gravity=(0.0, -9.81, 0.0))
    low, high = mesh.vertices.min(axis=0), mesh.vertices.max(axis=0)
    height = float((high - low)[1])
    stiffness = RELATIVE_STIFFNESS * DENSITY * 9.81 * height
    young = float(f"{stiffness:.0e}")  # one digit
    rubber = Material(young=young, poisson=0.4, density=DENSITY, friction=0.5)
    scene.add_body(mesh, rubber, name="body" if name == GROUND else name, position=(0.0, DROP * height - float(low[1]), 0.0))
    scene.add_obstacle(HalfSpace((0.0, 0.0, 0.0), (0.0, 1.0, 0.0)), name=GROUND, friction=0.5)
    fall = math.sqrt(2.0 * DROP * height / 9.81)  # [s]
    fps = 50.0 if fall > 0.05 else float(np.ceil(2.5 / fall))
    return scene, {"dt": 0.5 / fps, "seconds": 100.0 / fps, "fps": fps}
