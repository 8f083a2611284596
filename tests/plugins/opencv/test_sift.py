from __future__ import annotations

from collections.abc import Callable

import numpy as np
import pytest

from photonpano import Located, NotLocated, VirtualExposure
from photonpano.geometry import apply, corner_displacements, corners, from_parameters, inverse, jacobian, translation
from photonpano_opencv.configs import OpencvSiftConfig
from photonpano_opencv.keypoints import Keypoints, SiftLocator

SHAPE = (160, 240)


def locator(**config: object) -> SiftLocator:
    return SiftLocator(OpencvSiftConfig.model_validate(config), seed=0)


def register(moving: VirtualExposure, fixed: VirtualExposure, initial: np.ndarray | None = None) -> Located | NotLocated:
    sift = locator()
    return sift.register(sift.describe(moving), sift.describe(fixed), initial)


def located(motion: Located | NotLocated) -> Located:
    assert isinstance(motion, Located), motion
    return motion


def error_px(motion: Located | NotLocated, true: np.ndarray) -> float:
    return float(corner_displacements(located(motion).homography, true, SHAPE).mean())


def roll(degrees: float) -> np.ndarray:
    """Return a rotation about the centre of the frame."""
    c, s = np.cos(np.deg2rad(degrees)), np.sin(np.deg2rad(degrees))
    middle = translation((SHAPE[1] - 1) / 2, (SHAPE[0] - 1) / 2)
    return middle @ np.array([[c, -s, 0], [s, c, 0], [0, 0, 1]]) @ inverse(middle)


MOTIONS = {
    "shift": translation(13.3, -7.6),
    "far": translation(-90, 20),
    "roll": roll(8),
    "perspective": from_parameters([0.03, -0.02, 0.01, -0.04, 12, 9, 1e-4, -5e-5]),
}


@pytest.mark.parametrize(("brightness", "tolerance_px"), [(1.0, 0.2), (0.2, 0.4)])
@pytest.mark.parametrize("true", MOTIONS.values(), ids=MOTIONS)
def test_sift_finds_known_motions_and_not_their_inverse(
    seen_from: Callable, true: np.ndarray, brightness: float, tolerance_px: float
) -> None:
    """At 0.5 and 0.1 photons per pixel per frame, 250 frames."""
    moving, fixed = seen_from(true, 1, brightness), seen_from(np.eye(3), 2, brightness)
    motion = located(register(moving, fixed))
    assert error_px(motion, true) < tolerance_px
    assert error_px(motion, inverse(true)) > 10
    assert motion.homography[2, 2] == 1
    assert motion.evidence["inliers"] > 100
    assert 0.02 <= motion.residual_px <= 1


def test_information_predicts_corner_errors_over_noisy_pairs(seen_from: Callable) -> None:
    """Over ten pairs at 0.1 photons per pixel per frame, to a factor of 3."""
    true, frame = MOTIONS["perspective"], corners(SHAPE)
    errors, predicted = [], []
    for seed in range(10):
        motion = located(register(seen_from(true, 2 * seed, 0.2), seen_from(np.eye(3), 2 * seed + 1, 0.2)))
        to_corners = jacobian(motion.homography, frame).reshape(8, 8)
        predicted.append(np.diag(to_corners @ np.linalg.inv(motion.information) @ to_corners.T))
        errors.append(apply(motion.homography, frame) - apply(true, frame))
    ratio = np.sqrt(np.mean(np.square(errors)) / np.mean(predicted))
    assert 1 / 3 < ratio < 3


@pytest.mark.parametrize("off_px", [0, 8, 15, 30])
def test_sift_finds_motion_from_wrong_initial_motion(seen_from: Callable, off_px: float) -> None:
    """Within `search_px` matching is guided; beyond, matches are searched in the whole image."""
    true = MOTIONS["roll"]
    initial = translation(off_px, 0) @ true
    assert error_px(register(seen_from(true, 1), seen_from(np.eye(3), 2), initial), true) < 0.2


def test_initial_motion_resolves_repeated_texture(photograph: Callable) -> None:
    """A wallpaper with a period of 40 px, six periods wide."""
    tile = 0.1 + np.random.default_rng(0).random((10, 10)).repeat(4, axis=0).repeat(4, axis=1)
    wallpaper = np.tile(tile, (7, 9))
    fixed, moving = photograph(wallpaper[20:180, 20:260], 0), photograph(wallpaper[23:183, 27:267], 1)
    assert isinstance(register(moving, fixed), NotLocated)
    for wallpapers in (0, 1):
        true = translation(7 + 40 * wallpapers, 3)
        assert error_px(register(moving, fixed, translation(4 + 40 * wallpapers, 1)), true) < 0.2


def few(motion: Located | NotLocated) -> tuple[str, dict[str, float]]:
    assert isinstance(motion, NotLocated)
    return motion.reason, dict(motion.evidence)


def test_pair_without_texture_is_rejected_with_numbers(photograph: Callable) -> None:
    reason, evidence = few(register(photograph(np.full(SHAPE, 0.5), 0), photograph(np.full(SHAPE, 0.5), 1)))
    assert reason == (
        f"{evidence['matches']:.0f} matches, fewer than min_inliers = 12 "
        f"({evidence['keypoints_moving']:.0f} and {evidence['keypoints_fixed']:.0f} keypoints)"
    )


