import json
from collections.abc import Callable
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from photonpano import FrameSpan, Group, Panorama, VirtualExposure
from photonpano.geometry import canvas_of, normalised, translation
from photonpano.merging.canvas_noise import CanvasNoise, DynamicRange
from photonpano.merging.panorama import RenderedPanorama
from photonpano.motion.frame_motion import FrameMotion
from photonpano.photometry import BinaryResponse
from photonpano.residuals.block_sums import GXX, GYY, N_SUMS, M, R, V, n_blocks
from photonpano.residuals.halves import Agreements, Halves
from photonpano.residuals.measure import Residuals
from photonpano.residuals.patterns import Shaking
from photonpano.residuals.refinement import Explained
from photonpano.testing import KnownMotion

FRAME_SHAPE = (254, 496)
N_FRAMES = 10_000
RANGE = DynamicRange(noise=CanvasNoise(response=BinaryResponse()))


def make_results(n_frames: int = N_FRAMES) -> tuple[FrameMotion, RenderedPanorama]:
    """Make the motion and the panorama of a pan of 750 px with a hand shake, whose first and last frames were not located."""
    frame = np.arange(n_frames)
    time = frame / n_frames
    rng = np.random.default_rng(3)
    phases = rng.uniform(0, 6.28, (2, 3))
    shake = [sum(np.sin(40 * (k + 1) * time + p) for k, p in enumerate(phase)) for phase in phases]
    x = 750 * (time - 0.5) + 2 * shake[0]
    y = 40 * np.sin(5 * time) + 2 * shake[1]
    homographies = normalised(np.array([translation(*p) for p in zip(x, y, strict=True)]))
    homographies[:, 2, 0] = 1e-4 * (time - 0.5)
    reference = n_frames // 2
    homographies = normalised(np.linalg.inv(homographies[reference]) @ homographies)
    canvas = canvas_of(homographies, FRAME_SHAPE, 1.0)
    columns, rows = np.meshgrid(np.arange(canvas.width), np.arange(canvas.height))
    picture = 120 + 60 * np.sin(columns / 23) * np.cos(rows / 17) + 40 * ((columns // 64 + rows // 48) % 2)
    picture += rng.normal(0, 8, picture.shape)
    coverage = (
        5000 * np.exp(-(((columns / canvas.width - 0.5) / 0.35) ** 2)) * np.exp(-(((rows / canvas.height - 0.5) / 0.4) ** 6))
    )
    coverage[coverage < 60] = 0
    picture[coverage == 0] = 0
    located = (frame >= n_frames // 80) & (frame < n_frames - n_frames // 80)
    std_px = np.where(located, 0.05 + 0.6 * (2 * time - 1) ** 8, np.inf)
    known = np.flatnonzero(located)
    span = FrameSpan(int(known[0]), int(known[-1]) + 1)
    trajectory = KnownMotion(lambda frame: homographies[round(frame)])
    motion = FrameMotion(
        trajectory=trajectory,
        span=span,
        homographies=homographies,
        located=located,
        std_px=std_px,
        reference=reference,
        frame_shape=FRAME_SHAPE,
    )
    preview, weight = np.clip(picture, 0, 255).astype(np.uint8), coverage.astype(np.float32)
    thumbnail = Panorama(weight, weight, canvas.transform)
    share, std = float((weight > 0).mean()), 0.1 * weight
    return motion, RenderedPanorama(
        canvas=canvas,
        thumbnail=thumbnail,
        reduction=1,
        picture=preview,
        white_flux=1.8342,
        coverage_share=share,
        seconds=4.18,
        std=std,
        seen_frames=np.stack([weight, weight + 1]).astype(np.uint32),
        dynamic_range=RANGE,
    )


def make_residuals(n_frames: int = N_FRAMES, tremor_px: float = 0.0, period: float = 100.0) -> Residuals:
    """Make the residuals of spans of 16 frames: noise of 0.03 px, and a tremor along x that the motion lacks."""
    rng = np.random.default_rng(4)
    spans = tuple(FrameSpan(start, start + 16) for start in range(0, n_frames - 15, 16))
    instants = np.array([span.centre for span in spans])
    information = np.diag([1 / 0.03**2] * 2 + [1e6] * 3)
    steps = rng.normal(0, 1 / np.sqrt(np.diagonal(information)), (len(spans), 5))
    steps[:, 0] += tremor_px * np.sin(2 * np.pi * instants / period)
    grid, cells = n_blocks(FRAME_SHAPE), (20, 80)
    blocks = np.zeros((*grid, N_SUMS))
    blocks[..., [GXX, GYY]], blocks[..., [V, M]] = 1e6, 1e5
    blocks[..., R] = rng.normal(0, np.sqrt(1e5), grid)
    return Residuals(
        spans=spans,
        instants=instants,
        normal=np.repeat(information[None], len(spans), axis=0),
        gradient=steps @ information,
        reduced_chi2=np.ones(len(spans)),
        blocks=blocks,
        block_chi2=rng.normal(1, 0.05, grid),
        pixel_gain=np.ones(FRAME_SHAPE, np.float32),
        pixel_mean=np.full(FRAME_SHAPE, 1e4, np.float32),
        pixel_slopes=np.zeros((6, *FRAME_SHAPE), np.float32),
        cell_chi2=rng.normal(1, 0.1, cells),
        cell_count=np.full(cells, 300.0),
        cell_noise=np.full(cells, 0.01),
        frames_seen=4000.0,
        frame_shape=FRAME_SHAPE,
        light=np.ones(len(spans)),
        shaking=Shaking(0.0, float("nan"), 16),
    )


def make_record(n_frames: int, panorama: RenderedPanorama) -> dict[str, Any]:
    """Make the record of a run whose second level lost many pairs."""
    record = json.loads(Path(__file__).with_name("record.json").read_text())
    record["source"]["n_frames"] = n_frames
    height, width = panorama.canvas.shape
    record["panorama"] |= {"height": height, "width": width, "coverage_share": panorama.coverage_share}
    return record


@pytest.fixture(scope="session")
def results_of() -> Callable[[int], tuple[FrameMotion, RenderedPanorama]]:
    """Make the motion and the panorama of a number of frames."""
    return make_results


@pytest.fixture(scope="session")
def tremor_of() -> Callable[[int], Residuals]:
    """Make the residuals of a motion of a number of frames that lacks a tremor."""
    return partial(make_residuals, tremor_px=0.3)


@pytest.fixture(scope="session")
def record_of() -> Callable[[int, RenderedPanorama], dict[str, Any]]:
    """Make the record of a run of a number of frames."""
    return make_record


@pytest.fixture(scope="session")
def results() -> tuple[FrameMotion, RenderedPanorama]:
    return make_results()


@pytest.fixture(scope="session")
def motion(results: tuple[FrameMotion, RenderedPanorama]) -> FrameMotion:
    return results[0]


@pytest.fixture(scope="session")
def panorama(results: tuple[FrameMotion, RenderedPanorama]) -> RenderedPanorama:
    return results[1]


@pytest.fixture(scope="session")
def residuals() -> Residuals:
    return make_residuals()


@pytest.fixture(scope="session")
def tremor() -> Residuals:
    """Residuals of a motion that lacks a tremor of 0.3 px with a period of 100 frames."""
    return make_residuals(tremor_px=0.3)


@pytest.fixture(scope="session")
def explained(motion: FrameMotion, panorama: RenderedPanorama, residuals: Residuals) -> Explained:
    cuts = np.linspace(motion.span.start, motion.span.stop, 34)[1:-1]
    agreeing, std_px = np.full(len(cuts), 0.999), np.full((len(cuts), 2), (0.01, 0.02))
    found = Agreements(cuts, agreeing, 0.002 * agreeing, std_px, 90 * agreeing)
    halves = Halves(found, found)
    return Explained(motion=motion, canvas=panorama.canvas, residuals=residuals, ratio=1.0123, halves=halves, refinements=())


@pytest.fixture
def record(motion: FrameMotion, panorama: RenderedPanorama) -> dict[str, Any]:
    return make_record(len(motion.homographies), panorama)


@pytest.fixture
def exposure_of() -> Callable[[int], VirtualExposure]:
    """Return exposures of noise by their number."""

    def exposure_of(index: int) -> VirtualExposure:
        flux = np.random.default_rng(index).uniform(0.1, 1, (24, 32)).astype(np.float32)
        flux[0, 0] = np.nan
        group = Group(FrameSpan(100 * index, 100 * index + 100), 100 * index + 50)
        return VirtualExposure(flux, np.full_like(flux, 100), group, 1.0, BinaryResponse())

    return exposure_of
