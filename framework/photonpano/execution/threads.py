"""Threads: how many a run uses, results in order, libraries kept to one thread, and time spent in stages."""

from __future__ import annotations

import os
import threading
import time
from collections import deque
from collections.abc import Callable, Iterable, Iterator, Mapping
from concurrent.futures import Future, ThreadPoolExecutor
from contextlib import contextmanager, nullcontext
from itertools import islice
from typing import Any, Literal, TypeVar

from threadpoolctl import threadpool_limits

ItemT = TypeVar("ItemT")
ResultT = TypeVar("ResultT")
# Calls a function with each item, several at once, and yields the results in order
InOrder = Callable[[Callable[[Any], Any], Iterable[Any]], Iterator[Any]]


def thread_count(threads: int | Literal["auto"]) -> int:
    """Return how many threads a run uses; `auto` is one for each core that the process may run on."""
    if threads != "auto":
        return threads
    return len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count() or 1


@contextmanager
def thread_pool(threads: int) -> Iterator[ThreadPoolExecutor]:
    """Open a pool of threads. If the block ends early, work that has not started is cancelled."""
    pool = ThreadPoolExecutor(threads)
    try:
        yield pool
    finally:
        pool.shutdown(cancel_futures=True)


def in_order(
    work: Callable[[ItemT], ResultT], items: Iterable[ItemT], threads: int, pool: ThreadPoolExecutor | None = None
) -> Iterator[ResultT]:
    """Yield the results of `work` in the order of the items; `threads` items are worked on ahead, in a pool.

    Unlike `Executor.map`, it holds at most one result for each thread beside the one that it yields. Items are drawn in the
    thread of the caller.
    """
    with nullcontext(pool) if pool else thread_pool(threads) as executor:
        submitted = (executor.submit(work, item) for item in items)
        # `map` keeps no reference to a result once it is yielded.
        yield from map(Future.result, lagging(submitted, threads))


def lagging(items: Iterable[ItemT], by: int) -> Iterator[ItemT]:
    """Yield the items, each as soon as `by` later ones were drawn."""
    held: deque[ItemT] = deque()
    for item in items:
        held.append(item)
        if len(held) > by:
            yield held.popleft()
    while held:
        yield held.popleft()


def batched(items: Iterable[ItemT], size: int) -> Iterator[tuple[ItemT, ...]]:
    """Yield the items in tuples of a size; the last may be shorter. As `itertools.batched` of Python 3.12."""
    left = iter(items)
    while batch := tuple(islice(left, size)):
        yield batch


class Guard:
    """A lock for a `with` block. With what it guards, it may be pickled: there it is a new one."""

    def __init__(self) -> None:
        self._lock = threading.Lock()

    def __enter__(self) -> None:
        self._lock.acquire()

    def __exit__(self, *error: object) -> None:
        self._lock.release()

    def __reduce__(self) -> tuple[type[Guard], tuple[()]]:
        return Guard, ()


@contextmanager
def one_thread_inside() -> Iterator[None]:
    """Keep OpenCV and BLAS from starting threads of their own, which would compete with ours for the cores."""
    import cv2

    before = cv2.getNumThreads()
    cv2.setNumThreads(1)
    try:
        with threadpool_limits(1):
            yield
    finally:
        cv2.setNumThreads(before)


class Stopwatch:
    """Adds up seconds by stage.

    Time in a thread of a pool is divided by the number of threads, so that the stages of a level add up to its duration.
    """

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
            self.add({stage: time.perf_counter() - start})

    def add(self, seconds: Mapping[str, float]) -> None:
        """Add seconds, by stage, that were spent for the calling thread."""
        share = 1 if threading.get_ident() == self._caller else self._threads
        with self._lock:
            for stage, spent in seconds.items():
                self.seconds[stage] = self.seconds.get(stage, 0.0) + spent / share

    def __reduce__(self) -> tuple[type[Stopwatch], tuple[int]]:
        """Start anew where it travels to."""
        return Stopwatch, (self._threads,)
