"""Residuals of a camera that turns all around: frames are predicted from a sphere, and through a lens."""

import numpy as np
import pytest

from photonpano import FrameSpan
from photonpano.capture import seen_through
from photonpano.context import Context
from photonpano.geometry import Camera, FrameTrajectory, rotation_matrices
from photonpano.merging.canvas_plan import View, plan_canvas
from photonpano.merging.panorama import render
from photonpano.residuals.measure import measure
from photonpano.residuals.prediction import Predictions
from photonpano.testing.captures import MemorySource
from photonpano.values import FloatArray

SHAPE = (48, 64)
N = 1200


def flux_of(rays: FloatArray) -> FloatArray:
    """Return the flux in some directions, 0.3 photons a frame on average."""
    x, y, z = np.moveaxis(rays / np.linalg.norm(rays, axis=-1, keepdims=True), -1, 0)
    return 0.3 * (1 + 0.5 * np.sin(5 * x + 1) * np.cos(6 * z) + 0.4 * np.sin(7 * y + 3 * z))


def turning(camera: Camera, projection: str) -> tuple[FloatArray, FloatArray]:
    """Return the misfit of a turn by 400 degrees, and the mean flux of the panorama over that of the scene."""
    turns = rotation_matrices(np.stack([np.zeros(N), np.radians(np.linspace(0, 400, N)), np.zeros(N)], axis=-1))
    turns = turns @ rotation_matrices(np.outer(0.05 * np.sin(np.arange(N) / 40), [1, 0, 1]))
    turns = turns[N // 2].T @ turns
    y, x = np.mgrid[: SHAPE[0], : SHAPE[1]]
    ahead = camera.directions(np.stack([x, y], axis=-1).astype(float))
    rng = np.random.default_rng(0)
    frames = np.array([rng.random(SHAPE) < 1 - np.exp(-flux_of(ahead @ turn.T)) for turn in turns])
    source, span = seen_through(MemorySource(frames), camera), FrameSpan(0, N)
    trajectory = FrameTrajectory(camera.homographies(turns))
    view = View(projection, camera=camera, turns=True)
    canvas = plan_canvas(trajectory, span, SHAPE, 1.0, 2**30, view=view)
    panorama = render(source, trajectory, span, canvas, 0.25, Context())
    residuals = measure(span, Predictions.of(source, panorama, canvas, trajectory, SHAPE), Context())
    (p, s), (q, r) = canvas.columns(), canvas.rows()
    rays = np.stack([np.outer(r, p), np.repeat(q[:, None], len(p), axis=1), np.outer(r, s)], axis=-1)
    seen = panorama.weight > 40
    return residuals.misfit, panorama.flux[seen] / flux_of(rays)[seen]


@pytest.mark.parametrize("projection", ["cylindrical", "spherical"])
@pytest.mark.parametrize("distortion", [(0, 0, 0, 0), (-0.1, 0.02, 0.002, 0)], ids=["pinhole", "lens"])
def test_panorama_explains_frames_of_a_full_turn(projection: str, distortion: tuple[float, ...]) -> None:
    misfit, ratio = turning(Camera.of(60.0, SHAPE, distortion), projection)
    assert misfit.mean() == pytest.approx(1, abs=0.06)
    assert misfit.max() < 3.5, "no span, not one at the seam either, is badly predicted"
    assert ratio.mean() == pytest.approx(1, abs=0.01)
