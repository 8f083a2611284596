"""Pairs by the patches that agree with one motion of the camera."""

from __future__ import annotations

import numpy as np
import pytest

from photonpano.geometry import patch_centres, transform_points, translation
from photonpano.motion.consensus import TOLERANCES_PX, agreeing
from photonpano.values import Located, Patches

SHAPE = (120, 160)


def _by_agreement(shifts: np.ndarray, std_px: float, tolerance_px: float = TOLERANCES_PX[-1]) -> Located:
    """Return a pair by the patches that agree with a motion of none, where they lie at `shifts`, (P, 2) px."""
    information = np.tile(np.eye(2) / std_px**2, (len(shifts), 1, 1))
    motion = Located(translation(0, 0), np.eye(8), patches=Patches(shifts, information))
    return agreeing([motion], shifts[None], tolerance_px, SHAPE)[0]


def _moved_px(found: Located) -> np.ndarray:
    """Return how far a motion takes the middle of a frame: (2,)."""
    height, width = SHAPE
    middle = np.array([(width - 1) / 2, (height - 1) / 2])
    return transform_points(found.homography, middle[None])[0] - middle


@pytest.mark.parametrize("std_px", [0.05, 3.0])
def test_patches_agree_within_their_noise(std_px: float) -> None:
    """The finest tolerance, of 0.18 px, takes no patches with 3 px of noise for others: they tell half of what all tell."""
    rng = np.random.default_rng(4)
    noise = rng.normal(0, std_px, (20, len(patch_centres(SHAPE)), 2))
    moved = np.array([_moved_px(_by_agreement(shifts, std_px)) for shifts in noise])
    # Eight parameters of all patches leave the middle uncertain by 1.5 times the error of a mean, weights by noise add a half.
    assert np.sqrt((moved**2).mean()) < 2.2 * std_px / np.sqrt(noise.shape[1])
    kept, known = (_by_agreement(each, std_px).information for each in (noise[0], 0 * noise[0]))
    assert kept is not None
    assert known is not None
    assert np.trace(kept) > 0.3 * np.trace(known)


def test_patches_of_another_motion_do_not_count() -> None:
    """A third of the patches that lie 1 px further move the middle by a hundredth of that."""
    shifts = np.random.default_rng(5).normal(0, 0.05, (len(patch_centres(SHAPE)), 2))
    shifts[::3, 0] += 1
    assert np.abs(_moved_px(_by_agreement(shifts, 0.05))).max() < 0.02
