"""Tests of a run, and the reasons for which it is doubtful."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import NamedTuple, TypeAlias

from photonpano.motion.loop import LevelResult
from photonpano.residuals.refinement import Explained
from photonpano.values import Decision

RIVAL = "rival_motion"  # name of the decision on a part of the frame that moves otherwise


@dataclass(frozen=True, slots=True)
class Reason:
    """Why a run is doubtful."""

    what: str  # what was found, in a clause
    figure: float  # the number that decided
    threshold: float  # the largest number that is trusted
    where: str  # the frames, pixels or places, in a clause; empty if it is everywhere
    what_to_do: str  # advice, in a clause

    def __str__(self) -> str:
        where = f" ({self.where})" if self.where else ""
        return f"{self.what}{where}: {self.figure:.3g}, trusted up to {self.threshold:g}; {self.what_to_do}"


@dataclass(frozen=True, slots=True, eq=False)
class TestedRun:
    """Data of a run that is tested: see `judge`."""

    explained: Explained
    levels: Sequence[LevelResult]
    decisions: Sequence[Decision]

    @property
    def pairs(self) -> tuple[int, int] | None:
        """Number of contradicting pairs of the last level, and of all its pairs."""
        if not self.levels:
            return None
        located = self.levels[-1].located
        return len(located.solution.outliers), len(located.edges)

    def decided(self, what: str, meaning: str) -> Found | None:
        """Return the figure of the last decision of a name; None if there is none."""
        figures = [float(each.value) for each in self.decisions if each.what == what]
        return Found(figures[-1], meaning) if figures else None


class Found(NamedTuple):
    """Figure of a test and where it occurs; `doubtful` overrides the threshold.

    Where the test could not be made, the figure is NaN, and `where` says why.
    """

    figure: float
    where: str
    doubtful: bool = False


@dataclass(frozen=True, slots=True)
class Test:
    """A row of the table: `find` returns what it found, or None where nothing is to be found."""

    what: str
    threshold: float
    what_to_do: str
    find: Callable[[TestedRun], Found | None]

    def untested(self, found: Found | None) -> str | None:
        """Return a clause on what was not tested, and why; None if it was."""
        return f"whether {self.what} ({found.where})" if found is not None and found.figure != found.figure else None

    def reason(self, found: Found | None) -> Reason | None:
        """Judge what was found; None if it is trusted, or not known."""
        if found is None or not (found.doubtful or found.figure > self.threshold):
            return None
        return Reason(self.what, found.figure, self.threshold, found.where, self.what_to_do)


_Finder: TypeAlias = Callable[[TestedRun], Found | None]


class Tests(list[Test]):
    """A table of tests; those that are added first are listed first."""

    def doubtful_above(self, threshold: float, what: str, what_to_do: str) -> Callable[[_Finder], Test]:
        """Add the decorated function as a test."""

        def added(find: _Finder) -> Test:
            self.append(Test(what, threshold, what_to_do, find))
            return self[-1]

        return added
