from __future__ import annotations

from concurrent.futures import ThreadPoolExecutor
from dataclasses import replace

import cv2
import numpy as np
import pytest

from photonpano import FrameSpan, Group, Located, NotLocated, VirtualExposure
from photonpano.geometry import apply, corner_displacements, corners, from_parameters, inverse, jacobian, translation
from photonpano.photometry import BinaryResponse

pytest.importorskip("pycolmap")

from collections.abc import Callable

from photonpano_colmap.configs import PycolmapTwoViewConfig
from photonpano_colmap.two_view import Features, TwoViewLocator

SHAPE = (160, 240)
STILL = np.eye(3)


def locator(seed: int = 0, **config: object) -> TwoViewLocator:
    return TwoViewLocator(PycolmapTwoViewConfig.model_validate(config), seed)


def register(moving: VirtualExposure, fixed: Features, initial: np.ndarray | None = None) -> Located | NotLocated:
    return locator().register(locator().describe(moving), fixed, initial)


@pytest.fixture(scope="module")
def still(seen_from: Callable) -> Features:
    """The street at 0.5 photons per pixel per frame, 250 frames."""
    return locator().describe(seen_from(STILL, 2))


def located(motion: Located | NotLocated) -> Located:
    assert isinstance(motion, Located), motion
    return motion


def lost(motion: Located | NotLocated) -> NotLocated:
    assert isinstance(motion, NotLocated), motion
    return motion


def error_px(motion: Located | NotLocated, true: np.ndarray) -> float:
    return float(corner_displacements(located(motion).homography, true, SHAPE).mean())


def about_the_middle(degrees: float, zoom: float) -> np.ndarray:
    c, s = zoom * np.cos(np.deg2rad(degrees)), zoom * np.sin(np.deg2rad(degrees))
    middle = translation((SHAPE[1] - 1) / 2, (SHAPE[0] - 1) / 2)
    return middle @ np.array([[c, -s, 0], [s, c, 0], [0, 0, 1]]) @ inverse(middle)


MOTIONS = {
    "shift": translation(13.3, -7.6),
    "far": translation(-90, 20),
    "rotation": about_the_middle(8, 1),
    "homography": from_parameters([0.03, -0.02, 0.01, -0.04, 12, 9, 1e-4, -5e-5]),
}


@pytest.mark.parametrize("true", MOTIONS.values(), ids=MOTIONS)
def test_two_view_finds_known_motions_and_not_their_inverse(seen_from: Callable, still: Features, true: np.ndarray) -> None:
    motion = located(register(seen_from(true, 1), still))
    assert error_px(motion, true) < 0.2
    assert error_px(motion, inverse(true)) > 10
    assert motion.homography[2, 2] == 1
    assert motion.evidence["inliers"] > 100


def test_two_view_works_in_the_dark(seen_from: Callable) -> None:
    """At 0.02 photons per pixel per frame, 250 frames."""
    true = MOTIONS["shift"]
    motion = register(seen_from(true, 1, 0.04), locator().describe(seen_from(STILL, 2, 0.04)))
    assert error_px(motion, true) < 0.8


def noise_free(flux: np.ndarray) -> VirtualExposure:
    weight = np.full(SHAPE, 250, np.float32)
    return VirtualExposure(flux.astype(np.float32), weight, Group(FrameSpan(0, 250), 0), 1.0, BinaryResponse())


def test_keypoints_have_integer_pixel_centres() -> None:
    """Blobs between and on pixels; the library's own positions are half a pixel down and to the right."""
    y, x = np.mgrid[: SHAPE[0], : SHAPE[1]]
    true = np.array([[40, 40], [120.5, 40], [200, 40.25], [40.75, 120], [120, 120], [200.5, 120.5]])
    blobs = sum(np.exp(-((x - a) ** 2 + (y - b) ** 2) / (2 * 4**2)) for a, b in true)
    found = locator().describe(noise_free(0.1 + 0.5 * blobs))
    nearest = np.linalg.norm(found.points[:, None] - true, axis=2).argmin(axis=0)
    np.testing.assert_allclose(found.points[nearest], true, atol=0.1)
    handed_on = np.array([(each.x, each.y) for each in found.for_matcher()[0]])
    np.testing.assert_allclose(handed_on, found.points, atol=1e-4)


def test_two_view_is_exact_to_half_a_pixel_between_scales(street: np.ndarray) -> None:
    """Half a pixel of the smaller image is more than half a pixel of the other."""
    true = translation(20, 15) @ np.diag([0.75, 0.75, 1])
    views = (translation(400, 280) @ motion for motion in (true, STILL))
    flags = cv2.INTER_LINEAR | cv2.WARP_INVERSE_MAP
    moving, fixed = (noise_free(cv2.warpPerspective(street, view, SHAPE[::-1], flags=flags)) for view in views)
    halves = translation(0.5, 0.5) @ true @ translation(-0.5, -0.5)
    assert corner_displacements(true, halves, SHAPE).min() > 0.17
    assert error_px(register(moving, locator().describe(fixed)), true) < 0.05


