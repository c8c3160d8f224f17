"""`taisoft draw DIR`: draw a finished run again from the states in its folder, in another look, without computing."""

import json
from argparse import Namespace
from contextlib import closing, suppress
from dataclasses import replace
from itertools import takewhile
from pathlib import Path

from taisoft.cli import EXIT_SIGNAL, Signals
from taisoft.cli.pictures import camera_of, picture_options, slowness
from taisoft.cli.recording import has_bar, make_video
from taisoft.errors import OutputError, SceneError, reworded
from taisoft.output.folder import CHECKPOINT_NAME, DRAWN_NAME, OutputFolder
from taisoft.output.picture_files import FRAMES_NAME, VIDEO_NAME
from taisoft.output.report import frame_rate
from taisoft.scene import checks
from taisoft.scene.tables import Table
from taisoft.scene.toml import TOP_KEYS, parsed
from taisoft.scene.toml_look import read_look
from taisoft.view.pictures import picture_writer
from taisoft.view.states import STATES_NAME, StoredRun


def draw(arguments: Namespace) -> int:
    """Draw the run and return the exit status. Bad input is refused before any file is written."""
    with Signals("ending with the pictures drawn so far") as signals:
        with reworded(OutputError, raised=SceneError):
            run, out = StoredRun(arguments.scene), Path(arguments.out or Path(arguments.scene) / DRAWN_NAME)
            options, slow = picture_options(arguments, name=run.name), slowness(arguments)
            fps = frame_rate(run.folder) if arguments.video else 0.0
            run.state(run.frames[0], options.colour)
        if any((out / name).exists() for name in (STATES_NAME, CHECKPOINT_NAME, "report.json")):
            raise SceneError(f"--out {out}: it is the folder of a run; without --out it is {run.folder / DRAWN_NAME}")
        _set_look(run, arguments)
        scale = None if arguments.scale is None else checks.number(arguments.scale, "--scale", above=0.0)
        if scale is not None and options.colour == "body":
            raise SceneError("--scale is that of a quantity, so it needs --colour")
        with closing(OutputFolder(out, arguments.overwrite)) as folder:
            signals.run_began()
            writer = picture_writer(folder.path, run.scene, replace(options, bar=has_bar(options.colour)))
            wanted, drawn = takewhile(lambda _: not signals.requested(), run.frames), 0
            writer.renderer.colouring.fix((run.state(index, options.colour) for index in wanted), scale)
            with closing(writer):
                for index in takewhile(lambda _: not signals.requested(), run.frames):
                    writer.frame(run.state(index, options.colour), index)
                    drawn += 1
            if arguments.video and not signals.requested():
                make_video(folder.path, fps / slow)
        print(f"pictures {out / FRAMES_NAME}/ ({drawn} of {len(run)} frames of {run.folder})")
        if (out / VIDEO_NAME).exists():
            print(f"film     {out / VIDEO_NAME}")
    return 0 if signals.number is None else EXIT_SIGNAL + signals.number


def _set_look(run: StoredRun, arguments: Namespace) -> None:
    """Set the look that --look, --camera and --set give, in this order. Raises SceneError."""
    if arguments.look is not None:
        file = Path(arguments.look)
        read_look(run, Table(file, "", parsed(file), TOP_KEYS))
    if arguments.camera is not None:
        run.camera = camera_of(arguments.camera)
    for assignment in arguments.assignments:
        name, equals, text = (part.strip() for part in assignment.partition("="))
        owner, _, key = name.rpartition(".")
        value = text.strip("'\"")
        with suppress(ValueError):
            value = json.loads(text)
        with reworded(SceneError, f"--set {assignment}: "):
            if value is None:
                raise SceneError("there is no value")
            if name == "scene.background":
                run.background = value
            elif equals and owner and key in ("colour", "opacity"):
                run.paint(owner, **{key: value})
            else:
                raise SceneError("write NAME.colour='#rrggbb', NAME.opacity=NUMBER or scene.background='#rrggbb'")
