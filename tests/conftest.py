"""What several test files use."""

from pathlib import Path

import pytest
from command import BEAM, write

SHARED = Path(__file__).resolve().parents[1].parent / "shared"


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
