"""Whether two results are the same to the last bit, and the same work done in several threads at once."""

from __future__ import annotations

import dataclasses
from collections.abc import Callable, Iterator, Mapping
from concurrent.futures import ThreadPoolExecutor
from contextlib import contextmanager
from threading import Barrier
from typing import Any, TypeVar

import numpy as np
from numpy.random.mtrand import get_bit_generator, set_bit_generator

T = TypeVar("T")

THREADS = 4


def fingerprint(value: Any) -> object:
    """Return something that is equal for values that hold the same bytes, those that are not numbers included."""
    if isinstance(value, np.ndarray):
        return value.dtype.str, value.shape, value.tobytes()
    if dataclasses.is_dataclass(value) and not isinstance(value, type):
        fields = [fingerprint(getattr(value, field.name)) for field in dataclasses.fields(value)]
        return type(value).__name__, *fields
    if isinstance(value, Mapping):
        return tuple((key, fingerprint(item)) for key, item in value.items())
    if isinstance(value, list | tuple):
        return tuple(fingerprint(item) for item in value)
    return repr(value)


@contextmanager
def global_chance(seed: int) -> Iterator[None]:
    """Seed the generator that all of numpy shares, which no component must depend on, within a block."""
    before = get_bit_generator()
    set_bit_generator(np.random.MT19937(seed))
    try:
        yield
    finally:
        set_bit_generator(before)


def in_threads(work: Callable[[int], T]) -> list[T]:
    """Do some work in several threads that start together, each given its number, and return what each made."""
    together = Barrier(THREADS)

    def start(number: int) -> T:
        together.wait()
        return work(number)

    with ThreadPoolExecutor(THREADS) as pool:
        return list(pool.map(start, range(THREADS)))
