"""The pictures of a video: their noise is that of the photons, and the outline lies where the frame is."""

from __future__ import annotations

import numpy as np
import pytest

from photonpano import FrameSpan
from photonpano.geometry import Camera, Canvas, FrameTrajectory, canvas_of_box, rotation_matrices, translation
from photonpano.motion.frame_motion import FrameMotion
from photonpano.pipeline.film import Film, outline_on
from photonpano.testing import MemorySource

SHAPE = (24, 32)


def motion_of(homographies: np.ndarray, camera: Camera | None = None) -> FrameMotion:
    n_frames = len(homographies)
    located, std_px = np.ones(n_frames, bool), np.zeros(n_frames)
    trajectory = FrameTrajectory(homographies)
    return FrameMotion(trajectory, FrameSpan(0, n_frames), homographies, located, std_px, 0, SHAPE, camera)


@pytest.fixture(scope="module")
def still() -> Film:
    """A still scene of 0.3 photons per pixel per frame, before a camera that jumps by whole pixels."""
    rng = np.random.default_rng(5)
    at = rng.integers(-3, 4, (2000, 2)).repeat(2, axis=0)[:2000]
    motion = motion_of(np.array([translation(*each) for each in at.astype(float)]))
    frames = (rng.random((2000, *SHAPE)) < -np.expm1(-0.3)).astype(np.uint8)
    return Film(MemorySource(frames), motion, canvas_of_box((4, 4, 28, 20), 1.0), 0.25, None, 0.6, "none")


def test_noise_of_stabilised_pictures_is_that_of_photons(still: Film) -> None:
    spans = [FrameSpan(start, start + 50) for start in range(0, 2000, 50)]
    flux = np.stack([still.exposure(span) for span in spans])
    assert flux.mean() == pytest.approx(0.3, rel=0.01)
    expected = np.sqrt(np.expm1(0.3) / 50)
    assert np.sqrt(flux.var(axis=0, ddof=1).mean()) == pytest.approx(expected, rel=0.04)


@pytest.mark.parametrize(("bits", "white"), [(8, 255), (16, 65535)])
def test_pictures_have_levels_of_srgb(still: Film, bits: int, white: int) -> None:
    [picture] = still.pictures([FrameSpan(0, 2000)], 2, bits)
    assert picture.dtype.itemsize * 8 == bits
    assert picture.mean() / white == pytest.approx(1.055 * 0.5 ** (1 / 2.4) - 0.055, rel=0.01)


def test_pictures_do_not_depend_on_threads(still: Film) -> None:
    spans = [FrameSpan(start, start + 100) for start in range(0, 600, 100)]
    np.testing.assert_array_equal(*(np.stack(list(still.pictures(spans, threads, 8))) for threads in (1, 3)))


def test_outline_lies_around_the_frame() -> None:
    motion = motion_of(np.array([translation(10, 5), translation(30, 5)]))
    drawn = outline_on(canvas_of_box((0, 0, 80, 40), 1.0), motion, None, 1)
    y, x = np.nonzero(drawn > 0.5)
    assert (x.min(), x.max(), y.min(), y.max()) == pytest.approx((30, 61, 5, 28), abs=2)
    assert drawn[10:24, 35:56].max() == 0


def test_outline_goes_on_at_the_other_end_of_a_sphere() -> None:
    camera = Camera.of(20, SHAPE)
    behind = camera.homographies(rotation_matrices([[0, np.pi, 0]]))
    canvas = Canvas(
        40, 80, np.array([[80 / (2 * np.pi), 0, 40], [0, 80 / (2 * np.pi), 20], [0, 0, 1]]), "spherical", camera.matrix
    )
    drawn = outline_on(canvas, motion_of(behind, camera), camera, 0)
    columns = np.flatnonzero((drawn > 0.5).any(axis=0))
    assert columns.min() == 0
    assert columns.max() == 79
    assert not ((columns > 12) & (columns < 67)).any()
