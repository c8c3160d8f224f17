"""Elastic soft bodies in Taichi. Importing this package does not start Taichi: public names are loaded at their first use."""

import os
from importlib import import_module

__version__ = "0.1.0"

if os.name == "posix" and "HOME" not in os.environ:
    # Without HOME, importing Taichi ends the process. expanduser looks in the user database, which may have no entry.
    _home = os.path.expanduser("~")
    os.environ["HOME"] = _home if os.path.isabs(_home) else "/tmp"

os.environ.setdefault("ENABLE_TAICHI_HEADER_PRINT", "0")  # else Taichi prints a banner on standard output when imported
os.environ.setdefault("TI_ENABLE_PYBUF", "0")  # else Taichi writes a line into a notebook's cell

_MODULES = {  # public name -> the module that defines it
    "TetMesh": "taisoft.mesh.tet_mesh",
    "box_mesh": "taisoft.mesh.shapes",
    "sheet_mesh": "taisoft.mesh.shapes",
    "ball_mesh": "taisoft.mesh.shapes",
    "cylinder_mesh": "taisoft.mesh.shapes",
    "read_mesh": "taisoft.mesh.files",
    "write_mesh": "taisoft.mesh.files",
    "read_usd": "taisoft.mesh.usd",
    "SurfaceMesh": "taisoft.mesh.surface_mesh",
    "read_surface": "taisoft.mesh.surface_mesh",
    "tetrahedralize": "taisoft.mesh.surface_mesh",
    "place": "taisoft.mesh.placing",
    "harmonic_fibres": "taisoft.scene.fibres",
    "Material": "taisoft.scene.scene",
    "Body": "taisoft.scene.scene",
    "Scene": "taisoft.scene.scene",
    "HalfSpace": "taisoft.scene.obstacles",
    "Sphere": "taisoft.scene.obstacles",
    "Box": "taisoft.scene.obstacles",
    "Capsule": "taisoft.scene.obstacles",
    "MeshObstacle": "taisoft.scene.obstacles",
    "Obstacle": "taisoft.scene.obstacles",
    "Robot": "taisoft.scene.robot",
    "KeyFrames": "taisoft.scene.key_frames",
    "Camera": "taisoft.scene.look",
    "Light": "taisoft.scene.look",
    "read_scene": "taisoft.scene.toml",
    "write_scene": "taisoft.scene.toml_writer",
    "CollisionSettings": "taisoft.scene.collision",
    "Simulator": "taisoft.simulator",
    "Film": "taisoft.view.notebook",
    "StoredRun": "taisoft.view.states",
    "InteractiveView": "taisoft.view.interactive",
    "LiveWindow": "taisoft.view.window.window",
    "show": "taisoft.view.window.window",
    "solve_static": "taisoft.static",
    "modes": "taisoft.stability",
    "evaluate_law": "taisoft.fem.laws.evaluate",
    "register_law": "taisoft.fem.laws.registration",
    "check_law": "taisoft.fem.laws.checking",
    "Parameter": "taisoft.scene.law",
    "positive": "taisoft.scene.laws",
    "solve_contact_problem": "taisoft.contact.api",
    "run_many": "taisoft.many.runs",
    "Results": "taisoft.many.results",
    "Energies": "taisoft.records",
    "ErrorEstimate": "taisoft.records",
    "StepReport": "taisoft.records",
    "RunReport": "taisoft.records",
    "TaisoftError": "taisoft.errors",
    "MeshError": "taisoft.errors",
    "SceneError": "taisoft.errors",
    "OutputError": "taisoft.errors",
    "SimulationError": "taisoft.errors",
}

_SUBMODULES = ("gym",)  # whose names stay in them; not in __all__, since they need optional packages

__all__ = sorted(_MODULES) + ["__version__"]


def __getattr__(name: str):
    """Import a public name from its module at the first use (PEP 562)."""
    if name in _SUBMODULES:
        return import_module(f"taisoft.{name}")
    if name not in _MODULES:
        raise AttributeError(f"module 'taisoft' has no attribute {name!r}")
    value = getattr(import_module(_MODULES[name]), name)
    globals()[name] = value
    return value


def __dir__() -> list[str]:
    return list(__all__)  # public names only
