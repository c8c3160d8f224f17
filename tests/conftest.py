"""What several test files use, and what makes the tests fast: most of their time is compiling."""

from collections.abc import Iterator
from pathlib import Path

import pytest
from taichi._lib import core

from taisoft import compile_message
from taisoft.backend import runtime
from tests.cli.command import BEAM, write
from tests.long import LONG, is_long

SHARED = Path(__file__).resolve().parents[1].parent / "shared"
SLOW = (
    "references",
    "demos",
    "contact_stepping",
    "stepping",
    "cli_run",
    "bench_collision",
    "bvh",
    "simulator",
    "self_collision",
    "checkpoint",
    "static",
    "spatial_hash",
    "elasticity",
    "detection_runs",
)  # files by time, slowest first
WRITE_AFTER = 10.0  # [s] of compiling after which kernels are worth writing for the other processes that share the files
_compiled = [0.0, None]  # compile clock when Taichi was last set back [s]; the file of the last test


def pytest_addoption(parser: pytest.Parser) -> None:
    parser.addoption("--long", action="store_true", help="also the variations and long runs listed in tests/long.py")


def pytest_collection_modifyitems(config: pytest.Config, items: list[pytest.Item]) -> None:
    """Without the long ones. Slow files first, so that processes that share the files end at about the same time."""
    long = [item for item in items if is_long(item.nodeid) or item.get_closest_marker("long")]
    if config.args == [str(config.rootpath / path) for path in config.getini("testpaths")] or config.args == ["tests"]:
        _refuse_parts_of_nothing(items)
    named = len(long) == len(items) and any("::" in name for name in config.args)  # what is named one by one is meant
    if not (named or config.getoption("--long")):
        items[:] = [item for item in items if item not in long]
        config.hook.pytest_deselected(items=long)
    no_gpu = pytest.mark.skip(reason="this machine has no NVIDIA GPU")
    for item in items:
        if item.get_closest_marker("cuda") and not core.with_cuda():
            item.add_marker(no_gpu)
    places = {f"test_{name}": k for k, name in enumerate(SLOW)}
    # by precision within a file: another one makes Taichi forget all kernels
    items.sort(key=lambda item: (places.get(item.path.stem, len(SLOW)), str(item.path), "f64" in item.name))


def _refuse_parts_of_nothing(items: list[pytest.Item]) -> None:
    names = [item.nodeid for item in items]
    for file in LONG:
        if not (Path(__file__).parent / f"{file}.py").is_file():
            raise pytest.UsageError(f"tests/long.py: there is no {file}.py")
    collected = {item.nodeid.partition("::")[0].removeprefix("tests/").removesuffix(".py") for item in items}  # absent libraries
    for file, parts in LONG.items():
        for part in parts if file in collected else ():
            if not any(f"/{file}.py::" in name and part in name for name in names):
                raise pytest.UsageError(f"tests/long.py: no test of {file} has '{part}' in its name")


@pytest.hookimpl(tryfirst=True)
def pytest_runtest_setup(item: pytest.Item) -> None:
    """Let the first simulator of a file initialise Taichi anew where the files before compiled for long.

    Taichi writes kernels to the cache on disk when it ends, and looks for those of other processes when it starts.
    """
    is_new, _compiled[1] = item.path != _compiled[1], item.path
    if is_new and runtime.open_kind() is None and runtime.compile_clock() > _compiled[0] + WRITE_AFTER:
        runtime._kind = None
        _compiled[0] = runtime.compile_clock()


@pytest.fixture(scope="session", autouse=True)
def no_compile_messages() -> Iterator[None]:
    """What a test reads on stderr does not depend on which kernels are in the cache."""
    with compile_message.silenced():
        yield


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
