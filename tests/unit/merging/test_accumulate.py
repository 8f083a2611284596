from collections.abc import Callable
from dataclasses import replace

import cv2
import numpy as np
import pytest

from photonpano import FrameSpan
from photonpano.capture import capture_of
from photonpano.geometry import from_parameters, rescaling, translation
from photonpano.merging import Chunk, PhotonSum, accumulate, chunks_of
from photonpano.photometry import BinaryResponse
from photonpano.testing import MemorySource
from photonpano.testing.captures import detected

SHAPE = (30, 40)
FLUX = 0.7


def frames_of(flux: np.ndarray | float, n: int) -> np.ndarray:
    """Binary frames of a still scene."""
    return detected(np.broadcast_to(flux, (n, *SHAPE)))


def still(n: int, homography: np.ndarray | None = None) -> list[Chunk]:
    return [Chunk(FrameSpan(0, n), np.eye(3) if homography is None else homography)]


HALVES = [Chunk(FrameSpan(0, 20), np.eye(3)), Chunk(FrameSpan(20, 50), np.eye(3))]


@pytest.mark.parametrize(("chunks", "told"), [(still(50), [50]), (HALVES, [20, 30])], ids=["whole", "halves"])
def test_accumulate_returns_source_counts_of_still_capture(memory_source: type, chunks: list[Chunk], told: list[int]) -> None:
    source = memory_source(frames_of(FLUX, 50))
    advances: list[int] = []
    photons = accumulate(source, chunks, np.eye(3), SHAPE, advances.append)
    np.testing.assert_array_equal(photons.counts, source.counts(FrameSpan(0, 50)))
    np.testing.assert_array_equal(photons.weight, np.full(SHAPE, 50))
    assert advances == told


def test_accumulate_interpolates_counts_and_weight_alike(memory_source: type) -> None:
    """Shifted by 0.5 px, every pixel is the mean of two; at the border half of the weight is missing."""
    source = memory_source(frames_of(FLUX, 50))
    photons = accumulate(source, still(50, translation(0.5, 0)), np.eye(3), SHAPE)
    counts = source.counts(FrameSpan(0, 50)).astype(float)
    np.testing.assert_allclose(photons.counts[:, 1:], (counts[:, :-1] + counts[:, 1:]) / 2, rtol=1e-5)
    np.testing.assert_allclose(photons.counts[:, 0], counts[:, 0] / 2, rtol=1e-5)
    np.testing.assert_allclose(photons.weight[:, :2], [[25, 50]] * 30, rtol=1e-5)


def test_accumulate_misplaces_chunks_by_less_than_tolerance(memory_source: type, known_motion: type) -> None:
    """In a smooth scene, a displacement by d px changes a count by d times its gradient."""
    n, tolerance_px = 80, 0.5
    motion = known_motion(lambda frame: from_parameters(np.array([1e-4, 5e-4, -5e-4, 0, 0.11, 0.05, 1e-6, 0]) * frame))
    y, x = np.mgrid[: SHAPE[0], : SHAPE[1]]
    bright = 0.5 + 0.4 * np.sin(x / 4) * np.cos(y / 5)
    frames = frames_of(-np.log1p(-bright), n)
    source = memory_source(frames)
    chunks = chunks_of(FrameSpan(0, n), motion, SHAPE, tolerance_px)
    assert 10 < len(chunks) < n / 2
    grid = (50, 60)
    onto = translation(5, 5)
    quick = accumulate(source, chunks, onto, grid)
    counts, weight = np.zeros(grid), np.zeros(grid)
    for frame, homography in zip(frames, motion.at(range(n)), strict=True):
        for total, image in ((counts, frame), (weight, np.ones(SHAPE))):
            total += cv2.warpPerspective(image.astype(np.float32), onto @ homography, grid[::-1])
    inside = weight > n - 0.5
    assert inside.sum() > 400
    # Smooth the photon noise away, which moves with the chunks: what is left is the misplacement.
    misplaced = cv2.GaussianBlur(np.where(inside, quick.counts - counts, 0), (0, 0), 2) / n
    slope = 0.4 / 4
    assert np.abs(misplaced).max() < slope * tolerance_px / 2
    np.testing.assert_allclose(quick.weight[inside], n, atol=1)
    assert abs(quick.weight.sum() / weight.sum() - 1) < 0.01


