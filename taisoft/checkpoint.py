"""Checkpoints: everything the next step depends on, in one `.npz` file that is complete or absent.

A file holds arrays without pickled objects, `header`, and `sha256` over all else. `header` is JSON text: versions, the
Simulator's settings, the numbers that may change at run time (present and initial values), all scalars of the state, and a
digest of each part of the scene. Each class saves its state between steps by `snapshot` and restores it by `restore`; an
array's name is its path in there, joined by slashes. Meshes, constraints, where loads act, and paths are not in the file:
they come from the scene passed at loading. Its digests must equal those of the saved scene, and its numbers those at the
start, since other numbers would be ignored. With the same machine and versions, a run continues bitwise as if it had not been
interrupted.
"""

import dataclasses
import json
import math
import zipfile
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

from taisoft import __version__
from taisoft.attributes import thawed
from taisoft.errors import SceneError, SimulationError
from taisoft.files import replacing
from taisoft.nested import join_arrays, part_arrays
from taisoft.scene.checks import instance
from taisoft.scene.fingerprint import FEATURES, digest, scene_fingerprint
from taisoft.scene.numbers import Numbers, first_difference, scene_numbers, set_numbers
from taisoft.scene.scene import Scene
from taisoft.settings import NAMES, Settings, plan_of

if TYPE_CHECKING:
    from taisoft.simulator import Simulator

KIND, FORMAT = "taisoft checkpoint", 28  # increment FORMAT with every change of a file's content
PARTS = ("settings", "numbers", "start", "fingerprint", "state", "notes")  # of the header, each a table


class _UnfitContent(Exception):
    """Says in words for users what is wrong with a file, which errors of NumPy and zipfile do not."""


@dataclasses.dataclass(frozen=True)
class Checkpoint:
    """Content of a checkpoint file.

    settings: arguments of Simulator; numbers: those of the scene, see `scene_numbers`; start: those at the start of the run;
    fingerprint: digests of the scene's parts by name; state: nested dict of numbers and arrays; notes: the writer's own plain
    data.
    """

    path: Path
    settings: dict
    numbers: Numbers
    start: Numbers
    fingerprint: dict[str, str]
    state: dict
    notes: dict


def write_checkpoint(
    path: str | Path,
    settings: dict,
    scene: Scene,
    features: dict[str, bool],
    state: dict,
    notes: dict,
    start: Scene | None = None,
) -> None:
    """Write the state of a simulation of a scene. Raises OutputError.

    features: of its plan; notes: see Checkpoint; start: the scene at the start of the run, if its numbers may have changed since.
    """
    arrays: dict[str, np.ndarray] = {}
    header = {
        "kind": KIND,
        "format": FORMAT,
        "taisoft": __version__,
        "settings": settings,
        "state": part_arrays(state, arrays),
        "numbers": part_arrays(scene_numbers(scene), arrays, "numbers"),
        "start": part_arrays(scene_numbers(start or scene), arrays, "start"),
        "fingerprint": scene_fingerprint(start or scene, features),
        "notes": notes,
    }
    text = np.frombuffer(json.dumps(header).encode(), dtype=np.uint8)
    with replacing(path) as part, open(part, "wb") as file:
        np.savez(file, header=text, sha256=_checksum(text, arrays), **arrays)


def read_checkpoint(path: str | Path) -> Checkpoint:
    """Return a file's content. Raises SimulationError if it is absent, damaged, no checkpoint, or of another format version."""
    header, arrays = _contents(Path(path))
    try:
        return Checkpoint(Path(path), **{name: join_arrays(header[name], arrays) for name in PARTS})
    except (KeyError, TypeError) as error:
        raise SimulationError(f"{path} is no checkpoint of taisoft, or damaged: {_sentence(error)}") from None


