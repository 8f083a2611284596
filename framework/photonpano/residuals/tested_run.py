"""What tests of a run look at, and the tables that they are listed in."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import TypeAlias

from photonpano.motion.loop import LevelResult
from photonpano.residuals.refinement import Explained
from photonpano.values import Decision
from photonpano.values.verdict import Found, Test

FREE = "write motion: {model: homography}"  # what a spec says of a motion that may be any
FIND_LENS = "camera: {distortion: {k1: find}}"  # what a spec says to measure the lens
RIVAL = "rival_motion"  # name of the decision on a part of the frame that moves otherwise


@dataclass(frozen=True, slots=True, eq=False)
class TestedRun:
    """Data of a run that is tested: see `judge`."""

    explained: Explained
    levels: Sequence[LevelResult]
    decisions: Sequence[Decision]

    @property
    def freer_model(self) -> str:
        """What to do if a planar model that was written may hold less than the motion; "" for those that hold any."""
        kind = self.levels[-1].located.solution.model.kind if self.levels else "homography"
        return "" if kind in ("homography", "rotation") else f"{FREE}, as {kind} may hold less than the motion"

    def decided(self, name: str, meaning: str = "", *, what: str = "", what_to_do: str = "") -> Found | None:
        """Return the figure of the last decision of a name, with its reason if no meaning is given; None if there is none."""
        for each in reversed(self.decisions):
            if each.what == name:
                return Found(float(each.value), meaning or each.reason, what=what, what_to_do=what_to_do)
        return None


_Finder: TypeAlias = Callable[[TestedRun], Found | None]


class Tests(list[Test[TestedRun]]):
    """A table of tests; those that are added first are listed first."""

    def __init__(self, *, decides: bool = True) -> None:
        super().__init__()
        self._decides = decides

    def doubtful_above(self, threshold: float, what: str, what_to_do: str) -> Callable[[_Finder], Test[TestedRun]]:
        """Add the decorated function as a test."""

        def added(find: _Finder) -> Test[TestedRun]:
            self.append(Test(what, threshold, what_to_do, find, self._decides))
            return self[-1]

        return added
