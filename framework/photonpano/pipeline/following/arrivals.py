"""Watch a capture that is still being written: the number of its frames and their delays; and copy a pipe to a file."""

from __future__ import annotations

import fcntl
import os
import select
import threading
import time
from collections import deque
from collections.abc import Callable
from contextlib import suppress
from pathlib import Path

import numpy as np

from photonpano.contracts.protocols import Arrived, Piped, Source
from photonpano.errors import InputError, OutputError, PhotonpanoError

_POLL_S = 0.02
_TOLERATED_S = 1.0  # time for which an unreadable capture is tolerated: files may appear in any order
_MOST_MARKS = 4096  # Maximum number of arrival times; beyond, neighbours are merged.
_STEP_S, _STEPS = 0.01, 12_000  # resolution and number of the bins of delays: 10 ms, up to two minutes


class Arrivals:
    """Watches a capture in a thread.

    Attributes:
        n_frames: whole frames that are there.
        promised: frames that the capture will have; None if it does not say so.
        ended: whether no more frames are expected.
        fell_silent: whether that is because nothing came for long.
        seconds: from the first frame to the last.
    """

    def __init__(self, look: Callable[[], Arrived], is_over: Callable[[], bool] | None, silence_s: float) -> None:
        """Begin to watch what `look` returns.

        A capture that is copied from a pipe is over when `is_over` returns true; another one when all frames are there that it
        promises, or nothing has come for `silence_s` seconds.
        """
        self.n_frames, self.ended, self.fell_silent, self.seconds = 0, False, False, 0.0
        self.promised: int | None = None
        self._look, self._is_over, self._silence_s = look, is_over, silence_s
        self._source: Source | None = None
        self._failure: PhotonpanoError | None = None
        self._marks: deque[tuple[int, float]] = deque()  # number of frames, and time of the last look without them
        self._forgotten = 0
        self._lock, self._changed, self._stopped = threading.Lock(), threading.Event(), threading.Event()
        self._thread = threading.Thread(target=self._watch, name="arrivals", daemon=True)
        self._thread.start()

    def source(self) -> Source | None:
        """Return the frames that are there, None as long as there is none; `InputError` if what arrives is no capture."""
        if self._failure is not None:
            raise self._failure
        return self._source

    def wait(self, seconds: float) -> None:
        """Wait until frames arrive or the capture ends, but no longer than that."""
        self._changed.wait(seconds)
        self._changed.clear()

    def waited(self, n_frames: int, now: float) -> list[tuple[int, float]]:
        """Return how long ago the frames up to a number arrived, and forget them: numbers of frames, and seconds.

        A frame counts as arrived at the last look at which it was not there, so that no time is too short.
        """
        found = []
        with self._lock:
            first = self._forgotten
            while self._marks and first < n_frames:
                stop, when = self._marks[0]
                part = min(stop, n_frames) - first
                found.append((part, now - when))
                first += part
                if first == stop:
                    self._marks.popleft()
            self._forgotten = first
        return found

    def oldest(self, now: float) -> float:
        """Return how long ago the first of the frames arrived that are not forgotten, in seconds; 0 if there is none."""
        with self._lock:
            return now - self._marks[0][1] if self._marks else 0.0

    def close(self) -> None:
        """Stop watching."""
        self._stopped.set()
        self._thread.join()

    def _watch(self) -> None:
        before = began = changed = well = time.monotonic()
        while not self._stopped.is_set():
            over = self._is_over is not None and self._is_over()  # asked first: what came before that is seen now
            now = time.monotonic()
            try:
                arrived = self._look()
            except PhotonpanoError as error:
                if now - well <= _TOLERATED_S and not over:
                    self._stopped.wait(_POLL_S)
                    continue
                self._failure, self.ended = error, True
                break
            well = now
            self._source, self.promised = arrived.source, arrived.promised
            n_frames = 0 if arrived.source is None else arrived.source.info.n_frames
            if n_frames > self.n_frames:
                began = began if self.n_frames else before
                self._mark(n_frames, before)
                self.n_frames, changed, self.seconds = n_frames, now, now - began
                self._changed.set()
            self.fell_silent = self._is_over is None and now - changed > self._silence_s
            if over or self.fell_silent or (n_frames and n_frames == self.promised):
                self.ended = True
                break
            before = now
            self._stopped.wait(_POLL_S)
        self._changed.set()

    def _mark(self, n_frames: int, when: float) -> None:
        with self._lock:
            self._marks.append((n_frames, when))
            if len(self._marks) > _MOST_MARKS:
                marks = list(self._marks)
                self._marks = deque((later[0], earlier[1]) for earlier, later in zip(marks[::2], marks[1::2], strict=False))
                if len(marks) % 2:
                    self._marks.append(marks[-1])


