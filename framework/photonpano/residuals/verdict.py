"""The verdict on a run: a table of tests, each with a known rate of false alarms.

A test is a function under `Tests.doubtful_above`; `judge` makes a `Reason` of what it found if that exceeds the threshold.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import numpy as np

from photonpano.motion.loop import LevelResult
from photonpano.residuals.motion_tests import MOTION_TESTS
from photonpano.residuals.refinement import Explained
from photonpano.residuals.residual_tests import RESIDUAL_TESTS
from photonpano.residuals.scene_tests import SCENE_TESTS
from photonpano.residuals.tested_run import TestedRun
from photonpano.values import Decision, Verdict
from photonpano.values.verdict import Test, judged

TESTS: tuple[Test[TestedRun], ...] = (*SCENE_TESTS, *RESIDUAL_TESTS, *MOTION_TESTS)  # the most telling first


def judge(explained: Explained, levels: Sequence[LevelResult], decisions: Sequence[Decision] = ()) -> Verdict:
    """Test the result of a run; `levels` are empty if they are not known, `decisions` hold the share that stands still."""
    figures = explained.ratio, float(explained.residuals.reduced_chi2.mean())
    ratio, reduced_chi2 = (each if np.isfinite(each) else None for each in figures)
    return replace(judged(TESTS, TestedRun(explained, levels, decisions), ratio), reduced_chi2=reduced_chi2)