def test_information_predicts_corner_errors_over_noisy_pairs(seen_from: Callable) -> None:
    """Over three pairs at 0.1 photons, corners err as much as the information predicts, to a factor of 3."""
    true, frame = MOTIONS["homography"], corners(SHAPE)
    two_view = locator(max_keypoints=400)
    errors, predicted = [], []
    for seed in range(3):
        moving, fixed = seen_from(true, 2 * seed, 0.2), seen_from(STILL, 2 * seed + 1, 0.2)
        motion = located(two_view.register(two_view.describe(moving), two_view.describe(fixed), true))
        to_corners = jacobian(motion.homography, frame).reshape(8, 8)
        predicted.append(np.diag(to_corners @ np.linalg.inv(motion.information) @ to_corners.T))
        errors.append(apply(motion.homography, frame) - apply(true, frame))
    assert 1 / 3 < np.sqrt(np.mean(np.square(errors)) / np.mean(predicted)) < 3


def test_initial_motion_resolves_repeated_texture(photograph: Callable) -> None:
    """A wallpaper with a period of 40 px, six periods wide."""
    tile = 0.1 + np.random.default_rng(0).random((10, 10)).repeat(4, axis=0).repeat(4, axis=1)
    wallpaper = np.tile(tile, (7, 9))
    two_view = locator()
    fixed, moving = (two_view.describe(photograph(wallpaper[y : y + 160, x : x + 240])) for x, y in ((20, 20), (27, 23)))
    lost(two_view.register(moving, fixed, None))
    for wallpapers in (0, 1):
        true = translation(7 + 40 * wallpapers, 3)
        assert error_px(two_view.register(moving, fixed, translation(4 + 40 * wallpapers, 1)), true) < 0.2


def test_two_view_finds_motion_from_wrong_initial_motion(seen_from: Callable, still: Features) -> None:
    true = MOTIONS["rotation"]
    motion = register(seen_from(true, 1), still, translation(30, 0) @ true)
    assert error_px(motion, true) < 0.2


def test_result_is_independent_of_threads_and_order(seen_from: Callable) -> None:
    two_view = locator(seed=2**40, max_keypoints=300)
    exposures = [seen_from(translation(9 * index, 0), index) for index in range(3)]
    features = [two_view.describe(each) for each in exposures]
    pairs = [(1, 0), (2, 1), (2, 0)]

    def motion(pair: tuple[int, int]) -> bytes:
        moving, fixed = pair
        found = located(two_view.register(features[moving], features[fixed], None))
        return found.homography.tobytes() + found.information.tobytes()

    alone = [motion(pair) for pair in pairs]
    with ThreadPoolExecutor(2) as pool:
        assert list(pool.map(motion, reversed(pairs))) == alone[::-1]
        assert [each.points.tobytes() for each in pool.map(two_view.describe, exposures)] == [
            each.points.tobytes() for each in features
        ]


def masked(exposure: VirtualExposure, unseen: np.ndarray) -> VirtualExposure:
    return replace(
        exposure,
        flux=np.where(unseen, np.float32(np.nan), exposure.flux),
        weight=np.where(unseen, np.float32(0), exposure.weight),
    )


def test_masked_third_does_not_bias_motion(seen_from: Callable) -> None:
    """The same third of both exposures, as on a sensor with a dead corner."""
    left = np.arange(SHAPE[1]) < 80 + np.zeros((SHAPE[0], 1))
    two_view, true = locator(), MOTIONS["shift"]
    moving, fixed = (two_view.describe(masked(each, left)) for each in (seen_from(true, 1), seen_from(STILL, 2)))
    assert min(each.points[:, 0].min() for each in (moving, fixed)) > 79
    assert error_px(two_view.register(moving, fixed, None), true) < 0.4


@pytest.mark.parametrize("what", ["grey", "dark", "unseen", "lit"])
def test_pair_without_texture_is_rejected(photograph: Callable, still: Features, what: str) -> None:
    two_view = locator(max_keypoints=300)
    wall = photograph(np.full(SHAPE, {"grey": 0.5, "dark": 0.0, "unseen": 0.5, "lit": 50.0}[what]))
    if what == "unseen":
        wall = masked(wall, np.ones(SHAPE, bool))
    blank = two_view.describe(wall)
    other = two_view.describe(photograph(np.full(SHAPE, 0.5), 9)) if what == "grey" else blank
    assert (len(blank.points) == 0) == (what != "grey")
    for initial in (None, STILL, MOTIONS["far"]):
        for pair in ((blank, other), (blank, still), (still, blank)):
            motion = lost(two_view.register(*pair, initial))
            moving, fixed = (len(each.points) for each in pair)
            assert motion.reason == (
                f"{motion.evidence['matches']:.0f} matches, fewer than min_inliers = 12 ({moving} and {fixed} keypoints)"
            )


def test_describe_keeps_the_largest_keypoints(seen_from: Callable, still: Features) -> None:
    best = locator(max_keypoints=50).describe(seen_from(STILL, 2))
    assert len(still.points) > 300
    assert len(best.points) == len(best.descriptors) == 50
    assert best.sizes.min() > np.quantile(still.sizes, 0.9)
    assert np.all(np.diff(best.sizes) <= 0)
