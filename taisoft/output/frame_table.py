"""`frames.csv`, a row per frame: tensions of springs and tendons [N], volumes [m^3] and pressures [Pa] of cavities, and poses of
rigid bodies: the centre of mass [m] and the rotation from the mesh's axes as a unit quaternion with w >= 0.
"""

from pathlib import Path

from scipy.spatial.transform import Rotation

from taisoft.files import write_bytes
from taisoft.output.folder import Observer
from taisoft.output.tables import csv_text, read_table

TABLE_NAME = "frames.csv"
POSE = (*((axis, " [m]") for axis in "xyz"), *((f"q{part}", "") for part in "wxyz"))  # columns and units


class FrameTable(Observer):
    """Observer that writes folder/frames.csv, whole at each `flush` and at the end.

    folder: the run's folder; scene: one that `needed` is true of; first: number of the first frame of a resumed run, before
    which rows of the folder's table are kept. Raises OutputError.
    """

    def __init__(self, folder: str | Path, scene, first: int = 0):
        self.path = Path(folder) / TABLE_NAME
        tensions = [f"tension of {one.name} [N]" for one in (*scene.springs, *scene.tendons)]
        self._cavities = [cavity.name for body in scene.bodies for cavity in body.cavities]
        of_cavities = [text for name in self._cavities for text in (f"volume of {name} [m^3]", f"pressure of {name} [Pa]")]
        self._rigid_bodies = list(scene.rigid_bodies)
        poses = [f"{column} of {body.name}{unit}" for body in self._rigid_bodies for column, unit in POSE]
        self._header = ["frame", "time", *tensions, *of_cavities, *poses]
        header, rows = read_table(self.path, lambda row: int(row[0]) < first)
        self._rows = rows if first and header == self._header else []

    @staticmethod
    def needed(scene) -> bool:
        """Whether a scene has what the table holds."""
        return bool(scene.springs or scene.tendons or scene.rigid_bodies or any(body.cavities for body in scene.bodies))

    def frame(self, sim, index: int) -> None:
        """Add sim's present state as frame `index`."""
        values = list(sim.tensions().values())
        for name in self._cavities:
            values += [sim.cavity_volume(name), sim.cavity_pressure(name)]
        for body in self._rigid_bodies:
            translation, rotation = sim.pose(body.name)
            x, y, z, w = Rotation.from_matrix(rotation).as_quat(canonical=True).tolist()
            values += [*(body.centre + body.position + translation).tolist(), w, x, y, z]
        self._rows.append([index, sim.time, *values])

    def flush(self) -> None:
        """Write the rows so far. Raises OutputError."""
        write_bytes(self.path, csv_text([self._header, *self._rows]).encode())
