"""The command `taisoft`: parses arguments, handles signals and warnings, and returns an exit status.

Exit status: 0 the run is ok or degraded, 1 the run failed, 2 bad input (refused before any file is written), 3 output
could not be written, 130 ended by SIGINT, 143 ended by SIGTERM.
"""

import argparse
import os
import re
import signal
import sys
import tomllib
import warnings
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import fields
from importlib import import_module
from importlib.util import find_spec

from taisoft import __version__
from taisoft.errors import OutputError, SceneError, TaisoftError, no_memory
from taisoft.study import Request, Setting
from taisoft.view.choices import COLOURS, LAYERS, PLOTS

EXIT_FAILED = 1
EXIT_BAD_INPUT = 2
EXIT_OUTPUT = 3
EXIT_SIGNAL = 128  # plus the signal's number: 130, 143
SIGNALS = (signal.SIGINT, signal.SIGTERM)
BARE_WORD = re.compile(r"[A-Za-z_]\w*|#\w+")  # or a colour


def main(argv: list[str] | None = None) -> int:
    """Run one command and return the exit status. argv: arguments after the program's name (default: sys.argv).

    argparse exits with status 2 if it cannot parse the arguments. A TaisoftError becomes one sentence on stderr; any
    other exception is a bug in taisoft and keeps its traceback. Only the requested command's module is imported, so that
    `doctor` also works on a broken installation.
    """
    parser = command_parser()
    if "_ARGCOMPLETE" in os.environ and find_spec("argcomplete"):
        import_module("argcomplete").autocomplete(parser)
    arguments = parser.parse_args(argv)
    try:
        module, function = arguments.command
        return getattr(import_module(f"taisoft.cli.{module}"), function)(arguments)
    except TaisoftError as error:
        print(f"taisoft: {error}", file=sys.stderr)
        return EXIT_OUTPUT if isinstance(error, OutputError) else EXIT_BAD_INPUT
    except MemoryError as error:
        print(f"taisoft: {no_memory('this scene or file', error)}", file=sys.stderr)
        return EXIT_BAD_INPUT
    except Interrupted as leave:
        print("taisoft: ended by a signal; nothing was written", file=sys.stderr)
        return EXIT_SIGNAL + leave.signal_number
    except BrokenPipeError:
        # The reader of our output has exited (`taisoft list | head -1`): closing stdout would raise again.
        os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())
        return EXIT_OUTPUT


class Interrupted(BaseException):
    """A signal arrived when there was nothing to save, so the command just exits."""

    def __init__(self, signal_number: int):
        super().__init__(signal_number)
        self.signal_number = signal_number


class Signals:
    """Handles SIGINT and SIGTERM while a command runs; restores the old handlers afterwards.

    `number` is the first signal's number, or None. Before `run_began()` a signal raises Interrupted, because there is
    nothing to save yet. After it, a signal makes `requested()` return True, and the run should end and save its results.
    ending: message printed at the first signal.
    """

    def __init__(self, ending: str = "ending and saving") -> None:
        self._ending = ending
        self.number: int | None = None
        self._running = False
        self._old_handlers: dict = {}

    def __enter__(self) -> "Signals":
        self._old_handlers = {number: signal.signal(number, self._handle) for number in SIGNALS}
        return self

    def __exit__(self, *_) -> None:
        for number, handler in self._old_handlers.items():
            signal.signal(number, handler)

    def run_began(self) -> None:
        """Make the first signal only request the run to end."""
        self._running = True

    def requested(self) -> bool:
        """Return whether a signal has requested the run to end."""
        return self.number is not None

    def _handle(self, number: int, _frame) -> None:
        if not self._running:
            raise Interrupted(number)
        if self.number is not None:
            os._exit(128 + number)  # files are written by rename, so exiting here leaves none incomplete
        self.number = number
        # os.write, because print is not reentrant
        os.write(2, f"\ntaisoft: {self._ending}; a second signal exits immediately\n".encode())


@contextmanager
def printed_warnings() -> Iterator[list[str]]:
    """Print each warning as one sentence; yield the list of their texts, which goes into the report."""
    texts: list[str] = []

    def show(message, category, filename, lineno, file=None, line=None) -> None:
        is_ours = category is UserWarning
        text = str(message) if is_ours else f"{filename}, line {lineno}: {category.__name__}: {message}"
        texts.append(text)
        print(f"taisoft: warning: {text}", file=sys.stderr)

    with warnings.catch_warnings():
        warnings.simplefilter("always", UserWarning)
        warnings.showwarning = show
        yield texts


