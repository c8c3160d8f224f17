"""`taisoft bench NAME`: passes the remaining arguments to main(argv) -> exit status in benchmarks/NAME.py."""

from argparse import Namespace

from taisoft.cli.listing import print_table
from taisoft.cli.scene_file import load_shipped, shipped_files
from taisoft.errors import SceneError
from taisoft.scene.checks import nearest


def command(arguments: Namespace) -> int:
    """Run the benchmark, or list all of them if none is named. Raises SceneError for an unknown name."""
    # files in subfolders, and files without main(), are parts of benchmarks
    files = {name: path for name, path in shipped_files("benchmarks").items() if "." not in name}
    benchmarks = {name: path for name, path in files.items() if "def main(" in path.read_text()}
    if arguments.name in (None, "-h", "--help"):
        print("usage: taisoft bench NAME [arguments of the benchmark]")
        print_table(benchmarks)
        return 0
    if arguments.name not in benchmarks:
        hint = nearest(arguments.name, benchmarks)
        raise SceneError(f"no benchmark is called {arguments.name!r}{hint}; there are {', '.join(benchmarks) or 'none'}")
    return load_shipped("benchmarks", arguments.name).main(arguments.rest) or 0
