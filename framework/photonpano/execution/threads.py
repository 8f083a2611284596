"""Threads and other executors: how many tasks are under way, results in order, libraries kept to one thread, time of stages."""

from __future__ import annotations

import os
import pickle
import time
from collections import deque
from collections.abc import Callable, Iterable, Iterator, Mapping
from concurrent.futures import Executor, Future, ThreadPoolExecutor
from contextlib import contextmanager, nullcontext
from itertools import islice
from typing import Any, Literal, TypeVar

from threadpoolctl import threadpool_limits

from photonpano.errors import PluginError

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
    work: Callable[[ItemT], ResultT], items: Iterable[ItemT], threads: int, pool: Executor | None = None
) -> Iterator[ResultT]:
    """Yield the results of `work` in the order of the items; `threads` items are worked on ahead, in a pool.

    Unlike `Executor.map`, it holds at most one result for each thread beside the one that it yields. Items are drawn in the
    thread of the caller.
    """
    with nullcontext(pool) if pool else thread_pool(threads) as executor:
        under_way = (submitted(executor, work, item) for item in items)
        # `map` keeps no reference to a result once it is yielded.
        yield from map(Future.result, lagging(under_way, threads))


def submitted(executor: Executor, work: Callable[..., ResultT], *given: Any) -> Future[ResultT]:
    """Submit a task to an executor.

    Unless threads work on it, it travels as a pickle: a `PluginError` says here what cannot be sent to another process, and the
    task itself fails where it cannot be opened.
    """
    if isinstance(executor, ThreadPoolExecutor):
        return executor.submit(work, *given)
    try:
        task = pickle.dumps((work, given), pickle.HIGHEST_PROTOCOL)
    except (pickle.PicklingError, AttributeError, TypeError) as error:
        raise PluginError(
            f"a component cannot be sent to other processes: {error}; run it in threads: leave out run.executor"
        ) from error
    return executor.submit(_unpacked, task)


def _unpacked(task: bytes) -> Any:
    work, given = pickle.loads(task)
    return work(*given)


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
    """Adds up seconds by stage."""

    def __init__(self) -> None:
        self.seconds: dict[str, float] = {}

    @contextmanager
    def __call__(self, stage: str) -> Iterator[None]:
        """Add the time of the block to a stage."""
        start = time.perf_counter()
        try:
            yield
        finally:
            self.add({stage: time.perf_counter() - start})

    def add(self, seconds: Mapping[str, float], under_way: int = 1) -> None:
        """Add seconds, by stage; those of tasks are divided by how many are `under_way`, so that all add up to the duration."""
        for stage, spent in seconds.items():
            self.seconds[stage] = self.seconds.get(stage, 0.0) + spent / under_way
