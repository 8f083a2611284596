"""Compare results bit by bit, and run the same work in several threads at once."""

from __future__ import annotations

import dataclasses
import hashlib
import pickle
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
    """Return a value that is equal for results with the same bytes; unlike `==`, also for NaN.

    Arrays become hashes: pytest would compare megabytes letter by letter to explain how they differ.
    """
    if isinstance(value, np.ndarray):
        return value.dtype.str, value.shape, hashlib.sha256(value.tobytes()).hexdigest()
    if dataclasses.is_dataclass(value) and not isinstance(value, type):
        fields = [fingerprint(getattr(value, field.name)) for field in dataclasses.fields(value)]
        return type(value).__name__, *fields
    if isinstance(value, Mapping):
        return tuple((key, fingerprint(item)) for key, item in value.items())
    if isinstance(value, list | tuple):
        return tuple(fingerprint(item) for item in value)
    return repr(value)


@contextmanager
def global_seed(seed: int) -> Iterator[None]:
    """Seed numpy's global generator, on which no component may depend, within a block."""
    before = get_bit_generator()
    set_bit_generator(np.random.MT19937(seed))
    try:
        yield
    finally:
        set_bit_generator(before)


def in_threads(work: Callable[[int], T]) -> list[T]:
    """Call `work(number)` in `THREADS` threads that start together, and return all results."""
    together = Barrier(THREADS)

    def start(number: int) -> T:
        together.wait()
        return work(number)

    with ThreadPoolExecutor(THREADS) as pool:
        return list(pool.map(start, range(THREADS)))


def copied(value: T, what: str) -> T:
    """Return a copy as another process would get it; fail with a message if it cannot travel there."""
    try:
        copy: T = pickle.loads(pickle.dumps(value))
    except Exception as error:
        raise AssertionError(
            f"{what} must survive pickling, so that other processes can use it; keep functions and classes at the top of a "
            f"module, and drop locks and open files in __getstate__ ({type(error).__name__}: {error})"
        ) from error
    return copy
