"""OpenUSD export: `chunks/points_<first frame>.usdc` while a run lasts, `scene.usdc` when it ends.

Each chunk is a whole scene of its own (topology, materials, a few frames), published complete: a killed run leaves
files that open, and loses the frames of the chunk in the making at most. The same frames are appended to a temporary
`scene.usdc.*.part`, which becomes `scene.usdc` at the end, one file that needs no other; then the chunks go. Appending
costs what the new frames cost (the crate format writes new values behind the old ones), and saved frames leave memory;
it would ruin the file if the process died meanwhile, hence the separate chunks. Layers cannot share the work: USD takes
an attribute's time samples from the strongest layer alone, and value clips are unknown to many readers.
`join_chunks` makes a `scene.usdc` from the chunks of a run that was killed. A run that goes on begins with the frames before
its own, from both.

Time codes are frame numbers; metres, y up. A body is `/World/<name>` with `surface` (Mesh), `tets` (TetMesh, purpose
guide, so that the two are not drawn over each other) and `material`. Both are flat: a second-order body is written as
the linear triangles and tets that its elements are cut into, all its nodes as points (`taisoft/mesh/nodes.py`).
Both carry `primvars:vonMisesStress` [Pa], and where there can be contacts the surface `primvars:contactImpulse` [N s], what
the contacts of the last step before the frame gave each point; both are those of `nodal_fields.py`.
An obstacle is `/World/<name>` with `surface` and `material`; its points change over time where it follows a path. A half-space
whose square lies wholly within others is left out. `/View` holds a camera and lights (`usd_view.py`).
"""

import re
from contextlib import suppress
from pathlib import Path

import numpy as np

from taisoft.errors import OutputError
from taisoft.output.files import make_folder, part_path, publish, replacing, write_error
from taisoft.output.nodal_fields import NodalMean, contact_impulses, von_mises
from taisoft.output.usd_prims import IMPULSE, ROOT, STRESS, scene_layer
from taisoft.output.usd_view import PLACE

SCENE_NAME = "scene.usdc"
CHUNKS_NAME = "chunks"
CHANGING = {"points", "extent", f"primvars:{STRESS}", f"primvars:{IMPULSE}", PLACE}  # names of attributes


