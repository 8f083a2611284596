"""What the conformance kit does not test of locators: far motions, darkness, masks of one image, wallpaper, wrong starts."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from typing import Any

import numpy as np
import pytest

from photonpano import Located, LocatesTurns, NotLocated, StageContext, StreamInfo, VirtualExposure, discover
from photonpano.geometry import (
    Camera,
    corner_displacements,
    from_parameters,
    inverse,
    rotation_matrices,
    scaled_ahead,
    translation,
)
from photonpano.photometry import BinaryResponse

SHAPE = (160, 240)
STILL = np.eye(3)
SHIFT = translation(20.25, 7.5)
CATALOG = discover()
CONTEXT = StageContext(StreamInfo(1000, *SHAPE, frame_rate_hz=None), BinaryResponse())
# Mean error of a corner in px at 0.5 photons per pixel per frame, 250 frames.
TOLERANCE_PX = {
    "opencv-sift": 0.4,
    "opencv-orb": 1.2,
    "opencv-ecc": 0.15,
    "phase-correlation": 0.15,
    "direct": 0.15,
    "kornia-registrator": 0.15,
    "kornia-features": 0.3,
    "pycolmap-two-view": 0.4,
}
KEYPOINTS = ("opencv-sift", "opencv-orb", "kornia-features", "pycolmap-two-view")


def built(name: str, **keys: Any) -> Any:
    found = CATALOG.find("locator", name)
    if found.unavailable:
        pytest.skip(found.unavailable)
    return found.contribution.build(found.contribution.config(**keys), CONTEXT)


def register(
    name: str, moving: VirtualExposure, fixed: VirtualExposure, initial: np.ndarray | None = None
) -> Located | NotLocated:
    locator = built(name)
    return locator.register(locator.describe(moving), locator.describe(fixed), initial)


def error_px(motion: Located | NotLocated, true: np.ndarray) -> float:
    assert isinstance(motion, Located), motion
    return float(corner_displacements(motion.homography, true, SHAPE).mean())


def reason(motion: Located | NotLocated) -> str:
    assert isinstance(motion, NotLocated), motion
    return motion.reason


def masked(exposure: VirtualExposure, unseen: np.ndarray) -> VirtualExposure:
    flux = np.where(unseen, np.float32(np.nan), exposure.flux)
    return replace(exposure, flux=flux, weight=np.where(unseen, np.float32(0), exposure.weight))


@pytest.mark.parametrize("name", TOLERANCE_PX)
def test_shift_of_48_px_is_found(name: str, seen_from: Callable) -> None:
    true = translation(-48, 0)
    assert error_px(register(name, seen_from(true, 1), seen_from(STILL, 2)), true) < TOLERANCE_PX[name]


@pytest.mark.parametrize("name", TOLERANCE_PX)
def test_locator_works_in_the_dark(name: str, seen_from: Callable) -> None:
    """At 0.02 photons per pixel per frame."""
    assert error_px(register(name, seen_from(SHIFT, 1, 0.04), seen_from(STILL, 2, 0.04)), SHIFT) < 3 * TOLERANCE_PX[name]


@pytest.mark.parametrize("both", [False, True])
@pytest.mark.parametrize("name", TOLERANCE_PX)
def test_masked_third_does_not_bias_motion(name: str, both: bool, seen_from: Callable) -> None:
    """A third of one exposure is masked, and bright in the other; or of both, as on a sensor with a dead corner."""
    left = np.arange(SHAPE[1]) < 80 + np.zeros((SHAPE[0], 1))
    fixed = seen_from(STILL, 2)
    motion = register(name, masked(seen_from(SHIFT, 1), left), masked(fixed, left) if both else fixed)
    assert error_px(motion, SHIFT) < 2 * TOLERANCE_PX[name]


def roll(degrees: float) -> np.ndarray:
    """Return a rotation about the centre of the frame."""
    c, s = np.cos(np.deg2rad(degrees)), np.sin(np.deg2rad(degrees))
    middle = translation((SHAPE[1] - 1) / 2, (SHAPE[0] - 1) / 2)
    return middle @ np.array([[c, -s, 0], [s, c, 0], [0, 0, 1]]) @ inverse(middle)


FAR = {
    "shift": translation(-90, 20),
    "roll": roll(8),
    "perspective": from_parameters([0.03, -0.02, 0.01, -0.04, 12, 9, 1e-4, -5e-5]),
}


@pytest.mark.parametrize("name", ["opencv-sift", "pycolmap-two-view"])
@pytest.mark.parametrize("motion", FAR)
def test_keypoints_find_far_motions_whatever_the_start(name: str, motion: str, seen_from: Callable) -> None:
    """From a start beyond `search_px`, matches are searched in the whole image."""
    true, exposures = FAR[motion], (seen_from(FAR[motion], 1), seen_from(STILL, 2))
    for initial in (None, true, translation(30, 0) @ true):
        found = register(name, *exposures, initial)
        assert error_px(found, true) < 0.2
        assert found.evidence["inliers"] > 100


@pytest.mark.parametrize("name", ["opencv-sift", "kornia-registrator", "kornia-features", "pycolmap-two-view"])
def test_initial_motion_resolves_repeated_texture(name: str, photograph: Callable) -> None:
    """A wallpaper with a period of 40 px, six periods wide."""
    tile = 0.1 + np.random.default_rng(0).random((10, 10)).repeat(4, axis=0).repeat(4, axis=1)
    wallpaper = np.tile(tile, (7, 9))
    fixed, moving = photograph(wallpaper[20:180, 20:260], 0), photograph(wallpaper[23:183, 27:267], 1)
    if name in ("opencv-sift", "pycolmap-two-view"):
        assert isinstance(register(name, moving, fixed), NotLocated)
    for wallpapers in (0, 1):
        true = translation(7 + 40 * wallpapers, 3)
        assert error_px(register(name, moving, fixed, translation(5 + 40 * wallpapers, 2)), true) < TOLERANCE_PX[name]


@pytest.mark.parametrize(("name", "seeds"), [("opencv-sift", (21, 28)), ("opencv-orb", (0, 7))])
def test_turning_locates_pairs_in_the_dark_that_homographies_lose(
    name: str, seeds: tuple[int, ...], seen_from: Callable
) -> None:
    """At 0.001 photons per pixel per frame, 250 frames; the motion known so far is off by 3 px."""
    camera = Camera.of(300.0, SHAPE)
    true = scaled_ahead(camera.homographies(rotation_matrices([0.02, -0.05, 0.02])))
    locator = built(name)
    assert isinstance(locator, LocatesTurns)
    for seed in seeds:
        pair = [locator.describe(seen_from(each, 2 * seed + index, 0.002)) for index, each in enumerate((true, STILL))]
        assert isinstance(locator.register(*pair, true @ translation(2, -2)), NotLocated)
        motion = locator.turning(camera.matrix).register(*pair, true @ translation(2, -2))
        assert error_px(motion, true) < 3
        assert motion.evidence["degrees_of_freedom"] == 3


@pytest.mark.parametrize("flux", [0.0, np.nan, 50.0], ids=["dark", "unseen", "lit"])
@pytest.mark.parametrize("name", KEYPOINTS)
def test_exposure_without_keypoints_is_rejected_with_their_numbers(
    name: str, flux: float, photograph: Callable, seen_from: Callable
) -> None:
    locator, image = built(name), np.full(SHAPE, np.nan_to_num(flux, nan=0.5))
    empty, scene = photograph(image), seen_from(STILL)
    empty = locator.describe(masked(empty, np.full(SHAPE, np.isnan(flux))))
    scene = locator.describe(scene)
    for initial in (None, STILL):
        for moving, fixed in ((empty, empty), (scene, empty), (empty, scene)):
            numbers = f"({len(moving.points)} and {len(fixed.points)} keypoints)"
            assert reason(locator.register(moving, fixed, initial)) == f"0 matches, fewer than min_inliers = 12 {numbers}"


@pytest.mark.parametrize("seed", range(3))
def test_noise_is_rejected_with_initial_motion(photograph: Callable, seed: int) -> None:
    """Hundreds of keypoints of noise match near any predicted position, but do not agree."""
    sift = built("opencv-sift")
    features = [sift.describe(photograph(np.full(SHAPE, 0.5), 2 * seed + index)) for index in (0, 1)]
    assert min(len(each.points) for each in features) > 300
    for initial in (STILL, translation(13.3, -7.6)):
        reason(sift.register(*features, initial))


# Points that match one to one, without images: which motions are accepted.
BACKENDS = {
    "opencv-sift": {},
    "kornia-features": {"matcher": "smnn"},
    "kornia-features, adalam": {"matcher": "adalam"},
}


def features(name: str, points: np.ndarray) -> Any:
    """Return keypoints with distinct descriptors, as `describe` does."""
    rng, points = np.random.default_rng(0), points.astype(np.float32)
    if name == "opencv-sift":
        from photonpano_opencv.locators import Keypoints

        descriptors = rng.integers(0, 256, (len(points), 128), dtype=np.uint8)
        return Keypoints(points, np.full(len(points), 4, np.float32), descriptors, SHAPE)
    from photonpano_kornia.locators import SiftFeatures

    frames = np.concatenate([np.tile(6 * np.eye(2), (len(points), 1, 1)), points[:, :, None]], axis=2)
    unit = rng.normal(size=(len(points), 128))
    unit /= np.linalg.norm(unit, axis=1, keepdims=True)
    return SiftFeatures(frames.astype(np.float32), unit.astype(np.float16), SHAPE)


@pytest.fixture(params=BACKENDS)
def backend(request: pytest.FixtureRequest) -> str:
    return str(request.param)


def matched(
    backend: str, moving: np.ndarray, fixed: np.ndarray, initial: np.ndarray | None = None, **keys: Any
) -> Located | NotLocated:
    name = backend.partition(",")[0]
    locator = built(name, **BACKENDS[backend], **keys)
    return locator.register(features(name, moving), features(name, fixed), initial)


def few(motion: Located | NotLocated) -> tuple[str, dict[str, float]]:
    assert isinstance(motion, NotLocated), motion
    return motion.reason, dict(motion.evidence)


def uniform(count: int, *, sets: int = 1) -> Any:
    return np.random.default_rng(0).uniform((0, 0), (239, 159), (sets, count, 2)).squeeze()


@pytest.mark.parametrize("backend", ["opencv-sift", "kornia-features"], indirect=True)
def test_matches_that_agree_by_chance_are_rejected(backend: str) -> None:
    """200 outliers; more than 8 + 0.1 * 200 matches must agree."""
    points, moved = uniform(200, sets=2)
    reason, evidence = few(matched(backend, points, moved))
    assert reason == f"{evidence['agreeing']:.0f} of 200 matches agree on a motion, which may be chance (more than 28 must)"
    assert 4 <= evidence["agreeing"] <= 28
    # A third of them is more than chance gives.
    moved[:70] = points[:70] + np.array([3, 4])
    motion = matched(backend, points, moved)
    assert isinstance(motion, Located), motion
    assert corner_displacements(motion.homography, translation(3, 4), SHAPE).mean() < 0.1
