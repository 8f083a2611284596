"""The merger that finds motion beyond that of the camera: local-flow."""

from __future__ import annotations

from collections.abc import Callable

import cv2
import numpy as np
import pytest

from photonpano import FrameSpan, Group, Source, Trajectory, VirtualExposure
from photonpano.photometry import flux_std
from photonpano.testing import MemorySource
from photonpano_core.configs import LocalFlowConfig, PhotonMleConfig
from photonpano_core.local_flow import LocalFlowMerger, number_of
from photonpano_core.mergers import PhotonMleMerger

N, HEIGHT, WIDTH = 270, 80, 112
GROUP = Group(FrameSpan(0, N), (N - 1) / 2)
SPEED_PX, OWN_PX = 0.06, 0.08
"""Motion of the camera, and of an object over the scene, in px per frame."""
TOP, LEFT, SIDE = 22, 36, 40


def texture(shape: tuple[int, int], seed: int) -> np.ndarray:
    noise = np.random.default_rng(seed).standard_normal(shape)
    layers = sum(sigma * cv2.GaussianBlur(noise, (0, 0), sigma) for sigma in (1.5, 4.0))
    return 0.6 * np.exp(0.6 * layers)


SCENE, OBJECT = texture((HEIGHT, 160), 1), texture((SIDE, SIDE), 2)


def shifted(image: np.ndarray, left: float, shape: tuple[int, int]) -> np.ndarray:
    to_image = np.array([[1, 0, left], [0, 1, 0]])
    return cv2.warpAffine(image, to_image, shape[::-1], flags=cv2.INTER_LINEAR | cv2.WARP_INVERSE_MAP)


def view(frame: float, crossed: bool) -> np.ndarray:
    """The flux in a frame of a camera that pans to the right, with a textured square that moves by itself."""
    seen = shifted(SCENE, SPEED_PX * frame + 4, (HEIGHT, WIDTH))
    if crossed:
        at = LEFT + (OWN_PX - SPEED_PX) * (frame - GROUP.reference)
        whole = shifted(OBJECT, -at, (SIDE, WIDTH))
        inside = np.clip(np.minimum(np.arange(WIDTH) + 0.5, at + SIDE) - np.maximum(np.arange(WIDTH) - 0.5, at), 0, 1)
        seen[TOP : TOP + SIDE] += inside * (whole - seen[TOP : TOP + SIDE])
    return seen


def capture(crossed: bool, light: float = 1.0, seed: int = 0, valid: np.ndarray | None = None) -> MemorySource:
    rng = np.random.default_rng(seed)
    frames = [rng.random((HEIGHT, WIDTH)) < -np.expm1(-light * view(frame, crossed)) for frame in range(N)]
    return MemorySource(np.array(frames, np.uint8), valid)


@pytest.fixture(scope="module")
def motion(pan: Callable) -> Trajectory:
    return pan(SPEED_PX)


@pytest.fixture(scope="module")
def crossed() -> MemorySource:
    return capture(crossed=True)


def local_flow(**config: float) -> LocalFlowMerger:
    return LocalFlowMerger(LocalFlowConfig.model_validate(config))


def plain() -> PhotonMleMerger:
    return PhotonMleMerger(PhotonMleConfig(tolerance_px=0.5))


def as_exact(exposure: VirtualExposure, other: VirtualExposure) -> bool:
    """Whether two exposures differ by less than a third of the noise: they are cut into other chunks of frames."""
    noise = flux_std(other.flux, other.weight, other.response)
    difference = ((exposure.flux - other.flux) / noise)[5:-5, 5:-5]
    return bool(np.sqrt(np.nanmean(difference**2)) < 0.33) and np.allclose(exposure.weight, other.weight, rtol=0.01, atol=1.5)


def swept() -> np.ndarray:
    """Pixels of the reference view that the object covers at some time, along the motion of the scene."""
    half = OWN_PX * N / 2
    mask = np.zeros((HEIGHT, WIDTH), bool)
    mask[TOP : TOP + SIDE, round(LEFT - half) : round(LEFT + half) + SIDE] = True
    return mask


def test_moving_object_is_sharper_than_with_other_mergers(crossed: Source, motion: Trajectory) -> None:
    true = view(GROUP.reference, crossed=True)

    def error(merger: LocalFlowMerger | PhotonMleMerger) -> float:
        return float(np.mean((merger.merge(crossed, GROUP, motion, 1.0).flux - true)[swept()] ** 2))

    assert error(local_flow()) < 0.3 * error(plain())


def test_photons_of_moving_object_are_used(crossed: Source, motion: Trajectory) -> None:
    """Most frames count inside of it, since they are warped along its own motion."""
    weight = local_flow().merge(crossed, GROUP, motion, 1.0).weight
    assert weight[TOP + 8 : TOP + SIDE - 8, LEFT + 8 : LEFT + SIDE - 8].mean() > 0.85 * N


def test_nothing_changes_outside_of_what_moves(crossed: Source, motion: Trajectory) -> None:
    """All frames count, and the error is that of photon-mle."""
    found, other = (merger.merge(crossed, GROUP, motion, 1.0) for merger in (local_flow(), plain()))
    above = (slice(5, TOP - 12), slice(5, -5))
    np.testing.assert_allclose(found.weight[above], other.weight[above], rtol=0.01)
    true = view(GROUP.reference, crossed=True)
    errors = [np.mean((each.flux - true)[above] ** 2) for each in (found, other)]
    assert errors[0] < 1.02 * errors[1]


@pytest.mark.parametrize("light", [1.0, 0.1])
def test_still_scene_is_merged_as_by_photon_mle(motion: Trajectory, light: float) -> None:
    source = capture(crossed=False, light=light)
    assert as_exact(*(merger.merge(source, GROUP, motion, 1.0) for merger in (local_flow(), plain())))


def test_too_dark_group_is_merged_as_by_photon_mle(motion: Trajectory) -> None:
    source = capture(crossed=True, light=0.01)
    assert number_of(source, GROUP) == 1
    assert as_exact(*(merger.merge(source, GROUP, motion, 1.0) for merger in (local_flow(), plain())))


def test_ghost_map_shows_what_moves(crossed: Source, motion: Trajectory) -> None:
    found = local_flow().ghost_map(crossed, GROUP, motion)
    both = (found.moving & swept()).sum()
    assert both > 0.85 * found.moving.sum()
    assert both > 0.85 * swept().sum()
    assert (found.significance >= 0).all()


def test_significance_of_photon_noise_is_normal(pan: Callable) -> None:
    """For a still camera it is the positive part of a standard normal variable."""
    frames = np.random.default_rng(4).random((N, HEIGHT, WIDTH)) < 0.3
    found = local_flow(tolerated_px=0).ghost_map(MemorySource(frames), GROUP, pan(0.0)).significance[8:-8, 8:-8]
    assert 0.02 < (found > 1).mean() < 0.25
    assert (found > 3.5).mean() < 2e-3


def test_motion_beyond_the_global_one_is_found_from_any_reference(motion: Trajectory, crossed: Source) -> None:
    """Also if the reference instant is the first of the group."""
    group = Group(GROUP.span, 0.0)
    true = view(0.0, crossed=True)
    inside = (slice(TOP + 5, TOP + SIDE - 5), slice(LEFT + 5, LEFT + SIDE - 5))
    errors = [
        np.mean((merger.merge(crossed, group, motion, 1.0).flux - true)[inside] ** 2) for merger in (local_flow(), plain())
    ]
    assert errors[0] < 0.3 * errors[1]
