from __future__ import annotations

import cv2
import numpy as np
import pytest
from hypothesis import assume, given
from hypothesis import strategies as st

from photonpano.geometry import corners, from_parameters, normalised, rescaling, translation, why_implausible

SHAPE = (101, 201)


def about_centre(matrix: np.ndarray) -> np.ndarray:
    """Return a map that acts about the centre of the image."""
    return normalised(translation(100, 50) @ matrix @ translation(-100, -50))


def turned(degrees: float) -> np.ndarray:
    c, s = np.cos(np.deg2rad(degrees)), np.sin(np.deg2rad(degrees))
    return np.array([[c, -s, 0], [s, c, 0], [0, 0, 1]])


@pytest.mark.parametrize(
    "homography",
    [np.eye(3), translation(170, 0), translation(-90, 40), about_centre(turned(40)), about_centre(np.diag([1.3, 1.3, 1.0]))],
    ids=["identity", "shift", "diagonal shift", "roll", "zoom"],
)
def test_why_implausible_accepts_camera_motion(homography: np.ndarray) -> None:
    assert why_implausible(homography, SHAPE) is None


TURNED = np.array([[1.0, 0.0, 0.0], [0.0, 1.0, 0.0], [0.0025, 0.0, 1.0]])
TILTED = np.array([[1.0, 0.0, 0.0], [0.0, 1.0, 0.0], [0.0, 0.005, 1.0]])

REASONS = [
    (np.full((3, 3), np.nan), "the homography is not finite"),
    (np.array([[1.0, 0, 0], [0, 1, 0], [-0.01, 0, 1]]), "the homography sends part of the image behind the camera"),
    (about_centre(np.diag([-1.0, 1.0, 1.0])), "the homography mirrors or folds the image"),
    (np.diag([0.0, 1.0, 1.0]), "the homography mirrors or folds the image"),
    (
        about_centre(np.diag([2.0, 2.0, 1.0])),
        "the homography changes the area of the image by a factor of 4 (at most 2 is plausible)",
    ),
    (
        about_centre(rescaling(0.6)),
        "the homography changes the area of the image by a factor of 0.36 (at most 2 is plausible)",
    ),
    (
        about_centre(TURNED),
        "the homography makes opposite sides of the image differ by a factor of 1.7 (at most 1.5 is plausible)",
    ),
    (
        about_centre(TILTED),
        "the homography makes opposite sides of the image differ by a factor of 1.7 (at most 1.5 is plausible)",
    ),
    (translation(190, 0), "the images overlap by 5% (at least 10% is needed)"),
    (translation(1000, 0), "the images overlap by 0% (at least 10% is needed)"),
]


@pytest.mark.parametrize(("homography", "reason"), REASONS)
def test_why_implausible_gives_reason(homography: np.ndarray, reason: str) -> None:
    assert why_implausible(homography, SHAPE) == reason


@given(
    st.builds(
        lambda *p: about_centre(from_parameters(p)),
        *[st.floats(-0.15, 0.15)] * 4,
        st.floats(-150, 150),
        st.floats(-80, 80),
        *[st.floats(-5e-4, 5e-4)] * 2,
    )
)
def test_why_implausible_overlap_agrees_with_warped_mask(homography: np.ndarray) -> None:
    assume(why_implausible(homography, SHAPE, min_overlap=0) is None)
    height, width = SHAPE
    quad = cv2.perspectiveTransform(corners(SHAPE)[None], homography)[0]
    mask = np.zeros((16 * (height - 1), 16 * (width - 1)), np.uint8)  # sixteen times as fine
    cv2.fillConvexPoly(mask, np.rint(16 * quad - 0.5).astype(np.int32), 1)
    share = float(mask.mean())
    assume(share > 0.03)
    assert why_implausible(homography, SHAPE, min_overlap=share - 0.02) is None
    reason = why_implausible(homography, SHAPE, min_overlap=share + 0.02)
    assert reason is not None
    assert reason.startswith("the images overlap by ")