def parse_scalar(text: str, assignment: str, option: str = "--set") -> float | int | bool | str | None:
    """Parse a number, true, false or "text" in TOML syntax; a bare word is text, and none is None."""
    try:
        table = tomllib.loads(f"value = {text}")
    except tomllib.TOMLDecodeError:
        if not BARE_WORD.fullmatch(text):
            raise SceneError(f"{option} {assignment}: {text!r} is not a number, true, false, none or a word") from None
        return None if text == "none" else text
    if set(table) != {"value"} or not isinstance(table["value"], (float, int, bool, str)):
        raise SceneError(f"{option} {assignment}: {text!r} is not a single number, true, false, none or a word")
    return table["value"]


def command_parser() -> argparse.ArgumentParser:
    parser = argparse.ArgumentParser(prog="taisoft", description="Elastic soft bodies in Taichi.", allow_abbrev=False)
    parser.add_argument("--version", action="version", version=f"taisoft {__version__}")
    commands = parser.add_subparsers(title="commands", required=True, metavar="COMMAND")

    def add(name: str, function: tuple[str, str], help_text: str, **options) -> argparse.ArgumentParser:
        """Add a command. function: its module in this package, and its name there."""
        command = commands.add_parser(name, help=help_text, allow_abbrev=False, **options)
        command.set_defaults(command=function)
        return command

    _add_run(add)
    option = add("scene", ("meshes", "scene"), "write a scene, or a starting scene for a mesh, as a .toml file").add_argument
    _add_scene_name(option, "a .toml or .py file, or a mesh (.msh, .vtu, .vtk, .mesh, .node, USD) that falls on the ground")
    _add_placement(option, "instead of falling from above the ground")
    option("--order", type=int, choices=(1, 2), help="of the tets of a mesh, 1 or 2; 2 bends correctly (default 1)")
    option("--out", metavar="FILE", required=True, help="the .toml file; its meshes are written beside it")
    option("--overwrite", action="store_true", help="replace existing files")

    option = add("draw", ("draw", "draw"), "draw a finished run again in another look, without computing").add_argument
    option("scene", metavar="DIR", help="folder of `taisoft run --out`")
    option("--out", metavar="DIR", help="folder for the pictures (default: drawn in the run's)")
    option("--overwrite", action="store_true", help="replace pictures already there")
    _add_pictures(option, "colouring of bodies, by a quantity that the run has kept")
    option(
        "--scale", type=float, metavar="X", help="upper end of the colour scale [the quantity's unit] (default: fits all frames)"
    )
    option("--look", metavar="FILE.toml", help="take background, lights and camera of a scene file")
    look = "NAME.colour='#rrggbb', NAME.opacity=NUMBER, or scene.background='#rrggbb'; may be repeated"
    option("--set", action="append", default=[], dest="assignments", metavar="NAME.KEY=VALUE", help=look)

    _add_study(add)
    add("list", ("scene_file", "list_demos"), "the demos, one line each")

    option = add("info", ("meshes", "info"), "report a mesh file's counts, size, quality and problems").add_argument
    option("mesh", metavar="MESH", help="tetrahedra in any format that meshio reads, a surface, or a USD stage")
    option("--weld", type=float, metavar="D", help="first merge vertices at most this far apart, in the file's unit")

    option = add("tetrahedralize", ("meshes", "fill"), "fill a surface with tets (extra 'mesh')").add_argument
    option("surface", metavar="SURFACE", help="an .obj, .stl, .ply or .off file of triangles")
    _add_placement(option)
    option("--out", metavar="MESH", required=True, help="the mesh file: .msh, .vtk, .vtu or .mesh")
    option("--edge-length", type=float, metavar="L", help="of the tets [m] (default: a twentieth of the diagonal)")
    option("--envelope", type=float, metavar="E", help="how far the surface may move [m] (default: L / 10)")
    option("--weld", type=float, default=0.0, metavar="D", help="merge vertices at most this far apart, in the file's unit")
    option("--overwrite", action="store_true", help="replace MESH if it exists")

    option = add("docs", ("scene_file", "docs"), "open the manual in a browser, and print where it is").add_argument
    option("page", metavar="PAGE", nargs="?", default="index", help="such as quickstart, contacts or tutorials/drop")
    option("--path", action="store_true", help="only print the path")

    add("doctor", ("doctor", "doctor"), "report what this machine offers, and how to get what is missing")

    option = add(
        "warm",
        ("warm", "warm"),
        "compile the kernels of scenes in advance",
        description="Compile the kernels of scenes in advance; without names those of the demos, of pictures and of statics, "
        "which takes some minutes. Scenes of the same kind then start at once, whatever their meshes and numbers.",
    ).add_argument
    _complete(option("scenes", metavar="SCENE", nargs="*", help="a demo's name, or a .toml or .py file"))
    option("--precision", choices=("f32", "f64"), help="of all kernels (default: the scenes' own, and f64 of statics)")

    option = add("completion", ("scene_file", "completion"), "print a shell's script for completion (extra 'completion')")
    option.add_argument("shell", choices=("bash", "zsh", "fish"), help="where to use it")

    option = add("bench", ("scene_file", "bench"), "run a benchmark; without a name, list them", add_help=False).add_argument
    option("name", metavar="NAME", nargs="?", help="the benchmark's name")
    option("rest", nargs=argparse.REMAINDER, help="arguments of the benchmark itself")
    return parser