def check_scene(saved: Checkpoint, scene: Scene, features: dict[str, bool]) -> None:
    """Raise SceneError unless the scene is the one that the saved run started from. Paths that are functions are not compared."""
    fingerprint = scene_fingerprint(scene, features)
    for kinds in ("bodies", "obstacles"):
        if fingerprint[kinds] != saved.fingerprint.get(kinds):
            raise SceneError(
                f"{saved.path} is a checkpoint of another scene: its {kinds} are {saved.fingerprint.get(kinds)}, those here "
                f"{fingerprint[kinds]}"
            )
    differing = [name for name in fingerprint | saved.fingerprint if fingerprint.get(name) != saved.fingerprint.get(name)]
    if parts := [name for name in differing if name != FEATURES]:
        raise SceneError(f"{saved.path} is a checkpoint of another scene, which differs in {parts[0]}")
    found = first_difference(saved.start, scene_numbers(scene))
    if found:
        raise SceneError(
            f"{saved.path} is a checkpoint of another scene: {found}; pass the scene as it was at the start, since a resumed run "
            "keeps its own numbers, which the simulator's set_ methods change, or start a new run"
        )
    if differing:
        raise SceneError(f"{saved.path} is a checkpoint of another scene, which differs in {FEATURES}")


def restore_numbers(saved: Checkpoint, scene: Scene) -> None:
    """Set the numbers of a scene that differ from a checkpoint's. Raises SceneError for invalid numbers."""
    start, decided = scene_numbers(scene), [body.dilatation for body in scene.bodies]
    by_tet = [name for name, value in saved.numbers.items() if value is None and isinstance(start.get(name), np.ndarray)]
    with thawed(scene, *scene.bodies):
        set_numbers(scene, {name: float(start[name].mean()) for name in by_tet})  # no longer; those by region follow
        start = scene_numbers(scene)
        changed = {name: value for name, value in saved.numbers.items() if not np.array_equal(value, start.get(name))}
        set_numbers(scene, {name: value for name, value in changed.items() if value is not None})
        for body, dilatation in zip(scene.bodies, decided):
            if body.dilatation != dilatation:
                body.dilatation = dilatation
                body.warn_locking(stacklevel=2)


def _checksum(header: np.ndarray, arrays: dict[str, np.ndarray]) -> np.ndarray:
    """Return the checksum of a file's content, (32,) uint8."""
    text = digest([header, *(x for name in sorted(arrays) for x in (name, arrays[name]))])
    return np.frombuffer(bytes.fromhex(text), dtype=np.uint8)


def _check_sizes(path: Path) -> None:
    """Raise _UnfitContent if arrays claim more bytes than the file has. A damaged header could otherwise exhaust memory."""
    size = path.stat().st_size
    with zipfile.ZipFile(path) as archive:
        declared = sum(info.file_size for info in archive.infolist())  # np.savez does not compress
        if declared > size:
            raise _UnfitContent(f"{declared} bytes are declared, but the file has {size}")
        for info in archive.infolist():
            with archive.open(info) as member:
                version = np.lib.format.read_magic(member)
                read_header = np.lib.format.read_array_header_1_0 if version == (1, 0) else np.lib.format.read_array_header_2_0
                shape, _, dtype = read_header(member)
                if math.prod(shape) * dtype.itemsize > info.file_size:
                    raise _UnfitContent(f"an array of shape {shape} is declared, but it has {info.file_size} bytes")


def _contents(path: Path) -> tuple[dict, dict[str, np.ndarray]]:
    """Return a file's header and arrays, after checking them. Raises SimulationError."""
    fault = "is no checkpoint of taisoft, or damaged"
    try:
        file = np.load(path, allow_pickle=False)
        if not isinstance(file, np.lib.npyio.NpzFile):
            raise _UnfitContent("it holds one array")
        with file:
            _check_sizes(path)
            text = file["header"]
            header = json.loads(text.tobytes())
            if header["kind"] != KIND:
                raise _UnfitContent(f"its kind is {header['kind']!r}")
            if header["format"] != FORMAT:
                made = f"was written by taisoft {header['taisoft']} in format {header['format']}"
                raise SimulationError(f"{path} {made}, and taisoft {__version__} reads format {FORMAT}")
            if not all(isinstance(header.get(key), dict) for key in PARTS):
                raise _UnfitContent("its header has another structure")
            fault = "is damaged"
            arrays = {name: file[name] for name in file.files if name not in ("header", "sha256")}
            if not np.array_equal(file["sha256"], _checksum(text, arrays)):
                raise _UnfitContent("its checksum does not match its content")
    except SimulationError:
        raise
    except FileNotFoundError:
        raise SimulationError(f"{path}: no such checkpoint") from None
    except Exception as error:  # NumPy and zipfile raise many types for foreign or truncated files
        is_refusal = isinstance(error, OSError) and error.filename  # of the system
        raise SimulationError(f"{path} {fault}: {error.strerror if is_refusal else _sentence(error)}") from None
    return header, arrays


