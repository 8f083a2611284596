from __future__ import annotations

import os
import threading
import time
from collections.abc import Callable, Iterator
from pathlib import Path

import numpy as np
import pytest


@pytest.fixture(scope="session")
def moving_frames(simulated: Callable[..., Path]) -> np.ndarray:
    """(300, 64, 12) packed frames of a camera that pans by 30 px."""
    return np.load(simulated(n_frames=300, frame_shape=[64, 96], path={"kind": "pan", "length_px": 30}, flux=0.5))


@pytest.fixture
def pipe_on_stdin(monkeypatch: pytest.MonkeyPatch) -> Iterator[Callable[..., None]]:
    """Let a thread write to what a run takes for standard input, and then close it."""
    threads: list[threading.Thread] = []
    reading, writing = os.pipe()
    monkeypatch.setattr("photonpano.pipeline.following.follow._standard_input", lambda: reading)

    def begin(data: bytes, pieces: int = 1, seconds: float = 0.0) -> None:
        def write() -> None:
            size = -(-len(data) // pieces) or 1
            for start in range(0, len(data), size):
                os.write(writing, data[start : start + size])
                time.sleep(seconds / pieces)
            os.close(writing)

        threads.append(threading.Thread(target=write))
        threads[0].start()

    yield begin
    threads[0].join()
    os.close(reading)