class UsdWriter:
    """Observer that writes the scene's bodies and obstacles over time to folder/scene.usdc.

    folder: the run's folder; scene: meshes and names of its bodies and obstacles are read now; fps: frames per second of
    simulated time [1/s]; chunk_frames: frames per chunk, at most so many are lost when the process is killed;
    self_collision: the simulator's, for whether there can be contacts; first: of a run that goes on, the number of its first
    frame: those before it are taken over from what the folder holds. Raises OutputError, also for an obstacle whose path
    fails, and where the folder holds another scene or frame rate.
    """

    def __init__(
        self, folder: str | Path, scene, fps: float = 60.0, chunk_frames: int = 10, self_collision: bool = False, first: int = 0
    ):  # fmt: skip
        if not fps > 0:
            raise OutputError(f"USD export: fps is {fps}, it must be positive")
        if chunk_frames < 1:
            raise OutputError(f"USD export: chunk_frames is {chunk_frames}, it must be at least 1")
        self.path = Path(folder) / SCENE_NAME
        self.chunks = make_folder(Path(folder) / CHUNKS_NAME)
        self.chunk_frames = chunk_frames
        self._touching = scene.pushes(self_collision)
        self._tracks, self._moving, self._view, self._template = scene_layer(scene, fps, self._touching)
        self._mean = NodalMean(scene.bodies)
        self._joined = _Joined(self.path, self._template)
        self._chunk = None
        self._frames: list[int] = []  # in the chunk
        try:
            self._take_over(first)
        except BaseException:
            self._joined.discard()
            raise

    def _take_over(self, first: int) -> None:
        """Frames before the first one, of an earlier run's scene and of its chunks, which know more."""
        old = [path for path in (self.path, *_chunk_paths(self.chunks)) if first > 0 and path.exists()]
        for path in old:
            layer = _opened(path)
            if layer.timeCodesPerSecond != self._template.timeCodesPerSecond or _shape(layer) != _shape(self._template):
                raise OutputError(f"{path} is of another scene or frame rate, so no run can go on in it: name another folder")
            self._joined.append(layer, first)
        times = self._joined.layer.ListTimeSamplesForPath(self._view.attribute)
        if times:
            self._view.go_on(np.array(self._joined.layer.QueryTimeSample(self._view.attribute, times[-1])))

    def frame(self, sim, index: int) -> None:
        """Record sim's state as frame index; index must ascend. Raises OutputError."""
        from pxr import Gf

        moved = [(track, surface.at(sim.time).astype(np.float32)) for track, surface in self._moving]  # may fail
        if self._chunk is None:
            self._chunk = _copy(self._template)
        x = sim.positions()
        points, fields = x.astype(np.float32), {STRESS: von_mises(self._mean(sim.stress())).astype(np.float32)}
        if self._touching:
            fields[IMPULSE] = contact_impulses(sim.contacts(), len(x)).astype(np.float32)
        samples = [(self._view.attribute, Gf.Vec3d(*self._view.place(x).tolist()))]
        for track in self._tracks:
            samples += track.samples(points, fields)
        for track, corners in moved:
            samples += track.samples(corners, {})
        for path, value in samples:
            self._chunk.SetTimeSample(path, float(index), value)
        self._frames.append(index)
        if len(self._frames) >= self.chunk_frames:
            self._publish_chunk()

    def close(self) -> None:
        """Complete scene.usdc and remove the chunks; without a frame no file is made. Raises OutputError.

        After a failed write there is nothing to complete: the chunks stay as they are.
        """
        self.flush()
        if self._joined is not None:
            joined, self._joined = self._joined, None
            joined.publish()
            _remove_chunks(self.chunks)

    def flush(self) -> None:
        """Publish the chunk in the making, so that no frame before a checkpoint can be lost. Raises OutputError."""
        if self._frames:
            self._publish_chunk()

    def _publish_chunk(self) -> None:
        chunk, frames = self._chunk, self._frames
        self._chunk, self._frames = None, []
        if self._joined is None:
            raise OutputError(f"cannot go on writing {self.path}: an earlier write failed")
        try:
            _set_range(chunk, frames[0], frames[-1])
            _export(chunk, self.chunks / f"points_{frames[0]:05d}.usdc")
            self._joined.append(chunk)
        except Exception:
            self._joined.discard()
            self._joined = None
            raise


def join_chunks(folder: str | Path) -> Path:
    """Make folder/scene.usdc from the chunks that a killed run left, then remove the chunks; returns the path.

    Raises OutputError where there is no chunk, one cannot be read, or the scene cannot be written.
    """
    target, chunks = Path(folder) / SCENE_NAME, Path(folder) / CHUNKS_NAME
    paths = _chunk_paths(chunks)
    if not paths:
        raise OutputError(f"{chunks} holds no chunk of a USD export")
    joined = None
    for path in paths:
        chunk = _opened(path)
        joined = joined or _Joined(target, _without_samples(chunk))
        joined.append(chunk)
    joined.publish()
    _remove_chunks(chunks)
    return target


