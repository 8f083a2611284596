"""End the program: at once when its work is done, and in time on Ctrl-C, SIGTERM and SIGHUP, whatever plugins do.

A signal raises `KeyboardInterrupt` in the main thread, which removes unfinished files on its way out. That fails if a plugin
hangs, so two watchers wait for the end. A thread ends the program after `GRACE_S`, or at the second signal. It needs the
interpreter, which C code may hold: so a small process, the guard, kills the program after `KILL_S`.
"""

from __future__ import annotations

import ctypes
import os
import select
import signal
import sys
import threading
import time
from contextlib import suppress
from typing import Any, NoReturn

from photonpano.api.cli.errors import INTERRUPTED, SIGNALLED
from photonpano.execution.interrupts import interrupt
from photonpano.files.atomic import discard_unfinished

GRACE_S = 1.2  # time for the main thread to clean up after a signal
KILL_S = 1.7  # time after a signal until the guard kills the program
_LEFT_S = 0.2  # time for threads that a plugin has left running
_SIGNALS = (signal.SIGINT, signal.SIGTERM, signal.SIGHUP)


def end_on_signals() -> None:
    """Watch for signals. The main thread calls it once, before other threads start.

    A signal that the caller ignores stays ignored: shells have their background jobs ignore Ctrl-C, and `nohup` SIGHUP.
    """
    heeded = [each for each in _SIGNALS if signal.getsignal(each) is not signal.SIG_IGN]
    for each in heeded:
        signal.signal(each, interrupt)
    handlers = _Handlers(heeded)
    numbers, to_write = os.pipe()
    os.set_blocking(to_write, False)
    passed_on = _with_guard(numbers, to_write)
    signal.set_wakeup_fd(to_write, warn_on_full_buffer=False)
    os.register_at_fork(after_in_child=lambda: signal.set_wakeup_fd(-1))
    threading.Thread(target=_end_in_time, args=(passed_on, handlers), name="signals", daemon=True).start()


def leave(code: int) -> NoReturn:
    """End the program with an exit code, without waiting for threads that a plugin has left running."""
    last = time.monotonic() + _LEFT_S
    # A thread that a signal stopped before its first step is listed, but is not alive, and cannot be joined.
    others = [t for t in threading.enumerate() if t.is_alive() and not t.daemon and t is not threading.current_thread()]
    for each in others:
        each.join(max(0.0, last - time.monotonic()))
    if any(each.is_alive() for each in others):
        for stream in (sys.stdout, sys.stderr):
            with suppress(Exception):  # closed, or its disk is full
                stream.flush()
        os._exit(code)
    sys.exit(code)


class _Handlers:
    """Python's handlers of signals in C: each handles one signal, and the kernel ends the process at the second.

    So a second Ctrl-C works even while C code holds the interpreter. Without glibc, the guard has to do it.
    """

    def __init__(self, numbers: list[signal.Signals]) -> None:
        self._system: Any = ctypes.CDLL(None)
        self._handlers: dict[int, int | None] = {}
        if hasattr(self._system, "sysv_signal"):
            self._system.signal.restype = ctypes.c_void_p
            for number in numbers:
                self._handlers[number] = self._system.signal(number, None)
                self._system.sysv_signal(number, ctypes.c_void_p(self._handlers[number]))

    def renew(self, number: int) -> None:
        """Handle the next signal as well: a thread of the interpreter is there to end the process, with its exit code."""
        if number in self._handlers:
            self._system.signal(number, ctypes.c_void_p(self._handlers[number]))


def _end_in_time(numbers: int, handlers: _Handlers) -> None:
    """Wait for a signal, give the main thread its time, and end the program."""
    number = _next_signal(numbers)
    if not number:
        return
    handlers.renew(number)
    _next_signal(numbers, GRACE_S)
    last = threading.Thread(target=_clean_up, daemon=True)
    last.start()
    last.join(_LEFT_S)  # the disk may hang, and so may the reader of standard error
    os._exit(SIGNALLED + number)


def _clean_up() -> None:
    discard_unfinished()
    with suppress(OSError):
        os.write(2, f"{INTERRUPTED}\n".encode())


def _with_guard(numbers: int, to_write: int) -> int:
    """Start the guard, and return the pipe of signals that it passes on; `numbers` if no process can be started."""
    passed_on, to_pass = os.pipe()
    program = os.getpid()
    try:
        guard = os.fork()
    except OSError:
        return numbers
    if not guard:
        try:
            os.close(to_write)
            os.close(passed_on)
            _guard(program, numbers, to_pass)
        finally:
            os._exit(0)
    os.close(numbers)
    os.close(to_pass)
    return passed_on


def _guard(program: int, numbers: int, to_pass: int) -> None:
    """Pass signals on to the thread of the program, and kill the program if it does not end."""
    for each in _SIGNALS:
        signal.signal(each, signal.SIG_IGN)
    nothing = os.open(os.devnull, os.O_RDWR)
    for stream in (0, 1, 2):  # whoever reads the output of the program waits until nobody holds it open
        os.dup2(nothing, stream)
    number = _next_signal(numbers)
    if not number:  # the program has ended
        return
    os.write(to_pass, bytes([number]))
    if second := _next_signal(numbers, KILL_S):
        os.write(to_pass, bytes([second]))
        _next_signal(numbers, 2 * _LEFT_S)
    for sent in (number, signal.SIGKILL):
        if os.getppid() == program:
            os.kill(program, sent)
            _next_signal(numbers, 0.05)


def _next_signal(numbers: int, seconds: float | None = None) -> int:
    """Return the next of our signals from a pipe; 0 if the pipe ends, or the time is over."""
    last = None if seconds is None else time.monotonic() + seconds
    while select.select([numbers], [], [], None if last is None else max(0.0, last - time.monotonic()))[0]:
        number = os.read(numbers, 1)
        if not number or number[0] in _SIGNALS:
            return number[0] if number else 0
    return 0
