"""Fixtures of tests of laws."""

import pytest

from taisoft.fem.laws.evaluate import double_precision
from taisoft.scene.laws import LAWS


@pytest.fixture
def kernels():
    """One runtime for all evaluations of a test."""
    with double_precision():
        yield


@pytest.fixture
def known_laws():
    """Forget the laws that a test has registered."""
    before = dict(LAWS)
    yield
    LAWS.clear()
    LAWS.update(before)
