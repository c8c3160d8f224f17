"""Completion of commands in a shell by argcomplete (extra 'completion'), whose script calls the command with _ARGCOMPLETE set."""

from argparse import ArgumentParser, Namespace

from taisoft.cli.scene_file import shipped_files
from taisoft.errors import SceneError


def completion(arguments: Namespace) -> int:
    """Print the script that a shell needs."""
    try:
        import argcomplete
    except ImportError:
        raise SceneError("completion needs argcomplete: pip install 'taisoft[completion]'") from None
    print(argcomplete.shellcode(["taisoft"], shell=arguments.shell))
    return 0


def complete(parser: ArgumentParser) -> None:
    """Answer the script with what fits the words so far, and exit."""
    import argcomplete
    from argcomplete.completers import FilesCompleter

    files = FilesCompleter(("toml", "py"))
    commands = next(iter(parser._subparsers._group_actions)).choices
    for action in (action for command in commands.values() for action in command._actions):
        if action.dest == "scene":
            action.completer = lambda prefix, **_: [*shipped_files("demos"), *files(prefix)]
    argcomplete.autocomplete(parser)
