"""Output files are complete or absent, and an output folder has one writer:

* a file appears under its name when it is complete, or not at all, whatever fails: writing, fsync, rename, a full disk;
* an older file stays until its successor is complete, and no temporary file is left;
* an output folder is created, or accepted if it holds no results; one that cannot be written is refused;
* a second writer is refused with the first one's process id; the lock of a dead process is taken over.
"""

import errno
import os
import resource
import signal
import subprocess
import sys
import tempfile
from pathlib import Path

import pytest

from taisoft.errors import OutputError
from taisoft.files import replacing, write_bytes
from taisoft.output.files import LOCK_NAME, OutputFolder, make_folder

ROOT = Path(__file__).resolve().parents[2]


def names(folder):
    return sorted(path.name for path in folder.iterdir())


@pytest.fixture
def small_disk():
    """Limits files to 50,000 bytes, as a full disk would (Python ignores the signal of that limit)."""
    soft, hard = resource.getrlimit(resource.RLIMIT_FSIZE)
    resource.setrlimit(resource.RLIMIT_FSIZE, (50_000, hard))
    yield 50_000
    resource.setrlimit(resource.RLIMIT_FSIZE, (soft, hard))


def test_writing_replaces_a_file_and_leaves_no_other(tmp_path):
    write_bytes(tmp_path / "a.bin", b"first")
    write_bytes(tmp_path / "a.bin", b"second")
    assert (tmp_path / "a.bin").read_bytes() == b"second"
    assert names(tmp_path) == ["a.bin"]


def test_a_full_disk_keeps_the_old_file(tmp_path, small_disk):
    write_bytes(tmp_path / "a.bin", b"old")
    with pytest.raises(OutputError, match=r"a\.bin \(60000 bytes\): File too large"):
        write_bytes(tmp_path / "a.bin", b"x" * 60_000)
    with pytest.raises(OutputError, match=r"b\.bin \(60000 bytes\)"):
        write_bytes(tmp_path / "b.bin", b"x" * 60_000)
    assert names(tmp_path) == ["a.bin"]
    assert (tmp_path / "a.bin").read_bytes() == b"old"


@pytest.mark.parametrize("call", ["fsync", "replace"])
def test_an_input_output_error_keeps_the_old_file(tmp_path, monkeypatch, call):
    write_bytes(tmp_path / "a.bin", b"old")

    def fail(*_):
        raise OSError(errno.EIO, os.strerror(errno.EIO))

    monkeypatch.setattr(os, call, fail)
    with pytest.raises(OutputError, match=r"a\.bin \(3 bytes\): Input/output error"):
        write_bytes(tmp_path / "a.bin", b"new")
    monkeypatch.undo()
    assert names(tmp_path) == ["a.bin"]
    assert (tmp_path / "a.bin").read_bytes() == b"old"


def test_a_failure_while_writing_leaves_nothing(tmp_path):
    with pytest.raises(KeyboardInterrupt), replacing(tmp_path / "a.bin") as part:
        part.write_bytes(b"half")
        raise KeyboardInterrupt
    assert names(tmp_path) == []


def test_data_are_on_disk_before_the_rename(tmp_path, monkeypatch):
    """And the new name after it: fsync, rename, fsync of the folder."""
    calls = []
    fsync, replace = os.fsync, os.replace

    def watched_fsync(descriptor):
        calls.append("folder" if os.path.isdir(f"/proc/self/fd/{descriptor}") else "file")
        fsync(descriptor)

    def watched_replace(source, target):
        calls.append("rename")
        replace(source, target)

    monkeypatch.setattr(os, "fsync", watched_fsync)
    monkeypatch.setattr(os, "replace", watched_replace)
    write_bytes(tmp_path / "a.bin", b"data")
    assert "file" in calls[: calls.index("rename")]
    assert calls[calls.index("rename") + 1 :] == ["folder"]


def test_a_folder_is_created_and_unlocked(tmp_path):
    with OutputFolder(tmp_path / "a" / "b") as folder:
        assert (folder.path / LOCK_NAME).read_text().strip() == str(os.getpid())
    assert names(tmp_path / "a" / "b") == []


def test_a_folder_without_results_is_accepted(tmp_path):
    (tmp_path / "notes.txt").write_text("mine")
    (tmp_path / "frames").mkdir()
    OutputFolder(tmp_path).close()
    assert names(tmp_path) == ["frames", "notes.txt"]


