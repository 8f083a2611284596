"""Warnings of frames that are copies, and of a motion whose error is not known."""

from pathlib import Path

import numpy as np
import pytest

from photonpano.geometry import FrameTrajectory, translation
from photonpano.motion.frame_motion import FrameMotion
from photonpano.motion.level import Timeline
from photonpano.record.run_json import motion_warnings, timeline_warnings
from photonpano.values import FrameSpan


@pytest.mark.parametrize(("every", "n_copies"), [(2, "1,000"), (3, "666"), (10, None)])
def test_many_copies_are_a_warning(every: int, n_copies: str | None) -> None:
    timeline = Timeline.with_repeats(np.arange(2000) % every == every - 1)
    warnings = timeline_warnings(timeline, Path("run"))
    begins = [] if n_copies is None else [f"{n_copies} of 2,000 frames are copies of the frame before"]
    assert [each.partition(":")[0] for each in warnings] == begins
    assert timeline_warnings(Timeline.regular(2000), Path("run")) == timeline_warnings(None, Path("run")) == []


@pytest.mark.parametrize(
    ("px", "begins"), [(0.2, "how far the motion errs is not known"), (0.0, "only one exposure was located")]
)
def test_error_that_is_not_known_is_a_warning(px: float, begins: str) -> None:
    homographies = np.array([translation(px * frame, 0) for frame in range(100)])
    motion = FrameMotion(
        trajectory=FrameTrajectory(homographies),
        span=FrameSpan(0, 100),
        homographies=homographies,
        located=np.ones(100, np.bool_),
        std_px=np.full(100, np.inf),
        reference=50,
        frame_shape=(64, 96),
    )
    [warning] = motion_warnings(motion)
    assert warning.startswith(begins)
