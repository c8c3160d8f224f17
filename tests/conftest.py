"""What several test files use, and what makes the tests fast: most of their time is compiling."""

from pathlib import Path

import pytest
from command import BEAM, write

from taisoft import runtime

SHARED = Path(__file__).resolve().parents[1].parent / "shared"
SLOW = (
    "references", "demos", "contact_stepping", "stepping", "cli_run", "bench_collision", "bvh", "simulator", "self_collision",
    "static", "spatial_hash", "elasticity", "detection_runs",
)  # files by time, slowest first
_compiled = [0.0]  # compile clock when Taichi was last set back [s]


def pytest_collection_modifyitems(items: list[pytest.Item]) -> None:
    """Slow files first, so that processes that share the files end at about the same time."""
    places = {f"test_{name}": k for k, name in enumerate(SLOW)}
    items.sort(key=lambda item: places.get(item.path.stem, len(SLOW)))


@pytest.hookimpl(tryfirst=True)
def pytest_runtest_setup(item: pytest.Item) -> None:
    """Let the next simulator initialise Taichi anew where earlier tests have compiled and hold nothing any more.

    The key of a kernel in the cache on disk holds the running numbers of its fields. Numbers that start anew let a scene
    of an earlier test, process or run be found there, whatever ran before: compiling takes several times as long.
    """
    if getattr(item.module, "KEEPS_TAICHI", False):  # its kernels have no fields
        return
    if runtime.open_kind() is None and runtime.compile_clock() > _compiled[0]:
        runtime._kind = None
        _compiled[0] = runtime.compile_clock()


@pytest.fixture(scope="session")
def shared() -> Path:
    """Folder of reference values, hard cases and meshes beside the repository; without it the test is skipped."""
    if not SHARED.is_dir():
        pytest.skip("the folder of reference data beside the repository is absent")
    return SHARED


@pytest.fixture
def beam(tmp_path) -> Path:
    """A scene file that runs in a moment."""
    return write(tmp_path / "beam.py", BEAM)
