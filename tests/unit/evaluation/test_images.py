"""Scores of runs and images, and bounds of errors."""

from types import ModuleType

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from photonpano import Panorama
from photonpano.evaluation import (
    corner_errors,
    covered,
    evaluate,
    image_score,
    true_panorama,
)
from photonpano.geometry import (
    Canvas,
    align_planes,
    corners,
    from_parameters,
    normalised,
    rescaling,
    transform_points,
    translation,
)
from photonpano.photometry import BinaryResponse, srgb_to_linear

WHITE = 2.5


def flux_of(encoded: np.ndarray) -> np.ndarray:
    """Return the flux that is `encoded` in sRGB when images are compared."""
    return srgb_to_linear(encoded) * np.float32(WHITE)


@pytest.fixture
def encoded() -> np.ndarray:
    x, y = np.meshgrid(np.arange(160), np.arange(120))
    return 0.5 + 0.25 * np.sin(x / 5) * np.cos(y / 4)


EVERYWHERE = np.ones((120, 160), bool)


@pytest.mark.parametrize("sigma", [0.01, 0.05])
def test_image_score_psnr_is_that_of_added_noise(encoded, sigma):
    noise = np.random.default_rng(0).normal(0, sigma, encoded.shape)
    score = image_score(flux_of(encoded + noise), flux_of(encoded), EVERYWHERE, WHITE)
    # The variance of 19,200 independent differences has an error of 1 %, which is 0.045 dB.
    assert score.psnr_db == pytest.approx(-20 * np.log10(sigma), abs=0.15)


def test_image_score_compares_pixels_that_are_known_in_both_images_and_asked_for(encoded):
    compared = np.zeros(encoded.shape, bool)
    compared[20:100, 30:130] = True
    panorama, truth = flux_of(np.where(compared, encoded, 0.9)), flux_of(encoded)
    score = image_score(panorama, truth, compared, WHITE)
    assert (score.psnr_db, score.ssim) == (np.inf, pytest.approx(1))
    assert score.compared_share == pytest.approx(80 * 100 / encoded.size)
    panorama, truth = flux_of(encoded), flux_of(encoded)
    panorama[:30] = np.nan
    truth[:, -40:] = np.nan
    score = image_score(panorama, truth, EVERYWHERE, WHITE)
    assert score.psnr_db == np.inf
    assert score.compared_share == pytest.approx(90 * 120 / encoded.size)


def test_image_score_clips_at_white(encoded):
    truth = flux_of(encoded)
    truth[50:60, 50:60] = WHITE
    panorama = truth.copy()
    panorama[50:60, 50:60] = 10 * WHITE
    score = image_score(panorama, truth, EVERYWHERE, WHITE)
    assert (score.psnr_db, score.ssim, score.compared_share) == (np.inf, pytest.approx(1), 1)


def test_covered_is_false_for_hardly_seen_pixels():
    weight = np.full((10, 10), 400, dtype=np.float32)
    weight[0], weight[1], weight[2] = 0, 19, 20
    np.testing.assert_array_equal(covered(weight).all(axis=1), [False, False, *[True] * 8])
    assert not covered(np.zeros((3, 3), dtype=np.float32)).any()


def test_true_panorama_samples_scene_through_canvas_and_alignment():
    x, y = np.meshgrid(np.arange(50, dtype=np.float32), np.arange(40, dtype=np.float32))
    scene = 2 * x + 3 * y  # linear interpolation is exact on a plane
    reference_to_scene = translation(5.5, 4)
    reference_to_canvas = rescaling(2.0) @ translation(3, 1)
    image = true_panorama(scene, Canvas(300, 90, reference_to_canvas), reference_to_scene)
    assert image.shape == (300, 90)
    # Canvas (20, 10) is reference ((20.5 / 2 - 0.5) - 3, (10.5 / 2 - 0.5) - 1) = (6.75, 3.75), and scene (12.25, 7.75).
    assert image[10, 20] == pytest.approx(2 * 12.25 + 3 * 7.75, rel=1e-6)
    assert np.isnan(image[299]).all()


