"""Threads: how many a run uses, results in order, libraries kept to one thread, and time spent in stages."""

from __future__ import annotations

import os
import threading
import time
from collections import deque
from concurrent.futures import ThreadPoolExecutor
from contextlib import contextmanager
from typing import TYPE_CHECKING, Literal, TypeVar

from threadpoolctl import threadpool_limits

if TYPE_CHECKING:
    from collections.abc import Callable, Iterable, Iterator
    from concurrent.futures import Future

ItemT = TypeVar("ItemT")
ResultT = TypeVar("ResultT")


def thread_count(threads: int | Literal["auto"]) -> int:
    """Return how many threads a run uses; `auto` is one for each core that the process may run on."""
    if threads != "auto":
        return threads
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


class Stopwatch:
    """Adds up seconds by stage. What runs in a pool counts for its share of the pool, so that stages add up to the whole."""

    def __init__(self, threads: int) -> None:
        self._threads = threads
        self._lock = threading.Lock()
        self._caller = threading.get_ident()
        self.seconds: dict[str, float] = {}

    @contextmanager
    def __call__(self, stage: str) -> Iterator[None]:
        """Add the time of the block to a stage."""
        start = time.perf_counter()
        try:
            yield
        finally:
            share = 1 if threading.get_ident() == self._caller else self._threads
            elapsed = (time.perf_counter() - start) / share
            with self._lock:
                self.seconds[stage] = self.seconds.get(stage, 0.0) + elapsed
