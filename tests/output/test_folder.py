"""Output files are complete or absent, whatever fails; an output folder has one writer and no results, unless overwritten."""

import errno
import itertools
import os
import resource
import tempfile
from contextlib import closing
from pathlib import Path

import pytest

from taisoft.errors import OutputError
from taisoft.files import replacing, write_bytes
from taisoft.output.folder import LOCK_NAME, OutputFolder


def names(folder):
    return sorted(path.name for path in folder.iterdir())


@pytest.mark.parametrize("call", ["write", "fsync", "replace"])
def test_a_failure_keeps_the_old_file(tmp_path, monkeypatch, call):
    """A limit on files of 50,000 bytes stands for a full disk (Python ignores its signal)."""

    def fail(*_):
        raise OSError(errno.EIO, os.strerror(errno.EIO))

    write_bytes(tmp_path / "a.bin", b"old")
    limits = resource.getrlimit(resource.RLIMIT_FSIZE)
    if call == "write":
        resource.setrlimit(resource.RLIMIT_FSIZE, (50_000, limits[1]))
    else:
        monkeypatch.setattr(os, call, fail)
    try:
        for name in ("a", "b"):
            with pytest.raises(OutputError, match=rf"{name}\.bin \(60000 bytes\): (File too large|Input/output error)"):
                write_bytes(tmp_path / f"{name}.bin", b"x" * 60_000)
    finally:
        resource.setrlimit(resource.RLIMIT_FSIZE, limits)
        monkeypatch.undo()
    with pytest.raises(KeyboardInterrupt), replacing(tmp_path / "a.bin") as part:
        part.write_bytes(b"half")
        raise KeyboardInterrupt
    assert names(tmp_path) == ["a.bin"] and (tmp_path / "a.bin").read_bytes() == b"old"


def test_data_are_on_disk_before_the_rename(tmp_path, monkeypatch):
    """And the new name after it: fsync, rename, fsync of the folder."""
    calls, fsync, replace = [], os.fsync, os.replace

    def watched_fsync(descriptor):
        calls.append("folder" if os.path.isdir(f"/proc/self/fd/{descriptor}") else "file")
        fsync(descriptor)

    monkeypatch.setattr(os, "fsync", watched_fsync)
    monkeypatch.setattr(os, "replace", lambda source, target: (calls.append("rename"), replace(source, target)))
    for data in (b"data", b"later"):
        write_bytes(tmp_path / "a.bin", data)
    assert [call for call, _ in itertools.groupby(calls)] == 2 * ["file", "rename", "folder"]
    assert names(tmp_path) == ["a.bin"] and (tmp_path / "a.bin").read_bytes() == b"later"


@pytest.mark.parametrize("result", ["report.json", "steps.csv", "scene.usdc", "frames/00000.png", "chunks/points_00000.usdc"])
def test_a_folder_with_results_is_refused(tmp_path, result):
    (tmp_path / result).parent.mkdir(exist_ok=True)
    (tmp_path / result).write_text("old")
    with pytest.raises(OutputError, match="already holds results"):
        OutputFolder(tmp_path)
    assert (tmp_path / result).read_text() == "old" and not (tmp_path / LOCK_NAME).exists()
    OutputFolder(tmp_path, overwrite=True).close()


def test_overwriting_removes_old_results_only(tmp_path):
    for name in ("frames", "chunks"):
        (tmp_path / name).mkdir()
    kept = ("notes.txt", "report.json.2026-11-22.bak", "frames/mine.png")
    removed = ("frames/00007.png", "scene.usdc.1-0.part")
    removed += ("chunks/points_00000.usdc.123-7.part", "chunks/points_00010.usdc.123-8.jtZrXE")  # USD's own
    for name in ("report.json", "scene.usdc", *kept, *removed):
        (tmp_path / name).write_text("old")
    OutputFolder(tmp_path, overwrite=True).close()
    assert names(tmp_path / "frames") == ["mine.png"] and names(tmp_path / "chunks") == []
    assert names(tmp_path) == ["chunks", "frames", "notes.txt", "report.json.2026-11-22.bak"]


def test_files_and_folders_of_other_kinds_are_refused(tmp_path):
    file = tmp_path / "out"
    file.write_text("mine")
    (tmp_path / "scene.usdc").mkdir()
    for folder, message in (
        (file, "a file has that name"),
        (file / "deeper", "cannot create the folder"),
        (tmp_path, r"scene\.usdc: a folder has that name"),
    ):
        with pytest.raises(OutputError, match=message):
            OutputFolder(folder, overwrite=True)
    assert file.read_text() == "mine"


def test_a_folder_without_write_permission_is_refused():
    """As an ordinary user, since the superuser may write anywhere."""
    folder, user = Path(tempfile.mkdtemp()), os.geteuid()
    folder.chmod(0o555)
    try:
        os.seteuid(65534 if user == 0 else user)
        for name in (folder, folder / "new"):
            with pytest.raises(OutputError, match="Permission denied"):
                OutputFolder(name)
    finally:
        os.seteuid(user)
    folder.rmdir()


def test_a_folder_has_one_writer(tmp_path):
    """The lock of a dead process is taken over; a folder without results is created or accepted."""
    folder = tmp_path / "a" / "b"
    folder.mkdir(parents=True)
    (folder / LOCK_NAME).write_text("1\n")  # left by a process that does not hold it
    (folder / "notes.txt").write_text("mine")
    with closing(OutputFolder(folder)), closing(OutputFolder(tmp_path / "new" / "er")):
        assert (folder / LOCK_NAME).read_text().strip() == str(os.getpid())
        with pytest.raises(OutputError, match=f"process {os.getpid()} is writing"):
            OutputFolder(folder, overwrite=True)
    assert names(folder) == ["notes.txt"] and names(tmp_path / "new" / "er") == []
