"""What a component is told when it is built: the run, and the capture."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass, field

from photonpano.errors import CaptureUnreadError
from photonpano.execution import CaptureElsewhere
from photonpano.execution.threads import InOrder
from photonpano.values import CaptureSummary, DecisionValue, Response, StreamInfo


@dataclass(frozen=True, slots=True)
class SourceContext:
    """The run for which a source is built."""

    seed: int = 0  # the seed of the run; all randomness derives from it
    threads: int = 1  # the number of threads that the component may use


def _unread() -> CaptureSummary:
    raise CaptureUnreadError("chosen from flux and speed when the capture is read")


def _not_recorded(what: str, value: DecisionValue, reason: str) -> None:
    """Record nothing: the default `decide` of a context."""


@dataclass(frozen=True, slots=True)
class StageContext:
    """The run for which any component but a source is built."""

    stream: StreamInfo  # the capture's frames, size and rate
    response: Response  # the camera's response
    seed: int = 0  # the seed of the run; all randomness derives from it
    threads: int = 1  # the number of threads that the component may use
    # returns the flux and the speed of the capture, which are measured at the first call. Raises `CaptureUnreadError` where a
    # spec is only explained: call it when the component works, not when it is built.
    capture: Callable[[], CaptureSummary] = field(default=_unread, compare=False)
    # records a choice that the spec leaves to the component: what was chosen, its value (a number, a text, true or false), and
    # a clause with the reason. `run.json` and the report list it.
    decide: Callable[[str, DecisionValue, str], None] = field(default=_not_recorded, compare=False)
    # calls a function with each of some items, several at once, and yields the results in order. Other processes or machines
    # may do the work: there the function is a copy, pickled with all that it holds.
    in_order: InOrder = field(default=map, compare=False)


@dataclass(frozen=True, slots=True)
class ExecutorContext:
    """The run for which an executor is built."""

    threads: int  # the number of threads of the run
    capture: CaptureElsewhere  # what stands for the capture in tasks of other processes
    # what this process has of what the run needs, by name: versions of photonpano, of the plugins of the run and of libraries,
    # and a hash of the capture
    here: Mapping[str, str]
    elsewhere: Callable[[], Mapping[str, str]]  # tells the same of another process, which must have the same; can be pickled
