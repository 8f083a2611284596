"""Threads and compiled code."""

import importlib.util
import os
import time
from collections.abc import Callable, Iterator
from pathlib import Path

import cv2
import numba
import numpy as np
import pytest
from threadpoolctl import threadpool_info, threadpool_limits

from photonpano.compiling import notify_on_first_compile
from photonpano.execution.threads import in_order, one_thread_inside


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
