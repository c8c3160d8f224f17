"""The files of a study: study.md, study.csv, study.json and, with matplotlib, study.png."""

import json
from pathlib import Path

from taisoft.errors import OutputError
from taisoft.files import write_bytes
from taisoft.output.report import json_text
from taisoft.output.tables import require_matplotlib
from taisoft.study.plot import draw
from taisoft.study.results import Study, plain
from taisoft.study.table import csv_of, text_of

FILES = ("study.md", "study.csv", "study.json", "study.png")


def check_scene(folder: Path, scene: str) -> None:
    """Raise OutputError if the folder holds a study of a scene with another digest."""
    try:
        found = json.loads((folder / "study.json").read_bytes())
        name, same = found["request"]["scene"], found["scene_digest"] == scene
    except FileNotFoundError:
        return
    except (OSError, ValueError, KeyError, TypeError, RecursionError) as error:
        raise OutputError(f"the folder {folder} holds a study.json not written by this version: name another folder") from error
    if not same:
        raise OutputError(f"the folder {folder} holds a study of another scene ({name}, with other content): name another folder")


def write(study: Study, folder: Path) -> str:
    """Write all files. Return a sentence if there is no picture, else an empty text. Raises OutputError."""
    write_bytes(folder / "study.md", text_of(study).encode())
    write_bytes(folder / "study.csv", csv_of(study).encode())
    write_bytes(folder / "study.json", json_text(plain(study)).encode())
    picture = folder / "study.png"
    try:
        require_matplotlib("study.png")
    except OutputError as error:
        reason = str(error)
    else:
        if draw(study, picture):
            return ""
        reason = "study.png is not drawn, because no setting has both a time and an error"
    try:
        picture.unlink(missing_ok=True)  # from an earlier study: the folder holds only one
    except OSError as error:
        raise OutputError(f"cannot remove the earlier {picture}: {error.strerror or error}") from error
    return reason
