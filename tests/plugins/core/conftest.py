from __future__ import annotations

from collections.abc import Iterator

import pytest
from threadpoolctl import threadpool_limits


@pytest.fixture(autouse=True, scope="session")
def one_thread() -> Iterator[None]:
    """Keep BLAS from starting threads for small matrices, as a run does."""
    with threadpool_limits(1):
        yield
