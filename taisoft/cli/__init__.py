"""The command `taisoft`: parses arguments and returns an exit status. Each command has its own module in this package.

Exit status: 0 the run is ok or degraded, 1 the run failed, 2 bad input (refused before any file is written), 3 output
could not be written, 130 ended by SIGINT, 143 ended by SIGTERM.
"""

import argparse
import os
import sys
from importlib import import_module

from taisoft import __version__
from taisoft.cli.signals import Interrupted
from taisoft.errors import OutputError, TaisoftError, no_memory

EXIT_FAILED = 1
EXIT_BAD_INPUT = 2
EXIT_OUTPUT = 3
EXIT_SIGNAL = 128  # plus the signal's number: 130, 143


def main(argv: list[str] | None = None) -> int:
    """Run one command and return the exit status. argv: arguments after the program's name (default: sys.argv).

    argparse exits with status 2 if it cannot parse the arguments. A TaisoftError becomes one sentence on stderr; any
    other exception is a bug in taisoft and keeps its traceback. Only the requested command's module is imported, so that
    `doctor` also works on a broken installation.
    """
    arguments = _parser().parse_args(argv)
    try:
        return import_module(f"taisoft.cli.{arguments.command}").command(arguments)
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


def _parser() -> argparse.ArgumentParser:
    parser = argparse.ArgumentParser(prog="taisoft", description="Elastic soft bodies in Taichi.", allow_abbrev=False)
    parser.add_argument("--version", action="version", version=f"taisoft {__version__}")
    commands = parser.add_subparsers(title="commands", required=True, metavar="COMMAND")

    _add_run(commands)
    _add_scene(commands)
    _add_study(commands)

    listed = commands.add_parser("list", help="the demos, one line each")
    listed.set_defaults(command="listing")

    mesh_info = commands.add_parser("info", help="report a mesh file's counts, size, quality and problems")
    mesh_info.add_argument("mesh", metavar="MESH", help="tetrahedra in any format that meshio reads, or a surface")
    mesh_info.set_defaults(command="info")

    tets = commands.add_parser("tetrahedralize", help="fill a surface with tets (extra 'mesh')", allow_abbrev=False)
    tets.add_argument("surface", metavar="SURFACE", help="an .obj, .stl, .ply or .off file of triangles")
    tets.add_argument("--out", metavar="MESH", required=True, help="the mesh file: .msh, .vtk, .vtu or .mesh")
    tets.add_argument("--edge-length", type=float, metavar="L", help="of the tets [m] (default: a twentieth of the diagonal)")
    tets.add_argument("--envelope", type=float, metavar="E", help="how far the surface may move [m] (default: L / 10)")
    tets.add_argument("--weld", type=float, default=0.0, metavar="D", help="merge vertices at most this far apart [m]")
    tets.add_argument("--overwrite", action="store_true", help="replace MESH if it exists")
    tets.set_defaults(command="tetrahedralize")

    doctor_parser = commands.add_parser("doctor", help="report what this machine offers, and how to get what is missing")
    doctor_parser.set_defaults(command="doctor")

    warm = commands.add_parser(
        "warm",
        help="compile the kernels of common scenes in advance",
        description="Compile the kernels of common scenes in advance, which takes a minute or two: the demos without pictures; "
        "each law in explicit, implicit_euler and bdf2 steps, with fixed nodes, on a half-space and between bodies; and for "
        "stable_neo_hookean statics, order 2, loads, prescribed nodes, damping, boxes and mesh obstacles, very flat tets, and "
        "surfaces of more than 1,500 triangles.",
    )
    warm.add_argument("--precision", choices=("f32", "f64"), help="of all kernels (default: simulations f32, statics f64)")
    warm.set_defaults(command="warm")

    bench_parser = commands.add_parser("bench", help="run a benchmark; without a name, list them", add_help=False)
    bench_parser.add_argument("name", metavar="NAME", nargs="?", help="the benchmark's name")
    bench_parser.add_argument("rest", nargs=argparse.REMAINDER, help="arguments of the benchmark itself")
    bench_parser.set_defaults(command="bench")
    return parser


