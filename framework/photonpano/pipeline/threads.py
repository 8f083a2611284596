"""Threads: how many a run uses, and how those of the libraries are kept from fighting with them."""

from __future__ import annotations

import os
from contextlib import contextmanager
from typing import TYPE_CHECKING

from threadpoolctl import threadpool_limits

if TYPE_CHECKING:
    from collections.abc import Iterator

    from photonpano.spec.settings import RunSettings


def thread_count(settings: RunSettings) -> int:
    """Return how many threads a run uses; `auto` is one for each core that the process may run on."""
    if settings.threads != "auto":
        return settings.threads
    return len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count() or 1


@contextmanager
def one_thread_inside() -> Iterator[None]:
    """Keep OpenCV and BLAS from starting threads of their own under ours: they would fight for the cores."""
    import cv2

    before = cv2.getNumThreads()
    cv2.setNumThreads(1)
    try:
        with threadpool_limits(1):
            yield
    finally:
        cv2.setNumThreads(before)
