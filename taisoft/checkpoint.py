"""Checkpoints: all that the next step rests on, in one `.npz` file that is whole or absent.

A file holds arrays without pickled objects; `header`, a JSON text: versions, the Simulator's settings, numbers that may change
while it runs, as they are and as they were at the start, every number of the state that is no array, and a digest of each part
of the scene; and `sha256` over all else. What lives between steps each class tells by `snapshot` and takes back by `restore`;
here it is only flattened, its names joined by slashes. Meshes, constraints, where loads act, and paths are not in the file: they
come from the scene that is given, whose digests must be those of the scene that was saved, and its numbers those of the start,
since others would be ignored. On the machine, with the versions and the number of threads that wrote it, a run goes on bitwise
as if it had not been interrupted.
"""

import dataclasses
import hashlib
import json
import math
import zipfile
from collections.abc import Callable
from pathlib import Path

import numpy as np

from taisoft import __version__
from taisoft.attributes import thawed
from taisoft.errors import SceneError, SimulationError
from taisoft.files import replacing
from taisoft.scene.body import Body
from taisoft.scene.changes import LOADS, change_load
from taisoft.scene.key_frames import NodePath, ShapePath
from taisoft.scene.numbers import Numbers, first_difference, scene_numbers
from taisoft.scene.scene import Material, Scene

KIND, FORMAT = "taisoft checkpoint", 6  # FORMAT grows with every change of what a file holds
PARTS = ("settings", "numbers", "start", "fingerprint", "state", "notes")  # of the header, each a table
FEATURES = "the features that it needs"  # the last mark: of the plan, which follows from parts and numbers


@dataclasses.dataclass(frozen=True)
class Checkpoint:
    """A file's content. settings: arguments of Simulator; numbers: of the scene, that may change while it runs; start: those, and
    values of loads, of the scene that the run began with; marks: digests of the scene's parts by name; state: nested dict of
    numbers and arrays; notes: plain data of whoever wrote it."""

    path: Path
    settings: dict
    numbers: dict
    start: Numbers
    fingerprint: dict[str, str]
    state: dict
    notes: dict


def write_checkpoint(
    path: str | Path, settings: dict, scene: Scene, features: dict[str, bool], state: dict, notes: dict,
    start: Scene | None = None,
) -> None:  # fmt: skip
    """Write the state of a simulation of a scene. features: of its plan; notes: see Checkpoint; start: the scene as the run began
    with it, where its numbers may have changed since. Raises OutputError."""
    plain, arrays = _flat(state)
    header = {
        "kind": KIND, "format": FORMAT, "taisoft": __version__, "settings": settings, "numbers": _numbers(scene),
        "start": scene_numbers(start or scene), "fingerprint": scene_fingerprint(scene, features), "state": plain, "notes": notes,
    }  # fmt: skip
    text = np.frombuffer(json.dumps(header).encode(), dtype=np.uint8)
    with replacing(path) as part, open(part, "wb") as file:
        np.savez(file, header=text, sha256=_checksum(text, arrays), **arrays)


def read_checkpoint(path: str | Path) -> Checkpoint:
    """The content of a file. Raises SimulationError for one that is absent, damaged, foreign, or newer than this version."""
    header, arrays = _contents(Path(path))
    state: dict = {}
    for name, value in [*header["state"].items(), *arrays.items()]:
        *folders, last = name.split("/")
        place = state
        for folder in folders:
            place = place.setdefault(folder, {})
        place[last] = value
    return Checkpoint(Path(path), state=state, **{name: header[name] for name in PARTS if name != "state"})


def check_scene(saved: Checkpoint, scene: Scene, features: dict[str, bool]) -> None:
    """Raises SceneError unless the scene is the one that the saved run began with, but for paths."""
    fingerprint = scene_fingerprint(scene, features)
    for kinds in ("bodies", "obstacles"):
        if fingerprint[kinds] != saved.fingerprint.get(kinds):
            raise SceneError(
                f"{saved.path} is a checkpoint of another scene: its {kinds} are {saved.fingerprint.get(kinds)}, those here "
                f"{fingerprint[kinds]}"
            )
    differing = [name for name in fingerprint | saved.fingerprint if fingerprint.get(name) != saved.fingerprint.get(name)]
    if differing and differing[0] != FEATURES:
        raise SceneError(f"{saved.path} is a checkpoint of another scene, which differs in {differing[0]}")
    found = first_difference(saved.start, scene_numbers(scene))
    if found:
        raise SceneError(
            f"{saved.path} is a checkpoint of another scene: {found}; give the scene as it was, since a run goes on with its own "
            "numbers, which the simulator's set_ methods change, or begin a new run"
        )
    if differing:
        raise SceneError(f"{saved.path} is a checkpoint of another scene, which differs in {FEATURES}")