def test_estimate_of_panned_frames_is_unbiased_and_of_still_ones_has_photon_noise(memory_source: type, pan: Callable) -> None:
    """The standard error of the mean over P pixels of n frames is sqrt((exp(f) - 1) / (n P))."""
    n = 200
    source = memory_source(frames_of(FLUX, n))
    chunks = chunks_of(FrameSpan(0, n), pan(0.013), SHAPE, 0.25)
    flux, weight = accumulate(source, chunks, np.eye(3), SHAPE).estimate(source.response)
    known = flux[weight > n - 1]
    bias = np.expm1(FLUX) / (2 * n)
    std = np.sqrt(np.expm1(FLUX) / (n * known.size))
    assert abs(known.mean() - FLUX - bias) < 4 * std
    assert abs(known.mean() - FLUX) < 0.01
    flux, _ = accumulate(source, still(n), np.eye(3), SHAPE).estimate(source.response)
    # With 1,200 pixels the standard deviation has an error of 2 %.
    assert flux.std() == pytest.approx(np.sqrt(np.expm1(FLUX) / n), rel=0.08)


@pytest.fixture
def masked(memory_source: type) -> object:
    """A capture with one hot pixel, which is masked."""
    frames = frames_of(FLUX, 200)
    frames[:, 10, 20] = True
    valid = np.ones(SHAPE, bool)
    valid[10, 20] = False
    return memory_source(frames, valid)


def test_masked_pixel_is_nan_for_a_still_camera_and_filled_from_moved_frames(masked, pan: Callable) -> None:
    flux, weight = accumulate(masked, still(200), np.eye(3), SHAPE).estimate(masked.response)
    assert weight[10, 20] == 0
    assert np.isnan(flux[10, 20])
    assert np.isnan(flux).sum() == 1
    chunks = chunks_of(FrameSpan(0, 200), pan(0.02), SHAPE, 0.25)
    flux, weight = accumulate(masked, chunks, np.eye(3), SHAPE).estimate(masked.response)
    seen = weight[10, 20:25]
    assert np.all((seen > 50) & (seen < 190))
    # Lit in every frame it would be ln(400); it is as the others, within five times the noise.
    np.testing.assert_allclose(flux[10, 20:25], FLUX, atol=5 * np.sqrt(np.expm1(FLUX) / 50))


@pytest.mark.parametrize("factor", [2, 3, 5])
def test_accumulate_preserves_photons_on_coarser_grid(memory_source: type, factor: int) -> None:
    """3 and 5 do not divide both sides of 30x40 px: the missing part of the last pixels is unseen, not dark."""
    source = memory_source(frames_of(FLUX, 50))
    grid = (-(-SHAPE[0] // factor), -(-SHAPE[1] // factor))
    photons = accumulate(source, still(50), rescaling(1 / factor), grid)
    assert photons.counts.sum() * factor**2 == pytest.approx(int(source.counts(FrameSpan(0, 50)).sum()), rel=1e-5)
    assert photons.weight.sum() * factor**2 == pytest.approx(50 * SHAPE[0] * SHAPE[1], rel=1e-6)
    flux, _ = photons.estimate(source.response)
    assert np.nanmean(flux) == pytest.approx(FLUX, abs=0.02)


def test_estimate_is_nan_below_one_frame_and_zero_where_corrected_counts_are_negative() -> None:
    counts, weight = np.float32([[0.5, 0.5, 3]]), np.float32([[0.99, 1, 4]])
    flux, known = PhotonSum(counts, weight).estimate(BinaryResponse())
    np.testing.assert_array_equal(known, [[0, 1, 4]])
    np.testing.assert_allclose(flux, [[np.nan, np.log(2), np.log(4)]], rtol=1e-6)
    flux, _ = PhotonSum(np.float32([[-3, 5]]), np.float32([[10, 10]])).estimate(BinaryResponse())
    assert flux.tolist() == [[0, pytest.approx(np.log(2))]]


def halved_less_an_offset(counts: np.ndarray, n_frames: int) -> np.ndarray:
    assert counts.dtype == np.uint32
    return counts.astype(np.float32) / 2 - n_frames


@pytest.mark.parametrize("scale", [1, 0.5])
def test_accumulate_corrects_each_chunk_once(scale: float) -> None:
    """Sums are corrected before pixels are masked and averaged, also if they come from a cache."""
    frames = frames_of(FLUX, 50)
    valid = np.random.default_rng(0).random(SHAPE) > 0.1
    shape = round(scale * SHAPE[0]), round(scale * SHAPE[1])
    source = MemorySource(frames, valid)
    corrected = replace(capture_of(source), steps=(halved_less_an_offset,))
    plain, halved = (
        accumulate(each, HALVES, rescaling(scale), shape, counts_of=counts_of)
        for each, counts_of in ((source, None), (corrected, MemorySource(frames).counts))
    )
    np.testing.assert_array_equal(halved.weight, plain.weight)
    np.testing.assert_allclose(halved.counts, plain.counts / 2 - plain.weight, atol=1e-3)
