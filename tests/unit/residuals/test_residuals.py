"""Residuals of spans, full turns, and lenses."""

from dataclasses import replace
from functools import cache
from itertools import pairwise

import numpy as np
import pytest

from photonpano import FrameSpan, open_source, parse_spec
from photonpano.capture import capture_of, seen_through
from photonpano.execution.context import Context
from photonpano.geometry import Camera, FrameTrajectory, rotation_matrices, translation
from photonpano.merging.panorama import View, plan_canvas, render
from photonpano.residuals.measure import Residuals, measure
from photonpano.residuals.patterns import lens_distortion
from photonpano.residuals.prediction import Predictions
from photonpano.residuals.refinement import bounded_std_px, residual_ratio, unexplained_px
from photonpano.testing.captures import KnownMotion, MemorySource, ReadOnlySource, Scene, recorded
from photonpano.values import FloatArray

SHAPE = (48, 80)
FRAMES = 800
PERIOD = 90


def shaken(frame: float, tremor_px: float, period: float = PERIOD) -> np.ndarray:
    tremor = tremor_px * np.sin(2 * np.pi * frame / period)
    return translation(0.08 * frame + tremor, 0.02 * frame)


@cache
def capture(tremor_px: float = 0.0, period: float = PERIOD) -> ReadOnlySource:
    motion = KnownMotion(lambda frame: shaken(frame, tremor_px, period))
    return ReadOnlySource(recorded(Scene(seed=5, flux=(0.1, 0.8)), motion, FRAMES, SHAPE))


@cache
def residuals_of(tremor_px: float = 0.0, threads: int = 1, period: float = PERIOD) -> Residuals:
    """Measure the residuals of a capture with a tremor along a path without it."""
    source, span = capture(tremor_px, period), FrameSpan(0, FRAMES)
    trajectory = FrameTrajectory(np.array([shaken(frame, 0) for frame in range(FRAMES)]))
    canvas = plan_canvas(trajectory, span, SHAPE, 1.0, 2**30)
    panorama = render(source, trajectory, span, canvas, 0.25, Context())
    return measure(span, Predictions.of(source, panorama, canvas, trajectory, SHAPE), Context(threads=threads))


def test_measure_finds_photon_noise_along_true_motion() -> None:
    found = residuals_of()
    assert found.reduced_chi2.mean() == pytest.approx(1, abs=0.1)
    assert residual_ratio(found) == pytest.approx(1, abs=0.2)
    assert np.nanmean(found.block_chi2) == pytest.approx(1, abs=0.1)
    gains, stds = found.gains()
    assert (gains / stds).std() == pytest.approx(1, abs=0.15)
    assert unexplained_px(found, FRAMES).max() < 0.05
    steps = found.steps()
    chi2 = np.einsum("si,sij,sj->s", steps.steps, steps.information, steps.steps) / 4
    assert chi2.mean() == pytest.approx(1, abs=0.2)
    assert (found.spans[0].start, found.spans[-1].stop) == (0, FRAMES)
    assert all(one.stop == two.start for one, two in pairwise(found.spans))


def test_copies_of_frames_have_the_noise_of_one() -> None:
    twice, span = np.arange(FRAMES) // 2, FrameSpan(0, FRAMES)
    source = MemorySource(capture().frames(span)[twice])
    trajectory = FrameTrajectory(np.array([shaken(frame, 0) for frame in twice]))
    canvas = plan_canvas(trajectory, span, SHAPE, 1.0, 2**30)
    panorama = render(source, trajectory, span, canvas, 0.25, Context())

    def chi2(copies: np.ndarray | None) -> float:
        of_copies = replace(capture_of(source), copies=copies)
        predictions = Predictions.of(of_copies, panorama, canvas, trajectory, SHAPE)
        return float(measure(span, predictions, Context()).reduced_chi2.mean())

    assert chi2(None) == pytest.approx(2, abs=0.2)
    assert chi2(np.arange(FRAMES) % 2 == 1) == pytest.approx(1, abs=0.1)


def test_steps_are_the_tremor_that_the_motion_lacks() -> None:
    found = residuals_of(0.4)
    steps = found.steps()
    expected = 0.4 * np.sin(2 * np.pi * found.instants / PERIOD)
    slope = (steps.steps[:, 0] * expected).sum() / (expected**2).sum()
    # The panorama is blurred by the tremor, too, which makes it seem smaller.
    assert 0.7 < slope < 1.1
    assert residual_ratio(found) > 2
    assert unexplained_px(found, FRAMES).mean() == pytest.approx(0.4 / np.sqrt(2), rel=0.4)
    assert bounded_std_px(np.full(FRAMES, 10.0), found).min() == 10


def test_predicted_view_is_the_scene_and_its_variance() -> None:
    source = capture()
    trajectory = FrameTrajectory(np.array([shaken(frame, 0) for frame in range(FRAMES)]))
    canvas = plan_canvas(trajectory, source.info.span, SHAPE, 1.0, 2**30)
    panorama = render(source, trajectory, source.info.span, canvas, 0.25, Context())
    mean, variance = Predictions.of(source, panorama, canvas, trajectory, SHAPE).predicted(400)
    true = -np.expm1(-Scene(seed=5, flux=(0.1, 0.8)).view(shaken(400, 0), SHAPE))
    seen = np.isfinite(mean)
    assert seen.mean() > 0.9
    assert np.abs(mean - true)[seen].mean() < 0.02
    np.testing.assert_allclose(variance[seen], (mean * (1 - mean))[seen], rtol=0.35, atol=0.02)


TURNED = (48, 64)
N = 1200


