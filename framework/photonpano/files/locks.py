"""Locks between processes: the system forgets them with the process, and a readable note names who holds one."""

from __future__ import annotations

import fcntl
import json
import os
import socket
import stat
import time
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from datetime import datetime
from pathlib import Path
from typing import TypedDict

from photonpano.errors import OutputError

_NOTE_S = 2.0  # how long to wait for the note of a process that has just taken a lock
_held: dict[Path, int] = {}  # open files that this process uses until its end


class Holder(TypedDict):
    """Who holds a lock: a process of a host, when that process began (in the system's own words), and when it took the lock."""

    host: str
    pid: int
    process_start: str
    since: str


@contextmanager
def locked(path: Path, what: str) -> Iterator[None]:
    """Hold the lock file of `what`, such as `the run folder runs/scan`, during the block, and remove it afterwards.

    The lock of a dead process is taken over.

    Raises:
        OutputError: another process holds it.
        OSError: the lock file cannot be made.
    """
    descriptor = _acquired(path, what)
    try:
        yield
    finally:
        with suppress(OSError):
            path.unlink()
        os.close(descriptor)


def _acquired(path: Path, what: str) -> int:
    """Return the open and locked lock file, which holds the note of this process."""
    while True:
        descriptor = os.open(path, os.O_RDWR | os.O_CREAT | os.O_NOFOLLOW | os.O_NONBLOCK, 0o666)
        try:
            if not stat.S_ISREG(os.fstat(descriptor).st_mode):
                raise OutputError(f"{path} is not a file of photonpano; remove it, or choose another folder")
            mine = claimed(descriptor)
            if mine is False or (mine is None and _may_live(_note(descriptor))):
                raise OutputError(_refusal(path, what, _note_soon(descriptor)))
            if is_at(descriptor, path):  # the holder before may have removed it meanwhile
                pid, now = os.getpid(), datetime.now().astimezone().isoformat(timespec="seconds")
                note: Holder = {"host": socket.gethostname(), "pid": pid, "process_start": _process_start(pid), "since": now}
                os.ftruncate(descriptor, 0)
                os.pwrite(descriptor, json.dumps(note).encode(), 0)
                os.fsync(descriptor)
                return descriptor
        except BaseException:
            os.close(descriptor)
            raise
        os.close(descriptor)


def claimed(descriptor: int) -> bool | None:
    """Lock an open file or folder for this process; return whether that worked, None where the file system has no locks."""
    try:
        fcntl.flock(descriptor, fcntl.LOCK_EX | fcntl.LOCK_NB)
    except BlockingIOError:
        return False
    except OSError:
        return None
    return True


def is_lock(path: Path) -> bool:
    """Return whether a file is the lock of a folder."""
    if not (path.name.startswith(".") and path.name.endswith(".lock") and path.is_file()):
        return False
    with path.open("rb") as file:
        return _note(file.fileno()) is not None


def hold(path: Path) -> None:
    """Mark a file as in use until the process ends; other processes may do so too."""
    with suppress(OSError):  # a file system without locks
        descriptor = os.open(path, os.O_RDONLY)
        if path in _held:
            os.close(_held[path])
        _held[path] = descriptor
        fcntl.flock(descriptor, fcntl.LOCK_SH | fcntl.LOCK_NB)


@contextmanager
def claim(path: Path) -> Iterator[bool | None]:
    """Lock a file or folder during the block, if nobody has; yield whether that worked, None where nobody knows."""
    try:
        descriptor = os.open(path, os.O_RDONLY | os.O_NOFOLLOW | os.O_NONBLOCK)
    except OSError:
        yield None
        return
    try:
        yield claimed(descriptor) if is_at(descriptor, path) else None
    finally:
        os.close(descriptor)


def is_at(descriptor: int, path: Path) -> bool:
    """Return whether an open file still has that name."""
    try:
        return os.path.samestat(os.fstat(descriptor), path.lstat())
    except FileNotFoundError:
        return False


def _note(descriptor: int) -> Holder | None:
    try:
        holder: Holder = json.loads(os.pread(descriptor, 4096, 0))
        holder["pid"], holder["host"], holder["process_start"], holder["since"]
    except (OSError, ValueError, TypeError, KeyError):
        return None
    return holder


def _note_soon(descriptor: int) -> Holder | None:
    """Return the note of a holder, who may have taken the lock a moment ago."""
    end = time.monotonic() + _NOTE_S
    while (holder := _note(descriptor)) is None and time.monotonic() < end:
        time.sleep(0.01)
    return holder


def _may_live(holder: Holder | None) -> bool:
    """Return whether a holder may still work; processes of other hosts cannot be looked up."""
    if holder is None:
        return False
    started = _process_start(holder["pid"])
    return holder["host"] != socket.gethostname() or (started != "" and started == holder["process_start"])


def _process_start(pid: int) -> str:
    """Return when a process began, in ticks since the system did; empty if there is no such process, or nobody knows."""
    try:
        return Path(f"/proc/{pid}/stat").read_text(encoding="ascii", errors="replace").rpartition(")")[2].split()[19]
    except (OSError, IndexError):
        return ""


def _refusal(path: Path, what: str, holder: Holder | None) -> str:
    elsewhere = "choose another folder with --output"
    if holder is None:
        return f"{what} is in use by another process; wait for it, or {elsewhere}"
    who = f"process {holder['pid']} on {holder['host']} has been writing it since {holder['since']}"
    gone = "" if holder["host"] == socket.gethostname() else f"; if that process is gone, remove {path}"
    return f"{what} is in use: {who}; wait for it, or {elsewhere}{gone}"
