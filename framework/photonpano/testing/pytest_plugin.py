"""Plugin of pytest: failed checks of the kit show the compared values.

Every pytest imports this module where photonpano is installed, so it imports pytest only.
"""

from __future__ import annotations

from typing import TYPE_CHECKING

import pytest

if TYPE_CHECKING:
    from collections.abc import Iterator

for _name in ("conformance", "sources", "images", "locators", "motions", "executors"):
    pytest.register_assert_rewrite(f"photonpano.testing.{_name}")


@pytest.fixture(scope="class")
def photonpano_one_thread_inside() -> Iterator[None]:
    """Keep OpenCV and BLAS from starting threads of their own, as a run does."""
    from photonpano.execution.threads import one_thread_inside

    with one_thread_inside():
        yield
