"""What each stage of a command takes: seconds, CPU seconds of all threads of the process, and bytes read from files."""

from __future__ import annotations

import time
from collections import Counter
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

import numpy as np

from photonpano.api.cli.verbosity import STARTED_S
from photonpano.text import columns, count, share
from photonpano.values import FloatArray

_READ = "rchar: "  # of the process so far, from files and caches, by the count of Linux
START, OTHER, WHOLE = "start", "other", "whole"


class StageCosts:
    """Adds up the costs of stages by their titles; the start is what comes before the first of them."""

    def __init__(self) -> None:
        self._spent: dict[str, FloatArray] = {}
        self._times: Counter[str] = Counter()

    @contextmanager
    def __call__(self, title: str) -> Iterator[None]:
        """Add the cost of the block to a stage."""
        before = _spent()
        self._spent.setdefault(START, before)
        try:
            yield
        finally:
            self._spent[title] = self._spent.get(title, 0.0) + _spent() - before
            self._times[title] += 1

    def table(self) -> str:
        """Return a table of the stages; empty for a single one, whose line says all."""
        if len(self._times) < 2:
            return ""
        whole = _spent()
        other = whole - np.sum(list(self._spent.values()), axis=0)
        rows = [["stage", "seconds", "CPU seconds", "GB read", "share"]]
        for title, (seconds, cpu_s, read) in {**self._spent, OTHER: other, WHOLE: whole}.items():
            times = f" ({count(self._times[title])} times)" if self._times[title] > 1 else ""
            gigabytes = "\N{EN DASH}" if np.isnan(read) else f"{read / 1e9:.2f}"
            rows.append(
                [f"{title}{times}", f"{seconds:7.2f}", f"{cpu_s:11.2f}", f"{gigabytes:>7}", f"{share(seconds / whole[0]):>5}"]
            )
        return columns(rows)


def _spent() -> FloatArray:
    """Return what the process has spent so far: seconds, CPU seconds, and bytes read, NaN where the system does not count."""
    return np.array([time.perf_counter() - STARTED_S, time.process_time(), _bytes_read()])


def _bytes_read() -> float:
    try:
        lines = Path("/proc/self/io").read_text(encoding="ascii").splitlines()
    except OSError:  # not Linux, or not allowed
        return np.nan
    return next((float(line.removeprefix(_READ)) for line in lines if line.startswith(_READ)), np.nan)
