"""States of a run in its folder: `states/scene.npz`, what is drawn of the scene, and `states/00000.npz ...`, one for each frame.

`taisoft draw` and `StoredRun` draw a finished run from them, without computing. A file holds arrays without pickled objects, and
`header`, JSON text of all else. Each file is complete or absent.
"""

import json
from collections.abc import Iterator, Mapping, Sequence
from contextlib import ExitStack, contextmanager
from dataclasses import replace
from pathlib import Path

import numpy as np

from taisoft.attributes import Guarded
from taisoft.errors import OutputError, TaisoftError, reason
from taisoft.files import replacing
from taisoft.nested import join_arrays, part_arrays
from taisoft.output.background import BackgroundWriter
from taisoft.output.folder import Observer, make_folder
from taisoft.scene import checks
from taisoft.scene.look import Camera, check_follow, colour_of, opacity_of
from taisoft.scene.scene import Scene
from taisoft.view.choices import LAYERS
from taisoft.view.colouring import checked_colour
from taisoft.view.drawn import DrawnBody, DrawnScene, DrawnState
from taisoft.view.offscreen import SIZE, Offscreen
from taisoft.view.sampling import Sampler

STATES_NAME, SCENE_NAME = "states", "scene.npz"
FORMAT = 1  # increment it with every change of a file's content
KEPT = ("stress", "speed")  # quantities that a run keeps by default
DISPLACEMENT, VALUES = "displacement", "values"  # arrays over the nodes; the latter followed by a quantity's name


class StateWriter(Observer):
    """Observer that samples every frame once, writes its state to the run's folder, and passes it on.

    kinds: quantities that are kept, besides positions; without any no states are written. members: get `frame(state, index)`;
    shown: layers and colour that they show; name: of the scene. Files are written in a thread; what fails in it raises
    OutputError at a later call.
    """

    def __init__(
        self, folder: str | Path, sampler: Sampler, kinds: Sequence[str], members: Sequence, shown: tuple, name: str = ""
    ):
        self._sampler, self.members, self._folder = sampler, members, Path(folder) / STATES_NAME if kinds else None
        self._layers, self._kinds = (LAYERS if kinds else shown[0]), list(dict.fromkeys([*kinds, shown[1]]))
        self._writer = BackgroundWriter()
        if self._folder is not None:
            _write(make_folder(self._folder) / SCENE_NAME, {"scene": sampler.drawn.plain(), "name": name}, {})

    def frame(self, sim, index: int) -> None:
        """Keep sim's present state as frame number index. Raises OutputError."""
        layers = [one for one in self._layers if one != "contacts" or sim.plan.on["contact_forces"]]
        state = self._sampler.state(sim, layers, self._kinds)
        if self._folder is not None:
            values = {f"{VALUES}/{kind}": one for kind, one in state.values.items()}
            arrays = {DISPLACEMENT: state.displacement} | values
            self._writer.write(self._folder / f"{index:05d}.npz", _write, state.plain(), arrays)
        for member in self.members:
            member.frame(state, index)

    def flush(self) -> None:
        """Wait until all states, and what the members write, are written. Raises OutputError."""
        for one in (*self.members, self._writer):
            one.flush()

    def close(self) -> None:
        """Write the states that wait, and close the members; a second call does nothing. Raises OutputError."""
        with ExitStack() as stack:
            for one in (self._writer, *self.members):
                stack.callback(one.close)


