from __future__ import annotations

import numpy as np
import pytest

from photonpano import FrameSpan, InputError
from photonpano.geometry import translation
from photonpano.testing import KnownMotion, MemorySource, Scene, photographed, recorded
from photonpano.testing.captures import ReadOnlySource
from photonpano.testing.sameness import fingerprint, in_threads

SHAPE = (30, 44)
STILL = KnownMotion(lambda _: np.eye(3))


def test_scene_view_moved_by_whole_pixels_has_same_values():
    scene = Scene()
    here, there = scene.view(np.eye(3), SHAPE), scene.view(translation(3, -2), SHAPE)
    np.testing.assert_allclose(there[2:, :-3], here[:-2, 3:], rtol=1e-9)


def test_scene_flux_spans_given_range():
    flux = Scene(flux=(0.2, 0.7)).view(np.eye(3), (200, 200))
    assert 0.2 < flux.min() < 0.25
    assert 0.65 < flux.max() < 0.7


def test_scenes_of_different_seeds_are_uncorrelated():
    views = [Scene(seed).view(np.eye(3), (100, 100)).ravel() for seed in (0, 1)]
    assert abs(np.corrcoef(views)[0, 1]) < 0.2


def test_recorded_frames_follow_detection_model():
    scene = Scene()
    frames = recorded(scene, STILL, 150, SHAPE)
    known = -np.expm1(-scene.view(np.eye(3), SHAPE))
    z = (frames.mean(axis=0) - known) / np.sqrt(known * (1 - known) / 150)
    assert abs(z.mean()) * np.sqrt(z.size) < 4
    assert z.std() == pytest.approx(1, abs=0.1)


def test_photographed_exposure_has_photon_noise():
    known = Scene().view(np.eye(3), SHAPE)
    unseen = np.zeros(SHAPE, bool)
    unseen[3] = True
    exposure = photographed(known, n_frames=2000, unseen=unseen)
    np.testing.assert_array_equal(np.isnan(exposure.flux), unseen)
    np.testing.assert_array_equal(exposure.weight, np.where(unseen, 0, 2000))
    z = (exposure.flux - known) / np.sqrt(np.expm1(known) / 2000)
    assert np.nanstd(z) == pytest.approx(1, abs=0.1)


@pytest.mark.parametrize("kind", [MemorySource, ReadOnlySource])
def test_memory_source_returns_its_frames(kind):
    frames = recorded(Scene(), STILL, 20, SHAPE)
    with kind(frames) as source:
        np.testing.assert_array_equal(source.frames(FrameSpan(3, 9)), frames[3:9])
        np.testing.assert_array_equal(source.counts(FrameSpan(3, 9)), frames[3:9].sum(axis=0))
        assert source.counts(FrameSpan(0, 1)).flags.writeable == (kind is MemorySource)
        with pytest.raises(InputError):
            source.counts(FrameSpan(19, 21))


def test_fingerprint_distinguishes_bytes():
    exposures = [photographed(np.full(SHAPE, 0.3), seed=seed) for seed in (0, 0, 1)]
    prints = [fingerprint({"of": [exposure, np.nan]}) for exposure in exposures]
    assert prints[0] == prints[1] != prints[2]
    assert fingerprint(np.zeros(2)) != fingerprint(np.zeros(2, np.float32))


def test_in_threads_runs_all_threads():
    assert in_threads(lambda number: number) == [0, 1, 2, 3]
