"""Super-resolution against known fluxes, and sharpening of what was interpolated, with photon noise."""

from __future__ import annotations

from concurrent.futures import ThreadPoolExecutor
from dataclasses import replace
from functools import cache

import cv2
import numpy as np
import pytest

from photonpano import FrameSpan, Light, Panorama, capture_of
from photonpano.capture import MaskedSpan, in_light
from photonpano.geometry import Canvas, translation
from photonpano.merging import Chunk, MergeRenderer, PhotonSum
from photonpano.photometry import BinaryResponse, BinarySumResponse
from photonpano.testing import KnownMotion, MemorySource
from photonpano_core.configs import SuperResolutionConfig
from photonpano_core.fine_grid import expected, pixel_area
from photonpano_core.motion_fields import sharpened
from photonpano_core.super_resolution import SuperResolutionRenderer, sums_on

SIDE, CHUNKS, FRAMES, FINE = 40, 96, 40, 8
"""Pixels of a side of a frame, its stops, the frames of each, and the samples of the scene along the side of a pixel."""
SCALE = 2


@cache
def fine_scene(flux: float = 0.3) -> np.ndarray:
    """Return discs with sharp edges, sampled 8 times a pixel: (448, 448) float64."""
    rng = np.random.default_rng(4)
    scene = np.full((56 * FINE, 56 * FINE), 0.3, np.float32)
    for _ in range(160):
        middle, radius = rng.integers(0, 56 * FINE, 2).tolist(), int(rng.integers(6, 40))
        cv2.circle(scene, middle, radius, float(rng.uniform(0.05, 1.0)), -1)
    return scene.astype(np.float64) * flux / scene.mean()


def stops() -> np.ndarray:
    """Return where the camera stands for each chunk, in samples of the scene: (CHUNKS, 2) along x and y."""
    return np.random.default_rng(5).integers(0, 16 * FINE, (CHUNKS, 2))


def seen_from(stop: np.ndarray, scene: np.ndarray, area: int = FINE) -> np.ndarray:
    """Return the flux that pixels with an area of a width of some samples see."""
    x, y = stop
    margin = (FINE - area) // 2
    view = scene[y : y + SIDE * FINE, x : x + SIDE * FINE].reshape(SIDE, FINE, SIDE, FINE)
    return view[:, margin : margin + area, :, margin : margin + area].mean(axis=(1, 3))


