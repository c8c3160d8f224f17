"""What all folders share, and what makes the tests fast: most of their time is compiling kernels.

A kernel is compiled for a structure and a precision, and a process keeps those of one precision only. So the folders lie in an
order by precision, and processes take files from both ends of it: one of two processes hardly compiles what the other one does.
Without --long, kernels are compiled without Taichi's advanced optimisation: that takes a quarter less, and the code, up to five
times as slow, computes the same bits.

A test marked `gpu_path` runs twice, the second time on the GPU path; of one marked `gpu_path("bdf2")` only variants with this in
their names do. What it shares with other tests must take the fixture `taken_path`, so that there is one on each path.
"""

import os
from collections.abc import Iterator
from contextlib import nullcontext
from pathlib import Path

import pytest
from taichi._lib import core

from taisoft import compile_message
from taisoft.backend.paths import gpu_path
from tests.cli.command import BEAM, write

SHARED = Path(__file__).resolve().parents[1].parent / "shared"
# f64 first, f32 last, between them folders that hardly compile; those that take longest at both ends
FOLDERS = (
    *("references", "dynamics", "fem", "contact", "collision", "linear", "simulator", "estimation"),
    *("structure", "scene", "mesh", "backend"),
    *("output", "study", "many", "view", "faults", "cli", "benchmarks", "scenes"),
)

GPU_PATH = "gpu_path"  # marker, and name of the second run
TAKEN = "taken_path"
path: dict[str, str | None] = {TAKEN: None}  # on which that and other fixtures of a module were made


def pytest_addoption(parser: pytest.Parser) -> None:
    parser.addoption("--long", action="store_true", help="also the variations and long runs that are marked long")


def pytest_configure(config: pytest.Config) -> None:
    if not config.getoption("--long"):
        os.environ.setdefault("TI_ADVANCED_OPTIMIZATION", "0")  # read by ti.init, here and in child processes


def pytest_generate_tests(metafunc: pytest.Metafunc) -> None:
    """Run a test marked `gpu_path` twice."""
    if metafunc.definition.get_closest_marker(GPU_PATH):
        metafunc.parametrize(TAKEN, [None, GPU_PATH], ids=["cpu", GPU_PATH], indirect=True)


@pytest.fixture(scope="module", autouse=True)
def taken_path(request: pytest.FixtureRequest) -> Iterator[None]:
    """What is made while this is open takes the GPU path in the second run of a test marked so."""
    path[TAKEN] = getattr(request, "param", None)
    with gpu_path() if path[TAKEN] else nullcontext():
        yield


def pytest_fixture_setup(fixturedef: pytest.FixtureDef, request: pytest.FixtureRequest) -> None:
    """Remember on which path it is made what the tests of a module share."""
    if fixturedef.scope == "module" and fixturedef.argname != TAKEN:
        path[fixturedef.argname] = path[TAKEN]


def pytest_fixture_post_finalizer(fixturedef: pytest.FixtureDef, request: pytest.FixtureRequest) -> None:
    """Forget that."""
    if fixturedef.argname != TAKEN:
        path.pop(fixturedef.argname, None)


def pytest_runtest_call(item: pytest.Item) -> None:
    """Refuse what was made on the other path."""
    others = [name for name in item.fixturenames if path.get(name, path[TAKEN]) != path[TAKEN]]
    assert others == [], f"the fixtures {others} must take `taken_path`"


def pytest_collection_modifyitems(config: pytest.Config, items: list[pytest.Item]) -> None:
    """Leave out the long ones unless all that is asked for is long, skip what needs a GPU, and sort."""
    for item in list(items):
        asked = marker.args if (marker := item.get_closest_marker(GPU_PATH)) else ()
        if asked and item.callspec.params[TAKEN] and not any(text in item.name for text in asked):
            items.remove(item)
    long = [item for item in items if item.get_closest_marker("long")]
    named = len(long) == len(items) and any("::" in name for name in config.args)  # what is named one by one is meant
    if not (named or config.getoption("--long")):
        items[:] = [item for item in items if item not in long]
        config.hook.pytest_deselected(items=long)
    no_gpu = pytest.mark.skip(reason="this machine has no NVIDIA GPU")
    for item in items:
        if item.get_closest_marker("cuda") and not core.with_cuda():
            item.add_marker(no_gpu)
    if not config.pluginmanager.hasplugin("randomly"):
        place = {name: k for k, name in enumerate(FOLDERS)}
        items.sort(key=lambda item: (place.get(item.path.parent.name, len(place)), str(item.path), "f32" in item.name))


@pytest.hookimpl(optionalhook=True)
def pytest_xdist_make_scheduler(config: pytest.Config, log):
    """Whole files to each process; every second one takes them from the end of the list. Only if no other way is asked for."""
    if config.option.dist != "load":
        return None
    from xdist.scheduler import LoadFileScheduling

    class BothEnds(LoadFileScheduling):
        def _assign_work_unit(self, node) -> None:
            if self.nodes.index(node) % 2:
                self.workqueue.move_to_end(next(reversed(self.workqueue)), last=False)
            super()._assign_work_unit(node)

    config.option.loadscopereorder = False  # the order is that of `pytest_collection_modifyitems`
    return BothEnds(config, log)


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
