"""Write the frames of a pipe to a file as they come, in a thread, so that none is lost however long locating takes."""

from __future__ import annotations

import fcntl
import os
import select
import threading
from contextlib import suppress
from pathlib import Path

from photonpano.errors import InputError, OutputError, PhotonpanoError
from photonpano.protocols import Piped

_BUFFER_BYTES = 1024**2
_WAIT_S = 0.2  # how long a spool that is stopped may wait for the writer


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