class StoredRun(Guarded):
    """A run in a folder, drawn again without computing.

    folder: of `taisoft run --out`. name: of its scene; frames: numbers of its frames. background, lights, camera: as of a
    `Scene`, to be set. Raises OutputError if there are no states, or they cannot be read.
    """

    _read_only = frozenset(("folder", "frames", "name"))

    def _label(self) -> str:
        return "stored run"

    def __init__(self, folder: str | Path):
        self.folder = Path(folder)
        states = self.folder / STATES_NAME
        self.frames = sorted(int(path.stem) for path in states.glob("*.npz") if path.stem.isdecimal())
        if not self.frames or not (states / SCENE_NAME).exists():
            raise OutputError(
                f"{states}: there are no states of a run, which `taisoft run` keeps with --out, but not with --keep none"
            )
        with _read(states / SCENE_NAME) as (given, _):
            self._scene, self.name = DrawnScene.from_plain(given["scene"]), str(given["name"])
        self._background, self._lights, self._camera = self._scene.background, self._scene.lights, self._scene.camera
        self._seal(StoredRun.__init__)

    background, lights = Scene.background, Scene.lights
    camera = checks.attribute("camera", None, "`Camera` of pictures; None: one that frames the start.")

    def _check_camera(self, value) -> Camera | None:
        return check_follow(checks.instance(value, "stored run: camera", Camera, optional=True), self.bodies)

    @property
    def bodies(self) -> list[DrawnBody]:
        """What is drawn of the bodies."""
        return self._scene.bodies

    @property
    def scene(self) -> DrawnScene:
        """What is drawn of the scene, with the looks that have been set."""
        return replace(self._scene, background=self.background, lights=self.lights, camera=self.camera)

    def __len__(self) -> int:
        return len(self.frames)

    def __repr__(self) -> str:
        return f"StoredRun({str(self.folder)!r}, {len(self)} frames)"

    def state(self, frame: int, kind: str = "body") -> DrawnState:
        """Return the state of a frame, by its number, with a quantity at the nodes, one of COLOURS. Raises OutputError."""
        path = self.folder / STATES_NAME / f"{frame!r:0>5}.npz"
        if not path.exists():
            raise OutputError(f"{self.folder}: there is no frame {frame!r}: they are {self.frames[0]} to {self.frames[-1]}")
        name = f"{VALUES}/{checked_colour(kind)}"
        with _read(path) as (given, arrays):
            if kind != "body" and name not in arrays:
                kept = [one.removeprefix(f"{VALUES}/") for one in arrays if one.startswith(VALUES)]
                has, again = ", ".join(kept), f"run it again with --keep {','.join([*kept, kind])}"
                raise OutputError(f"{self.folder}: colour {kind!r} cannot be drawn: frame {frame} has kept {has}; {again}")
            values = {} if kind == "body" else {kind: arrays[name]}
            return DrawnState(self._scene, displacement=arrays[DISPLACEMENT], values=values, **given)

    def paint(self, name: str, colour=None, opacity: float | None = None) -> None:
        """Give a body or an obstacle another colour or opacity, as of `Scene.add_body`. Raises SceneError."""
        scene, what = self._scene, f"{name!r}"
        ones = [*scene.bodies, *scene.obstacles]
        k = checks.index(name, [one.name for one in ones], "no body or obstacle")
        given = {} if colour is None else {"colour": colour_of(colour, f"{what}: colour")}
        given |= {} if opacity is None else {"opacity": opacity_of(opacity, f"{what}: opacity")}
        owner, at = (scene.bodies, k) if k < len(scene.bodies) else (scene.obstacles, k - len(scene.bodies))
        owner[at] = replace(owner[at], **given)

    def picture(
        self, frame: int | None = None, size: tuple[int, int] = SIZE, colour: str = "body", camera: Camera | None = None
    ) -> np.ndarray:
        """Return a picture of a frame, by default the last, uint8 (height, width, 3); arguments as for `Simulator.picture`.

        The automatic camera frames the start, and the scale is the frame's own. Raises OutputError.
        """
        state = self.state(self.frames[-1] if frame is None else frame, colour)
        return Offscreen(self.scene, size, camera, colour).image(state)


def _write(path: Path, given: dict, arrays: dict[str, np.ndarray]) -> None:
    arrays = dict(arrays)
    header = json.dumps({"format": FORMAT, "content": part_arrays(given, arrays)})
    with replacing(path) as part, open(part, "wb") as file:
        np.savez(file, header=np.frombuffer(header.encode(), dtype=np.uint8), **arrays)


@contextmanager
def _read(path: Path) -> Iterator[tuple[dict, Mapping[str, np.ndarray]]]:
    """Yield what `_write` wrote; arrays are read when they are asked for. Raises OutputError, also for another format."""
    try:
        with np.load(path, allow_pickle=False) as arrays:
            header = json.loads(arrays["header"].tobytes())
            if header["format"] != FORMAT:
                raise OutputError(f"{path} has format {header['format']}, and this version reads format {FORMAT}")
            yield join_arrays(header["content"], arrays), arrays
    except TaisoftError:
        raise
    except Exception as error:  # NumPy, zipfile and the content raise many types
        raise OutputError(f"{path} is no state of a run, or damaged: {reason(error)}") from None
