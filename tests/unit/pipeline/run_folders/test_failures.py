"""Run folders whose writing fails, or is killed: the files before it, or all of the new ones."""

from __future__ import annotations

import errno
import json
import os
import resource
import signal
import socket
import subprocess
import sys
from collections.abc import Callable, Iterator
from contextlib import contextmanager, suppress
from pathlib import Path
from typing import Any

import pytest

from photonpano import OutputError
from photonpano.pipeline.run_folder import RunFolder, run_folder
from photonpano.record.contents import changed_files, finish_run_folder

from .small_results import FILES, RECORD, WRITERS, files_in, run_into


def write_and_fail(directory: Path, error: BaseException) -> None:
    with run_folder(directory, overwrite=True) as folder:
        for write in WRITERS[:-1]:
            write(folder)
        raise error


@pytest.mark.parametrize("error", [ValueError, KeyboardInterrupt])
def test_run_folder_keeps_old_files_when_the_block_raises(old: Path, error: type[BaseException]) -> None:
    before = files_in(old.parent)
    with pytest.raises(error):
        write_and_fail(old, error())
    assert files_in(old.parent) == before


def test_run_folder_removes_new_folders_when_the_block_raises(tmp_path: Path) -> None:
    with pytest.raises(ValueError, match="half-way"):
        write_and_fail(tmp_path / "runs" / "today" / "scan", ValueError("half-way"))
    assert list(tmp_path.iterdir()) == []


@contextmanager
def files_of_at_most(n_bytes: int) -> Iterator[None]:
    """Let the system cut short what is written, as a full disk does."""
    before = resource.getrlimit(resource.RLIMIT_FSIZE)
    resource.setrlimit(resource.RLIMIT_FSIZE, (n_bytes, before[1]))
    try:
        yield
    finally:
        resource.setrlimit(resource.RLIMIT_FSIZE, before)


@pytest.mark.parametrize("write", WRITERS)
def test_run_folder_keeps_old_files_when_the_disk_is_full(old: Path, write: Callable[[RunFolder], None]) -> None:
    before = files_in(old.parent)
    with pytest.raises(OutputError) as caught, run_folder(old, overwrite=True) as folder, files_of_at_most(4096):
        write(folder)
    assert str(caught.value) == (
        f"{old}: the results could not be written (File too large); what was there before is unchanged. "
        "Make room, or choose another folder with --output"
    )
    assert files_in(old.parent) == before


@pytest.mark.parametrize("number", range(18))
def test_run_folder_is_old_or_new_when_any_step_fails_once(
    old: Path, system: str, number: int, monkeypatch: pytest.MonkeyPatch
) -> None:
    before, steps = files_in(old), []

    def failing(name: str) -> Callable[..., Any]:
        step = getattr(os, name)

        def maybe(*args: Any, **options: Any) -> Any:
            steps.append(name)
            if len(steps) - 1 == number:
                raise OSError(errno.EIO, os.strerror(errno.EIO))
            return step(*args, **options)

        return maybe

    with suppress(OutputError), run_folder(old, overwrite=True) as folder:
        for write in WRITERS[:-1]:
            write(folder)
        with monkeypatch.context() as patch:
            for name in ("rename", "replace", "fsync", "link"):
                patch.setattr(os, name, failing(name))
            folder.commit(RECORD)
    finish_run_folder(old)
    after = files_in(old)
    if after != before:
        assert changed_files(old) == []
        assert "seed" not in json.loads(after["run.json"])
        assert set(after) == (FILES - {"report.html"}) | {"notes/a.txt"}
    run_into(old, overwrite=True)
    assert list(old.parent.iterdir()) == [old]
    assert set(files_in(old)) == {*FILES, "notes/a.txt"}


_STOPS = """
import os, signal, sys
from pathlib import Path
from photonpano import folders
from photonpano.pipeline.run_folder import run_folder

def stop(*args):
    os.kill(os.getpid(), signal.SIGKILL)

directory, where = Path(sys.argv[1]), sys.argv[2]
with run_folder(directory, overwrite=True) as folder:
    (folder.staging / "panorama.tiff").write_bytes(b"new")
    if where == "before":
        stop()
    if where == "exchanged":
        folders._remove_old = stop
    else:
        folders._exchange = lambda one, other: False
        folders._put_in_place = stop
    folder.commit({"photonpano": "0", "spec": {}})
"""


@pytest.mark.parametrize("where", ["before", "exchanged", "pending"])
def test_run_folder_recovers_from_a_killed_run(old: Path, where: str) -> None:
    before = files_in(old)
    done = subprocess.run([sys.executable, "-c", _STOPS, old, where], check=False)
    assert done.returncode == -signal.SIGKILL
    assert len(list(old.parent.iterdir())) > 1 or where == "pending"
    finish_run_folder(old)
    if where == "before":
        assert files_in(old) == before
    else:
        assert changed_files(old) == []
        assert set(files_in(old)) == {"panorama.tiff", "run.json", "notes/a.txt"}
    run_into(old, overwrite=True)
    assert list(old.parent.iterdir()) == [old]
    assert set(files_in(old)) == {*FILES, "notes/a.txt"}


def test_lock_of_a_dead_process_is_taken_over(tmp_path: Path) -> None:
    note = {"host": socket.gethostname(), "pid": 2**22 + 1, "process_start": "1", "since": "2026-01-01T00:00:00+00:00"}
    (tmp_path / ".scan.lock").write_text(json.dumps(note))
    run_into(tmp_path / "scan")
    assert list(tmp_path.iterdir()) == [tmp_path / "scan"]


def test_without_locks_of_the_system_the_note_decides(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("fcntl.flock", lambda *_: (_ for _ in ()).throw(OSError(errno.ENOLCK, os.strerror(errno.ENOLCK))))
    lock = tmp_path / ".scan.lock"
    note = {"host": socket.gethostname(), "pid": 2**22 + 1, "process_start": "1", "since": "2026-01-01T00:00:00+00:00"}
    lock.write_text(json.dumps(note))
    run_into(tmp_path / "scan")
    assert not lock.exists()
    lock.write_text(json.dumps(note | {"host": "elsewhere"}))
    with pytest.raises(OutputError) as caught:
        run_into(tmp_path / "scan")
    assert str(caught.value) == (
        f"the run folder {tmp_path}/scan is in use: process {note['pid']} on elsewhere has been writing it since "
        f"{note['since']}; wait for it, or choose another folder with --output; if that process is gone, remove {lock}"
    )
