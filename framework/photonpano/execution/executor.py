"""Executors of tasks: that of this process, and those of other processes, which pack tasks and have a cluster work on them."""

from __future__ import annotations

import io
import pickle
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from functools import lru_cache
from operator import itemgetter
from typing import Any, Protocol, TypeVar, cast

from photonpano.errors import PluginError

ValueT = TypeVar("ValueT")
ResultT = TypeVar("ResultT")
_CAPTURE = "capture"
# Items of a task. An exposure takes some ten milliseconds, and a task costs about one in the scheduler and in the client.
_MOST_AT_ONCE = 8
# Items are worked on at once where there are so many tasks for each one under way, so that no worker waits for the last.
_TASKS_UNDER_WAY = 4


class Executor(Protocol):
    """Works on the tasks of a run. May be called from several threads; each call returns when its task is done.

    A task is a function and what is given to it. The function, and each thing that is given, may be what `share` or `keep` has
    returned, and stands for a value. Results do not depend on the executor.
    """

    @property
    def under_way(self) -> int:
        """How many tasks are worth having under way at once."""

    def at_once(self, number: int) -> int:
        """Return how many of a number of items are best worked on in one task: more than one where tasks cost time to send."""

    def share(self, value: ValueT) -> ValueT:
        """Return what stands for a value, which may be large, in tasks: it travels to each worker once."""

    def call(self, work: Callable[..., ResultT], *given: Any) -> ResultT:
        """Work on a task, and return its result."""

    def keep(self, work: Callable[..., tuple[ValueT, ResultT]], *given: Any) -> tuple[ValueT, ResultT]:
        """Work on a task with two results: the first stays where it was made, and what is returned stands for it in tasks."""

    def close(self) -> None:
        """Cancel what is under way, and release what was started for the run."""


class LocalExecutor:
    """Works on each task in the thread that asks for it: the executor of a single process."""

    def __init__(self, threads: int = 1) -> None:
        """Take the number of threads of the run."""
        self.under_way = threads

    def at_once(self, number: int) -> int:
        """Return 1."""
        del number
        return 1

    def share(self, value: ValueT) -> ValueT:
        """Return the value itself."""
        return value

    def call(self, work: Callable[..., ResultT], *given: Any) -> ResultT:
        """Work on a task."""
        return work(*given)

    def keep(self, work: Callable[..., tuple[ValueT, ResultT]], *given: Any) -> tuple[ValueT, ResultT]:
        """Work on a task with two results."""
        return work(*given)

    def close(self) -> None:
        """Do nothing."""


def packed(value: object, capture: object) -> bytes:
    """Pickle a value, in which the capture travels as a name; a `PluginError` says what cannot be pickled."""
    buffer = io.BytesIO()
    try:
        _Packer(buffer, capture).dump(value)
    except (pickle.PicklingError, AttributeError, TypeError) as error:
        raise PluginError(
            f"a component cannot be sent to other processes: {error}; run it in threads: leave out run.executor"
        ) from error
    return buffer.getvalue()


def unpacked(data: bytes, capture: object) -> Any:
    """Return a value from what `packed` returned; `capture` takes the place of the capture."""
    return _Unpacker(io.BytesIO(data), capture).load()


class _Packer(pickle.Pickler):
    def __init__(self, buffer: io.BytesIO, capture: object) -> None:
        super().__init__(buffer, protocol=pickle.HIGHEST_PROTOCOL)
        self._capture = capture

    def persistent_id(self, obj: object) -> str | None:
        return _CAPTURE if obj is self._capture else None


class _Unpacker(pickle.Unpickler):
    def __init__(self, buffer: io.BytesIO, capture: object) -> None:
        super().__init__(buffer)
        self._capture = capture

    def persistent_load(self, pid: object) -> object:
        if pid != _CAPTURE:
            raise pickle.UnpicklingError(f"unknown object {pid!r}")
        return self._capture


@dataclass(frozen=True, slots=True, eq=False)
class CaptureElsewhere:
    """What stands for a capture in tasks."""

    source: object  # the capture in this process
    opener: Callable[[], object]  # opens it in another one; can be pickled, and tells by `==` whether it is the same capture


class Pending(Protocol):
    """A result that a worker holds, or will."""

    def result(self) -> Any:
        """Wait for the result, and fetch it.

        Raises:
            Exception: what the task raised.
        """