def take_numbers(saved: Checkpoint, scene: Scene) -> None:
    """Give a scene the gravity, materials, pairs and loads of a checkpoint. Raises SceneError for numbers outside the rules."""
    with thawed(scene, *scene.bodies):
        scene.gravity = saved.numbers["gravity"]
        for body, material in zip(scene.bodies, saved.numbers["materials"]):
            body.material = Material(**material)
        scene.contact_pairs = {frozenset(names): (a, b) for names, a, b in saved.numbers["pairs"]}
        for k, body in enumerate(scene.bodies):
            for kind, name in LOADS.items():
                for i in range(len(getattr(body, name))):
                    change_load(body, kind, i, saved.state["loads"][str(k)][kind][str(i)])


def load_values(scene: Scene) -> dict:
    """Values of all loads of a scene, which may change while it runs, as part of a checkpoint's state."""
    return {
        str(k): {kind: {str(i): load.value for i, load in enumerate(getattr(body, name))} for kind, name in LOADS.items()}
        for k, body in enumerate(scene.bodies)
    }


def scene_fingerprint(scene: Scene, features: dict[str, bool]) -> dict[str, str]:
    """A digest of each part of a scene that must be the same where a run goes on, by what to call it."""
    fingerprint = {  # in the order added, which numbers nodes
        "bodies": json.dumps([body.name for body in scene.bodies]), "obstacles": json.dumps([o.name for o in scene.obstacles]),
    }  # fmt: skip
    for body in scene.bodies:
        what = f"body '{body.name}'"
        for part, values in _body_parts(body).items():
            fingerprint[f"{what}: {part}"] = _digest(values)
    for one in scene.obstacles:
        what, shape = f"obstacle '{one.name}'", one.shape
        own = [getattr(shape, field.name) for field in dataclasses.fields(shape)]
        fingerprint[f"{what}: shape, friction, restitution or path"] = _digest(
            [type(shape).__name__, *own, one.friction, one.restitution, *_path_parts(one.path)]
        )
    fingerprint["collision settings"] = _digest([json.dumps(dataclasses.asdict(scene.collision)), scene.contact_forces])
    # damping that was 0 at the start is compiled out, and so on
    fingerprint[FEATURES] = _digest([json.dumps(features)])
    return fingerprint


def scene_digest(scene: Scene) -> str:
    """A digest of all that can be compared of a scene: its parts as a checkpoint compares them, and its numbers."""
    loads = [load.value for body in scene.bodies for name in LOADS.values() for load in getattr(body, name)]
    return _digest([json.dumps(scene_fingerprint(scene, {})), json.dumps(_numbers(scene)), scene.allow_initial_overlap, *loads])


def _body_parts(body: Body) -> dict[str, list]:
    """What makes a body, by what to call it."""
    return {
        "mesh": [body.mesh.vertices, body.mesh.tets],
        "order, quadrature, law or collision": [body.order, body.quadrature_degree, body.material.law, body.collision],
        "start": [body.position, body.velocity],
        "constraints": [x for c in body.constraints for x in (c.nodes, c.axes, *_path_parts(c.path))],
        "loads": [
            *(x for t in body.tractions for x in ("traction", t.triangles)),
            *(x for f in body.forces for x in ("force", f.nodes)),
        ],
    }


def _path_parts(path: Callable | None) -> list:
    """What can be compared of a path: key frames are data, of other functions only that there is one."""
    if not isinstance(path, (NodePath, ShapePath)):
        return [path is None]
    frames = path.frames
    own = [frames.times, frames.translations, frames.rotations, frames.pivot, frames.smooth, frames.release]
    return [*own, path.starts if isinstance(path, NodePath) else path.center]


def _numbers(scene: Scene) -> dict:
    """Of a scene, what may change while it runs, but for its loads."""
    pairs = [[sorted(names), *numbers] for names, numbers in scene.contact_pairs.items()]
    materials = [dataclasses.asdict(body.material) for body in scene.bodies]
    return {"gravity": scene.gravity.tolist(), "materials": materials, "pairs": pairs}