@pytest.mark.parametrize("result", ["report.json", "steps.csv", "scene.usdc", "frames/00000.png", "chunks/points_00000.usdc"])
def test_a_folder_with_results_is_refused(tmp_path, result):
    (tmp_path / result).parent.mkdir(exist_ok=True)
    (tmp_path / result).write_text("old")
    with pytest.raises(OutputError, match="already holds results"):
        OutputFolder(tmp_path)
    assert (tmp_path / result).read_text() == "old"
    assert not (tmp_path / LOCK_NAME).exists()
    OutputFolder(tmp_path, overwrite=True).close()


def test_overwriting_removes_old_results_only(tmp_path):
    (tmp_path / "frames").mkdir()
    (tmp_path / "chunks").mkdir()
    kept = ("notes.txt", "report.json.2026-11-22.bak", "frames/mine.png")
    removed = ("frames/00007.png", "scene.usdc.1-0.part")
    removed += ("chunks/points_00000.usdc.123-7.part", "chunks/points_00010.usdc.123-8.jtZrXE")  # USD's own
    for name in ("report.json", "scene.usdc", *kept, *removed):
        (tmp_path / name).write_text("old")
    with OutputFolder(tmp_path, overwrite=True):
        assert names(tmp_path / "frames") == ["mine.png"] and names(tmp_path / "chunks") == []
        assert (tmp_path / "scene.usdc").read_text() == "old"  # until its successor is complete
        write_bytes(tmp_path / "report.json", b"new")
        write_bytes(tmp_path / "report.json", b"newer")
    assert names(tmp_path) == ["chunks", "frames", "notes.txt", "report.json", "report.json.2026-11-22.bak"]
    assert (tmp_path / "report.json").read_text() == "newer"


def test_a_failed_overwrite_keeps_the_old_files(tmp_path):
    (tmp_path / "scene.usdc").write_text("old")
    with pytest.raises(RuntimeError), OutputFolder(tmp_path, overwrite=True):
        raise RuntimeError("the run broke down")
    assert names(tmp_path) == ["scene.usdc"]


def test_a_folder_that_is_a_file_is_refused(tmp_path):
    (tmp_path / "out").write_text("mine")
    with pytest.raises(OutputError, match="a file has that name"):
        OutputFolder(tmp_path / "out")
    with pytest.raises(OutputError, match="cannot create the folder"):
        OutputFolder(tmp_path / "out" / "deeper")
    with pytest.raises(OutputError, match="a file has that name"):
        make_folder(tmp_path / "out")
    assert (tmp_path / "out").read_text() == "mine"


def test_a_folder_with_the_name_of_a_result_is_refused(tmp_path):
    (tmp_path / "scene.usdc").mkdir()
    with pytest.raises(OutputError, match=r"scene\.usdc: a folder has that name"):
        OutputFolder(tmp_path, overwrite=True)


def test_a_folder_without_write_permission_is_refused():
    """Run as an ordinary user, since the superuser may write anywhere."""
    folder = Path(tempfile.mkdtemp())
    code = """
import os, sys
from taisoft.errors import OutputError
from taisoft.output.files import OutputFolder
import fcntl
if os.geteuid() == 0:
    os.setuid(65534)
for name in (sys.argv[1], sys.argv[1] + "/new"):
    try:
        OutputFolder(name)
        print("accepted")
    except OutputError as error:
        print(error)
"""
    try:
        folder.chmod(0o555)
        child = run_python(code, str(folder))
        assert child.stdout.count("Permission denied") == 2, child.stdout + child.stderr
        assert names(folder) == []
    finally:
        folder.chmod(0o755)
        folder.rmdir()


def run_python(code, *arguments):
    return subprocess.run(
        [sys.executable, "-c", code, *arguments], cwd=ROOT, capture_output=True, text=True, timeout=60, check=False
    )


def test_a_second_writer_is_refused_until_the_first_is_dead(tmp_path):
    code = """
import sys, time
from taisoft.output.files import OutputFolder
folder = OutputFolder(sys.argv[1])
print("locked", flush=True)
time.sleep(60)
"""
    holder = subprocess.Popen([sys.executable, "-c", code, str(tmp_path)], cwd=ROOT, stdout=subprocess.PIPE, text=True)
    try:
        assert holder.stdout.readline() == "locked\n"
        with pytest.raises(OutputError, match=f"process {holder.pid} is writing"):
            OutputFolder(tmp_path, overwrite=True)
    finally:
        holder.send_signal(signal.SIGKILL)
        holder.communicate()
    assert (tmp_path / LOCK_NAME).exists()  # left by the dead process
    with OutputFolder(tmp_path):
        assert (tmp_path / LOCK_NAME).read_text().strip() == str(os.getpid())
        with pytest.raises(OutputError, match=f"process {os.getpid()} is writing"):
            OutputFolder(tmp_path)
    assert names(tmp_path) == []
