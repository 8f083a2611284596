"""The rule of passes: what a pass proposes is accepted if it explains the photons no worse."""

from __future__ import annotations

import logging
from abc import ABC, abstractmethod
from dataclasses import dataclass
from typing import Any, ClassVar, Generic, TypeVar

from photonpano.errors import CanvasTooLargeError, LocationError
from photonpano.pipeline.state import State

logger = logging.getLogger(__name__)

FoundT = TypeVar("FoundT")


class Pass(ABC, Generic[FoundT]):
    """One thing to try with the motion so far.

    Attributes:
        compared: whether the proposal is compared with the state before. Otherwise it is accepted, and its errors end the run.
        severity: of the message about a proposal that is rejected.
    """

    compared: bool = True
    severity: ClassVar[int] = logging.DEBUG

    @abstractmethod
    def find(self, state: State) -> FoundT | None:
        """Measure what the state lacks; None if it lacks nothing."""

    @abstractmethod
    def propose(self, state: State, found: FoundT) -> State | None:
        """Return the state with this in place; None if a closer look finds nothing.

        Raises:
            LocationError: the motion could not be estimated, or the panorama not rendered. So it is for the next.
            CanvasTooLargeError: the panorama would be far larger than the memory.
        """

    def worse(self, proposed: State, state: State) -> str:
        """Return how the proposal explains the photons worse than the state before, as a clause; empty if it does not."""
        return proposed.fit.worse_than(state.fit)

    def settled(self, proposed: State, state: State) -> State:
        """Return an accepted proposal, with what only its residuals show."""
        del state
        return proposed

    def rejection(self, found: FoundT, worse: str) -> str:
        """Return the message about a proposal that is rejected."""
        del found
        return f"{type(self).__name__}: {worse}"


@dataclass(frozen=True, slots=True, eq=False)
class Trial:
    """What came of a pass.

    Attributes:
        state: the state after it.
        found: what it has found; None for nothing.
        accepted: whether its proposal was accepted.
        worse: why it was not; empty where it proposed nothing.
    """

    state: State
    found: Any = None
    accepted: bool = False
    worse: str = ""


def tried(state: State, step: Pass[FoundT]) -> Trial:
    """Try a pass, and keep the state before if the proposal fails or explains the photons worse."""
    found = step.find(state)
    if found is None:
        return Trial(state)
    try:
        proposed = step.propose(state, found)
        if proposed is None:
            return Trial(state, found)
        worse = step.worse(proposed, state) if step.compared else ""
    except (LocationError, CanvasTooLargeError) as error:
        if not step.compared:
            raise
        worse = str(error)
    else:
        if not worse:
            return Trial(step.settled(proposed, state), found, accepted=True)
    logger.log(step.severity, step.rejection(found, worse))
    return Trial(state, found, worse=worse)