def test_true_panorama_averages_the_area_of_each_pixel_and_is_the_scene_at_its_resolution():
    """With four pixels of the scene a side of one of the canvas, stripes of two px vanish, and means stay in their places."""
    scene = np.random.default_rng(0).random((48, 64)).astype(np.float32)
    image = true_panorama(scene, Canvas(12, 16, np.eye(3)), rescaling(4))
    np.testing.assert_allclose(image[:-1, :-1], scene.reshape(12, 4, 16, 4).mean(axis=(1, 3))[:-1, :-1], rtol=1e-5)
    # A panorama of scale 2 of a scene with two pixels a side of a pixel of a frame.
    np.testing.assert_allclose(true_panorama(scene, Canvas(48, 64, rescaling(2)), rescaling(2)), scene, rtol=1e-5)


RESPONSE = BinaryResponse()
SHAPE = (40, 60)


def waves(points: np.ndarray) -> np.ndarray:
    """A smooth scene, defined everywhere."""
    x, y = points[..., 0], points[..., 1]
    return 0.3 + 0.1 * np.sin(x / 3 + 0.2) * np.cos(y / 4) + 0.05 * np.sin((x + y) / 5)


FLUX = waves(np.stack(np.meshgrid(np.arange(SHAPE[1]), np.arange(SHAPE[0])), axis=-1)).astype(np.float32)


def test_exposure_bound_falls_with_number_of_frames_and_pair_bound_adds_noise_of_second_exposure(bounds: ModuleType) -> None:
    alone = bounds.exposure_bound_px(FLUX, RESPONSE, 100)
    assert bounds.exposure_bound_px(FLUX, RESPONSE, 400) == pytest.approx(alone / 2, rel=1e-6)
    assert bounds.pair_bound_px(FLUX, RESPONSE, 100, 100) == pytest.approx(np.sqrt(2) * alone, rel=1e-6)
    assert bounds.pair_bound_px(FLUX, RESPONSE, 100, 1e9) == pytest.approx(alone, rel=1e-4)


def test_maximum_likelihood_reaches_exposure_bound(bounds: ModuleType) -> None:
    """Linearised at the truth; the standard deviation of 400 draws has an error of a few per cent."""
    frames, rng, steps = 2000, np.random.default_rng(0), 1e-4
    p = -np.expm1(-FLUX.astype(float))
    points = np.stack(np.meshgrid(np.arange(SHAPE[1]), np.arange(SHAPE[0])), axis=-1).reshape(-1, 2)
    units = np.array([1 / 30, 1 / 30, 1 / 30, 1 / 30, 1, 1, 1 / 900, 1 / 900])
    derivatives = np.stack(
        [
            (-np.expm1(-waves(transform_points(from_parameters(steps * unit), points))) - p.ravel()) / steps
            for unit in np.diag(units)
        ],
        axis=-1,
    )
    weights = frames / (p * (1 - p)).ravel()
    counts = rng.binomial(frames, p, (400, *SHAPE)).reshape(400, -1) / frames
    scores = ((counts - p.ravel()) * weights) @ derivatives
    found = np.linalg.solve((derivatives.T * weights) @ derivatives, scores.T).T * units
    errors = transform_points(from_parameters(found), corners(SHAPE)) - corners(SHAPE)
    scatter = np.sqrt((errors**2).sum(axis=-1).mean())
    assert bounds.exposure_bound_px(FLUX, RESPONSE, frames) == pytest.approx(scatter, rel=0.1)


def test_evaluate_scores_perfect_run_in_any_gauge_and_scale(capture):
    score = evaluate(capture.folder, capture.truth)
    assert score.trajectory.max_px < 1e-6
    assert score.trajectory.located_share == 1
    assert score.panorama.psnr_db > 45  # what linear interpolation of the scene leaves
    assert score.panorama.ssim > 0.99
    height, width = capture.canvas.shape
    assert score.panorama.compared_share == pytest.approx((height - 40) * (width - 40) / (height * width), rel=0.01)
    assert score.white_flux == pytest.approx(0.8, rel=0.01)
    assert score.oracle is None
    assert score.below_oracle_db is None


