"""Threads: how many a run uses, and how those of the libraries are kept from fighting with them."""

from __future__ import annotations

import os
from collections import deque
from concurrent.futures import ThreadPoolExecutor
from contextlib import contextmanager
from typing import TYPE_CHECKING, TypeVar

from threadpoolctl import threadpool_limits

if TYPE_CHECKING:
    from collections.abc import Callable, Iterable, Iterator
    from concurrent.futures import Future

    from photonpano.spec.settings import RunSettings

ItemT = TypeVar("ItemT")
ResultT = TypeVar("ResultT")


def thread_count(settings: RunSettings) -> int:
    """Return how many threads a run uses; `auto` is one for each core that the process may run on."""
    if settings.threads != "auto":
        return settings.threads
    return len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count() or 1


def in_order(work: Callable[[ItemT], ResultT], items: Iterable[ItemT], threads: int) -> Iterator[ResultT]:
    """Yield the results of `work` in the order of the items, while as many more as there are threads are being made.

    Unlike `Executor.map`, it never has more than these in memory.
    """
    due: deque[Future[ResultT]] = deque()
    with ThreadPoolExecutor(threads, thread_name_prefix="in-order") as pool:
        for item in items:
            due.append(pool.submit(work, item))
            if len(due) > threads:
                yield due.popleft().result()
        while due:
            yield due.popleft().result()


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
