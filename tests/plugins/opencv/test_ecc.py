from __future__ import annotations

from collections.abc import Callable

import cv2
import numpy as np
import pytest

from photonpano import Located, NotLocated
from photonpano.geometry import corner_displacements, translation
from photonpano_opencv.brightness import EccLocator
from photonpano_opencv.configs import OpencvEccConfig

SHAPE = (160, 240)
STILL = np.eye(3)
LOCATOR = EccLocator(OpencvEccConfig())


def test_pyramid_is_finest_first_and_ends_above_smallest_side(seen_from: Callable) -> None:
    views = LOCATOR.describe(seen_from(STILL))
    assert [view.shape for view in views] == [(160, 240), (80, 120), (40, 60)]
    assert len(EccLocator(OpencvEccConfig(pyramid_levels=1)).describe(seen_from(STILL))) == 1


def test_ecc_locates_pair_of_different_brightness_with_less_certainty(seen_from: Callable) -> None:
    """The correlation coefficient does not depend on brightness; the expected error does."""
    true = translation(10, -3)
    equal, dimmed = (
        LOCATOR.register(LOCATOR.describe(seen_from(true, 1)), LOCATOR.describe(seen_from(STILL, 2, brightness)), None)
        for brightness in (1.0, 0.7)
    )
    for motion in (equal, dimmed):
        assert isinstance(motion, Located), motion
        assert corner_displacements(motion.homography, true, SHAPE).mean() < 0.15
    assert dimmed.residual_px > 2 * equal.residual_px


def test_ecc_skips_layers_that_fail(seen_from: Callable, monkeypatch: pytest.MonkeyPatch) -> None:
    find = cv2.findTransformECCWithMask

    def on_fine_levels_only(moving: np.ndarray, *rest: object) -> object:
        if moving.shape != SHAPE:
            raise cv2.error("the coarse levels see nothing")
        return find(moving, *rest)

    monkeypatch.setattr(cv2, "findTransformECCWithMask", on_fine_levels_only)
    true = translation(10.5, -3.25)
    motion = LOCATOR.register(LOCATOR.describe(seen_from(true, 1)), LOCATOR.describe(seen_from(STILL, 2)), None)
    assert isinstance(motion, Located), motion
    assert motion.evidence["aligned_levels"] == 1
    assert corner_displacements(motion.homography, true, SHAPE).mean() < 0.15


def test_ecc_reports_error_of_opencv_as_reason(seen_from: Callable) -> None:
    """From an initial motion without overlap OpenCV raises on every layer."""
    pair = (LOCATOR.describe(seen_from(each, seed)) for seed, each in enumerate((STILL, STILL)))
    motion = LOCATOR.register(*pair, translation(235, 0))
    assert isinstance(motion, NotLocated)
    assert motion.reason == "the correlation cannot be maximised: NaN encountered"
