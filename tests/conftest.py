"""What several test files use, and what makes the tests fast: most of their time is compiling."""

from pathlib import Path

import pytest
from command import BEAM, write
from long import LONG, is_long
from taichi._lib import core

from taisoft import runtime

SHARED = Path(__file__).resolve().parents[1].parent / "shared"
SLOW = (
    "references", "demos", "contact_stepping", "stepping", "cli_run", "bench_collision", "bvh", "simulator", "self_collision",
    "checkpoint", "static", "spatial_hash", "elasticity", "detection_runs",
)  # files by time, slowest first
_compiled = [0.0]  # compile clock when Taichi was last set back [s]


def pytest_addoption(parser: pytest.Parser) -> None:
    parser.addoption("--long", action="store_true", help="also the variations and long runs listed in tests/long.py")


def pytest_collection_modifyitems(config: pytest.Config, items: list[pytest.Item]) -> None:
    """Without the long ones. Slow files first, so that processes that share the files end at about the same time."""
    long = [item for item in items if is_long(item.nodeid)]
    if config.getoption("--long"):
        if config.args == [str(config.rootpath / path) for path in config.getini("testpaths")] or config.args == ["tests"]:
            _refuse_parts_of_nothing([item.nodeid for item in long])
    elif not (len(long) == len(items) and any("::" in name for name in config.args)):  # what is named one by one is meant
        items[:] = [item for item in items if not is_long(item.nodeid)]
        config.hook.pytest_deselected(items=long)
    no_gpu = pytest.mark.skip(reason="this machine has no NVIDIA GPU")
    for item in items:
        if item.get_closest_marker("cuda") and not core.with_cuda():
            item.add_marker(no_gpu)
    places = {f"test_{name}": k for k, name in enumerate(SLOW)}
    items.sort(key=lambda item: places.get(item.path.stem, len(SLOW)))


def _refuse_parts_of_nothing(names: list[str]) -> None:
    for file, parts in LONG.items():
        for part in parts:
            if not any(f"/{file}.py::" in name and part in name for name in names):
                raise pytest.UsageError(f"tests/long.py: no test of {file} has '{part}' in its name")


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
