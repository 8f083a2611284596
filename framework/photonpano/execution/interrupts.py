"""Interrupts: tell Ctrl-C and signals from a `KeyboardInterrupt` or `SystemExit` that a plugin raises."""

from __future__ import annotations

import signal
import threading
from types import FrameType

_noted: list[int] = []  # the numbers of the signals that have interrupted the program, in their order


def interrupt(number: int, frame: FrameType | None) -> None:
    """Handle a signal: note that it came, and raise `KeyboardInterrupt` in the main thread."""
    _noted.append(number)
    signal.default_int_handler(number, frame)


def interrupted() -> bool:
    """Return whether a signal has interrupted the program, which then ends."""
    return bool(_noted)


def interrupted_by() -> int:
    """Return the number of the signal that has interrupted the program first; that of Ctrl-C if none was noted."""
    return _noted[0] if _noted else signal.SIGINT


def is_interrupt(error: BaseException) -> bool:
    """Return whether an exception is an interrupt by the user, which no component may be blamed for.

    It is a `KeyboardInterrupt` after a signal that `interrupt` handled. Where Python's own handler stands, as in a notebook,
    it is any one in the main thread, since signals interrupt no other.
    """
    if not isinstance(error, KeyboardInterrupt):
        return False
    unnoted = signal.getsignal(signal.SIGINT) is signal.default_int_handler
    return bool(_noted) or (unnoted and threading.current_thread() is threading.main_thread())