def test_evaluate_renders_oracle_along_true_motion_on_same_canvas(capture):
    calls = []
    clean, shape = capture.flux, capture.flux.shape
    noise = np.random.default_rng(0).normal(0, 0.02, shape).astype(np.float32)

    def render(trajectory, canvas):
        calls.append((trajectory, canvas))
        weight = capture.weight.copy()
        weight[:, : shape[1] // 2] = 0
        return Panorama(np.where(weight > 0, clean + noise, np.nan), weight, canvas.transform)

    capture.flux = clean + 2 * noise
    capture.write()
    score = evaluate(capture.folder, capture.truth, render)
    [(trajectory, canvas)] = calls
    np.testing.assert_allclose(trajectory.at(np.arange(120)), capture.trajectory["homographies"], atol=1e-5)
    assert canvas.shape == shape
    np.testing.assert_array_equal(canvas.transform, capture.canvas.transform)
    assert score.below_oracle_db == pytest.approx(20 * np.log10(2), abs=0.2)
    assert score.panorama.compared_share == score.oracle.compared_share < 0.5


def jittered(motion: np.ndarray, sigma_px: float, seed: int = 1) -> np.ndarray:
    """Shift every frame by its own normal offset, in pixels of the frame."""
    offsets = np.random.default_rng(seed).normal(0, sigma_px, (len(motion), 2))
    return normalised(motion @ np.array([translation(x, y) for x, y in offsets]))


@st.composite
def gauges(draw: st.DrawFn) -> np.ndarray:
    """Draw a change of the reference plane: similarity, shear and perspective that keep the scene in front of the camera."""
    small = st.floats(-0.2, 0.2)
    perspective = st.floats(-4e-4, 4e-4)
    shift = st.floats(-500, 500)
    p = [draw(s) for s in (small, small, small, small, shift, shift, perspective, perspective)]
    return rescaling(draw(st.floats(0.2, 5))) @ from_parameters(p)


@settings(max_examples=25)
@given(gauge=gauges())
def test_align_planes_finds_any_change_of_plane(gauge, true_motion, frame_shape):
    found = align_planes(normalised(gauge @ true_motion), true_motion, frame_shape)
    points = transform_points(true_motion[::40], corners(frame_shape))
    np.testing.assert_allclose(transform_points(found @ gauge, points), points, atol=1e-6)


def test_corner_errors_do_not_depend_on_true_plane_or_number_of_frames(true_motion, frame_shape):
    estimated = jittered(true_motion, 0.5)
    scene = rescaling(3.0) @ translation(20, -90)
    here = corner_errors(estimated, true_motion, frame_shape)
    there = corner_errors(estimated, normalised(scene @ true_motion), frame_shape)
    np.testing.assert_allclose(there.errors_px, here.errors_px, atol=1e-4)
    many = corner_errors(np.repeat(estimated, 50, axis=0), np.repeat(true_motion, 50, axis=0), frame_shape)
    assert many.mean_px == pytest.approx(here.mean_px, rel=0.02)
    assert corner_errors(np.eye(3)[None], true_motion[:1], frame_shape).max_px < 1e-9


def test_corner_errors_of_random_shifts_follow_rayleigh_distribution(true_motion, frame_shape):
    true = np.tile(true_motion, (20, 1, 1))
    score = corner_errors(jittered(true, 0.4), true, frame_shape)
    # The length of a normal vector in the plane follows Rayleigh's law.
    assert score.mean_px == pytest.approx(0.4 * np.sqrt(np.pi / 2), rel=0.03)
    assert score.median_px == pytest.approx(0.4 * np.sqrt(2 * np.log(2)), rel=0.04)
    assert score.p95_px == pytest.approx(0.4 * np.sqrt(-2 * np.log(0.05)), rel=0.04)
    assert score.max_px == score.errors_px.max()


def test_corner_errors_ignore_frames_that_are_not_located(true_motion, frame_shape):
    estimated = true_motion.copy()
    estimated[:30] = normalised(true_motion[:30] @ translation(40, 0))
    located = np.arange(len(true_motion)) >= 30
    score = corner_errors(estimated, true_motion, frame_shape, located)
    assert score.max_px < 1e-6
    assert score.located_share == 0.75
    np.testing.assert_allclose(score.errors_px[:30], 40, atol=1e-5)
