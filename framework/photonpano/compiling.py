"""Compile loops over pixels and bits with numba; the machine code is kept on disk for the next process.

Plugins may use `compiled` for their own loops. Modules that use it import numba: import them from `build`, not from hooks.
"""

from __future__ import annotations

import logging
import os
import pickle
import stat
import tempfile
from collections.abc import Callable, Iterator
from contextlib import contextmanager, suppress
from functools import cache
from hashlib import sha256
from pathlib import Path
from typing import Any, TypeVar, cast

import numba
from numba.core import event
from numba.core.caching import FunctionCache, IndexDataCacheFile, NullCache

__all__ = ["compiled", "notify_on_first_compile"]

logger = logging.getLogger(__name__)

_DIGEST_BYTES = sha256().digest_size

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
    dispatcher._cache = _Cache(function)
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


class _Cache:
    """Machine code on disk, for numba: it never fails. What is damaged is compiled and written again.

    If the folder cannot be written, a temporary one of the user takes its place.
    """

    def __init__(self, function: Callable[..., object]) -> None:
        self._function = function
        self._files: Any
        try:
            self._files = _files_of(function)
        except (RuntimeError, OSError):  # no folder can be written to: neither beside the module nor in a home
            self._files = self._elsewhere()

    @property
    def cache_path(self) -> str:
        return str(self._files.cache_path)

    def load_overload(self, signature: object, context: object) -> object:
        """Return the code for a signature; None if it has to be compiled."""
        try:
            found = self._files.load_overload(signature, context)
            if found is None and _temporary_name().is_dir():
                found = self._elsewhere().load_overload(signature, context)
            return found
        except Exception:  # whatever is wrong with it, the code can be compiled again
            _note(f"compiled code in {self.cache_path} is damaged, and is compiled again")
        try:
            self._files.flush()
        except OSError:
            self._files = self._elsewhere()
        return None

    def save_overload(self, signature: object, result: object) -> None:
        """Keep code, if any folder can be written."""
        try:
            self._files.save_overload(signature, result)
        except OSError as error:
            before = self.cache_path
            self._files = self._elsewhere()
            with suppress(OSError):
                self._files.save_overload(signature, result)
            _note(f"compiled code cannot be kept in {before} ({error.strerror}); it is kept in {self.cache_path} instead")

    def _elsewhere(self) -> Any:
        config: Any = numba.core.config
        before, config.CACHE_DIR = config.CACHE_DIR, str(_temporary_folder())
        try:
            return _files_of(self._function)
        except (RuntimeError, OSError):  # not even there
            return NullCache()
        finally:
            config.CACHE_DIR = before


class _CheckedFiles(IndexDataCacheFile):
    """An index of signatures, and a file of code for each, with their hashes: damaged code might run, and do anything."""

    def _dump(self, content: object) -> bytes:
        data: bytes = super()._dump(content)  # type: ignore[no-untyped-call]
        return data + sha256(data).digest()

    def _load_data(self, name: str) -> object:
        return _checked(Path(self._cache_path, name).read_bytes())

    def _load_index(self) -> dict[object, str]:
        try:
            data = Path(self._index_path).read_bytes()
        except FileNotFoundError:
            return {}
        version = pickle.dumps(self._version, protocol=-1)
        if not data.startswith(version):  # of another version of numba, or damaged
            return {}
        stamp, overloads = _checked(data[len(version) :])
        return overloads if stamp == self._source_stamp else {}


def _files_of(function: Callable[..., object]) -> Any:
    cache: Any = FunctionCache(function)  # type: ignore[no-untyped-call]
    name, stamp = f"{cache._impl.filename_base}-sha256", cache._impl.locator.get_source_stamp()
    cache._cache_file = _CheckedFiles(cache.cache_path, name, stamp)  # type: ignore[no-untyped-call]
    return cache


def _checked(data: bytes) -> Any:
    content, digest = data[:-_DIGEST_BYTES], data[-_DIGEST_BYTES:]
    if sha256(content).digest() != digest:
        raise ValueError("its hash is another")
    return pickle.loads(content)


def _temporary_name() -> Path:
    return Path(tempfile.gettempdir(), f"photonpano-{os.getuid()}")


def _temporary_folder() -> Path:
    """Return a folder for temporary files that only this user can write, and that the next process finds."""
    folder = _temporary_name()
    with suppress(OSError):
        folder.mkdir(mode=0o700, exist_ok=True)
        found = folder.lstat()
        if stat.S_ISDIR(found.st_mode) and found.st_uid == os.getuid() and not found.st_mode & 0o022:
            return folder
    return Path(tempfile.mkdtemp(prefix="photonpano-"))


@cache
def _note(message: str) -> None:
    logger.warning(message)