def _add_run(add) -> None:
    """Add `taisoft run`; defaults are None to distinguish options given from those omitted."""
    option = add(
        "run",
        ("run", "run"),
        "run a scene: a demo's name, a .toml scene file or a .py file with build()",
        description="Run a scene and, with --out, write report.json, steps.csv, checkpoint.npz, frames/ and scene.usdc.",
    ).add_argument
    _add_scene_name(option)
    option("--arch", choices=("cpu", "cuda"), help="where to compute (default cpu)")
    option("--precision", choices=("f32", "f64"), help="floating-point precision (default f32)")
    option(
        "--tolerance", type=float, metavar="X", help="choose integrator and dt for this error in time over the largest excursion"
    )
    option("--headless", action="store_true", help="open no window")
    option("--seconds", type=float, metavar="T", help="simulated time [s] (default: the scene's, or 1)")
    option("--fps", type=float, metavar="N", help="frames per simulated second (default: the scene's, or 60)")
    option("--out", metavar="DIR", help="folder for the results; without it nothing is written")
    option("--overwrite", action="store_true", help="replace results already in DIR")
    assignment = {"action": "append", "default": [], "dest": "assignments", "metavar": "NAME.NUMBER=VALUE"}
    option("--set", **assignment, help="a number of scene or solver, e.g. beam.young=2e5 or solver.dt=0.01; may be repeated")
    option("--resume", metavar="CHECKPOINT", help="continue a run of this scene from its checkpoint, until --seconds in total")
    every = "write DIR/checkpoint.npz every T of simulated time [s], not only at the end"
    option("--checkpoint-every", type=float, metavar="T", help=every)
    _add_pictures(option, "colouring of bodies in pictures and the window")
    option(
        "--keep",
        metavar="NAME,...",
        help="quantities kept by frame for `taisoft draw`, or none for no states (default stress,speed)",
    )
    option("--vtu", action="store_true", help="also write every frame as a .vtu file, and scene.pvd, which ParaView opens")
    option("--no-usd", action="store_true", help="write no scene.usdc")
    quantity = "report a number at the end, with --error its error too: docs/errors.md lists the texts; may be repeated"
    option("--quantity", action="append", default=[], metavar="NAME=TEXT", help=quantity)
    details = "also write per step: pairs (forces, torques, slip velocities of what presses), bodies (their energies), quantities"
    option("--details", metavar="NAME,...", help=details)
    option("--about", type=float, nargs=3, metavar=("X", "Y", "Z"), help="point of torques [m] (default: centres of mass)")
    option("--error", action="store_true", help="estimate the error by runs with other steps and tolerances beside this one")
    option("--error-mesh", choices=("refined", "order"), help="also by one on another mesh; implies --error")
    option("--plots", metavar="NAME,...", help=f"on pictures: {', '.join(PLOTS)}")
    option("--no-frames", action="store_true", help="write no pictures")
    option("--verbose", action="store_true", help="print why each feature of the plan is on, and which are left out")