def flux_of(rays: FloatArray) -> FloatArray:
    """Return the flux in some directions, 0.3 photons a frame on average."""
    x, y, z = np.moveaxis(rays / np.linalg.norm(rays, axis=-1, keepdims=True), -1, 0)
    return 0.3 * (1 + 0.5 * np.sin(5 * x + 1) * np.cos(6 * z) + 0.4 * np.sin(7 * y + 3 * z))


@cache
def turned(distortion: tuple[float, ...]) -> tuple[Camera, FloatArray, MemorySource]:
    """Return a camera, its rotations in a turn by 400 degrees, and its frames."""
    camera = Camera.of(60.0, TURNED, distortion)
    turns = rotation_matrices(np.stack([np.zeros(N), np.radians(np.linspace(0, 400, N)), np.zeros(N)], axis=-1))
    turns = turns @ rotation_matrices(np.outer(0.05 * np.sin(np.arange(N) / 40), [1, 0, 1]))
    turns = turns[N // 2].T @ turns
    y, x = np.mgrid[: TURNED[0], : TURNED[1]]
    ahead = camera.directions(np.stack([x, y], axis=-1).astype(float))
    rng = np.random.default_rng(0)
    frames = np.array([rng.random(TURNED) < 1 - np.exp(-flux_of(ahead @ turn.T)) for turn in turns])
    return camera, turns, MemorySource(frames)


def turning(distortion: tuple[float, ...], projection: str) -> tuple[FloatArray, FloatArray]:
    """Return the reduced chi-square of the turn, and the mean flux of the panorama over that of the scene."""
    camera, turns, frames = turned(distortion)
    source, span = seen_through(frames, camera), FrameSpan(0, N)
    trajectory = FrameTrajectory(camera.homographies(turns))
    view = View(projection, camera=camera, turns=True)
    canvas = plan_canvas(trajectory, span, TURNED, 1.0, 2**30, view=view)
    panorama = render(source, trajectory, span, canvas, 0.25, Context())
    residuals = measure(span, Predictions.of(source, panorama, canvas, trajectory, TURNED), Context())
    (p, s), (q, r, _) = canvas.columns(), canvas.rows()
    rays = np.stack([np.outer(r, p), np.repeat(q[:, None], len(p), axis=1), np.outer(r, s)], axis=-1)
    seen = panorama.weight > 40
    return residuals.reduced_chi2, panorama.flux[seen] / flux_of(rays)[seen]


@pytest.mark.parametrize("projection", ["cylindrical", "spherical"])
@pytest.mark.parametrize("distortion", [(0, 0, 0, 0), (-0.1, 0.02, 0.002, 0)], ids=["pinhole", "lens"])
def test_panorama_explains_frames_of_a_full_turn(projection: str, distortion: tuple[float, ...]) -> None:
    reduced_chi2, ratio = turning(distortion, projection)
    assert reduced_chi2.mean() == pytest.approx(1, abs=0.06)
    assert reduced_chi2.max() < 3.5, "no span, not one at the seam either, is badly predicted"
    assert ratio.mean() == pytest.approx(1, abs=0.01)


BENT = (96, 128)


def found(k1: float):
    simulator = {
        "scene": {"kind": "street", "width": 512, "height": 341},
        "path": {"kind": "pan", "length_px": 80},
        "flux": 0.5,
        "n_frames": 800,
        "frame_shape": list(BENT),
        "lens": {"k1": k1},
    }
    with open_source(parse_spec({"version": 1, "source": {"use": "simulator", "with": simulator}})) as source:
        motion = FrameTrajectory(source.truth()["homographies"])
        span = source.info.span
        canvas = plan_canvas(motion, span, BENT, 1.0, 2**30)
        panorama = render(source, motion, span, canvas, 0.25, Context())
        residuals = measure(span, Predictions.of(source, panorama, canvas, motion, BENT), Context())
        return lens_distortion(*residuals.block_shifts(), motion.at(np.arange(span.stop)), BENT)


@pytest.mark.parametrize("k1", [-0.02, 0.02])
def test_lens_distortion_is_found_with_its_sign(k1: float) -> None:
    distortion = found(k1)
    assert distortion.sigmas > 5
    # The motion is the true one, which has not followed the distortion as an estimated one does.
    assert 0.7 < distortion.k1 / k1 < 2.2
    # A distortion bends the ends of a path most.
    start, *_, end = distortion.bend_px
    assert min(start, end) > 2 * distortion.bend_px.min()


@pytest.mark.parametrize(("number", "generator"), [(2, [[0, -1], [1, 0]]), (3, [[1, 0], [0, 1]])], ids=["roll", "zoom"])
def test_steps_have_the_sign_of_a_roll_and_of_a_zoom(number: int, generator: list[list[int]]) -> None:
    """Spans are compared with a panorama along another motion, which lacks a roll, or a zoom, about the middle of the frame."""
    middle, span = translation((SHAPE[1] - 1) / 2, (SHAPE[0] - 1) / 2), FrameSpan(0, FRAMES)
    size = 0.01
    matrix = np.eye(3)
    matrix[:2, :2] += size * np.array(generator)
    still = FrameTrajectory(np.array([shaken(frame, 0) for frame in range(FRAMES)]))
    missing = FrameTrajectory(still.at(np.arange(FRAMES)) @ np.linalg.inv(middle @ matrix @ np.linalg.inv(middle)))
    source = capture()
    canvas = plan_canvas(still, span, SHAPE, 1.0, 2**30)
    panorama = render(source, still, span, canvas, 0.25, Context())
    steps = measure(span, Predictions.of(source, panorama, canvas, missing, SHAPE), Context()).steps().steps
    others = [n for n in range(2, 4) if n != number]
    assert np.median(steps[:, number]) == pytest.approx(size, rel=0.3)
    assert np.abs(np.median(steps[:, others])) < 0.1 * size
