"""Frames of a run as data: `vtu/00000.vtu ...` with `scene.pvd` for ParaView, and `npz/00000.npz ...` with `npz/bodies.npz`.

Each file is complete or absent. `scene.pvd` lists the .vtu files with their times. It is replaced after each of them, so a killed
run leaves a list of complete files. A resumed run continues the list.
"""

import xml.etree.ElementTree as ET
from pathlib import Path

import numpy as np

from taisoft.errors import OutputError
from taisoft.files import replacing, write_bytes
from taisoft.output.files import BODIES_NAME, PVD_NAME, make_folder
from taisoft.output.vtu import ENDING, Grid, vtk_file
from taisoft.scene.rigid import RigidBody

VTU_NAME, NPZ_NAME = "vtu", "npz"  # folders


class VtuWriter:
    """Observer that writes folder/vtu/<index>.vtu, and folder/scene.pvd, which ParaView opens as a film.

    folder: the run's folder; scene: its meshes and names are read at construction; first: number of the first frame of a resumed
    run, whose list of earlier frames is continued; errors: whether the run estimates errors. Raises OutputError, also if that
    list cannot be read.
    """

    def __init__(self, folder: str | Path, scene, first: int = 0, errors: bool = False):
        self._folder, self._grid, self._errors = Path(folder), Grid(scene), errors
        self._times = _read_pvd(self._folder, first)
        make_folder(self._folder / VTU_NAME)

    def frame(self, sim, index: int) -> None:
        """Write sim's state as frame index. Raises OutputError."""
        write_bytes(self._folder / VTU_NAME / f"{index:05d}{ENDING}", self._grid.encoded(sim, self._errors))
        self._times[index] = sim.time
        _write_pvd(self._folder, self._times)

    def close(self) -> None:
        """Do nothing; part of the observer interface."""


def cut_pvd(folder: Path, first: int) -> None:
    """Take the frames from number `first` on out of folder/scene.pvd, if it exists. Raises OutputError if it cannot be read."""
    if (folder / PVD_NAME).exists():
        _write_pvd(folder, _read_pvd(folder, first))


def _read_pvd(folder: Path, first: int) -> dict[int, float]:
    """Return number -> time [s] of the frames before `first` in folder/scene.pvd whose files exist. Raises OutputError."""
    path = folder / PVD_NAME
    if first == 0 or not path.exists():
        return {}
    try:
        listed = [(Path(one.attrib["file"]), float(one.attrib["timestep"])) for one in ET.parse(path).iter("DataSet")]
        times = {int(file.stem): time for file, time in listed}
    except (OSError, ET.ParseError, KeyError, ValueError) as error:
        raise OutputError(f"{path} cannot be read, so its frames cannot be continued: {error}; remove it or its run") from None
    return {k: t for k, t in times.items() if k < first and (folder / VTU_NAME / f"{k:05d}{ENDING}").exists()}


def _write_pvd(folder: Path, times: dict[int, float]) -> None:
    """Write folder/scene.pvd, atomically. times: number -> time [s] of the frames. Raises OutputError."""
    sets = [f'<DataSet timestep="{time!r}" part="0" file="{VTU_NAME}/{k:05d}{ENDING}"/>' for k, time in times.items()]
    write_bytes(folder / PVD_NAME, vtk_file("Collection", sets))


class NpzWriter:
    """Observer that writes folder/npz/<index>.npz, and once folder/npz/bodies.npz. Float64, without pickled objects.

    A frame has positions (n,3) [m] and velocities (n,3) [m/s] of the nodes of all bodies in the order added, and time [s].
    bodies.npz has names (b,); first_node, first_tet and first_triangle (b+1,), where each body begins; rest_positions (n,3) [m],
    at the body's place; tets (m,4) and triangles (t,3) of the surfaces, node numbers over all bodies. A quadratic tet is cut into
    eight linear ones, and a rigid body has none. Raises OutputError.
    """

    def __init__(self, folder: str | Path, scene):
        self._folder, self._scene = Path(folder), scene
        make_folder(self._folder / NPZ_NAME)

    def frame(self, sim, index: int) -> None:
        """Write sim's state as frame index. Raises OutputError."""
        if self._scene is not None:
            _write_npz(self._folder / BODIES_NAME, body_arrays(self._scene))
            self._scene = None
        arrays = {"positions": sim.positions(), "velocities": sim.velocities(), "time": np.float64(sim.time)}
        _write_npz(self._folder / NPZ_NAME / f"{index:05d}.npz", arrays)

    def close(self) -> None:
        """Do nothing; part of the observer interface."""


def body_arrays(scene) -> dict[str, np.ndarray]:
    """Return the arrays of bodies.npz, see `NpzWriter`."""
    bodies = scene.bodies
    tets = [body.nodes.tets[: 0 if isinstance(body, RigidBody) else None] for body in bodies]
    first = {
        "first_node": np.cumsum([0] + [body.n_nodes for body in bodies]),
        "first_tet": np.cumsum([0] + [len(own) for own in tets]),
        "first_triangle": np.cumsum([0] + [len(body.nodes.surface) for body in bodies]),
    }
    of_bodies = list(zip(bodies, first["first_node"]))
    return first | {
        "names": np.array([body.name for body in bodies]),
        "rest_positions": np.concatenate([body.rest_positions + body.position for body in bodies]),
        "tets": np.concatenate([own + n for own, n in zip(tets, first["first_node"])]),
        "triangles": np.concatenate([body.nodes.surface + n for body, n in of_bodies]),
    }


def _write_npz(path: Path, arrays: dict[str, np.ndarray]) -> None:
    with replacing(path) as part, open(part, "wb") as file:
        np.savez(file, **arrays)
