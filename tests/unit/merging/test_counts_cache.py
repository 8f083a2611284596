"""The cache of sums."""

from __future__ import annotations

from concurrent.futures import ThreadPoolExecutor
from threading import Barrier

import numpy as np
import pytest

from photonpano import FrameSpan, InputError
from photonpano.merging import CountsCache


@pytest.fixture
def counted(memory_source: type) -> tuple[object, list[FrameSpan]]:
    """A source of 20 frames, and the spans that it summed."""
    source = memory_source(np.random.default_rng(0).random((20, 4, 6)) < 0.5)
    summed: list[FrameSpan] = []
    sums = source.counts

    def counts(span: FrameSpan) -> np.ndarray:
        summed.append(span)
        if span.start == 7:
            raise InputError("a damaged block")
        return sums(span)

    source.counts = counts
    return source, summed


def test_counts_cache_computes_each_sum_once(counted: tuple) -> None:
    source, summed = counted
    shared = CountsCache(source, 1000)
    first = shared(FrameSpan(0, 5))
    assert shared(FrameSpan(0, 5)) is first
    assert summed == [FrameSpan(0, 5)]
    np.testing.assert_array_equal(first, source.frames(FrameSpan(0, 5)).sum(axis=0))
    assert not first.flags.writeable


def test_counts_cache_drops_least_recently_used_sum(counted: tuple) -> None:
    source, summed = counted
    shared = CountsCache(source, 2 * 4 * 6 * 4)
    for start in (0, 1, 0, 2, 0, 1):
        shared(FrameSpan(start, start + 3))
    assert [span.start for span in summed] == [0, 1, 2, 1]


def test_counts_cache_computes_sum_once_for_concurrent_threads(counted: tuple) -> None:
    source, summed = counted
    shared, together = CountsCache(source, 1000), Barrier(4)

    def ask(_: int) -> np.ndarray:
        together.wait()
        return shared(FrameSpan(0, 20))

    with ThreadPoolExecutor(4) as pool:
        found = list(pool.map(ask, range(4)))
    assert len(summed) == 1
    assert all(each is found[0] for each in found)


def test_counts_cache_raises_source_error_on_each_call(counted: tuple) -> None:
    shared = CountsCache(counted[0], 1000)
    for _ in range(2):
        with pytest.raises(InputError, match="a damaged block"):
            shared(FrameSpan(7, 9))
