"""The command `taisoft`: arguments in, an exit status out. Each command lives in its own file beside this one.

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
    """Runs one command. argv: the arguments after the program's name, those of the process by default.

    Returns the exit status; argparse itself leaves with status 2 where it cannot parse. A TaisoftError becomes one
    sentence on stderr; any other exception is a fault of taisoft and keeps its traceback. A command's module is
    imported only when it is asked for, so that `doctor` also works on a broken installation.
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
        # The reader of our output has gone (`taisoft list | head -1`): stdout as it is would complain when closed.
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

    mesh_info = commands.add_parser("info", help="what a mesh file holds: counts, size, quality, problems")
    mesh_info.add_argument("mesh", metavar="MESH", help="tetrahedra in any format that meshio reads, or a surface")
    mesh_info.set_defaults(command="info")

    tets = commands.add_parser("tetrahedralize", help="fill a surface with tets (extra 'mesh')", allow_abbrev=False)
    tets.add_argument("surface", metavar="SURFACE", help="an .obj, .stl, .ply or .off file of triangles")
    tets.add_argument("--out", metavar="MESH", required=True, help="the mesh file: .msh, .vtk, .vtu or .mesh")
    tets.add_argument("--edge-length", type=float, metavar="L", help="of the tets [m] (default: a twentieth of the diagonal)")
    tets.add_argument("--envelope", type=float, metavar="E", help="how far the surface may move [m] (default: L / 10)")
    tets.add_argument("--weld", type=float, default=0.0, metavar="D", help="vertices at most this far apart become one [m]")
    tets.add_argument("--overwrite", action="store_true", help="replace MESH where it exists")
    tets.set_defaults(command="tetrahedralize")

    doctor_parser = commands.add_parser("doctor", help="what this machine offers, and how to get what is missing")
    doctor_parser.set_defaults(command="doctor")

    warm = commands.add_parser(
        "warm",
        help="compile the kernels of common scenes ahead",
        description="Compile the kernels of common scenes ahead, which takes a minute or two. Covered are the demos without "
        "pictures; each law in explicit, implicit_euler and bdf2 steps, held, on a half-space and between bodies; and for "
        "stable_neo_hookean statics, order 2, loads, moved nodes, damping, boxes and mesh obstacles, very flat tets, and "
        "surfaces of more than 1,500 triangles.",
    )
    warm.add_argument("--precision", choices=("f32", "f64"), help="of all (default: simulations f32, statics f64)")
    warm.set_defaults(command="warm")

    bench_parser = commands.add_parser("bench", help="run a benchmark; without a name, list them", add_help=False)
    bench_parser.add_argument("name", metavar="NAME", nargs="?", help="the benchmark's name")
    bench_parser.add_argument("rest", nargs=argparse.REMAINDER, help="arguments of the benchmark itself")
    bench_parser.set_defaults(command="bench")
    return parser


def _add_run(commands) -> None:
    """The options of `taisoft run`; their defaults are None so that what was given can be told from what was not."""
    parser = commands.add_parser(
        "run",
        help="run a scene: a demo's name, a .toml scene file or a .py file with build()",
        description="Run a scene and, with --out, keep report.json, steps.csv, checkpoint.npz, frames/ and scene.usdc.",
        allow_abbrev=False,
    )
    _add_scene_name(parser)
    parser.add_argument("--arch", choices=("cpu", "cuda"), help="where to compute (default cpu)")
    parser.add_argument("--precision", choices=("f32", "f64"), help="of the arithmetic (default f32)")
    parser.add_argument("--headless", action="store_true", help="open no window")
    parser.add_argument("--seconds", type=float, metavar="T", help="simulated time [s] (default: the scene's, or 1)")
    parser.add_argument(
        "--fps", type=float, metavar="N", help="frames per simulated second (default: the scene's, or 60)"
    )
    parser.add_argument("--out", metavar="DIR", help="folder for the results; without it nothing is written")
    parser.add_argument("--overwrite", action="store_true", help="replace results that DIR already holds")
    parser.add_argument(
        "--set",
        action="append",
        default=[],
        dest="assignments",
        metavar="solver.KEY=VALUE",
        help="a Simulator argument, e.g. solver.dt=0.01; may be repeated",
    )
    parser.add_argument(
        "--resume", metavar="CHECKPOINT", help="go on from DIR/checkpoint.npz of a run of this scene, until --seconds in all"
    )
    parser.add_argument(
        "--checkpoint-every",
        type=float,
        metavar="T",
        help="write DIR/checkpoint.npz whenever so much simulated time has passed [s], not only at the end",
    )
    parser.add_argument("--video", action="store_true", help="also make video.mp4 of the pictures, by ffmpeg (extra 'video')")
    parser.add_argument("--no-usd", action="store_true", help="write no scene.usdc")
    colours = ("body", "stress", "stretch", "speed")
    parser.add_argument("--colour", choices=colours, default="body", help="what pictures and the window colour bodies by")
    parser.add_argument(
        "--layers", metavar="NAME,...", help="what they show beside bodies: wires, contacts, tractions, fixed_nodes, or none"
    )
    parser.add_argument(
        "--plots", metavar="NAME,...", help="what they plot over time: energies, residuals, iterations, contacts, step_time"
    )
    parser.add_argument("--caption", action="store_true", help="write scene, frame, time and energies on pictures")
    parser.add_argument("--no-frames", action="store_true", help="write no pictures")
    parser.set_defaults(command="run")


