from __future__ import annotations

import errno
import importlib.util
import logging
from collections.abc import Callable
from pathlib import Path
from types import ModuleType

import numba
import numpy as np
import pytest

from photonpano import compiling
from photonpano.compiling import notify_on_first_compile

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
def totals(tmp_path: Path, monkeypatch: pytest.MonkeyPatch, caplog: pytest.LogCaptureFixture) -> Callable[[], str]:
    """Compile a function of a module anew, as a further process does, call it, and return the warnings."""
    (tmp_path / "module").mkdir()
    (tmp_path / "module" / "loops.py").write_text(SOURCE)
    monkeypatch.setattr(compiling.tempfile, "gettempdir", lambda: str(tmp_path))
    number = iter(range(9))

    def load() -> ModuleType:
        spec = importlib.util.spec_from_file_location(f"loops{next(number)}", tmp_path / "module" / "loops.py")
        module = importlib.util.module_from_spec(spec)
        spec.loader.exec_module(module)
        return module

    def totals() -> str:
        caplog.clear()
        compiling._note.cache_clear()
        with caplog.at_level(logging.WARNING):
            assert load().total(np.arange(5.0)) == 10
        return caplog.text

    return totals


def test_damaged_machine_code_is_compiled_again(tmp_path: Path, totals: Callable[[], str]) -> None:
    assert totals() == totals() == ""
    folder = tmp_path / "module" / "__pycache__"
    code, index = (next(folder.glob(f"*.{suffix}")) for suffix in ("nbc", "nbi"))
    whole = code.read_bytes()
    for file, content in ((code, whole[:999] + b"x" + whole[1000:]), (code, b""), (index, index.read_bytes()[:-1])):
        file.write_bytes(content)
        assert f"compiled code in {folder} is damaged, and is compiled again" in totals()
        assert totals() == ""


def test_machine_code_that_cannot_be_kept_moves_to_temporary_folder(
    tmp_path: Path, totals: Callable[[], str], monkeypatch: pytest.MonkeyPatch
) -> None:
    folder, write = tmp_path / "module" / "__pycache__", compiling._CheckedFiles._save_data

    def full(files: compiling._CheckedFiles, name: str, data: object) -> None:
        if files._cache_path == str(folder):
            raise OSError(errno.ENOSPC, "No space left on device")
        write(files, name, data)

    monkeypatch.setattr(compiling._CheckedFiles, "_save_data", full)
    printed = totals()
    assert (
        f"compiled code cannot be kept in {folder} (No space left on device); it is kept in {tmp_path}/photonpano-" in printed
    )
    assert len(list(tmp_path.glob("photonpano-*/*/*.nbc"))) == 1