def _sentence(error: Exception) -> str:
    return str(error) if isinstance(error, _UnfitContent) else "expected arrays in a zip archive, as taisoft writes them"


# --- methods of Simulator -----------------------------------------------------------------------------------------------


def save_checkpoint(self: "Simulator", path: str | Path, notes: dict | None = None) -> None:
    """Write everything the next step depends on to a file, atomically; see `taisoft/checkpoint.py`.

    notes: plain data to store with it. Raises SimulationError while a body is dragged or if the state is not finite, and
    OutputError.
    """
    dynamics = self._open()
    if self.dragged is not None:
        raise SimulationError("a body is being dragged, which a checkpoint cannot hold: release it first")
    bad = dynamics.state.find_nonfinite()
    if bad is not None:
        raise SimulationError(f"no checkpoint is written of a state that is not finite: {bad}")
    settings, state = dataclasses.asdict(self.settings), dynamics.snapshot()
    write_checkpoint(path, settings, self.scene, self.plan.on, state, notes or {}, self._start_scene)


def load_checkpoint(cls: type["Simulator"], path: str | Path, scene: Scene, arch: str | None = None) -> "Simulator":
    """Return a simulator that continues from a checkpoint of the same scene, with its settings and numbers.

    scene: supplies what the file does not hold: meshes, constraints, where loads act, obstacles and paths. Only functions of
    time are not compared. Its numbers must be those at the start of the run; the run continues with those at the time of
    saving. The scene is frozen, as by a new Simulator. arch: replaces the checkpoint's; only its own arch continues bitwise.
    No other setting can be changed here; dt, gravity, materials, loads and contact pairs can be changed later, as in any
    simulator. Initial overlaps are not checked. Raises SimulationError for a file that cannot be used and SceneError for
    another scene, both naming the file.
    """
    return cls.from_checkpoint(read_checkpoint(path), scene, arch)


def from_checkpoint(cls: type["Simulator"], saved: Checkpoint, scene: Scene, arch: str | None = None) -> "Simulator":
    """Do as `load_checkpoint`, from a file's content."""
    instance(scene, "scene", Scene)
    settings = saved.settings | ({} if arch is None else {"arch": arch})
    if set(settings) != set(NAMES):
        raise SimulationError(f"{saved.path} holds no state of this scene: its settings are not those of this version")
    own = Settings(**settings)
    check_scene(saved, scene, plan_of(scene, own.integrator, own.self_collision, own.draggable, own.sleeps).on)
    present, sim = scene.snapshot(scene), None
    present.allow_initial_overlap = True  # bodies move to the saved positions below
    try:
        restore_numbers(saved, present)
        sim = cls(
            present, **settings | {"dt": saved.state["dt"]}
        )  # stable with these numbers, not always with those at the start
        with thawed(sim, sim.scene):
            sim.settings = dataclasses.replace(sim.settings, dt=settings["dt"])
            sim.scene.allow_initial_overlap = scene.allow_initial_overlap
        sim._dynamics.restore(saved.state)
    except BaseException as error:
        if sim is not None:
            sim.close()
        if isinstance(error, (KeyError, TypeError, ValueError)):  # the checksum is right, but the content does not fit this scene
            raise SimulationError(f"{saved.path} holds no state of this scene: its arrays have other names or sizes") from None
        raise
    scene.freeze()
    return sim
