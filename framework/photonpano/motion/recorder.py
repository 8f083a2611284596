"""Record the decisions that components take, also where they travel to with a task."""

from __future__ import annotations

from collections.abc import Callable

from photonpano.values import Decision, DecisionValue


class Recorder:
    """Records decisions: what a `StageContext` offers to components as `decide`.

    Components that travel take their recorder along. There it keeps decisions until a task brings them home.
    """

    def __init__(self, decisions: list[Decision] | None = None) -> None:
        """Take the list of a run that receives decisions; None where a component travels to."""
        self._decisions, self._waiting = decisions, list[Decision]()

    def __call__(self, what: str, value: DecisionValue, reason: str) -> None:
        """Record a decision.

        Raises:
            TypeError: the value is no plain one.
        """
        if not isinstance(value, bool | int | float | str):
            raise TypeError(f"the value of a decision is a number, a text, true or false; {what} is a {type(value).__name__}")
        self.add(Decision(what, value, reason))

    def add(self, decision: Decision) -> None:
        """Record a decision that was taken elsewhere."""
        (self._waiting if self._decisions is None else self._decisions).append(decision)

    def taken(self) -> tuple[Decision, ...]:
        """Return the decisions that wait to be brought home, once; there, none does."""
        waiting, self._waiting = self._waiting, []
        return tuple(waiting)

    def __reduce__(self) -> tuple[Callable[[], Recorder], tuple[()]]:
        return Recorder, ()
