"""Jumps of the image are found to the frame; tremor, turns and noise are not taken for jumps."""

from collections.abc import Callable, Iterator
from contextlib import contextmanager

import numpy as np
import pytest

from photonpano import FrameSpan
from photonpano.execution.context import Context
from photonpano.geometry import FrameTrajectory, translation
from photonpano.motion.frame_motion import FrameMotion
from photonpano.motion.level import Cut
from photonpano.residuals.cuts import find_cuts
from photonpano.residuals.refinement import MotionFit
from photonpano.testing import MemorySource
from photonpano.testing.captures import detected, seen_along

SHAPE, N_FRAMES, JUMP = (96, 128), 600, 330


@pytest.fixture
def cuts_of(street: np.ndarray) -> Callable[..., tuple[Cut, ...]]:
    """Look for cuts in frames of a street, given the true motion along x, in px by frame, and what the loop made of it."""

    def cuts_of(
        true_px: np.ndarray,
        found_px: np.ndarray,
        flux: float = 1.0,
        dark: FrameSpan | None = None,
        scene: np.ndarray = street,
        context: Context | None = None,
    ) -> tuple[Cut, ...]:
        lit = np.full(N_FRAMES, flux)
        if dark is not None:
            lit[dark.start : dark.stop] = 0
        views = seen_along(scene, [translation(250 + x, 300) for x in true_px], SHAPE)
        source = MemorySource(detected(lit[:, None, None] * views, 3))
        homographies = np.array([translation(x, 0) for x in found_px])
        everywhere, std_px = np.ones(N_FRAMES, dtype=bool), np.full(N_FRAMES, 0.05)
        trajectory, span = FrameTrajectory(homographies), FrameSpan(0, N_FRAMES)
        motion = FrameMotion(
            trajectory=trajectory,
            span=span,
            homographies=homographies,
            located=everywhere,
            std_px=std_px,
            reference=N_FRAMES // 2,
            frame_shape=SHAPE,
        )
        return find_cuts(source, MotionFit(source, motion, 2**30, Context()), context or Context(threads=2))

    return cuts_of


FRAMES = np.arange(N_FRAMES)
PAN_PX = 0.15 * FRAMES
AFTER = (FRAMES >= JUMP).astype(float)


def smoothed(motion_px: np.ndarray) -> np.ndarray:
    """Return what interpolation makes of a jump: half of a group of 60 frames on both sides is wrong."""
    kernel = np.hanning(60)
    return np.convolve(np.pad(motion_px, 60, mode="reflect", reflect_type="odd"), kernel / kernel.sum(), "same")[60:-60]


@pytest.mark.parametrize("jump_px", [-7.0, 3.0, 30.0])
def test_jump_is_found_to_the_frame_with_its_size(cuts_of: Callable[..., tuple[Cut, ...]], jump_px: float) -> None:
    true_px = PAN_PX + jump_px * AFTER
    [cut] = cuts_of(true_px, smoothed(true_px))
    assert cut.frame == JUMP
    # The camera moves on, so the image moves back.
    np.testing.assert_allclose(cut.shift_px, [-jump_px, 0], atol=1)
    assert cut.sigmas > 10
    assert cut.dark is None


def test_jump_is_found_in_dim_light(cuts_of: Callable[..., tuple[Cut, ...]]) -> None:
    true_px = PAN_PX + 6 * AFTER
    [cut] = cuts_of(true_px, smoothed(true_px), flux=0.1)
    assert abs(cut.frame - JUMP) <= 1


def test_sudden_turn_is_no_jump(cuts_of: Callable[..., tuple[Cut, ...]]) -> None:
    true_px = 0.4 * np.abs(FRAMES - JUMP)
    assert cuts_of(true_px, smoothed(true_px)) == ()


def test_jump_behind_dark_frames_is_cut_in_their_middle(cuts_of: Callable[..., tuple[Cut, ...]]) -> None:
    true_px, dark = PAN_PX + 40 * AFTER, FrameSpan(300, 350)
    [cut] = cuts_of(true_px, smoothed(true_px), dark=dark)
    assert (cut.frame, cut.dark) == (325, dark)
    np.testing.assert_allclose(cut.shift_px, [-40, 0], atol=2.5)


class Stages:
    """Progress that keeps how many units the stages have."""

    def __init__(self) -> None:
        self.total = 0

    @contextmanager
    def stage(self, title: str, total: int, unit: str) -> Iterator[Callable[[int], None]]:
        self.total += total
        yield lambda _: None


def test_only_frames_around_a_sudden_change_are_searched(cuts_of: Callable[..., tuple[Cut, ...]]) -> None:
    """All spans stand out from the noise where the loop has missed a tremor."""
    tremor_px, stages = 1.5 * np.sin(2 * np.pi * FRAMES / 160), Stages()
    assert cuts_of(PAN_PX + tremor_px, PAN_PX, context=Context(threads=1, progress=stages)) == ()
    assert stages.total == 0
    assert cuts_of(PAN_PX + 5 * AFTER, smoothed(PAN_PX + 5 * AFTER), context=Context(threads=1, progress=stages))
    assert 0 < stages.total < N_FRAMES / 2
