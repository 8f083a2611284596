"""Compile loops over pixels and bits with numba, which keeps the machine code on disk for the next process.

Plugins may use `compiled` for their own loops. Modules that use it import numba: import them from `build`, not from hooks.
"""

from __future__ import annotations

import inspect
import os
from collections.abc import Callable, Iterator
from contextlib import contextmanager, suppress
from pathlib import Path
from typing import Any, TypeVar, cast

import numba
from numba.core import caching, event

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
    if not os.access(Path(inspect.getfile(function)).parent, os.W_OK):
        dispatcher._cache = _SharedCode(function, dispatcher._cache)
    return cast("Function", dispatcher)


class _Beside(caching.InTreeCacheLocator):
    """The folder beside a module that only its owner writes to."""

    def ensure_cache_path(self) -> None:
        """Ask for nothing: it is read only."""


class _BesideImpl(caching.CompileResultCacheImpl):
    _locator_classes = [_Beside]  # noqa: RUF012  # as the base class has it


class _SharedCode(caching.FunctionCache):
    """Machine code that another user has kept beside a module, as in an image of a container; `own` keeps what is missing."""

    _impl_class = _BesideImpl

    def __init__(self, function: Callable[..., object], own: Any) -> None:
        super().__init__(function)  # type: ignore[no-untyped-call]
        self._own = own

    def load_overload(self, sig: Any, target_context: Any) -> Any:
        found = super().load_overload(sig, target_context)  # type: ignore[no-untyped-call]
        return self._own.load_overload(sig, target_context) if found is None else found

    def save_overload(self, sig: Any, data: Any) -> None:
        self._own.save_overload(sig, data)


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