def _add_pictures(option, colouring: str) -> None:
    """Add the options of pictures and films, see `taisoft.cli.pictures`."""
    option("--video", action="store_true", help="also make video.mp4 from the pictures with ffmpeg (extra 'video')")
    option("--slow", type=float, metavar="FACTOR", help="film time over simulated time of video.mp4 (default 1)")
    option("--size", metavar="WIDTHxHEIGHT", help="of the pictures in pixels (default 1280x720)")
    directions = (
        "direction of the pictures [deg]: about up from +z (with z up: -y) towards +x, and above the horizon (default 32 20)"
    )
    option("--view", type=float, nargs=2, metavar=("AZIMUTH", "ELEVATION"), help=directions)
    camera = "a .toml file with a table [camera], or its keys, as in 'position = [3, 2, 4], target = [0, 0.5, 0], fov = 30'"
    option("--camera", metavar="CAMERA", help=camera)
    option("--colour", choices=tuple(COLOURS), default="body", help=colouring)
    option("--layers", metavar="NAME,...", help=f"what they show besides bodies: {', '.join(LAYERS)}, or none")
    option("--caption", action="store_true", help="write scene, frame, time and energies on pictures")


def _add_placement(option, instead: str = "(default: the mesh stays)") -> None:
    """Add the options that place a mesh, in the order in which they are applied; those that are not given are None."""
    option("--up", choices=("x", "y", "z"), help="axis of the file that points up (default y)")
    option("--to", choices=("y", "z"), help="axis that points up in the scene; the mesh is turned to it (default y)")
    option("--scale", type=float, metavar="S", help="factor, such as 0.001 for millimetres (default 1)")
    angles = "angles [deg] about x, then y, then z, after --up (default 0 0 0)"
    option("--rotate", type=float, nargs=3, metavar=("RX", "RY", "RZ"), help=angles)
    option("--at", type=float, nargs=3, metavar=("X", "Y", "Z"), help=f"where the middle of its underside goes [m] {instead}")


def _add_study(add) -> None:
    """Add `taisoft study`; the options of the grid are its axes."""
    parser = add(
        "study",
        ("study", "study"),
        "run a scene over a grid of settings: speed against error",
        description="Run a scene over a grid of settings, each in its own process, against a reference. Lists are "
        "comma-separated; defaults are the scene's.",
    )
    option = parser.add_argument
    _add_scene_name(option)
    grid = parser.add_argument_group("grid (comma-separated lists)")
    for axis in fields(Setting):
        grid.add_argument(f"--{axis.name.replace('_', '-')}", metavar="LIST", help=axis.metadata["meaning"])
    option("--seconds", type=float, metavar="T", help="simulated time [s] (default: the scene's, or 1)")
    option("--tolerance", type=float, default=Request.tolerance, metavar="X", help="acceptable error (default %(default)s)")
    option("--by", choices=("max", "rms"), default=Request.by, help="error norm (default %(default)s)")
    option("--repeats", type=int, default=Request.repeats, metavar="N", help="timed runs of each setting (default %(default)s)")
    option("--reference-dt", type=float, metavar="DT", help="(default: the smallest dt over 8)")
    option("--reference-integrator", metavar="NAME", help="(default: one of second order that fits the scene)")
    finer = "refinements of the reference beyond the finest mesh"
    option("--reference-refine", type=int, default=Request.reference_refine, metavar="N", help=finer)
    option("--out", metavar="DIR", help="folder for the results; a study in it is continued")
    option("--budget", type=float, default=600.0, metavar="SECONDS", help="wall time for all runs (default 600)")
    option("--workers", type=int, metavar="N", help="processes at a time, each on its own cores (default 1)")
    option("--scheduler", metavar="ADDRESS", help="run on a Dask cluster, e.g. tcp://host:8786 (extra 'cluster')")


def _complete(scene: argparse.Action) -> None:
    scene.completer = lambda **given: import_module("taisoft.cli.scene_file").fitting_scenes(**given)


def _add_scene_name(option, others: str = "a .toml scene file or a .py file with build()") -> None:
    _complete(option("scene", metavar="SCENE", help=f"a demo's name (see `taisoft list`), {others}"))
    option("--allow-outside", action="store_true", help="let a .toml file name mesh files outside its folder")