def _digest(values: list) -> str:
    """Of arrays and plain values."""
    total = hashlib.sha256()
    for value in values:
        if isinstance(value, np.ndarray):
            total.update(f"{value.dtype.str} {value.shape} ".encode())
            total.update(np.ascontiguousarray(value))
        else:
            total.update(json.dumps(value).encode())
    return total.hexdigest()


def _flat(state: dict, prefix: str = "") -> tuple[dict, dict[str, np.ndarray]]:
    """Numbers, lists and None, and arrays, each by its names joined by slashes."""
    plain, arrays = {}, {}
    for name, value in state.items():
        if isinstance(value, dict):
            inner = _flat(value, f"{prefix}{name}/")
            plain |= inner[0]
            arrays |= inner[1]
        elif isinstance(value, np.ndarray):
            arrays[f"{prefix}{name}"] = value
        else:
            plain[f"{prefix}{name}"] = value
    return plain, arrays


def _checksum(header: np.ndarray, arrays: dict[str, np.ndarray]) -> np.ndarray:
    """(32,) uint8."""
    text = _digest([header, *(x for name in sorted(arrays) for x in (name, arrays[name]))])
    return np.frombuffer(bytes.fromhex(text), dtype=np.uint8)


def _check_sizes(path: Path) -> None:
    """Raises ValueError where arrays would take more room than the file has: a head may announce anything."""
    size = path.stat().st_size
    with zipfile.ZipFile(path) as archive:
        whole = sum(info.file_size for info in archive.infolist())  # nothing is packed
        if whole > size:
            raise ValueError(f"{whole} bytes are announced, but the file has {size}")
        for info in archive.infolist():
            with archive.open(info) as member:
                version = np.lib.format.read_magic(member)
                read_head = np.lib.format.read_array_header_1_0 if version == (1, 0) else np.lib.format.read_array_header_2_0
                shape, _, dtype = read_head(member)
                if math.prod(shape) * dtype.itemsize > info.file_size:
                    raise ValueError(f"an array of shape {shape} is announced, but it has {info.file_size} bytes")


def _contents(path: Path) -> tuple[dict, dict[str, np.ndarray]]:
    """Header and arrays, checked."""
    try:
        file = np.load(path, allow_pickle=False)
    except FileNotFoundError:
        raise SimulationError(f"{path}: no such checkpoint") from None
    except Exception as error:  # whatever a file of another kind, or a part of one, makes NumPy and zipfile raise
        raise _no_checkpoint(path, error) from None
    if not isinstance(file, np.lib.npyio.NpzFile):
        raise _no_checkpoint(path, "it holds one array")
    with file:
        try:
            _check_sizes(path)
        except Exception as error:
            raise _no_checkpoint(path, error) from None
        try:
            text = file["header"]
            header = json.loads(text.tobytes())
            kind, version = header["kind"], int(header["format"])
            writer = str(header["taisoft"])
            fits = all(isinstance(header.get(key), dict) for key in PARTS)
        except Exception as error:
            raise _no_checkpoint(path, error) from None
        if kind != KIND:
            raise _no_checkpoint(path, f"it is a {kind}")
        if version != FORMAT:
            raise SimulationError(
                f"{path} was written by taisoft {writer} in format {version}, and taisoft {__version__} reads format {FORMAT}"
            )
        if not fits:
            raise _no_checkpoint(path, "its header is of another form")
        try:
            arrays = {name: file[name] for name in file.files if name not in ("header", "sha256")}
            whole = np.array_equal(file["sha256"], _checksum(text, arrays))
        except Exception as error:
            raise _damaged(path, error) from None
    if not whole:
        raise _damaged(path, "its checksum is not that of its content")
    return header, arrays


def _no_checkpoint(path: Path, why) -> SimulationError:
    return SimulationError(f"{path} is no checkpoint of taisoft, or damaged: {_sentence(why)}")


def _damaged(path: Path, why) -> SimulationError:
    return SimulationError(f"{path} is damaged: {_sentence(why)}")


def _sentence(why) -> str:
    """An exception's first line, with its type where that is needed to understand it."""
    text = str(why).strip().splitlines()
    return why if isinstance(why, str) else f"{type(why).__name__}: {text[0] if text else 'no reason given'}"
