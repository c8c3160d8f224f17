"""OpenUSD export: `chunks/points_<first frame>.usdc` while a run lasts, `scene.usdc` when it ends.

Each chunk is a complete scene (topology, materials, a few frames), published whole. So a killed run leaves readable files, and
loses at most the frames of the unfinished chunk. At the end they are joined to the self-contained `scene.usdc` and removed. They
are appended to a temporary file one by one, which frees their memory. Composing the chunks as layers does not work: USD takes an
attribute's time samples from the strongest layer alone, and many readers do not support value clips. A resumed run also joins
the earlier frames of `scene.usdc` and of the chunks that a killed run left.

Time codes are frame numbers; a state before the time of its frame, as at the end of a run between two frames, has the fraction
that is its time. Units are metres, up is the scene's. A body is `/World/<name>` with `surface` (Mesh), `tets` (TetMesh, purpose
guide, so that the two are not drawn over each other) and `material`. Both are linear: a second-order body is written as
the linear triangles and tets that its elements are cut into, with all its nodes as points (`taisoft/mesh/nodes.py`).
Both carry `primvars:vonMisesStress` [Pa]. If there can be contacts, the surface also carries `primvars:contactImpulse` [N s], the
impulse of the last step before the frame on each point. `nodal_fields.py` defines both. A run with error=True adds
`primvars:estimatedError` [m], `Simulator.nodal_errors`, -1 where unknown.
Surfaces have normals and velocities (`usd_surface.py`). An obstacle is `/World/<name>` with `surface` and `material`; its points
change over time if it follows a path. A half-space whose square lies entirely within others is left out. A spring or a tendon is
`/World/<name>`, see `usd_curves.py`. `/View` holds a camera and lights (`usd_scene.py`).
"""

import math
from pathlib import Path

import numpy as np

from taisoft.dynamics.readout import nodal_impulses
from taisoft.errors import OutputError
from taisoft.files import replacing
from taisoft.mesh.usd_content import usd_message
from taisoft.output.folder import Observer, make_folder, output_errors
from taisoft.output.nodal_fields import UNKNOWN_ERROR, NodalValues
from taisoft.output.usd_curves import TENSION
from taisoft.output.usd_scene import OF_CAMERA, scene_layer
from taisoft.output.usd_surface import ERROR, IMPULSE, NORMALS, ROOT, STRESS, VELOCITIES
from taisoft.scene import checks

SCENE_NAME = "scene.usdc"
CHUNKS_NAME = "chunks"
SAME_FRAME = 1e-8  # relative error of a frame's time, from the rounding of dt and of its sum, that its time code does not show
INSTANT = 0.01  # of a frame: the time over which the velocity of an obstacle on a path is a difference
TIME_VARYING = {"points", "extent", VELOCITIES, NORMALS, STRESS, IMPULSE, ERROR, f"primvars:{TENSION}", *OF_CAMERA}  # attributes


