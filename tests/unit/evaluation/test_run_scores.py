from __future__ import annotations

import subprocess
import sys

import numpy as np
import pytest

from photonpano import Panorama
from photonpano.evaluation import evaluate
from photonpano.geometry import normalised, translation


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


def test_evaluate_scores_motion_only_without_scene(capture):
    del capture.true["scene"]
    capture.write()
    (capture.folder / "panorama.tiff").unlink()
    score = evaluate(capture.folder, capture.truth)
    assert score.trajectory.max_px < 1e-6
    assert score.panorama is None
    assert score.below_oracle_db is None


def test_evaluate_ignores_frames_that_were_not_located(capture):
    estimated = capture.trajectory["homographies"]
    estimated[:12] = normalised(estimated[:12] @ translation(30, 0))
    capture.trajectory["located"][:12] = False
    capture.write()
    score = evaluate(capture.folder, capture.truth)
    assert score.trajectory.max_px < 1e-6
    assert score.trajectory.located_share == 0.9


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


def test_evaluation_imports_no_heavy_library():
    heavy = ["cv2", "matplotlib", "scipy", "skimage", "tifffile"]
    code = f"import sys, photonpano.evaluation; print([name for name in {heavy} if name in sys.modules])"
    result = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    assert result.stdout.strip() == "[]"
