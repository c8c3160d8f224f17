"""One runtime for this folder, so that kernels are compiled once."""

from collections.abc import Iterator

import pytest

from taisoft.backend.runtime import Runtime
from tests.backend.lanes import opened


@pytest.fixture(scope="package", autouse=True)
def double_precision() -> Iterator[Runtime]:
    with opened("f64") as runtime:
        yield runtime
