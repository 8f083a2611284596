"""Turns of matched points, and locators that match points."""

from collections.abc import Iterator
from typing import NamedTuple

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from scipy.stats import binom

from photonpano import Located, LocatesTurns, NotLocated, VirtualExposure
from photonpano.geometry import Camera, corner_displacements, parameters, rotation_matrices, scaled_ahead, transform_points
from photonpano.locating import Matches, MatchingConfig, PointLocator, turn_of
from photonpano.locating.points import agreeing_by_chance

SHAPE = (160, 240)
CAMERA = Camera.of(300.0, SHAPE)
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


def test_turn_replaces_homography_of_fewer_matches() -> None:
    """Near the final motion, 300 matches were found, most of them by chance."""
    assert is_turn(registered(20, found(agreeing=99, inliers=300)))


LIMITS = MatchingConfig()


def matches(right: int, wrong: int = 0, std_px: float = 0.5, seed: int = 0, guided: bool = False) -> Matches:
    """Right matches that turn by TRUE, then wrong ones: within `search_px` of it if guided, else anywhere."""
    rng = np.random.default_rng(seed)
    points = rng.uniform((0, 0), (239, 159), (right + wrong, 2))
    moved = transform_points(TRUE, points) + rng.normal(0, std_px, points.shape)
    if guided:
        angles, radii = rng.uniform(0, 2 * np.pi, wrong), LIMITS.search_px * np.sqrt(rng.uniform(0, 1, wrong))
        moved[right:] = transform_points(TRUE, points[right:]) + (radii * [np.cos(angles), np.sin(angles)]).T
    else:
        moved[right:] = rng.uniform((0, 0), (239, 159), (wrong, 2))
    return Matches(points, moved, guided)


def turn(*attempts: Matches, focal_px: float = 300.0) -> Located | NotLocated:
    return turn_of(attempts, SHAPE, LIMITS, Camera.of(focal_px, SHAPE).matrix)


def located(motion: Located | NotLocated) -> Located:
    assert isinstance(motion, Located), motion
    return motion


def reason(motion: Located | NotLocated) -> str:
    assert isinstance(motion, NotLocated)
    return motion.reason


def error_px(motion: Located | NotLocated) -> float:
    return float(corner_displacements(located(motion).homography, TRUE, SHAPE).max())


def chi_squared(motion: Located | NotLocated) -> float:
    error = parameters(located(motion).homography) - parameters(TRUE)
    return float(error @ located(motion).information @ error)


@pytest.mark.parametrize("guided", [False, True])
def test_rotation_is_found_among_wrong_matches(guided: bool) -> None:
    """A homography needs more than 10 of 20 matches in the whole image, and more than 15 of 26 near a prediction."""
    motion = located(turn(matches(14, 12, guided=True) if guided else matches(9, 11)))
    assert error_px(motion) < 3
    assert motion.homography[2, 2] == 1
    assert motion.evidence["degrees_of_freedom"] == 3
    assert motion.evidence["inliers"] >= (14 if guided else 9)
    turned = CAMERA.rotations(motion.homography)
    np.testing.assert_allclose(turned @ turned.T, np.eye(3), atol=1e-9)


@pytest.mark.parametrize("focal_px", [300.0, 315.0], ids=["right", "5 % too long"])
@pytest.mark.parametrize(
    ("right", "wrong", "std_px", "guided"), [(12, 5, 0.5, False), (60, 0, 1.0, False), (40, 80, 1.5, True)], ids=str
)
def test_information_predicts_scatter(right: int, wrong: int, std_px: float, guided: bool, focal_px: float) -> None:
    """Over 24 fits chi squared of three unknowns has the mean 3, also if a wrong focal length bends the motion by some px."""
    found = [chi_squared(turn(matches(right, wrong, std_px, seed, guided), focal_px=focal_px)) for seed in range(24)]
    assert 1.5 < np.mean(found) < 4.5


def test_information_is_that_of_three_unknowns() -> None:
    values = np.linalg.eigvalsh(located(turn(matches(30))).information)
    assert np.linalg.matrix_rank(located(turn(matches(30))).information, tol=1e-3 * values[-1], hermitian=True) <= 3
    assert values[0] > 0


@pytest.mark.parametrize("guided", [False, True])
def test_wrong_matches_alone_are_rejected(guided: bool) -> None:
    for seed in range(40):
        motion = turn(matches(0, [6, 12, 40, 150][seed % 4], seed=seed, guided=guided))
        assert isinstance(motion, NotLocated), (seed, motion)


def test_too_few_matches_are_rejected() -> None:
    assert reason(turn(matches(4))) == "4 matches, and a rotation needs 5"


def test_one_structure_that_matches_often_counts_once() -> None:
    once = matches(4)
    jitter = np.random.default_rng(0).normal(0, 0.5, (20, 1, 2))
    often = Matches((once.moving + jitter).reshape(-1, 2), (once.fixed + jitter).reshape(-1, 2), guided=False)
    assert reason(turn(often)) == "4 matches, and a rotation needs 5"


def test_matches_in_a_spot_or_strip_are_rejected() -> None:
    """As those of an object that looks like another one; a strip is as good as no second direction."""
    every = matches(400)
    strip = np.abs(every.moving[:, 1] - 80) < 20
    found = turn(Matches(every.moving[strip], every.fixed[strip], guided=False))
    assert reason(found).endswith("matches agree, but lie in a spot or strip of 12 px (at least 16 px are needed)")


def test_implausible_rotation_is_rejected() -> None:
    points = np.random.default_rng(0).uniform((150, 0), (239, 159), (40, 2))
    far = scaled_ahead(CAMERA.homographies(rotation_matrices([0.0, -0.6, 0.0])))
    found = reason(turn(Matches(points, transform_points(far, points), guided=False)))
    assert found == "the homography changes the area of the image by a factor of 2.1 (at most 2 is plausible), from 39 matches"


@given(right=st.integers(0, 20), wrong=st.integers(0, 20), seed=st.integers(0, 2**32 - 1), spot=st.booleans())
def test_turn_of_never_raises(right: int, wrong: int, seed: int, spot: bool) -> None:
    found = matches(right, wrong, seed=seed)
    if spot:
        found.moving[:] = found.moving[:1]
    motion = turn(found)
    if isinstance(motion, Located):
        np.linalg.cholesky(motion.information)
    assert not (spot and isinstance(motion, Located))


def test_agreeing_by_chance_bounds_expected_number_of_rotations() -> None:
    """Among 40 matches, within 4 px of a search of 12 px: a ninth of the other 38 agree with each of 780 rotations."""
    every = matches(0, 40, guided=True)
    most = agreeing_by_chance(every.moving, every.fixed, TRUE, 4.0, 12.0)
    number, share = 40 * 39 / 2, 1 / 9
    assert number * binom.sf(most - 2, 38, share) < 1e-4 <= number * binom.sf(most - 3, 38, share)
