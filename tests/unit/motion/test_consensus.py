"""Pairs by the patches that agree with one motion of the camera."""

from __future__ import annotations

import numpy as np
import pytest

from photonpano.geometry import patch_centres, transform_points, translation
from photonpano.motion.models import APART, agreeing, tolerances_px, travelled
from photonpano.values import Located, Patches

SHAPE = (120, 160)


def _pair(std_px: float, wrong: int = 0, seed: int = 5) -> Located:
    """Return a pair that shows no motion, by patches with this noise, of which each `wrong`-th lies 1 px further."""
    shifts = np.random.default_rng(seed).normal(0, std_px, (len(patch_centres(SHAPE)), 2))
    if wrong:
        shifts[::wrong, 0] += 1
    information = np.tile(np.eye(2) / std_px**2, (len(shifts), 1, 1))
    return Located(translation(0, 0), np.eye(8), patches=Patches(shifts, information))


def _agreeing(motion: Located) -> Located:
    """Return the pair by the patches that agree with no motion, to the finest tolerance that their noise admits."""
    assert motion.patches is not None
    return agreeing([motion], motion.patches.shifts[None], tolerances_px([motion])[-1], SHAPE)[0]


@pytest.mark.parametrize("std_px", [0.05, 0.3, 3.0])
def test_noise_does_not_choose_the_patches_that_agree(std_px: float) -> None:
    """Of patches with 3 px of noise, a tolerance of 0.18 px would leave a few that agree by chance."""
    motions = [_agreeing(_pair(std_px, seed=seed)) for seed in range(20)]
    height, width = SHAPE
    middle = np.array([[(width - 1) / 2, (height - 1) / 2]])
    moved = np.array([transform_points(each.homography, middle)[0] - middle[0] for each in motions])
    # Eight parameters of all patches leave the middle uncertain by 1.5 times the error of a mean, weights by noise add a half.
    assert np.sqrt((moved**2).mean()) < 2.2 * std_px / np.sqrt(len(patch_centres(SHAPE)))
    shown = [each.patches for each in motions]
    assert all(each is not None and np.trace(each.information.sum(axis=0)) > 20 / std_px**2 for each in shown)


def test_patches_of_another_motion_do_not_count() -> None:
    """A third of the patches that lie 1 px further move the middle by a hundredth of that."""
    found = _agreeing(_pair(0.05, wrong=3))
    assert np.abs(transform_points(found.homography, np.array([[79.5, 59.5]])) - [79.5, 59.5]).max() < 0.02


def test_pairs_among_others_are_as_they_are_alone() -> None:
    """One has no patches, and one so few that agree that it says next to nothing."""
    lost = _pair(0.05, wrong=1)
    pairs = [_pair(0.05), Located(translation(3, 0), np.eye(8)), lost, _pair(0.3, wrong=3, seed=2)]
    shifts = np.array([np.zeros_like(lost.patches.shifts) if each.patches is None else each.patches.shifts for each in pairs])
    shifts[2] += 10
    found = agreeing(pairs, shifts, 0.5, SHAPE)
    for index, pair in enumerate(pairs):
        [alone] = agreeing([pair], shifts[index, None], 0.5, SHAPE)
        np.testing.assert_allclose(found[index].homography, alone.homography, atol=1e-9)
        np.testing.assert_allclose(found[index].information, alone.information, rtol=1e-6)
    assert found[1] is pairs[1]
    np.testing.assert_array_equal(found[2].homography, lost.homography)
    assert np.trace(found[2].information) < 1e-3 * np.trace(lost.information)
    assert not np.array_equal(found[3].homography, pairs[3].homography)


@pytest.mark.parametrize(("walks", "px"), [("", 30.0), ("both ways", 0.0), ("anywhere", 0.0)])
def test_only_what_rests_tells_how_far_the_camera_travels(walks: str, px: float) -> None:
    """The camera travels ahead and to the side: things move away from one point, by 3 px from each of 11 nodes to the next."""
    rng, places = np.random.default_rng(0), (patch_centres(SHAPE) - [79.5, 59.5]) / 200
    away = np.array([3.0, 0.5]) - 4 * places
    pairs, left, std_px = np.array([(node + 1, node) for node in range(10)]), [], 0.05
    for _ in pairs:
        shifts = away / np.median(np.linalg.norm(away, axis=1)) * rng.uniform(2, 4, (len(places), 1))
        if walks == "both ways":
            shifts *= np.sign(places[:, 1:])
        if walks == "anywhere":
            turned = rng.uniform(0, 2 * np.pi, len(places))
            shifts = np.linalg.norm(shifts, axis=1)[:, None] * np.stack([np.cos(turned), np.sin(turned)], axis=1)
        left.append(shifts + rng.normal(0, std_px, shifts.shape))
    motions, layers = [_pair(std_px)] * len(pairs), np.full((11, len(places)), APART + 1)
    assert travelled(pairs, motions, np.array(left), layers, np.tile(places, (10, 1, 1))) == pytest.approx(px, rel=0.1)