class UsdWriter(Observer):
    """Observer that writes the scene's bodies, obstacles, springs and tendons over time to folder/scene.usdc.

    folder: the run's folder; scene: its meshes and names are read at construction; fps: frames per second of simulated time
    [1/s]; chunk_frames: frames per chunk, the most that are lost if the process is killed; self_collision: the simulator's
    setting, which decides with the scene whether there can be contacts; first: number of the first frame of a resumed run;
    earlier frames are copied from the folder; errors: whether the run estimates errors; values: of its nodes, which writers may
    share. Raises OutputError, also if an obstacle's path fails or the folder holds another scene or frame rate.
    """

    def __init__(
        self,
        folder: str | Path,
        scene,
        fps: float = 60.0,
        chunk_frames: int = 10,
        self_collision: bool = False,
        first: int = 0,
        errors: bool = False,
        values: NodalValues | None = None,
    ):
        checks.number(fps, "USD export: fps", above=0.0, error=OutputError)
        checks.whole(chunk_frames, "USD export: chunk_frames", error=OutputError)
        self.path = Path(folder) / SCENE_NAME
        self.chunks = make_folder(Path(folder) / CHUNKS_NAME)
        self.chunk_frames = chunk_frames
        self._touching, self._errors = scene.pushes(self_collision), errors
        self._tracks, self._obstacles, self._curves, self._view, self._template = scene_layer(scene, fps, self._touching, errors)
        self._values = values or NodalValues(scene.bodies)
        self._chunk, self._moved = None, set()  # tracks of the obstacles that have moved
        self._codes: list[float] = []  # time codes in the unfinished chunk
        self._fps, self._start, self._latest = fps, 0.0, float(first - 1)  # start: time of frame 0 [s]; latest: time code
        self._is_open, self._kept = True, first - 1  # kept: the last frame of earlier files that stays
        self._earlier: list[Path] = []  # these files, of which later ones override earlier ones
        self._written: list[Path] = []  # chunks
        self._take_over([path for path in (self.path, *_chunk_paths(self.chunks)) if first > 0 and path.exists()])

    def _take_over(self, old: list[Path]) -> None:
        """Check the files of an earlier run, and take over what later frames depend on."""
        transform = None
        for path in old:
            layer = _opened(path)
            if layer.timeCodesPerSecond != self._template.timeCodesPerSecond or _structure(layer) != _structure(self._template):
                raise OutputError(
                    f"{path} is of another scene, up axis, frame rate or --error, so no run can resume in it: name another folder"
                )
            if layer.startTimeCode > self._kept:
                continue
            self._earlier.append(path)
            times = {track: layer.ListTimeSamplesForPath(track.points) for track, _ in self._obstacles}
            self._moved |= {track for track, codes in times.items() if codes and codes[0] <= self._kept}
            if codes := [code for code in layer.ListTimeSamplesForPath(self._view.transform) if code <= self._kept]:
                transform = layer.QueryTimeSample(self._view.transform, codes[-1])
        if transform is not None:
            self._view.resume(np.array(transform))

    def frame(self, sim, index: int) -> None:
        """Record sim's state as frame index, which must ascend; the first, if not 0, counts from time 0. Raises OutputError."""
        from pxr import Sdf

        moving = [one for one in self._obstacles if one[1].obstacle.path is not None or one[0] in self._moved]
        moved = [(track, surface.at(sim.time), self._velocities(surface, sim.time)) for track, surface in moving]  # it may raise
        x = sim.positions()
        curves = [] if self._curves is None else self._curves.samples(sim, x)
        if self._chunk is None:
            self._chunk = Sdf.Layer.CreateAnonymous(".usdc")
            self._chunk.TransferContent(self._template)
        fields = {STRESS: np.nan_to_num(self._values("stress", sim)), VELOCITIES: sim.velocities()}
        if self._touching:
            fields[IMPULSE] = nodal_impulses(sim.contacts(), len(x))
        if self._errors:
            fields[ERROR] = np.nan_to_num(sim.nodal_errors(), nan=UNKNOWN_ERROR)
        samples = self._view.samples(sim.time, x)
        for track in self._tracks:
            samples += track.samples(x, fields)
        for track, corners, velocities in moved:
            samples += track.samples(corners, {VELOCITIES: velocities})
        samples += curves
        for track, surface in moving:
            if track not in self._moved and self._latest >= 0.0:  # commanded since the frame before, where it was at rest
                for path, value in track.samples(surface.vertices, {VELOCITIES: np.zeros_like(surface.vertices)}):
                    self._chunk.SetTimeSample(path, self._latest, value)
            self._moved.add(track)
        if index == 0:
            self._start = sim.time
        code = (sim.time - self._start) * self._fps
        self._latest = code if self._latest < code < index - SAME_FRAME * (1 + index) else float(index)
        for path, value in samples:
            self._chunk.SetTimeSample(path, self._latest, value)
        self._codes.append(self._latest)
        if len(self._codes) >= self.chunk_frames:
            self._publish_chunk()

    def _velocities(self, surface, t: float) -> np.ndarray:
        """Return the velocities (n,3) [m/s] of an obstacle's vertices at time t [s], just before it; at 0 just after it."""
        h = INSTANT / self._fps
        return (surface.at(max(t, h)) - surface.at(max(t - h, 0.0))) / h

    def close(self) -> None:
        """Complete scene.usdc and remove the chunks; without a frame no file is written. Raises OutputError.

        After a failed write nothing is completed, and the chunks stay.
        """
        self.flush()
        if self._is_open:
            self._is_open = False
            self._join()
            _remove_chunks(self.chunks)

    def flush(self) -> None:
        """Publish the unfinished chunk, so that no frame before a checkpoint can be lost. Raises OutputError."""
        if self._codes:
            self._publish_chunk()

    def _publish_chunk(self) -> None:
        chunk, codes = self._chunk, self._codes
        self._chunk, self._codes = None, []
        if not self._is_open:
            raise OutputError(f"cannot continue writing {self.path}: an earlier write failed")
        self._is_open = False  # unless this succeeds
        chunk.startTimeCode, chunk.endTimeCode = codes[0], codes[-1]
        path = self.chunks / f"points_{math.ceil(codes[0]):05d}.usdc"
        with replacing(path) as part:
            _write_checked(path, chunk, lambda: chunk.Export(str(part), args={"format": "usdc"}))
        self._written.append(path)
        self._is_open = True

    def _join(self) -> None:
        """Write the earlier frames that stay, and those of the chunks, to scene.usdc. Raises OutputError."""
        from pxr import Sdf

        paths = [*(path for path in self._earlier if path.exists()), *self._written]
        if not paths:
            return
        with replacing(self.path) as part:
            layer = Sdf.Layer.New(Sdf.FileFormat.FindById("usdc"), str(part))
            layer.TransferContent(self._template)
            for k, path in enumerate(paths):
                chunk = _opened(path)
                last = chunk.endTimeCode if path in self._written else min(chunk.endTimeCode, self._kept)
                for attribute, code in _samples(chunk):
                    if code <= last:
                        layer.SetTimeSample(attribute, code, chunk.QueryTimeSample(attribute, code))
                layer.startTimeCode = layer.startTimeCode if k else chunk.startTimeCode
                layer.endTimeCode = max(last, layer.endTimeCode)
                _write_checked(self.path, chunk, layer.Save)  # which frees the memory of its frames
            del layer


