from __future__ import annotations

from collections.abc import Iterator
from typing import NamedTuple

import numpy as np
import pytest

from photonpano import Located, LocatesTurns, NotLocated, VirtualExposure
from photonpano.geometry import Camera, corner_displacements, rotation_matrices, scaled_ahead, transform_points
from photonpano.locating import Matches, MatchingConfig, PointLocator

CAMERA = Camera.of(300.0, (160, 240))
TRUE = scaled_ahead(CAMERA.homographies(rotation_matrices([0.03, -0.1, 0.05])))


class Picture(NamedTuple):
    shape: tuple[int, int]


class Known(PointLocator):
    """Finds `count` matches of TRUE, and says that the homography is what it is told."""

    def __init__(self, count: int, homography: Located | NotLocated) -> None:
        self._config = MatchingConfig()
        self._count, self._found = count, homography

    def describe(self, exposure: VirtualExposure) -> Picture:
        return Picture(exposure.flux.shape)

    def _homography(self, moving: Picture, fixed: Picture, initial: np.ndarray | None) -> Located | NotLocated:
        return self._found

    def _matches(self, moving: Picture, fixed: Picture, initial: np.ndarray | None) -> Iterator[Matches]:
        points = np.random.default_rng(0).uniform((0, 0), (239, 159), (self._count, 2))
        yield Matches(points, transform_points(TRUE, points), guided=initial is not None)


def registered(count: int, homography: Located | NotLocated, turning: bool = True) -> Located | NotLocated:
    locator = Known(count, homography)
    assert isinstance(locator, LocatesTurns)
    picture = Picture((160, 240))
    turned = locator.turning(CAMERA.matrix)
    return (turned if turning else locator).register(picture, picture, None)


def found(**evidence: float) -> Located:
    return Located(np.eye(3), evidence=evidence)


LOST = NotLocated("9 of 18 matches agree", {"matches": 18})


def is_turn(motion: Located | NotLocated) -> bool:
    return isinstance(motion, Located) and corner_displacements(motion.homography, TRUE, (160, 240)).max() < 0.1


def test_turn_replaces_homography_that_was_not_found() -> None:
    motion = registered(20, LOST)
    assert is_turn(motion)
    assert motion.evidence == {"matches": 20, "inliers": 20, "degrees_of_freedom": 3}


def test_without_camera_nothing_is_replaced() -> None:
    assert registered(20, LOST, turning=False) is LOST


@pytest.mark.parametrize("evidence", [{"agreeing": 100, "inliers": 90}, {"inliers": 100}], ids=["consensus", "inliers"])
def test_hundred_matches_determine_a_homography(evidence: dict[str, float]) -> None:
    assert registered(200, motion := found(**evidence)) is motion


def test_turn_replaces_homography_of_fewer_matches() -> None:
    """Near the final motion, 300 matches were found, most of them by chance."""
    assert is_turn(registered(20, found(agreeing=99, inliers=300)))


def test_homography_of_few_matches_stays_if_there_is_no_turn() -> None:
    assert registered(2, motion := found(agreeing=13, inliers=12)) is motion


def test_both_failures_are_told() -> None:
    reason = "9 of 18 matches agree; as a rotation: 2 matches, and a rotation needs 5"
    assert registered(2, LOST) == NotLocated(reason, {"matches": 18})
