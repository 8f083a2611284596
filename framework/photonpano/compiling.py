"""Loops over pixels and bits, compiled when they first run and kept on disk for the next process."""

from __future__ import annotations

from contextlib import contextmanager
from typing import TYPE_CHECKING, TypeVar, cast

import numba
from numba.core import event

if TYPE_CHECKING:
    from collections.abc import Callable, Iterator

Function = TypeVar("Function", bound="Callable[..., object]")


def compiled(function: Function) -> Function:
    """Compile a function that takes arrays and numbers. It lets other threads run meanwhile.

    Inside, give pixels of a row by slices (`row = image[y]`, `part = row[start:stop]`) and count from 0, or by indices without
    a sign: one that may be negative keeps a loop from being vectorised. What is smaller than a machine word grows to one in
    every operation, unless it is cast back.
    """
    try:
        return cast("Function", _jit(True)(function))
    except RuntimeError:  # nowhere to keep it: neither beside the module nor in a home
        return cast("Function", _jit(False)(function))


@contextmanager
def told_once(tell: Callable[[], None]) -> Iterator[None]:
    """Call `tell` if something is compiled within the block that is not on the disk yet, before the first of it."""
    listener = _Once(tell)
    register: Callable[[str, object], None] = event.register
    unregister: Callable[[str, object], None] = event.unregister
    register("numba:compile", listener)
    try:
        yield
    finally:
        unregister("numba:compile", listener)


class _Once(event.Listener):
    def __init__(self, tell: Callable[[], None]) -> None:
        self._tell: Callable[[], None] | None = tell

    def on_start(self, event: object) -> None:
        del event
        if self._tell is not None:
            tell, self._tell = self._tell, None
            tell()

    def on_end(self, event: object) -> None:
        del event


def _jit(cache: bool) -> Callable[[Function], object]:
    # Sums may be taken in another order, which vectors need; what is not a number stays that.
    return numba.njit(cache=cache, nogil=True, error_model="numpy", fastmath={"contract", "reassoc", "nsz"})