def _add_scene(commands) -> None:
    """The options of `taisoft scene`."""
    told = "write a scene, or one to start from for a mesh, as a .toml file"
    parser = commands.add_parser("scene", help=told, allow_abbrev=False)
    _add_scene_name(parser, "a .toml or .py file, or a mesh (.msh, .vtu, .vtk, .mesh, .node): it falls on the ground")
    parser.add_argument("--out", metavar="FILE", required=True, help="the .toml file; its meshes are written beside it")
    parser.add_argument("--overwrite", action="store_true", help="replace files that are there")
    parser.set_defaults(command="scene")


def _add_study(commands) -> None:
    """The options of `taisoft study`; those of the grid are comma lists."""
    parser = commands.add_parser(
        "study",
        help="run a scene over a grid of settings: speed against error",
        description="Run a scene over a grid of settings, each in its own process, against a reference. Lists are divided by "
        "commas; what is not given is the scene's.",
        allow_abbrev=False,
    )
    _add_scene_name(parser)
    grid = parser.add_argument_group("grid (comma lists)")
    for name, told in (
        ("dt", "steps [s]"), ("integrator", "names, such as bdf2"), ("order", "of the elements of all bodies, 1 or 2"),
        ("refine", "how often every tet is cut into eight"), ("precision", "f32, f64"),
        ("newton-tolerance", "relative, or none: adaptive"), ("linear-tolerance", "of conjugate gradients, relative, or none"),
        ("contact-solver", "auto or a solver"), ("contact-tolerance", "relative, or none"), ("arch", "cpu, cuda"),
    ):  # fmt: skip
        grid.add_argument(f"--{name}", metavar="LIST", help=told)
    parser.add_argument("--seconds", type=float, metavar="T", help="simulated time [s] (default: the scene's, or 1)")
    parser.add_argument("--tolerance", type=float, default=0.01, metavar="X", help="error that is good enough (default 0.01)")
    parser.add_argument("--by", choices=("max", "rms"), default="max", help="the error that counts (default max)")
    parser.add_argument("--repeats", type=int, default=3, metavar="N", help="timed runs of each setting (default 3)")
    parser.add_argument("--reference-dt", type=float, metavar="DT", help="(default: the smallest dt over 8)")
    parser.add_argument("--reference-integrator", metavar="NAME", help="(default: one of second order that fits the scene)")
    parser.add_argument(
        "--reference-refine", type=int, default=0, metavar="N", help="how much finer than the finest mesh the reference's is"
    )
    parser.add_argument("--out", metavar="DIR", help="folder for the results; a study that is there goes on")
    parser.add_argument(
        "--budget", type=float, default=600.0, metavar="SECONDS", help="wall time after which no more is run (default 600)"
    )
    parser.add_argument("--workers", type=int, metavar="N", help="processes at a time, each on its own cores (default 1)")
    parser.add_argument("--scheduler", metavar="ADDRESS", help="run on a Dask cluster, e.g. tcp://host:8786 (extra 'cluster')")
    parser.set_defaults(command="study")


def _add_scene_name(parser: argparse.ArgumentParser, others: str = "a .toml scene file or a .py file with build()") -> None:
    parser.add_argument("scene", metavar="SCENE", help=f"a demo's name (see `taisoft list`), {others}")
    parser.add_argument(
        "--allow-outside", action="store_true", help="let a .toml file name mesh files outside of its folder"
    )