@pytest.mark.parametrize("flux", [0.0, np.nan, 6.2146], ids=["dark", "unseen", "lit"])
def test_dark_masked_or_saturated_exposures_are_rejected(photograph: Callable, seen_from: Callable, flux: float) -> None:
    empty = photograph(np.zeros(SHAPE))
    empty.flux[:] = flux
    if np.isnan(flux):
        empty.weight[:] = 0
    text = "0 matches, fewer than min_inliers = 12 ({} and {} keypoints)"
    assert few(register(empty, empty))[0] == text.format(0, 0)
    for initial in (None, np.eye(3)):
        n = len(locator().describe(seen_from(np.eye(3))).points)
        assert few(register(seen_from(np.eye(3)), empty, initial))[0] == text.format(n, 0)


@pytest.mark.parametrize("initial", [None, np.eye(3), MOTIONS["roll"]], ids=["unknown", "still", "roll"])
def test_pair_of_different_places_is_rejected(seen_from: Callable, initial: np.ndarray | None) -> None:
    few(register(seen_from(translation(0, 330), 0), seen_from(np.eye(3), 1), initial))


@pytest.mark.parametrize("seed", range(3))
def test_noise_is_rejected_with_initial_motion(photograph: Callable, seed: int) -> None:
    """Hundreds of keypoints of noise match near any predicted position, but do not agree."""
    moving, fixed = (photograph(np.full(SHAPE, 0.5), 2 * seed + index) for index in (0, 1))
    sift = locator()
    features = sift.describe(moving), sift.describe(fixed)
    assert min(len(each.points) for each in features) > 300
    for initial in (np.eye(3), MOTIONS["shift"]):
        few(sift.register(*features, initial))


def features(points: np.ndarray, seed: int = 0) -> Keypoints:
    """Keypoints that match one to one, with distinct descriptors."""
    descriptors = np.random.default_rng(seed).integers(0, 256, (len(points), 128), dtype=np.uint8)
    return Keypoints(points.astype(np.float32), np.full(len(points), 4, np.float32), descriptors, SHAPE)


def test_keypoints_on_a_line_are_rejected() -> None:
    line = np.stack([np.linspace(10, 230, 40), np.full(40, 80.0)], axis=1)
    moved = line + np.random.default_rng(0).normal(scale=0.3, size=line.shape)
    few(locator().register(features(line), features(moved), None))


def test_matches_that_agree_by_chance_are_rejected() -> None:
    """200 outliers; more than 8 + 0.1 * 200 matches must agree."""
    rng = np.random.default_rng(0)
    points, moved = rng.uniform((0, 0), (239, 159), (2, 200, 2))
    reason, evidence = few(locator().register(features(points), features(moved), None))
    assert reason == f"{evidence['agreeing']:.0f} of 200 matches agree on a motion, which may be chance (more than 28 must)"
    assert 4 <= evidence["agreeing"] <= 28
    # A third of them is more than chance gives.
    moved[:70] = points[:70] + np.array([3, 4])
    assert error_px(locator().register(features(points), features(moved), None), translation(3, 4)) < 0.1


def test_clustered_keypoints_are_rejected_for_uncertain_corners() -> None:
    cluster = np.random.default_rng(0).uniform((20, 20), (60, 60), (30, 2))
    moved = cluster + np.random.default_rng(1).normal(scale=0.5, size=cluster.shape)
    reason, evidence = few(locator(max_std_px=0.5).register(features(cluster), features(moved), None))
    assert "inliers leave the corners of the frame uncertain by" in reason
    assert reason.endswith("px, more than max_std_px = 0.5")
    assert evidence["inliers"] == 30


def test_implausible_motion_is_rejected() -> None:
    """Keypoints at half their distances from the centre."""
    points = np.random.default_rng(0).uniform((0, 0), (239, 159), (60, 2))
    assert few(locator().register(features(points), features(0.5 * points + [60, 40]), None))[0] == (
        "the homography changes the area of the image by a factor of 0.25 (at most 2 is plausible), from 60 matches"
    )


@pytest.mark.parametrize("count", [0, 1, 2, 11])
def test_too_few_keypoints_are_rejected_with_their_numbers(count: int) -> None:
    points = np.random.default_rng(0).uniform((0, 0), (239, 159), (count, 2))
    for initial in (None, np.eye(3)):
        reason, evidence = few(locator().register(features(points), features(points), initial))
        assert reason.endswith(f"matches, fewer than min_inliers = 12 ({count} and {count} keypoints)")
        assert evidence == {"keypoints_moving": count, "keypoints_fixed": count, "matches": evidence["matches"]}


def test_describe_keeps_at_most_max_keypoints(seen_from: Callable) -> None:
    exposure = seen_from(np.eye(3))
    every, best = locator().describe(exposure), locator(max_keypoints=50).describe(exposure)
    assert len(every.points) > 300
    assert len(best.points) == len(best.sizes) == len(best.descriptors) == 50
    assert best.shape == SHAPE


def test_describe_finds_no_keypoints_in_masked_areas(seen_from: Callable) -> None:
    exposure = seen_from(np.eye(3))
    exposure.flux[:, :100], exposure.weight[:, :100] = np.nan, 0
    found = locator().describe(exposure)
    assert len(found.points) > 100
    assert found.points[:, 0].min() > 98


def test_sift_locates_half_masked_exposure(seen_from: Callable) -> None:
    true = MOTIONS["shift"]
    moving = seen_from(true, 1)
    moving.flux[:, :100], moving.weight[:, :100] = np.nan, 0
    assert error_px(register(moving, seen_from(np.eye(3), 2)), true) < 0.6
