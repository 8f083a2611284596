"""Threads and compiled code."""

import importlib.util
import os
import threading
import time
from collections.abc import Callable, Iterator
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path

import cv2
import numba
import numpy as np
import pytest
from threadpoolctl import threadpool_info, threadpool_limits

from photonpano.compiling import notify_on_first_compile
from photonpano.errors import described
from photonpano.execution.threads import Stopwatch, in_order, one_thread_inside, thread_count


def test_thread_count_auto_is_the_number_of_usable_cores(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(os, "sched_getaffinity", lambda _: {0, 2, 5}, raising=False)
    assert thread_count("auto") == 3
    assert thread_count(7) == 7


@pytest.fixture
def two_threads() -> Iterator[None]:
    before = cv2.getNumThreads()
    cv2.setNumThreads(2)
    with threadpool_limits(2):
        yield
    cv2.setNumThreads(before)


def threads_of_libraries() -> list[int]:
    return [cv2.getNumThreads(), *(library["num_threads"] for library in threadpool_info())]


def look_inside_and_fail() -> None:
    with one_thread_inside():
        assert set(threads_of_libraries()) == {1}
        raise ValueError("half-way")


@pytest.mark.usefixtures("two_threads")
def test_one_thread_inside_limits_libraries_and_restores_them() -> None:
    before = threads_of_libraries()
    with pytest.raises(ValueError, match="half-way"):
        look_inside_and_fail()
    assert threads_of_libraries() == before


def test_stopwatch_adds_up_by_stage(monkeypatch: pytest.MonkeyPatch) -> None:
    now = iter([0.0, 1.5, 10.0, 10.25, 20.0, 22.0])
    monkeypatch.setattr(time, "perf_counter", lambda: next(now))
    clock = Stopwatch(2)
    for stage in ("merge", "merge", "locate"):
        with clock(stage):
            pass
    assert clock.seconds == {"merge": 1.75, "locate": 2.0}


def test_stopwatch_divides_time_in_a_pool_by_its_threads() -> None:
    """Two threads that are busy for the same 0.1 s count as 0.1 s."""
    clock, together = Stopwatch(2), threading.Barrier(2)

    def work() -> None:
        with clock("merge"):
            together.wait()
            time.sleep(0.1)
            together.wait()

    with ThreadPoolExecutor(2) as pool:
        for future in [pool.submit(work), pool.submit(work)]:
            future.result()
    assert 0.1 <= clock.seconds["merge"] < 0.19


def test_stopwatch_counts_blocks_that_raise() -> None:
    clock = Stopwatch(1)
    with pytest.raises(ValueError, match="half-way"), clock("merge"):
        raise ValueError("half-way")
    assert set(clock.seconds) == {"merge"}


def test_in_order_yields_in_order_and_holds_few_results() -> None:
    made: list[int] = []

    def work(item: int) -> int:
        time.sleep(0.01 if item % 3 == 0 else 0)
        made.append(item)
        return -item

    ahead = []
    for taken, result in enumerate(in_order(work, iter(range(30)), threads=3)):
        assert result == -taken
        ahead.append(len(made) - taken)
    assert len(made) == 30
    assert max(ahead) <= 4


def test_in_order_raises_an_error_in_its_turn() -> None:
    results = in_order(lambda item: 1 / (3 - item), range(9), threads=2)
    assert [next(results) for _ in range(3)] == [1 / 3, 1 / 2, 1]
    with pytest.raises(ZeroDivisionError):
        next(results)


class Mute(BaseException):
    def __str__(self) -> str:
        raise RuntimeError("no words")


@pytest.mark.parametrize(
    ("error", "text"),
    [
        (ValueError("too dark"), "ValueError: too dark"),
        (SystemExit(), "SystemExit"),
        (Mute(), "Mute: (its message cannot be written)"),
    ],
)
def test_described_exception_has_type_and_message(error: BaseException, text: str) -> None:
    assert described(error) == text


SOURCE = """\
from photonpano.compiling import compiled

@compiled
def total(values):
    sum = 0.0
    for value in values:
        sum += value
    return sum
"""


def test_notify_on_first_compile_calls_once_per_block_and_only_if_something_is_compiled() -> None:
    @numba.njit
    def twice(values: np.ndarray) -> np.ndarray:
        return values * 2

    notes: list[str] = []
    with notify_on_first_compile(lambda: notes.append("compiling")):
        twice(np.ones(2))
        twice(np.ones(2, dtype=np.float32))
        assert notes == ["compiling"]
    with notify_on_first_compile(lambda: notes.append("again")):
        assert twice(np.ones(2)).tolist() == [2, 2]
    twice(np.ones(2, dtype=np.int64))
    assert notes == ["compiling"]


@pytest.fixture
def compiles(tmp_path: Path) -> Callable[[], bool]:
    """Load a module anew, as a further process does, call its function, and return whether that was compiled."""
    path = tmp_path / "loops.py"
    path.write_text(SOURCE)

    def compiles() -> bool:
        spec = importlib.util.spec_from_file_location("loops", path)
        module = importlib.util.module_from_spec(spec)
        spec.loader.exec_module(module)
        notes: list[str] = []
        with notify_on_first_compile(lambda: notes.append("compiling")):
            assert module.total(np.arange(5.0)) == 10
        return bool(notes)

    return compiles


def test_machine_code_is_kept_for_the_next_process(compiles: Callable[[], bool]) -> None:
    assert [compiles(), compiles()] == [True, False]


def test_function_is_compiled_anew_where_machine_code_cannot_be_kept(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, compiles: Callable[[], bool]
) -> None:
    """Neither beside the module nor in a home."""
    (tmp_path / "__pycache__").touch()
    for name in ("HOME", "XDG_CACHE_HOME"):
        monkeypatch.setenv(name, os.devnull)
    assert [compiles(), compiles()] == [True, True]
