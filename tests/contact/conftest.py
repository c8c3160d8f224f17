"""One runtime for this folder, so that kernels are compiled once."""

from collections.abc import Iterator

import pytest

from taisoft.backend.runtime import Runtime
from tests.backend.lanes import opened
from tests.contact.contact_rig import Rig


@pytest.fixture(scope="package", autouse=True)
def double_precision() -> Iterator[Runtime]:
    with opened("f64") as runtime:
        yield runtime


@pytest.fixture(scope="package")
def rig(double_precision) -> Iterator[Rig]:
    made = Rig()
    yield made
    made.close()
