"""The verdict on a run, and the reasons of a doubtful one."""

from __future__ import annotations

from collections.abc import Callable, Iterable
from dataclasses import dataclass
from typing import Generic, Literal, NamedTuple, TypeVar

Facts = TypeVar("Facts")


@dataclass(frozen=True, slots=True)
class Reason:
    """Why a run is doubtful, or what is worth a note."""

    what: str  # what was found, in a clause
    figure: float  # the number that decided
    threshold: float  # the largest number that is trusted
    where: str  # the frames, pixels or places, in a clause; empty if it is everywhere
    what_to_do: str  # advice, in a clause

    @property
    def finding(self) -> str:
        """What was found, and where."""
        where = f" ({self.where})" if self.where else ""
        figure = f"{self.figure:,.0f}" if abs(self.figure) >= 999.5 else f"{self.figure:.3g}"
        return f"{self.what}{where}: {figure}"

    def __str__(self) -> str:
        trusted = f", trusted up to {self.threshold:g}" if self.figure > self.threshold else ""
        return f"{self.finding}{trusted}; {self.what_to_do}"


@dataclass(frozen=True, slots=True)
class Verdict:
    """Whether the results of a run explain the photons."""

    status: Literal["trusted", "doubtful"]  # "trusted" or "doubtful"
    reasons: tuple[Reason, ...]  # why it is doubtful, the most telling first
    # in units of what noise explains, for a panorama the scatter of the shifts of short spans, and for other kinds of runs
    # residuals of their own; None if it is unknown
    residual_ratio: float | None
    untested: tuple[str, ...] = ()  # which tests could not be made, and why: clauses that begin with "whether"
    notes: tuple[Reason, ...] = ()  # what else was found; it is too small to make the motion or the panorama wrong
    # of the photons against the panorama, on average over the spans, without what a span adds to the panorama itself; 1 if only
    # photon noise is left. None without a panorama
    reduced_chi2: float | None = None

    @classmethod
    def of(
        cls,
        reasons: Iterable[Reason],
        residual_ratio: float | None,
        untested: Iterable[str] = (),
        notes: Iterable[Reason] = (),
    ) -> Verdict:
        """Return the verdict that has these reasons: doubtful if there is one."""
        reasons = tuple(reasons)
        return cls("doubtful" if reasons else "trusted", reasons, residual_ratio, tuple(untested), tuple(notes))


class Found(NamedTuple):
    """Figure of a test and where it occurs.

    `doubtful` overrides the threshold, `what` and `what_to_do` the words of the test. Where the test could not be made, the
    figure is NaN, and `where` says why.
    """

    figure: float
    where: str = ""
    doubtful: bool = False
    what: str = ""
    what_to_do: str = ""


@dataclass(frozen=True, slots=True)
class Test(Generic[Facts]):
    """A row of a table of tests: `find` returns what it found, or None where nothing is to be found.

    One that does not decide names a cause of what others doubt; what it finds is a note where none does.
    """

    what: str
    threshold: float
    what_to_do: str
    find: Callable[[Facts], Found | None]
    decides: bool = True

    def untested(self, found: Found | None) -> str | None:
        """Return a clause on what was not tested, and why; None if it was."""
        return f"whether {self.what} ({found.where})" if found is not None and found.figure != found.figure else None

    def reason(self, found: Found | None) -> Reason | None:
        """Judge what was found; None if it is trusted, or not known."""
        if found is None or not (found.doubtful or found.figure > self.threshold):
            return None
        words = found.what or self.what, found.what_to_do or self.what_to_do
        return Reason(words[0], found.figure, self.threshold, found.where, words[1])

    def judged(self, facts: Facts) -> Reason | None:
        """Make the test; None if what it finds is trusted, or not known."""
        return self.reason(self.find(facts))


def judged(tests: Iterable[Test[Facts]], facts: Facts, residual_ratio: float | None, doubts: Iterable[Reason] = ()) -> Verdict:
    """Return the verdict of a table of tests, in its order, after the doubts that are there already."""
    found = [(test, test.find(facts)) for test in tests]
    reasons = [(test, reason) for test, each in found if (reason := test.reason(each)) is not None]
    untested = (clause for test, each in found if (clause := test.untested(each)) is not None)
    listed, doubts = [reason for _, reason in reasons], tuple(doubts)
    if doubts or any(test.decides for test, _ in reasons):
        return Verdict.of((*doubts, *listed), residual_ratio, untested)
    return Verdict.of((), residual_ratio, untested, listed)
