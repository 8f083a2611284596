"""A run whose motion is right, and its residuals: photon noise."""

import numpy as np
import pytest

from photonpano import FrameSpan
from photonpano.geometry import Canvas, FrameTrajectory
from photonpano.motion.frame_motion import FrameMotion
from photonpano.residuals.block_sums import GXX, GYY, N_SUMS, M, R, V, n_blocks
from photonpano.residuals.halves import Halves
from photonpano.residuals.measure import Residuals
from photonpano.residuals.patterns import Shaking
from photonpano.residuals.refinement import Explained

SHAPE, N_SPANS, SPAN = (128, 192), 200, 10
N_FRAMES = N_SPANS * SPAN


@pytest.fixture
def noise() -> Residuals:
    """Residuals of a motion that is right: 100 photons a block and span, shifts with a noise of 0.03 px."""
    rng = np.random.default_rng(6)
    spans = tuple(FrameSpan(SPAN * k, SPAN * k + SPAN) for k in range(N_SPANS))
    information = np.diag([1 / 0.03**2] * 2 + [1e7] * 2 + [1e5])
    steps = rng.normal(0, 1 / np.sqrt(np.diagonal(information)), (N_SPANS, 5))
    grid, cells = n_blocks(SHAPE), (10, 30)
    blocks = np.zeros((*grid, N_SUMS))
    blocks[..., [V, M]] = 100 * N_SPANS
    blocks[..., [GXX, GYY]] = 1e6
    blocks[..., R] = rng.normal(0, np.sqrt(100 * N_SPANS), grid)
    return Residuals(
        spans=spans,
        instants=np.array([span.centre for span in spans]),
        normal=np.repeat(information[None], N_SPANS, axis=0),
        gradient=steps @ information,
        reduced_chi2=rng.normal(1, 0.1, N_SPANS),
        blocks=blocks,
        block_chi2=rng.normal(1, 0.05, grid),
        pixel_gain=rng.normal(1, 0.03, SHAPE).astype(np.float32),
        pixel_mean=np.full(SHAPE, 1000, np.float32),
        pixel_slopes=np.zeros((6, *SHAPE), np.float32),
        cell_chi2=rng.normal(1, 0.1, cells),
        cell_count=np.full(cells, 200.0),
        cell_noise=np.full(cells, 0.01),
        frames_seen=1000.0,
        frame_shape=SHAPE,
        light=np.ones(N_SPANS),
        shaking=Shaking(0.0, float("nan"), SPAN),
    )


@pytest.fixture
def explained(noise: Residuals) -> Explained:
    """A run whose motion is right."""
    homographies = np.repeat(np.eye(3)[None], N_FRAMES, axis=0)
    motion = FrameMotion(
        trajectory=FrameTrajectory(homographies),
        span=FrameSpan(0, N_FRAMES),
        homographies=homographies,
        located=np.ones(N_FRAMES, np.bool_),
        std_px=np.full(N_FRAMES, 0.05),
        reference=N_FRAMES // 2,
        frame_shape=SHAPE,
    )
    return Explained(
        motion=motion, canvas=Canvas(*SHAPE, np.eye(3)), residuals=noise, ratio=1.05, halves=Halves.none(), refinements=()
    )