class _Joined:
    """The one-file scene in the making, under a temporary name until `publish`."""

    def __init__(self, path: Path, template):
        from pxr import Sdf

        self.path, self.part = path, part_path(path)
        self.first: float | None = None
        self.layer = Sdf.Layer.New(Sdf.FileFormat.FindById("usdc"), str(self.part))
        self.layer.TransferContent(template)

    def append(self, chunk, end: int | None = None) -> None:
        """Add the chunk's frames, those before `end`, and save, which frees their memory. Raises OutputError."""
        last = chunk.endTimeCode if end is None else min(chunk.endTimeCode, end - 1)
        if last < chunk.startTimeCode:
            return
        for path in _sampled(chunk):
            for time in chunk.ListTimeSamplesForPath(path):
                if time <= last:
                    self.layer.SetTimeSample(path, time, chunk.QueryTimeSample(path, time))
        self.first = chunk.startTimeCode if self.first is None else self.first
        _set_range(self.layer, self.first, max(last, self.layer.endTimeCode))
        try:
            _written(self.path, chunk, self.layer.Save)
        except OutputError:
            self.discard()
            raise

    def publish(self) -> None:
        """Give the file its final name; without frames drop it. Raises OutputError."""
        if self.first is None:
            self.discard()
            return
        self.layer = None
        try:
            publish(self.part, self.path)
        except OSError as error:
            self.discard()
            raise write_error(self.path, error) from error

    def discard(self) -> None:
        """Drop the layer and its temporary file."""
        self.layer = None
        with suppress(OSError):  # unreachable when the folder is
            self.part.unlink()


def _copy(layer):
    from pxr import Sdf

    copy = Sdf.Layer.CreateAnonymous(".usdc")
    copy.TransferContent(layer)
    return copy


def _without_samples(layer):
    """A copy of a chunk with its frames taken out: what the joined scene starts from."""
    copy = _copy(layer)
    for path in _sampled(copy):
        for time in copy.ListTimeSamplesForPath(path):
            copy.EraseTimeSample(path, time)
    return copy


def _sampled(layer) -> list:
    """Paths of the attributes that change over time in a layer of this module, or would if it had frames."""
    from pxr import Sdf

    found = []
    layer.Traverse(Sdf.Path.absoluteRootPath, lambda path: found.append(path) if path.name in CHANGING else None)
    return [path for path in found if path.IsPropertyPath()]


def _chunk_paths(chunks: Path) -> list[Path]:
    return sorted(chunks.glob("points_*.usdc"), key=lambda p: int(p.stem.removeprefix("points_")))


def _opened(path: Path):
    """The layer of a file, apart from it. Raises OutputError."""
    from pxr import Sdf

    try:
        return Sdf.Layer.OpenAsAnonymous(str(path))
    except Exception as error:
        raise OutputError(f"{path} cannot be read: {_last_line(error)}") from None


def _shape(layer) -> list[str]:
    """Names of what a layer holds, and the attributes that change in it."""
    root = layer.GetPrimAtPath(ROOT)
    return [*(child.name for child in root.nameChildren), *_sampled(layer)] if root else []


def _set_range(layer, first: float, last: float) -> None:
    layer.startTimeCode, layer.endTimeCode = float(first), float(last)


def _export(layer, path: Path) -> None:
    """Write a layer under a temporary name, then publish it. Raises OutputError."""
    with replacing(path) as part:
        _written(path, layer, lambda: layer.Export(str(part), args={"format": "usdc"}))


def _written(path: Path, layer, write) -> None:
    """Run write(), and turn USD's failure, an exception or False, into an OutputError with the size of the frames."""
    try:
        if write():
            return
        reason = "USD does not say why"
    except Exception as error:
        reason = _last_line(error)
    n_bytes = sum(
        np.asarray(layer.QueryTimeSample(p, t)).nbytes for p in _sampled(layer) for t in layer.ListTimeSamplesForPath(p)
    )
    raise OutputError(f"cannot write {path} ({n_bytes} bytes of new frames): {reason}")


def _remove_chunks(chunks: Path) -> None:
    try:
        for path in chunks.glob("points_*.usdc"):
            path.unlink()
        if not any(chunks.iterdir()):
            chunks.rmdir()
    except OSError as error:
        raise OutputError(f"cannot remove the chunks in {chunks}: {error.strerror or error}") from error


def _last_line(error: Exception) -> str:
    """The gist of a USD error, whose text is a list of source locations, each with what went wrong there in quotes."""
    lines = [line.strip() for line in str(error).splitlines() if line.strip()]
    return re.sub(r"^Error in '.*' at line \d+ in file \S+ : '(.*)'$", r"\1", lines[-1]) if lines else type(error).__name__