class Delays:
    """How long frames waited until they were located, as a histogram: memory does not grow."""

    def __init__(self) -> None:
        self._counts = np.zeros(_STEPS, np.int64)
        self._sum, self._longest = 0.0, 0.0

    def add(self, n_frames: int, seconds: float) -> None:
        """Count frames that waited that long."""
        self._counts[min(int(seconds / _STEP_S), _STEPS - 1)] += n_frames
        self._sum += n_frames * seconds
        self._longest = max(self._longest, seconds)

    @property
    def n_frames(self) -> int:
        """How many frames were counted."""
        return int(self._counts.sum())

    @property
    def mean(self) -> float | None:
        """Mean delay, in seconds; None if no frame was counted."""
        return self._sum / self.n_frames if self.n_frames else None

    @property
    def longest(self) -> float | None:
        """Greatest delay, in seconds; None if no frame was counted."""
        return self._longest if self.n_frames else None

    def quantile(self, share: float) -> float | None:
        """Return the delay that this share of the frames did not exceed, in seconds, to 10 ms; None if there are none."""
        if not self.n_frames:
            return None
        step = int(np.searchsorted(np.cumsum(self._counts), share * self.n_frames))
        return min((step + 1) * _STEP_S, self._longest)


_BUFFER_BYTES = 1024**2
_WAIT_S = 0.2  # time until a spool notices that it is stopped


class Spool:
    """Copies a pipe to a file, until the pipe ends or the spool is closed; then it has `ended`."""

    def __init__(self, descriptor: int, path: Path, piped: Piped) -> None:
        """Make the file, which must not be there, and begin to copy; `OutputError` if it cannot be made."""
        self.path, self.ended = path, False
        self._empty = True
        self._failure: PhotonpanoError | None = None
        self._pipe, self._piped = descriptor, piped
        self._stopped = threading.Event()
        try:
            self._file = os.open(path, os.O_WRONLY | os.O_CREAT | os.O_EXCL | os.O_NOFOLLOW, 0o666)
        except OSError as error:
            raise OutputError(f"cannot write {path}: {error.strerror}; choose another folder with --output") from error
        self._thread = threading.Thread(target=self._copy, name="spool", daemon=True)
        self._thread.start()

    def require_whole(self) -> None:
        """Raise the error of a pipe that could not be copied, or ended within a frame. Whole frames are in the file."""
        if self._failure is not None:
            raise self._failure

    def close(self) -> None:
        """Stop copying. What is no whole frame is cut off, and a file without any frame removed."""
        self._stopped.set()
        self._thread.join()
        if self._empty:
            self.path.unlink(missing_ok=True)

    def _copy(self) -> None:
        with suppress(AttributeError, OSError):  # not a pipe, or another system: it is only slower
            fcntl.fcntl(self._pipe, fcntl.F_SETPIPE_SZ, _BUFFER_BYTES)
        written = 0
        try:
            while not self._stopped.is_set():
                if not select.select([self._pipe], [], [], _WAIT_S)[0]:
                    continue
                try:
                    read = os.read(self._pipe, _BUFFER_BYTES)
                except OSError as error:
                    self._failure = InputError(f"standard input cannot be read: {error.strerror}{self._kept(written)}")
                    break
                if not read:
                    self._failure = self._cut_short(written)
                    break
                left = memoryview(read)
                while left:
                    done = os.write(self._file, left)
                    left, written = left[done:], written + done
        except OSError as error:
            self._failure = OutputError(f"cannot write {self.path}: {error.strerror}{self._kept(written)}; make room")
        finally:
            with suppress(OSError):
                os.ftruncate(self._file, self._piped.header_bytes + self._n_frames(written) * self._piped.frame_bytes)
            os.close(self._file)
            self._empty = not self._n_frames(written)
            self.ended = True

    def _cut_short(self, written: int) -> InputError | None:
        """Return why a pipe that has ended is no capture; None if it is."""
        frames = written - self._piped.header_bytes
        if frames <= 0:
            return InputError("standard input ended before the first frame: look why the program that writes to it has ended")
        if not (rest := frames % self._piped.frame_bytes):
            return None
        return InputError(
            f"standard input ended within a frame: after {frames // self._piped.frame_bytes:,} frames of "
            f"{self._piped.frame_bytes:,} bytes came {rest:,} bytes more. Either the program that writes has died, or height "
            f"and width are wrong{self._kept(written)}"
        )

    def _kept(self, written: int) -> str:
        if not (n_frames := self._n_frames(written)):
            return ""
        kept = "whole frame is" if n_frames == 1 else f"{n_frames:,} whole frames are"
        return f"; the {kept} in {self.path}"

    def _n_frames(self, written: int) -> int:
        return max(0, written - self._piped.header_bytes) // self._piped.frame_bytes