def capture(
    scene: np.ndarray, area: int = FINE, seed: int = 0, gains: np.ndarray | None = None
) -> tuple[MemorySource, KnownMotion]:
    """Simulate a camera that jumps from stop to stop, in steady light or of given gains, (CHUNKS, FRAMES).

    The reference plane has the pixels of a frame.
    """
    rng, places = np.random.default_rng(seed), stops()
    gains = np.ones((CHUNKS, FRAMES)) if gains is None else gains
    lit = [
        rng.random((FRAMES, SIDE, SIDE)) < -np.expm1(-gain[:, None, None] * seen_from(stop, scene, area))
        for stop, gain in zip(places, gains, strict=True)
    ]
    motion = KnownMotion(lambda frame: translation(*places[min(int(frame) // FRAMES, CHUNKS - 1)] / FINE))
    return MemorySource(np.concatenate(lit)), motion


def true_panorama(scene: np.ndarray) -> np.ndarray:
    """Return the flux on the canvas of scale 2."""
    step = FINE // SCALE
    return scene.reshape(56 * SCALE, step, 56 * SCALE, step).mean(axis=(1, 3))


CANVAS = Canvas(56 * SCALE, 56 * SCALE, np.array([[2.0, 0, 0.5], [0, 2.0, 0.5], [0, 0, 1]]))
INNER = np.s_[2 * SCALE * 6 : -2 * SCALE * 6, 2 * SCALE * 6 : -2 * SCALE * 6]


def rendered(source: MemorySource, motion: KnownMotion, decisions: list | None = None, **keys: float) -> Panorama:
    decide = (lambda *given: decisions.append(given)) if decisions is not None else (lambda *_: None)
    renderer = SuperResolutionRenderer(SuperResolutionConfig(**keys), 2, decide)
    return renderer.render(source, motion, source.info.span, CANVAS, 0.125, lambda _: None)


def psnr_db(flux: np.ndarray, truth: np.ndarray) -> float:
    white = truth.max()
    difference = np.sqrt(np.clip(flux[INNER] / white, 0, 1)) - np.sqrt(truth[INNER] / white)
    return float(-10 * np.log10(np.mean(difference**2)))


def test_super_resolution_exceeds_interpolated_panorama_by_3_db_with_the_weight_of_a_merge() -> None:
    scene = fine_scene()
    source, motion = capture(scene)
    truth, decisions = true_panorama(scene), []
    panorama = rendered(source, motion, decisions)
    small = Canvas(56, 56, np.eye(3))
    merged = MergeRenderer(map).render(source, motion, source.info.span, small, 0.125, lambda _: None)
    bicubic = cv2.resize(np.nan_to_num(merged.flux), CANVAS.shape, interpolation=cv2.INTER_CUBIC)
    assert psnr_db(panorama.flux, truth) > psnr_db(bicubic, truth) + 3
    assert float(panorama.flux[INNER].mean()) == pytest.approx(truth[INNER].mean(), rel=0.01)
    merged = MergeRenderer(map).render(source, motion, source.info.span, CANVAS, 0.125, lambda _: None)
    assert panorama.weight[INNER].mean() == pytest.approx(merged.weight[INNER].mean(), rel=0.02)
    (what, value, reason), (supported, yes, _) = decisions
    assert (what, supported, yes) == ("super_resolution.rounds", "super_resolution.supported", True)
    assert 1 <= value <= 6
    assert reason.startswith(
        "of 6, each with a weaker prior: the first that predicts frames held out nearly as well as the best; "
    )


def test_flux_in_light_that_flickers_and_drifts_is_that_of_mean_light() -> None:
    time = np.arange(CHUNKS * FRAMES) / (CHUNKS * FRAMES)
    gain = (1 + np.cos(2 * np.pi * 37 * time)) * (1.4 - 0.8 * time)
    gain /= gain.mean()
    scene = fine_scene(0.6)
    source, motion = capture(scene, gains=gain.reshape(CHUNKS, FRAMES))
    truth, decisions = true_panorama(scene), []
    panorama, ignoring = rendered(in_light(source, Light.of_frames(gain)), motion, decisions), rendered(source, motion)
    assert float(panorama.flux[INNER].mean()) == pytest.approx(truth[INNER].mean(), rel=0.01)
    assert psnr_db(panorama.flux, truth) > psnr_db(ignoring.flux, truth) + 3
    assert panorama.weight[INNER].mean() == pytest.approx(ignoring.weight[INNER].mean(), rel=0.05)
    assert "nan" not in "".join(reason for _, _, reason in decisions)


def test_scale_beyond_the_photons_is_said_with_the_figure_and_done(caplog: pytest.LogCaptureFixture) -> None:
    source, motion = capture(np.full_like(fine_scene(), 0.02))
    decisions: list = []
    panorama = rendered(source, motion, decisions)
    assert np.isfinite(panorama.flux[INNER]).all()
    what, value, reason = decisions[-1]
    assert (what, value) == ("super_resolution.supported", False)
    assert reason.startswith(
        "the photons do not support scale 2: with its detail beyond that of scale 1, the log-likelihood of"
    )
    assert caplog.messages == [reason]


def test_panorama_keeps_fine_detail_of_pixels_with_a_small_area() -> None:
    """With a fill factor of 1 / 16, pixels sample points: an estimate for whole pixels sharpens what is sharp."""
    scene = fine_scene()
    source, motion = capture(scene, area=2)
    truth = true_panorama(scene)
    right, wrong = (psnr_db(rendered(source, motion, fill_factor=each).flux, truth) for each in (1 / 16, 1.0))
    assert right > wrong + 1


def test_expected_equals_a_filter_and_is_its_own_adjoint_inside() -> None:
    rng, kernel = np.random.default_rng(0), pixel_area(2.0)
    image = rng.random((17, 23)).astype(np.float32)
    found = np.empty_like(image)
    expected(image, kernel, np.empty_like(image), found)
    wanted = cv2.sepFilter2D(image, cv2.CV_32F, kernel, kernel, borderType=cv2.BORDER_REPLICATE)
    np.testing.assert_allclose(found, wanted, rtol=1e-5)


def test_what_a_mask_of_some_frames_leaves_out_is_not_summed() -> None:
    frames, left = np.ones((40, SIDE, SIDE), np.uint8), np.zeros((SIDE, SIDE), bool)
    left[:, :10] = True
    source = replace(capture_of(MemorySource(frames)), masks=(MaskedSpan(FrameSpan(10, 30), ~left),))
    chunks = [Chunk(each, np.eye(3)) for each in source.pieces(FrameSpan(0, 40))]
    with ThreadPoolExecutor(1) as pool:
        sums = sums_on(source, chunks, Canvas(SIDE, SIDE, np.eye(3)), lambda _: None, pool)
    for image in (sums.lit, sums.seen):
        np.testing.assert_array_equal(image, np.where(left, 20, 40))


def test_sums_of_binary_frames_give_the_flux_of_a_sum() -> None:
    class Sums(MemorySource):
        """Each frame is the sum of four binary ones."""

    scene = fine_scene()
    binary, motion = capture(scene)
    frames = binary.frames(binary.info.span).reshape(-1, 4, SIDE, SIDE).sum(axis=1)
    source = Sums(frames)
    source.response = BinarySumResponse(4)
    summed = rendered(source, KnownMotion(lambda frame: motion.at([4 * frame])[0]))
    single = rendered(binary, motion)
    assert isinstance(binary.response, BinaryResponse)
    np.testing.assert_allclose(np.median(summed.flux[INNER] / single.flux[INNER]), 4, rtol=0.02)


SHAPE, N = (96, 128), 5000
RESPONSE = MemorySource(np.zeros((1, 4, 4), np.uint8)).response
EVERYWHERE = np.ones(SHAPE, bool)


def texture() -> np.ndarray:
    """Probability of a photon, with detail of a few pixels."""
    noise = np.random.default_rng(0).standard_normal(SHAPE)
    return 0.35 + 0.25 * np.tanh(2 * cv2.GaussianBlur(noise, (0, 0), 1.0))


def interpolated(mean: np.ndarray, fractions: np.ndarray) -> np.ndarray:
    """Sums of photons of N frames, shifted by fractions of a pixel and linearly interpolated back."""
    rng, parts = np.random.default_rng(1), len(fractions)
    total = np.zeros(SHAPE, np.float32)
    rows, columns = np.indices(SHAPE, np.float32)
    for x, y in fractions.astype(np.float32):
        there = cv2.remap(mean.astype(np.float32), columns - x, rows - y, cv2.INTER_CUBIC, borderMode=cv2.BORDER_REFLECT)
        counts = rng.binomial(N // parts, np.clip(there, 0, 1)).astype(np.float32)
        total += cv2.remap(counts, columns + x, rows + y, cv2.INTER_LINEAR, borderMode=cv2.BORDER_REFLECT)
    return total


FRACTIONS = np.random.default_rng(2).uniform(0, 1, (50, 2))
BLUR = np.full(SHAPE, (FRACTIONS * (1 - FRACTIONS)).mean(), np.float32)


def errors(mean: np.ndarray, counts: np.ndarray, blur: np.ndarray = BLUR) -> tuple[float, float]:
    """Mean squared errors before and after."""
    weight = np.full(SHAPE, N, np.float32)
    found = sharpened(PhotonSum(counts, weight), blur, EVERYWHERE, RESPONSE)
    inside = (slice(4, -4), slice(4, -4))
    before, after = (float(np.mean((each / weight - mean)[inside] ** 2)) for each in (counts, found.counts))
    return before, after


def test_blur_of_interpolation_is_undone() -> None:
    before, after = errors(texture(), interpolated(texture(), FRACTIONS))
    assert after < 0.6 * before


def test_photon_noise_of_a_plain_surface_is_not_amplified() -> None:
    plain = np.full(SHAPE, 0.3)
    before, after = errors(plain, interpolated(plain, FRACTIONS))
    assert after < 1.05 * before
