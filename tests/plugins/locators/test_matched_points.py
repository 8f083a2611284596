"""Points that match one to one, without images: which motions locators accept."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest

from photonpano import Located, NotLocated, StageContext, StreamInfo, discover
from photonpano.geometry import corner_displacements, translation
from photonpano.photometry import BinaryResponse

SHAPE = (160, 240)
CATALOG = discover()
CONTEXT = StageContext(StreamInfo(1000, *SHAPE, frame_rate_hz=None), BinaryResponse())
BACKENDS = {
    "opencv-sift": {},
    "kornia-features": {"matcher": "smnn"},
    "kornia-features, adalam": {"matcher": "adalam"},
}


def features(name: str, points: np.ndarray) -> Any:
    """Return keypoints with distinct descriptors, as `describe` does."""
    rng, points = np.random.default_rng(0), points.astype(np.float32)
    if name == "opencv-sift":
        from photonpano_opencv.keypoints import Keypoints

        descriptors = rng.integers(0, 256, (len(points), 128), dtype=np.uint8)
        return Keypoints(points, np.full(len(points), 4, np.float32), descriptors, SHAPE)
    from photonpano_kornia.matched import SiftFeatures

    frames = np.concatenate([np.tile(6 * np.eye(2), (len(points), 1, 1)), points[:, :, None]], axis=2)
    unit = rng.normal(size=(len(points), 128))
    unit /= np.linalg.norm(unit, axis=1, keepdims=True)
    return SiftFeatures(frames.astype(np.float32), unit.astype(np.float16), SHAPE)


@pytest.fixture(params=BACKENDS)
def backend(request: pytest.FixtureRequest) -> str:
    return str(request.param)


def register(
    backend: str, moving: np.ndarray, fixed: np.ndarray, initial: np.ndarray | None = None, **keys: Any
) -> Located | NotLocated:
    name = backend.partition(",")[0]
    found = CATALOG.find("locator", name)
    if found.unavailable:
        pytest.skip(found.unavailable)
    locator = found.contribution.build(found.contribution.config(**BACKENDS[backend], **keys), CONTEXT)
    return locator.register(features(name, moving), features(name, fixed), initial)


def few(motion: Located | NotLocated) -> tuple[str, dict[str, float]]:
    assert isinstance(motion, NotLocated), motion
    return motion.reason, dict(motion.evidence)


def uniform(count: int, *, sets: int = 1) -> Any:
    return np.random.default_rng(0).uniform((0, 0), (239, 159), (sets, count, 2)).squeeze()


@pytest.mark.parametrize("count", [0, 1, 2, 11])
def test_too_few_keypoints_are_rejected_with_their_numbers(backend: str, count: int) -> None:
    points = uniform(count).reshape(-1, 2)
    for initial in (None, np.eye(3)):
        reason, evidence = few(register(backend, points, points, initial))
        assert reason.endswith(f" matches, fewer than min_inliers = 12 ({count} and {count} keypoints)")
        assert evidence == {"keypoints_moving": count, "keypoints_fixed": count, "matches": evidence["matches"]}


def test_keypoints_on_a_line_are_rejected(backend: str) -> None:
    line = np.stack([np.linspace(10, 230, 40), np.full(40, 80.0)], axis=1)
    few(register(backend, line, line + np.random.default_rng(0).normal(scale=0.3, size=line.shape)))


@pytest.mark.parametrize("backend", ["opencv-sift", "kornia-features"], indirect=True)
def test_matches_that_agree_by_chance_are_rejected(backend: str) -> None:
    """200 outliers; more than 8 + 0.1 * 200 matches must agree."""
    points, moved = uniform(200, sets=2)
    reason, evidence = few(register(backend, points, moved))
    assert reason == f"{evidence['agreeing']:.0f} of 200 matches agree on a motion, which may be chance (more than 28 must)"
    assert 4 <= evidence["agreeing"] <= 28
    # A third of them is more than chance gives.
    moved[:70] = points[:70] + np.array([3, 4])
    motion = register(backend, points, moved)
    assert isinstance(motion, Located), motion
    assert corner_displacements(motion.homography, translation(3, 4), SHAPE).mean() < 0.1


@pytest.mark.parametrize("backend", ["opencv-sift", "kornia-features"], indirect=True)
def test_clustered_keypoints_are_rejected_for_uncertain_corners(backend: str) -> None:
    cluster = np.random.default_rng(0).uniform((20, 20), (60, 60), (30, 2))
    moved = cluster + np.random.default_rng(1).normal(scale=0.5, size=cluster.shape)
    reason, evidence = few(register(backend, cluster, moved, max_std_px=0.5))
    assert "inliers leave the corners of the frame uncertain by" in reason
    assert reason.endswith("px, more than max_std_px = 0.5")
    assert evidence["inliers"] >= 28


@pytest.mark.parametrize("backend", ["opencv-sift", "kornia-features"], indirect=True)
def test_implausible_motion_is_rejected(backend: str) -> None:
    """Keypoints at half their distances from the centre."""
    points = uniform(60)
    assert few(register(backend, points, 0.5 * points + [60, 40]))[0] == (
        "the homography changes the area of the image by a factor of 0.25 (at most 2 is plausible), from 60 matches"
    )
