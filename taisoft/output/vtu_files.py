"""Frames of a run as data: `vtu/00000.vtu ...` with `scene.pvd` for ParaView.

Each file is complete or absent. `scene.pvd` lists the .vtu files with their times. It is replaced after each of them, so a killed
run leaves a list of complete files. A resumed run continues the list.
"""

import xml.etree.ElementTree as ET
from pathlib import Path

from taisoft.errors import OutputError
from taisoft.files import write_bytes
from taisoft.output.folder import PVD_NAME, Observer, make_folder
from taisoft.output.vtu import ENDING, Grid, vtk_file

VTU_NAME = "vtu"  # folder


class VtuWriter(Observer):
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
