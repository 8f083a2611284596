"""The noise that pairs of exposures share."""

from collections.abc import Sequence

import numpy as np
import pytest

from photonpano import FrameSpan, Group
from photonpano.geometry import corners, transform_points
from photonpano.motion.adjustment import ExposureNoise, Problem
from photonpano.motion.planar import PlanarAdjustment, Plane
from photonpano.values import FloatArray

from .measured_graphs import SHAPE, edge, groups_of, noise_of, pairs, true_motion


def weights_within(groups: Sequence[Group], skips: Sequence[int]) -> FloatArray:
    """Return the weights of the pairs far from both ends of a capture."""
    ends = np.array(pairs(len(groups), skips))
    weights = ExposureNoise.of(ends, [group.span for group in groups]).weights
    inside = (ends.min(axis=1) > len(groups) / 3) & (ends.max(axis=1) < 2 * len(groups) / 3)
    return weights[inside]


@pytest.mark.parametrize(
    ("length", "skips", "weight"),
    [
        (10, (1,), 1),
        (10, (1, 2, 4), 1 / 3),  # six pairs of an exposure, where a chain has two
        (20, (2, 3, 4), 1 / 6),  # and each photon is in two exposures
        (40, (4, 6, 8), 1 / 12),
        (20, (1,), 1 / 4),  # half of the photons of both are the same, which say nothing of their motion
        (400, (1,), 0.05 / 40),  # nearly all of them, but no pair counts for less than a twentieth
    ],
)
def test_each_photon_counts_once_in_dense_groups_and_many_pairs(length: int, skips: tuple[int, ...], weight: float) -> None:
    groups = groups_of(240, length, 10)
    np.testing.assert_allclose(weights_within(groups, skips), weight, rtol=1e-3)


@pytest.mark.parametrize(
    ("first", "second", "correlation"),
    [
        (FrameSpan(0, 20), FrameSpan(10, 30), 1 / 2),
        (FrameSpan(0, 20), FrameSpan(20, 40), 0),
        (FrameSpan(0, 20), FrameSpan(4, 24), 4 / 5),
        (FrameSpan(0, 40), FrameSpan(10, 20), 1 / 2),  # all of the shorter one: 10 frames of 10 and of 40
    ],
)
def test_noise_of_exposures_correlates_by_the_frames_that_they_have_in_common(
    first: FrameSpan, second: FrameSpan, correlation: float
) -> None:
    shares = ExposureNoise.of(np.array([[1, 0]]), [first, second]).shares
    np.testing.assert_allclose(shares @ shares.T, [[1, correlation], [correlation, 1]], atol=1e-12)


def drawn(groups: Sequence[Group], skips: Sequence[int], n_draws: int) -> tuple[FloatArray, FloatArray]:
    """Return errors of pairs of unit variance as they are expected, and as exposures have them: (E, 8, n_draws) each."""
    true, ends, rng = true_motion(len(groups)), pairs(len(groups), skips), np.random.default_rng(0)
    motions = [edge(true, *pair).motion for pair in ends]
    instants, spans = np.array([group.reference for group in groups]), [group.span for group in groups]
    adjustment = PlanarAdjustment(
        Problem(pairs=np.array(ends), anchor=0, motions=motions, frame_shape=SHAPE, instants=instants, spans=spans),
        "homography",
    )
    expected = adjustment._noise.errors(*adjustment._body_slopes(Plane(true)), n_draws, rng)
    exact, found = adjustment.mapped_corners(Plane(true)), []
    for _ in range(n_draws):
        noise = noise_of(groups, rng)
        seen = transform_points(np.array([edge(true, *pair, noise).motion.homography for pair in ends]), corners(SHAPE))
        found.append(np.einsum("eij,ej->ei", adjustment._whitening, (seen - exact).reshape(-1, 8)))
    return expected, np.stack(found, axis=-1)


@pytest.mark.parametrize("length", [10, 20], ids=["disjoint", "half overlapping"])
def test_drawn_errors_are_those_of_pairs_that_share_the_noise_of_exposures(length: int) -> None:
    """Pairs that know all that their exposures do: their errors have unit variance, and correlate as exposures have them."""
    expected, found = drawn(groups_of(8, length, 10), (2, 3), 300)
    alone = np.einsum("eis,ejs->eij", expected, expected) / 300
    assert np.abs(alone - np.eye(8)).max() < 0.3
    assert np.abs(alone.mean(axis=0) - np.eye(8)).max() < 0.1
    of_pairs = [np.einsum("eis,fis->ef", each, each) / (8 * 300) for each in (expected, found)]
    np.testing.assert_allclose(of_pairs[0], of_pairs[1], atol=0.12)
    # What shares an exposure is far from independent.
    assert np.abs(of_pairs[0] - np.eye(len(expected))).max() > 0.4
