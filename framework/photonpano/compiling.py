"""Compile loops over pixels and bits with numba, which keeps the machine code on disk for the next process.

Plugins may use `compiled` for their own loops. Modules that use it import numba: import them from `build`, not from hooks.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator
from contextlib import contextmanager, suppress
from typing import Any, TypeVar, cast

import numba
from numba.core import event

__all__ = ["compiled", "notify_on_first_compile"]

Function = TypeVar("Function", bound=Callable[..., object])


def compiled(function: Function) -> Function:
    """Compile a function of arrays, numbers and named tuples of these, on its first call. It releases the GIL.

    Loops are vectorised if pixels are read from slices of a row (`row = image[y]`, `part = row[start:stop]`) and the index
    counts from 0: an index that may be negative prevents it. numba widens small integers to a machine word in every operation;
    cast the result back.

    The compiler may reorder sums and fuse multiplications with additions. NaN and infinity keep their meaning, and dividing by
    zero gives one of them.
    """
    # No "nnan" and "ninf": NaN stands for pixels without a value.
    dispatcher: Any = numba.njit(nogil=True, error_model="numpy", fastmath={"contract", "reassoc", "nsz"})(function)
    # As cache=True, which raises where no folder can be written to: then each process compiles the function for itself.
    with suppress(RuntimeError):
        dispatcher.enable_caching()
    return cast("Function", dispatcher)


@contextmanager
def notify_on_first_compile(notify: Callable[[], None]) -> Iterator[None]:
    """Call `notify` once, before the first function that must be compiled within the block; not for code kept on disk."""
    listener = _Once(notify)
    register: Callable[[str, object], None] = event.register
    unregister: Callable[[str, object], None] = event.unregister
    register("numba:compile", listener)
    try:
        yield
    finally:
        unregister("numba:compile", listener)


class _Once(event.Listener):
    def __init__(self, notify: Callable[[], None]) -> None:
        self._notify: Callable[[], None] | None = notify

    def on_start(self, event: object) -> None:
        del event
        if self._notify is not None:
            notify, self._notify = self._notify, None
            notify()

    def on_end(self, event: object) -> None:
        del event
