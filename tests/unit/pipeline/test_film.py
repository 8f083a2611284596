"""The pictures of a video, and the metadata by which viewers open a spherical panorama."""

import re

import numpy as np
import pytest

from photonpano import FrameSpan
from photonpano.geometry import (
    Camera,
    Canvas,
    FrameTrajectory,
    canvas_around,
    canvas_of_box,
    covered_by,
    rotation_matrices,
    translation,
)
from photonpano.motion.frame_motion import FrameMotion
from photonpano.pipeline.film import Film
from photonpano.record.picture_files import photo_sphere
from photonpano.testing import MemorySource
from photonpano.testing.captures import detected

SHAPE = (24, 32)


def motion_of(homographies: np.ndarray, camera: Camera | None = None) -> FrameMotion:
    n_frames = len(homographies)
    located, std_px = np.ones(n_frames, bool), np.zeros(n_frames)
    trajectory = FrameTrajectory(homographies)
    return FrameMotion(
        trajectory=trajectory,
        span=FrameSpan(0, n_frames),
        homographies=homographies,
        located=located,
        std_px=std_px,
        reference=0,
        frame_shape=SHAPE,
        camera=camera,
    )


@pytest.fixture(scope="module")
def still() -> Film:
    """A still scene of 0.3 photons per pixel per frame, before a camera that jumps by whole pixels."""
    rng = np.random.default_rng(5)
    at = rng.integers(-3, 4, (2000, 2)).repeat(2, axis=0)[:2000]
    motion = motion_of(np.array([translation(*each) for each in at.astype(float)]))
    frames = detected(np.full((2000, *SHAPE), 0.3), rng)
    return Film(
        source=MemorySource(frames),
        motion=motion,
        canvas=canvas_of_box((4, 4, 28, 20), 1.0),
        tolerance_px=0.25,
        smooth_frames=None,
        white_flux=0.6,
        white_balance="none",
    )


def test_noise_of_stabilised_pictures_is_that_of_photons(still: Film) -> None:
    spans = [FrameSpan(start, start + 50) for start in range(0, 2000, 50)]
    flux = np.stack([still.exposure(span) for span in spans])
    assert flux.mean() == pytest.approx(0.3, rel=0.01)
    expected = np.sqrt(np.expm1(0.3) / 50)
    assert np.sqrt(flux.var(axis=0, ddof=1).mean()) == pytest.approx(expected, rel=0.04)


FRAME = (40, 60)
CAMERA = Camera.of(50.0, FRAME)


def spherical(first: float, last: float) -> Canvas:
    yaws = np.radians(np.arange(first, last + 1, 5))
    turns = rotation_matrices(np.stack([0 * yaws, yaws, 0 * yaws], axis=-1))
    return canvas_around(covered_by(turns, CAMERA, FRAME), CAMERA, 1.0, "spherical")


def numbers(packet: str) -> dict[str, int]:
    return {name: int(value) for name, value in re.findall(r"<GPano:(\w+Pixels)>(\d+)<", packet)}


def test_full_turn_has_the_width_of_the_sphere() -> None:
    canvas = spherical(0, 360)
    found = numbers(photo_sphere(canvas, canvas.shape) or "")
    assert found["FullPanoWidthPixels"] == found["CroppedAreaImageWidthPixels"] == canvas.width == 316
    assert found["FullPanoHeightPixels"] == 158
    assert found["CroppedAreaLeftPixels"] == 0
    # The horizon, b = 0, is the middle of the sphere.
    assert found["CroppedAreaTopPixels"] + canvas.transform[1, 2] == pytest.approx(158 / 2 - 0.5, abs=0.51)
    found = numbers(photo_sphere(canvas, (canvas.height // 2, canvas.width // 2)) or "")
    assert (found["FullPanoWidthPixels"], found["FullPanoHeightPixels"]) == (158, 79), "numbers of the pixels of the picture"
