"""Checkpoints in a folder of named records: each is a file that is written whole, and is checked when it is read."""

from __future__ import annotations

import logging
import shutil
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any, TypeVar

import numpy as np

from photonpano.errors import OutputError
from photonpano.files.atomic import atomic_path
from photonpano.pipeline.checkpoints.records import digest, packed, unpacked
from photonpano.text import byte_size
from photonpano.values import Decision

logger = logging.getLogger(__name__)

SUFFIX = ".npz"
_SPARE = 8  # free space, in sizes of a record, that must remain for the results


class Store:
    """Named records in an existing folder. One that is damaged or cannot be written gives a warning, and is computed again."""

    def __init__(self, folder: Path) -> None:
        self.folder = folder
        self.holds_something = any(folder.glob(f"[!.]*{SUFFIX}"))
        self._warned = False

    def save(self, name: str, value: Any) -> bool:
        """Write a record; return whether it was possible."""
        path = self.folder / f"{name}{SUFFIX}"
        try:
            arrays = packed(value)
            needed, free = sum(array.nbytes for array in arrays.values()), shutil.disk_usage(self.folder).free
            if free < (1 + _SPARE) * needed:
                raise OutputError(
                    f"{self.folder}: what was found is not kept, as the {byte_size(free)} free are for the results"
                )
            # A record that a power failure damages is computed again; waiting for the disk would cost more.
            with atomic_path(path, flushed=False) as temporary:
                np.savez(temporary, allow_pickle=False, **arrays)
        except (OutputError, OSError, TypeError) as error:
            if not self._warned:
                logger.warning("%s; the run goes on, but if it is interrupted, this is computed again", error)
            self._warned = True
            return False
        self.holds_something = True
        return True

    def load(self, name: str) -> Any:
        """Read a record; None if there is none, or it is damaged."""
        path = self.folder / f"{name}{SUFFIX}"
        if not path.exists():
            return None
        try:
            # Each array has a checksum, which is compared when it is read.
            with path.open("rb") as stream, np.load(stream, allow_pickle=False) as archive:
                return unpacked(dict(archive))
        except Exception as error:  # zipfile, zlib, numpy and json raise what they like for a damaged file
            logger.warning(
                "%s is damaged (%s), and is computed again", path, " ".join(str(error).split()) or type(error).__name__
            )
            path.unlink(missing_ok=True)
            return None

    def names(self, start: str) -> list[str]:
        """Return the names of the records that begin with a text, in order."""
        return sorted(path.name.removesuffix(SUFFIX) for path in self.folder.glob(f"{start}*{SUFFIX}"))


ResultT = TypeVar("ResultT")

FLUSH_S = 5.0  # time between writes of a log: a kill loses at most this much work
_END = "end"


class Kept:
    """Checkpoints in a store: see `photonpano.execution.context.Checkpoints`.

    Decisions that components take while they work are kept with the results, and taken again when these are found.
    """

    def __init__(
        self, store: Store, decisions: list[Decision], given: tuple[Any, ...] = (), logs: list[KeptLog] | None = None
    ) -> None:
        """Open the checkpoints of a run; all results depend on `given`, beside what the whole store is for."""
        self._store, self._decisions, self._given = store, decisions, given
        self._logs: list[KeptLog] = [] if logs is None else logs

    def once(self, step: str, compute: Callable[[], ResultT], *given: Any) -> ResultT:
        """See `photonpano.execution.context.Checkpoints`."""
        name = self._name(step, given)
        if (found := self._store.load(name)) is not None:
            kept: ResultT
            kept, decisions = found
            self._decisions += decisions
            return kept
        before = len(self._decisions)
        result = compute()
        self._store.save(name, (result, self._decisions[before:]))
        return result

    def log(self, step: str, *given: Any) -> KeptLog:
        """See `photonpano.execution.context.Checkpoints`."""
        log = KeptLog(self._store, self._name(step, given), self._decisions)
        self._logs.append(log)
        return log

    def within(self, *given: Any) -> Kept:
        """See `photonpano.execution.context.Checkpoints`."""
        return Kept(self._store, self._decisions, (*self._given, *given), self._logs)

    def flush(self) -> None:
        """Write what the logs have not written yet."""
        for log in self._logs:
            log.flush()

    def _name(self, step: str, given: tuple[Any, ...]) -> str:
        return f"{step}.{digest(*self._given, *given)}"


class KeptLog:
    """Results of a step with many of them, in files of what was found within some seconds: see `context.Log`."""

    def __init__(self, store: Store, name: str, decisions: list[Decision]) -> None:
        self._store, self._name, self._decisions = store, name, decisions
        self._restored: list[Decision] = []
        self._first_decision = len(decisions)
        self.found: list[Any] = []
        for batch in store.names(f"{name}."):
            if batch != self._batch(len(self.found)) or (kept := store.load(batch)) is None:
                continue
            results, taken = kept
            self.found += results
            self._restored = list(taken)
        self._written = len(self.found)
        self._pending: list[Any] = []
        self._flushed = time.monotonic()

    def add(self, result: Any) -> None:
        """See `photonpano.execution.context.Log`."""
        self._pending.append(result)
        if time.monotonic() - self._flushed >= FLUSH_S:
            self.flush()

    def finish(self) -> None:
        """See `photonpano.execution.context.Log`."""
        self.flush()
        for decision in self._restored:
            if decision not in self._decisions[self._first_decision :]:
                self._decisions.append(decision)
        if not self._store.names(finished := f"{self._name}.{_END}"):
            self._store.save(finished, None)

    def flush(self) -> None:
        """Write the results that were added since the last time."""
        self._flushed = time.monotonic()
        taken = [*self._restored, *self._decisions[self._first_decision :]]
        if self._pending and self._store.save(self._batch(self._written), (self._pending, taken)):
            self._written += len(self._pending)
            self._pending = []

    def _batch(self, first: int) -> str:
        """Return the name of the file whose first result has this number."""
        return f"{self._name}.{first:08d}"


def finished(store: Store, step: str) -> bool:
    """Return whether a log of a step was finished."""
    return any(name.endswith(f".{_END}") for name in store.names(f"{step}."))
