"""The verdict on a run: a table of tests of the capture, the residuals and the motion, each with a known rate of false alarms.

A test is a function under `Tests.doubtful_above`; `judge` makes a `Reason` of what it found if that exceeds the threshold.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Literal

import numpy as np

from photonpano.motion.loop import LevelResult
from photonpano.residuals.capture_tests import CAPTURE_TESTS
from photonpano.residuals.motion_tests import MOTION_TESTS, NO_TURN, REPEATS, contradictions
from photonpano.residuals.reasons import Reason, Test, TestedRun
from photonpano.residuals.refinement import Explained
from photonpano.residuals.residual_tests import MAX_CONTRAST, RESIDUAL_TESTS, changing_places
from photonpano.values import Decision

__all__ = [
    "MAX_CONTRAST",
    "NO_TURN",
    "REPEATS",
    "TESTS",
    "Reason",
    "Verdict",
    "changing_places",
    "contradictions",
    "judge",
]

TESTS: tuple[Test, ...] = (*CAPTURE_TESTS, *RESIDUAL_TESTS, *MOTION_TESTS)  # the most telling first


@dataclass(frozen=True, slots=True)
class Verdict:
    """Whether motion and panorama explain the photons."""

    status: Literal["trusted", "doubtful"]  # "trusted" or "doubtful"
    reasons: tuple[Reason, ...]  # why it is doubtful, the most telling first
    residual_ratio: float | None  # scatter of the shifts of short spans, in units of what noise explains; None if it is unknown
    untested: tuple[str, ...] = ()  # which tests could not be made, and why: clauses that begin with "whether"


def judge(explained: Explained, levels: Sequence[LevelResult], decisions: Sequence[Decision] = ()) -> Verdict:
    """Test the result of a run; `levels` are empty if they are not known, `decisions` hold the share that stands still."""
    run = TestedRun(explained, levels, decisions)
    found = [(test, test.find(run)) for test in TESTS]
    reasons = tuple(reason for test, each in found if (reason := test.reason(each)) is not None)
    untested = tuple(clause for test, each in found if (clause := test.untested(each)) is not None)
    ratio = explained.ratio if np.isfinite(explained.ratio) else None
    return Verdict("doubtful" if reasons else "trusted", reasons, ratio, untested)
