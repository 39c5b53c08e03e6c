"""Matrix operations on one thread, as in every fit."""

from __future__ import annotations

from collections.abc import Iterator

import pytest

from studies.threads import serial_blas


@pytest.fixture(scope="package", autouse=True)
def one_thread() -> Iterator[None]:
    """Of many small matrices each would wake, and wait for, threads of other tests' processors."""
    with serial_blas():
        yield
