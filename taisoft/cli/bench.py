"""`taisoft bench NAME`: hands the remaining arguments to benchmarks/NAME.py, main(argv) -> exit status."""

from argparse import Namespace

from taisoft.cli.listing import print_table
from taisoft.cli.scene_file import load_shipped, shipped_files
from taisoft.errors import SceneError
from taisoft.scene.checks import nearest


def command(arguments: Namespace) -> int:
    """Runs the benchmark, or lists all of them if none is named. Raises SceneError for an unknown name."""
    # a part of a benchmark, or a peer in a folder below, is no benchmark of its own
    files = {name: path for name, path in shipped_files("benchmarks").items() if "." not in name}
    benchmarks = {name: path for name, path in files.items() if "def main(" in path.read_text()}
    if arguments.name in (None, "-h", "--help"):
        print("usage: taisoft bench NAME [arguments of the benchmark]")
        print_table(benchmarks)
        return 0
    if arguments.name not in benchmarks:
        hint = nearest(arguments.name, benchmarks)
        raise SceneError(
            f"no benchmark is called {arguments.name!r}{hint}; there are {', '.join(benchmarks) or 'none'}"
        )
    return load_shipped("benchmarks", arguments.name).main(arguments.rest) or 0
