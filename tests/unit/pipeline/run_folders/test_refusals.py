"""Run folders that are refused: in use, in the way, or not to be replaced."""

from __future__ import annotations

import fcntl
import json
import os
import socket
import threading
from pathlib import Path

import pytest

from photonpano import OutputError
from photonpano.pipeline.run_folder import run_folder

from .small_results import RECORD, files_in, run_into


def test_run_folder_refuses_a_file_in_the_way_before_the_block(tmp_path: Path) -> None:
    """As root, permissions stop nobody; a file does."""
    way = tmp_path / "runs"
    way.write_text("a file")
    for directory, reason in ((way, "File exists"), (way / "scan", "Not a directory")):
        with pytest.raises(OutputError) as caught, run_folder(directory):
            raise AssertionError("the block must not run")
        assert str(caught.value) == (
            f"{directory}: the run folder cannot be written to ({reason}); choose another one with --output"
        )
    assert way.read_text() == "a file"


def test_run_folder_refuses_files_that_no_run_wrote(old: Path, tmp_path: Path) -> None:
    mine = tmp_path / "mine"
    mine.mkdir()
    for name in ("report.html", "run.json", "a.png", "b.png", "c.png"):
        (mine / name).write_text("mine")
    for directory, names in ((old, "notes"), (mine, "a.png, b.png, c.png and 2 more")):
        before = files_in(directory)
        with pytest.raises(OutputError) as caught, run_folder(directory):
            raise AssertionError("the block must not run")
        assert str(caught.value) == (
            f"{directory} holds files that no run has written: {names}; choose another folder with --output, "
            "or write the results among them with --overwrite"
        )
        assert files_in(directory) == before


def test_run_folder_refuses_what_must_not_be_replaced(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("HOME", str(tmp_path / "home" / "me"))
    (tmp_path / "home" / "me").mkdir(parents=True)
    capture = tmp_path / "captures" / "night" / "cube.npy"
    reasons = {
        Path("/"): "is the folder of a user or of the system",
        tmp_path / "home": "is the folder of a user or of the system",
        tmp_path / "home" / "me": "is the folder of a user or of the system",
        tmp_path / "captures": f"cannot be the run folder, since {capture} lies in it",
        capture: f"cannot be the run folder, since {capture} lies in it",
    }
    for directory, reason in reasons.items():
        with pytest.raises(OutputError) as caught, run_folder(directory, overwrite=True, inputs=[capture]):
            raise AssertionError("the block must not run")
        assert str(caught.value) == f"{directory} {reason}; choose another one with --output"


def test_second_run_into_a_folder_is_refused_with_the_first(tmp_path: Path) -> None:
    directory = tmp_path / "scan"
    with run_folder(directory):
        holder = json.loads((tmp_path / ".scan.lock").read_text())
        with pytest.raises(OutputError) as caught, run_folder(directory):
            raise AssertionError("the block must not run")
    assert (holder["pid"], holder["host"]) == (os.getpid(), socket.gethostname())
    assert str(caught.value) == (
        f"the run folder {directory} is in use: process {os.getpid()} on {socket.gethostname()} has been writing it since "
        f"{holder['since']}; wait for it, or choose another folder with --output"
    )
    assert list(tmp_path.iterdir()) == []


def test_refusal_waits_for_the_note_of_a_lock_that_was_just_taken(tmp_path: Path) -> None:
    note = {"host": socket.gethostname(), "pid": 7, "process_start": "1", "since": "2026-01-01T00:00:00+00:00"}
    lock = tmp_path / ".scan.lock"
    writes = threading.Timer(0.1, lock.write_text, [json.dumps(note)])
    with lock.open("w") as held:
        fcntl.flock(held, fcntl.LOCK_EX)
        writes.start()
        with pytest.raises(OutputError, match=f"process 7 on {socket.gethostname()} has been writing it since 2026-01-01"):
            run_into(tmp_path / "scan")
        writes.join()


def test_run_folder_refuses_a_run_of_another_capture(tmp_path: Path) -> None:
    captures = [tmp_path / "a.npy", tmp_path / "b.npy"]
    for path in captures:
        path.touch()
    with run_folder(tmp_path / "scan", inputs=captures[:1]) as folder:
        folder.commit(RECORD | {"capture": {"files": [{"path": str(captures[0])}]}})
    run_into_again = {"directory": tmp_path / "scan", "inputs": captures[1:]}
    with pytest.raises(OutputError) as caught:
        run_into(**run_into_again)
    assert str(caught.value) == (
        f"{tmp_path}/scan holds a run of another capture, {captures[0]}; choose another folder with --output, or replace that "
        "run with --overwrite"
    )
    captures[0].rename(tmp_path / "moved.npy")  # as when all of a project moves
    run_into(**run_into_again)