class Workers(Protocol):
    """Processes, here or on other machines, that work on tasks. May be called from several threads."""

    def submit(self, function: Callable[..., Any], *given: Any) -> Pending:
        """Have a worker call a function, as soon as there is one.

        Args:
            function: of a module that workers can import.
            given: its arguments; a `Pending` is replaced by its result, which travels from worker to worker alone.
        """

    @property
    def under_way(self) -> int:
        """How many tasks are worth having under way at once: more than there are workers, so that none waits for the next."""

    def close(self) -> None:
        """Cancel what is under way, and end the processes that were started."""


class Remote:
    """Has workers work on tasks: see `Executor`.

    What is given to a task travels as a pickle, but the capture does not: each worker opens it itself.
    """

    def __init__(self, workers: Workers, capture: CaptureElsewhere) -> None:
        """Take what works on the tasks, and what stands for the capture."""
        self._workers, self._capture, self._opener = workers, capture.source, capture.opener

    @property
    def under_way(self) -> int:
        """How many tasks are worth having under way at once."""
        return self._workers.under_way

    def at_once(self, number: int) -> int:
        """Return how many of a number of items are best worked on in one task; all workers have several tasks all the same."""
        return min(_MOST_AT_ONCE, max(1, number // (_TASKS_UNDER_WAY * self.under_way)))

    def share(self, value: ValueT) -> ValueT:
        """Return what stands for a value in tasks: it travels to each worker once."""
        return cast("ValueT", _StandIn(self._workers.submit(_Shared, packed(value, self._capture), self._opener)))

    def call(self, work: Callable[..., ResultT], *given: Any) -> ResultT:
        """Work on a task, and return its result."""
        result: ResultT = self._submitted(work, *given).result()
        return result

    def keep(self, work: Callable[..., tuple[ValueT, ResultT]], *given: Any) -> tuple[ValueT, ResultT]:
        """Work on a task with two results; the first stays where it was made."""
        both = self._submitted(work, *given)
        return cast("ValueT", _StandIn(both, of_two=True)), self._workers.submit(_second, both).result()

    def close(self) -> None:
        """End the processes that were started."""
        self._workers.close()

    def _submitted(self, work: Any, *given: Any) -> Pending:
        parts = [
            each.pending if isinstance(each, _StandIn) else _Sent(packed(each, self._capture), self._opener)
            for each in (work, *given)
        ]
        of_two = [isinstance(each, _StandIn) and each.of_two for each in (work, *given)]
        return self._workers.submit(_work, of_two, *parts)


_second = itemgetter(1)


class _StandIn:
    """Stands for a value that workers have, or for the first of two that a task has returned."""

    def __init__(self, pending: Pending, of_two: bool = False) -> None:
        self.pending, self.of_two = pending, of_two


class _Sent:
    """A value on its way to a task."""

    def __init__(self, data: bytes, opener: Callable[[], object]) -> None:
        self._data, self._opener = data, opener

    def value(self) -> Any:
        """Return the value, in the process of a worker."""
        return unpacked(self._data, opened(self._opener))


class _Shared(_Sent):
    """A value on its way to several tasks; each worker unpacks it once."""

    def __init__(self, data: bytes, opener: Callable[[], object]) -> None:
        super().__init__(data, opener)
        self._value: Any = None

    def value(self) -> Any:
        """Return the value, in the process of a worker."""
        if self._value is None:
            self._value = super().value()
        return self._value

    def __reduce__(self) -> tuple[Any, ...]:
        return _Shared, (self._data, self._opener)


@lru_cache(maxsize=1)
def opened(opener: Callable[[], object]) -> object:
    """Open a capture in the process of a worker, once as long as tasks of one run come."""
    return opener()


def differences(here: Mapping[str, str], there: Mapping[str, str]) -> str:
    """Say in what another process differs from this one, such as "numpy 2.0 (here 2.1)"; nothing if it does not."""
    return ", ".join(f"{name} {there[name]} (here {here[name]})" for name in here if there[name] != here[name])


def _work(of_two: Sequence[bool], *given: Any) -> Any:
    """Work on a task, a function and its arguments, in a worker; `of_two` marks results of two values, whose first is meant."""
    meant = (each[0] if first else each for first, each in zip(of_two, given, strict=True))
    work, *values = (each.value() if isinstance(each, _Sent) else each for each in meant)
    return work(*values)
