"""The two-view locator, and what its library does to the process that it is loaded into."""

from __future__ import annotations

import sys
from concurrent.futures import ThreadPoolExecutor

import cv2
import numpy as np
import pytest

from photonpano import FrameSpan, Group, Located, NotLocated, VirtualExposure, discover
from photonpano.geometry import corner_displacements, translation
from photonpano.photometry import BinaryResponse

pytest.importorskip("pycolmap")

from collections.abc import Callable

from photonpano_colmap.hooks import PycolmapTwoViewConfig
from photonpano_colmap.reconstruction import Features, TwoViewLocator

SHAPE = (160, 240)
STILL = np.eye(3)


def locator(seed: int = 0, **config: object) -> TwoViewLocator:
    return TwoViewLocator(PycolmapTwoViewConfig.model_validate(config), seed)


def register(moving: VirtualExposure, fixed: Features, initial: np.ndarray | None = None) -> Located | NotLocated:
    return locator().register(locator().describe(moving), fixed, initial)


def located(motion: Located | NotLocated) -> Located:
    assert isinstance(motion, Located), motion
    return motion


def error_px(motion: Located | NotLocated, true: np.ndarray) -> float:
    return float(corner_displacements(located(motion).homography, true, SHAPE).mean())


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


@pytest.mark.parametrize(("kind", "name"), [("locator", "pycolmap-two-view"), ("pose-estimator", "colmap-averages")])
def test_component_is_listed_with_install_hint_if_library_is_missing(
    kind: str, name: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setitem(sys.modules, "pycolmap", None)
    assert str(discover().find(kind, name).unavailable).startswith(
        f"the {kind} '{name}' needs pycolmap, which is not installed: pip install \"photonpano["
    )