def _add_run(commands) -> None:
    """Add the options of `taisoft run`; defaults are None to distinguish options given from those omitted."""
    parser = commands.add_parser(
        "run",
        help="run a scene: a demo's name, a .toml scene file or a .py file with build()",
        description="Run a scene and, with --out, write report.json, steps.csv, checkpoint.npz, frames/ and scene.usdc.",
        allow_abbrev=False,
    )
    _add_scene_name(parser)
    parser.add_argument("--arch", choices=("cpu", "cuda"), help="where to compute (default cpu)")
    parser.add_argument("--precision", choices=("f32", "f64"), help="floating-point precision (default f32)")
    parser.add_argument("--headless", action="store_true", help="open no window")
    parser.add_argument("--seconds", type=float, metavar="T", help="simulated time [s] (default: the scene's, or 1)")
    parser.add_argument("--fps", type=float, metavar="N", help="frames per simulated second (default: the scene's, or 60)")
    parser.add_argument("--out", metavar="DIR", help="folder for the results; without it nothing is written")
    parser.add_argument("--overwrite", action="store_true", help="replace results already in DIR")
    parser.add_argument(
        "--set",
        action="append",
        default=[],
        dest="assignments",
        metavar="solver.KEY=VALUE",
        help="a Simulator argument, e.g. solver.dt=0.01; may be repeated",
    )
    parser.add_argument(
        "--resume", metavar="CHECKPOINT", help="continue a run of this scene from its checkpoint, until --seconds in total"
    )
    parser.add_argument(
        "--checkpoint-every",
        type=float,
        metavar="T",
        help="write DIR/checkpoint.npz every T of simulated time [s], not only at the end",
    )
    parser.add_argument("--video", action="store_true", help="also make video.mp4 from the pictures with ffmpeg (extra 'video')")
    parser.add_argument("--no-usd", action="store_true", help="write no scene.usdc")
    colours = ("body", "stress", "stretch", "speed")
    parser.add_argument("--colour", choices=colours, default="body", help="colouring of bodies in pictures and the window")
    parser.add_argument(
        "--layers", metavar="NAME,...", help="what they show besides bodies: wires, contacts, tractions, fixed_nodes, or none"
    )
    parser.add_argument(
        "--plots", metavar="NAME,...", help="plots over time: energies, residuals, iterations, contacts, step_time"
    )
    parser.add_argument("--caption", action="store_true", help="write scene, frame, time and energies on pictures")
    parser.add_argument("--no-frames", action="store_true", help="write no pictures")
    parser.set_defaults(command="run")


def _add_scene(commands) -> None:
    """Add the options of `taisoft scene`."""
    summary = "write a scene, or a starting scene for a mesh, as a .toml file"
    parser = commands.add_parser("scene", help=summary, allow_abbrev=False)
    _add_scene_name(parser, "a .toml or .py file, or a mesh (.msh, .vtu, .vtk, .mesh, .node) that falls on the ground")
    parser.add_argument("--out", metavar="FILE", required=True, help="the .toml file; its meshes are written beside it")
    parser.add_argument("--overwrite", action="store_true", help="replace existing files")
    parser.set_defaults(command="scene")


def _add_study(commands) -> None:
    """Add the options of `taisoft study`; those of the grid are comma-separated lists."""
    parser = commands.add_parser(
        "study",
        help="run a scene over a grid of settings: speed against error",
        description="Run a scene over a grid of settings, each in its own process, against a reference. Lists are "
        "comma-separated; defaults are the scene's.",
        allow_abbrev=False,
    )
    _add_scene_name(parser)
    grid = parser.add_argument_group("grid (comma-separated lists)")
    for name, help_text in (
        ("dt", "steps [s]"),
        ("integrator", "names, such as bdf2"),
        ("order", "of the elements of all bodies, 1 or 2"),
        ("refine", "how many times every tet is divided into eight"),
        ("precision", "f32, f64"),
        ("newton-tolerance", "relative, or none: adaptive"),
        ("linear-tolerance", "of conjugate gradients, relative, or none"),
        ("contact-solver", "auto or a solver"),
        ("contact-tolerance", "relative, or none"),
        ("arch", "cpu, cuda"),
    ):
        grid.add_argument(f"--{name}", metavar="LIST", help=help_text)
    parser.add_argument("--seconds", type=float, metavar="T", help="simulated time [s] (default: the scene's, or 1)")
    parser.add_argument("--tolerance", type=float, default=0.01, metavar="X", help="acceptable error (default 0.01)")
    parser.add_argument("--by", choices=("max", "rms"), default="max", help="error norm (default max)")
    parser.add_argument("--repeats", type=int, default=3, metavar="N", help="timed runs of each setting (default 3)")
    parser.add_argument("--reference-dt", type=float, metavar="DT", help="(default: the smallest dt over 8)")
    parser.add_argument("--reference-integrator", metavar="NAME", help="(default: one of second order that fits the scene)")
    parser.add_argument(
        "--reference-refine", type=int, default=0, metavar="N", help="refinements of the reference beyond the finest mesh"
    )
    parser.add_argument("--out", metavar="DIR", help="folder for the results; a study in it is continued")
    parser.add_argument("--budget", type=float, default=600.0, metavar="SECONDS", help="wall time for all runs (default 600)")
    parser.add_argument("--workers", type=int, metavar="N", help="processes at a time, each on its own cores (default 1)")
    parser.add_argument("--scheduler", metavar="ADDRESS", help="run on a Dask cluster, e.g. tcp://host:8786 (extra 'cluster')")
    parser.set_defaults(command="study")


def _add_scene_name(parser: argparse.ArgumentParser, others: str = "a .toml scene file or a .py file with build()") -> None:
    parser.add_argument("scene", metavar="SCENE", help=f"a demo's name (see `taisoft list`), {others}")
    parser.add_argument("--allow-outside", action="store_true", help="let a .toml file name mesh files outside its folder")
