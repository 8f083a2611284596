"""The finest real detail: what two halves of the frames share, against what the picture of all shares with the true scene."""

from __future__ import annotations

from dataclasses import replace
from typing import NamedTuple

import cv2
import numpy as np
import pytest
from scipy.ndimage import gaussian_filter1d
from scipy.optimize import minimize

from photonpano import FrameSpan
from photonpano.execution.context import Context
from photonpano.geometry import FrameTrajectory, canvas_of, translation
from photonpano.motion.frame_motion import FrameMotion
from photonpano.residuals.detail import Detail, detail_of, finest_period
from photonpano.residuals.halves import detail_between, halves_in_time
from photonpano.testing.captures import MemorySource, detected, seen_along

SHAPE, N_FRAMES = (96, 128), 1000
FINER = 2  # pixels of the scene along a side of a pixel of the sensor


class Case(NamedTuple):
    flux: float
    error_px: float  # standard deviation of the error of the motion along an axis
    lasting: float  # frames over which that is correlated
    scale: float
    height_px: float = 8  # of the path


CASES = {
    "light": Case(0.5, 0, 1, 2),
    "light, motion that is slowly off": Case(0.5, 0.3, 100, 2),
    "dusk, motion that is slowly off": Case(0.1, 0.3, 100, 2),
    "dusk, motion that trembles": Case(0.1, 0.4, 3, 2),
    "dark": Case(0.02, 0, 1, 2),
    "night, at the scale of the frames": Case(0.005, 0, 1, 1),
}


def seen(case: Case, seed: int = 0) -> tuple[Detail, float | None]:
    """Return the detail of a simulated capture, and the period down to which its panorama correlates with the true scene."""
    rng = np.random.default_rng(seed)
    size = FINER * 150, FINER * 280
    texture = np.sum([cv2.GaussianBlur(rng.normal(size=size), (0, 0), each) for each in (0.7, 1.2, 2, 4, 8, 16)], axis=0)
    scene = np.exp(0.7 * texture / texture.std())
    by_pixels = cv2.blur((case.flux * scene / scene.mean()).astype(np.float32), (FINER, FINER), anchor=(0, 0))
    time = np.linspace(0, 1, N_FRAMES)
    path = np.stack([10 + 110 * time + 1.5 * np.sin(40 * time), 20 + case.height_px * np.sin(7 * time)], axis=1)
    to_scene = np.diag([FINER, FINER, 1.0])
    true = np.array([translation(*place) for place in path])
    frames = detected(seen_along(by_pixels, to_scene @ true, SHAPE), seed)
    wrong = gaussian_filter1d(rng.normal(size=path.shape), case.lasting, axis=0)
    found = np.array([translation(*place) for place in path + case.error_px * (wrong - wrong.mean(axis=0)) / wrong.std()])
    reference, span = N_FRAMES // 2, FrameSpan(0, N_FRAMES)
    homographies = np.linalg.inv(found[reference]) @ found
    motion = FrameMotion(
        trajectory=FrameTrajectory(homographies),
        span=span,
        homographies=homographies,
        located=np.ones(N_FRAMES, dtype=bool),
        std_px=np.full(N_FRAMES, 0.1),
        reference=reference,
        frame_shape=SHAPE,
    )
    canvas, source = canvas_of(homographies, SHAPE, case.scale), MemorySource(frames)
    sums = halves_in_time(source, motion, canvas, 0.5, Context())
    everywhere = (sums[:, 1] >= 0.5).all(axis=0)
    flux = sums[:, 0].sum(axis=0) / np.maximum(sums[:, 1].sum(axis=0), 1e-6)
    onto = to_scene @ true[reference] @ np.linalg.inv(canvas.transform)

    def true_picture(shift: np.ndarray) -> np.ndarray:
        flags = cv2.INTER_LINEAR | cv2.WARP_INVERSE_MAP
        return cv2.warpPerspective(by_pixels, onto @ translation(*shift), canvas.shape[::-1], flags=flags)[..., None]

    def unlike(shift: np.ndarray) -> float:
        return -float(np.corrcoef(true_picture(shift)[everywhere], flux[everywhere])[0, 1])

    start = {"initial_simplex": [[0, 0], [0.5, 0], [0, 0.5]], "xatol": 0.02}
    aligned = true_picture(minimize(unlike, [0, 0], method="Nelder-Mead", options=start).x)
    real = detail_of(flux, aligned, sums[:, 1].sum(axis=0), everywhere, case.scale)
    return detail_between(sums, source, motion, canvas), finest_period(real.frequencies, real.halves[0])


@pytest.mark.parametrize("name", CASES)
def test_detail_is_that_which_the_panorama_shares_with_the_true_scene(name: str) -> None:
    found, true_px = seen(CASES[name])
    assert true_px is not None
    assert true_px > 1.05 / found.frequencies[-1]  # the grid does not decide
    assert found.finest_px[0] == pytest.approx(true_px, rel=0.1)


def test_what_the_grid_of_the_sensor_makes_of_the_scene_is_not_detail() -> None:
    """Rows of pixels along the path see each place at one phase: both halves show the same aliasing."""
    found, true_px = seen(Case(0.5, 0, 1, 2, 0))
    assert found.phase == pytest.approx(1, abs=0.01)
    assert true_px is not None
    assert 0.95 * true_px < (found.finest_px[0] or 0) < 1.3 * true_px
    assert (replace(found, phase=0.0).finest_px[0] or 0) < 0.8 * true_px


def test_halves_differ_by_photon_noise_and_by_more_where_the_motion_is_off() -> None:
    right, wrong = (seen(Case(0.5, error_px, 100, 1))[0] for error_px in (0, 0.3))
    assert right.noise == pytest.approx(1, abs=0.05)
    assert wrong.noise > 1.3


def test_fewer_frames_show_less_detail() -> None:
    few, _, many = seen(CASES["dark"])[0].finest_px[1:]
    assert few is not None
    assert many is not None
    assert few > 1.1 * many


def test_noise_holds_no_detail() -> None:
    first, last = np.random.default_rng(0).normal(size=(2, 128, 192, 1)).astype(np.float32)
    found = detail_of(first, last, np.ones_like(first), np.ones_like(first, dtype=bool))
    assert found.finest_px[0] is None


def test_same_pictures_show_all_that_the_grid_holds() -> None:
    same = np.random.default_rng(0).normal(size=(40, 50, 1)).astype(np.float32)
    found = detail_of(same, same, np.ones_like(same), np.ones_like(same, dtype=bool))
    assert found.finest_px == [2.0]


@pytest.mark.parametrize("shape", [(10, 200, 1), (64, 64, 1)], ids=["low", "unseen"])
def test_no_square_that_both_halves_saw_gives_no_detail(shape: tuple[int, ...]) -> None:
    image = np.ones(shape, np.float32)
    found = detail_of(image, image, image, np.zeros(shape, dtype=bool))
    assert found.finest_px == []
