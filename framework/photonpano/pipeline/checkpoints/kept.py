"""The checkpoints of a run: results are found again by the name of their step and by what they depend on."""

from __future__ import annotations

import time
from collections.abc import Callable
from typing import Any, TypeVar

from photonpano.pipeline.checkpoints.records import digest
from photonpano.pipeline.checkpoints.store import Store
from photonpano.values import Decision

ResultT = TypeVar("ResultT")

# Seconds between writes of a log: a kill costs this much of its results, at most.
FLUSH_S = 5.0
_END = "end"


class Kept:
    """Checkpoints in a store: see `photonpano.context.Checkpoints`.

    Decisions that components take while they work are kept with the results, and taken again when these are found.
    """

    def __init__(
        self, store: Store, decisions: list[Decision], given: tuple[Any, ...] = (), logs: list[KeptLog] | None = None
    ) -> None:
        """Open the checkpoints of a run; all results depend on `given`, beside what the whole store is for."""
        self._store, self._decisions, self._given = store, decisions, given
        self._logs: list[KeptLog] = [] if logs is None else logs

    def once(self, step: str, compute: Callable[[], ResultT], *given: Any) -> ResultT:
        """See `photonpano.context.Checkpoints`."""
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
        """See `photonpano.context.Checkpoints`."""
        log = KeptLog(self._store, self._name(step, given), self._decisions)
        self._logs.append(log)
        return log

    def within(self, *given: Any) -> Kept:
        """See `photonpano.context.Checkpoints`."""
        return Kept(self._store, self._decisions, (*self._given, *given), self._logs)

    def flush(self) -> None:
        """Write what the logs have not written yet."""
        for log in self._logs:
            log.flush()

    def _name(self, step: str, given: tuple[Any, ...]) -> str:
        return f"{step}.{digest(*self._given, *given)}"


class KeptLog:
    """Results of a step with many of them, in files of what was found within some seconds: see `photonpano.context.Log`."""

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
        """See `photonpano.context.Log`."""
        self._pending.append(result)
        if time.monotonic() - self._flushed >= FLUSH_S:
            self.flush()

    def finish(self) -> None:
        """See `photonpano.context.Log`."""
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
