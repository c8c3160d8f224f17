"""`taisoft list`: the demos, one line each, from the first line of their docstrings."""

from argparse import Namespace

from taisoft.cli.scene_file import first_line, shipped_files


def command(_: Namespace) -> int:
    """Print the name and first docstring line of every demo, without running any."""
    print_table(shipped_files("demos"))
    return 0


def print_table(files: dict) -> None:
    """Print the name and first docstring line of .py files. files: name -> path."""
    width = max(map(len, files), default=0)
    for name, path in files.items():
        print(f"{name:<{width}}  {first_line(path)}".rstrip())
