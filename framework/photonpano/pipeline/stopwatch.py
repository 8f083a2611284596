"""Time spent in stages that interleave and run in several threads."""

from __future__ import annotations

import threading
import time
from contextlib import contextmanager
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from collections.abc import Iterator


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