def _sampled(layer) -> list:
    """Return the paths of the time-varying attributes of a layer of this module, whether or not it has frames."""
    from pxr import Sdf

    found = []
    layer.Traverse(Sdf.Path.absoluteRootPath, lambda path: found.append(path) if path.name in TIME_VARYING else None)
    return [path for path in found if path.IsPropertyPath()]


def _samples(layer) -> list[tuple]:
    """Return the path and time of every time sample of a layer of this module."""
    return [(path, time) for path in _sampled(layer) for time in layer.ListTimeSamplesForPath(path)]


def _chunk_paths(chunks: Path) -> list[Path]:
    return sorted(chunks.glob("points_*.usdc"), key=lambda p: int(p.stem.removeprefix("points_")))


def _opened(path: Path):
    """Return the layer of a file as an anonymous copy. Raises OutputError."""
    from pxr import Sdf

    try:
        return Sdf.Layer.OpenAsAnonymous(str(path))
    except Exception as error:
        raise OutputError(f"{path} cannot be read: {usd_message(error)}") from None


def _structure(layer) -> list[str]:
    """Return a layer's up axis, the names of its bodies and obstacles, and the paths of its time-varying attributes."""
    root = layer.GetPrimAtPath(ROOT)
    return [layer.pseudoRoot.GetInfo("upAxis"), *(child.name for child in root.nameChildren), *_sampled(layer)] if root else []


def _write_checked(path: Path, layer, write) -> None:
    """Call write(), and turn a failure of USD, an exception or False, into an OutputError with the size of the frames."""
    try:
        if write():
            return
        reason = "USD gives no reason"
    except Exception as error:
        reason = usd_message(error)
    n_bytes = sum(np.asarray(layer.QueryTimeSample(*sample)).nbytes for sample in _samples(layer))
    raise OutputError(f"cannot write {path} ({n_bytes} bytes of new frames): {reason}")


def _remove_chunks(chunks: Path) -> None:
    with output_errors(f"cannot remove the chunks in {chunks}"):
        for path in chunks.glob("points_*.usdc"):
            path.unlink()
        if not any(chunks.iterdir()):
            chunks.rmdir()
