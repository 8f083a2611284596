"""Warnings of frames that are copies, or out of order."""

from pathlib import Path

import numpy as np
import pytest

from photonpano.geometry import FrameTrajectory, translation
from photonpano.motion.frame_motion import FrameMotion
from photonpano.motion.timeline import Timeline
from photonpano.record.run_warnings import motion_warnings, timeline_warnings
from photonpano.values import FrameSpan


@pytest.mark.parametrize(("every", "n_copies"), [(2, "1,000"), (3, "666"), (10, None)])
def test_many_copies_are_a_warning(every: int, n_copies: str | None) -> None:
    timeline = Timeline.with_repeats(np.arange(2000) % every == every - 1)
    warnings = timeline_warnings(timeline, Path("run"))
    begins = [] if n_copies is None else [f"{n_copies} of 2,000 frames are copies of the frame before"]
    assert [each.partition(":")[0] for each in warnings] == begins
    assert timeline_warnings(Timeline.regular(2000), Path("run")) == timeline_warnings(None, Path("run")) == []


TIMES, RNG = np.arange(800), np.random.default_rng(2)
IN_BLOCKS = np.concatenate([start + RNG.permutation(8) for start in range(0, 800, 8)])
TREMOR = np.sin(2 * np.pi * TIMES / 3.3)


@pytest.mark.parametrize(
    ("times", "y", "warns"),
    [
        pytest.param(IN_BLOCKS, 0, True, id="shuffled within blocks of 8"),
        pytest.param(TIMES, 0, False, id="in order"),
        pytest.param(TIMES[::-1], 0, False, id="reversed"),
        pytest.param(TIMES // 2, 0, False, id="each frame twice"),
        pytest.param(TIMES + 5 * TREMOR, TREMOR, False, id="tremor"),
        pytest.param(400 - abs(TIMES - 400), 0, False, id="there and back"),
        pytest.param(IN_BLOCKS[:100], 0, False, id="short"),
    ],
)
def test_frames_that_jump_along_the_motion_alone_seem_to_be_out_of_order(times: np.ndarray, y: np.ndarray, warns: bool) -> None:
    places = np.broadcast_to(y, times.shape) + RNG.normal(0, 0.05, len(times))
    homographies = np.array([translation(0.2 * x, down) for x, down in zip(times, places, strict=True)])
    n_frames = len(times)
    known = np.ones(n_frames, np.bool_), np.full(n_frames, 0.1), n_frames // 2, (64, 96)
    motion = FrameMotion(FrameTrajectory(homographies), FrameSpan(0, n_frames), homographies, *known)
    assert [each.startswith("the image jumps back and forth along its motion") for each in motion_warnings(motion)] == [
        True
    ] * warns


@pytest.mark.parametrize(
    ("px", "begins"), [(0.2, "how far the motion errs is not known"), (0.0, "only one exposure was located")]
)
def test_error_that_is_not_known_is_a_warning(px: float, begins: str) -> None:
    homographies = np.array([translation(px * frame, 0) for frame in range(100)])
    known = np.ones(100, np.bool_), np.full(100, np.inf), 50, (64, 96)
    [warning] = motion_warnings(FrameMotion(FrameTrajectory(homographies), FrameSpan(0, 100), homographies, *known))
    assert warning.startswith(begins)
