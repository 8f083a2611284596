from __future__ import annotations

from concurrent.futures import ThreadPoolExecutor
from typing import TYPE_CHECKING

import cv2
import numpy as np
import pytest

from photonpano import FrameSpan, InputError
from photonpano.captures.writing import write_packed
from photonpano.testing.scenes import z_scores

if TYPE_CHECKING:
    from collections.abc import Callable, Iterator
    from pathlib import Path

    from photonpano_simulator.source import SimulatorSource

    Simulated = Callable[..., SimulatorSource]

NOISY = {"sensor": {"dark_rate": 0.01, "hot_fraction": 0.05}, "path": {"kind": "loop", "length_px": 100, "shake": {}}}


@pytest.fixture
def opencv_threads() -> Iterator[None]:
    before = cv2.getNumThreads()
    yield
    cv2.setNumThreads(before)


def test_info_describes_the_frames(simulated: Simulated) -> None:
    with simulated(frame_rate_hz=1000) as source:
        info = source.info
        assert (info.n_frames, info.frame_shape, info.frame_rate_hz) == (50, (40, 52), 1000)
        assert (info.kind, info.bit_depth) == ("binary", 1)
        frames = source.frames(info.span)
    assert (frames.shape, frames.dtype) == ((50, 40, 52), np.uint8)
    assert set(np.unique(frames)) == {0, 1}


def test_frames_are_the_same_in_any_order_and_from_any_thread(simulated: Simulated) -> None:
    with simulated(**NOISY) as source:
        frames = source.frames(source.info.span)
        order = np.random.default_rng(0).permutation(50)
        with ThreadPoolExecutor(4) as pool:
            again = list(pool.map(lambda index: source.frames(FrameSpan(index, index + 1))[0], order.tolist()))
        np.testing.assert_array_equal(again, frames[order])
        np.testing.assert_array_equal(source.counts(FrameSpan(7, 31)), frames[7:31].sum(axis=0))
        assert source.counts(FrameSpan(0, 1)).dtype == np.uint32
    with simulated(**NOISY) as other:
        np.testing.assert_array_equal(other.frames(FrameSpan(20, 50)), frames[20:])


@pytest.mark.usefixtures("opencv_threads")
def test_frames_do_not_depend_on_the_threads_of_opencv(simulated: Simulated) -> None:
    frames = []
    for threads in (1, 2, 3):
        cv2.setNumThreads(threads)
        frames.append(simulated(**NOISY).frames(FrameSpan(0, 20)))
    np.testing.assert_array_equal(frames[0], frames[1])
    np.testing.assert_array_equal(frames[0], frames[2])


def test_frames_depend_on_the_seed(simulated: Simulated) -> None:
    span = FrameSpan(0, 5)
    first = simulated(run_seed=1).frames(span)
    assert (first != simulated(run_seed=2).frames(span)).any()
    np.testing.assert_array_equal(first, simulated(run_seed=2, seed=1).frames(span))


def test_frames_are_independent(simulated: Simulated) -> None:
    """Neither in time nor in space does a pixel tell of another, beyond the scene."""
    source = simulated(n_frames=4000, path={"kind": "pan", "length_px": 1e-6}, flux=0.5)
    frames = source.frames(source.info.span).astype(np.float32)
    deviations = (frames - frames.mean(axis=0)) / frames.std(axis=0)
    n = deviations[1:].size
    for product in (
        deviations[1:] * deviations[:-1],
        deviations[7:] * deviations[:-7],
        deviations[:, :, 1:] * deviations[:, :, :-1],
        deviations[:, 1:] * deviations[:, :-1],
    ):
        # The mean of n products of independent unit deviations has the standard deviation 1 / sqrt(n).
        assert abs(product.mean(dtype=np.float64)) < 5 / np.sqrt(n)


def test_frames_agree_with_the_truth(simulated: Simulated) -> None:
    source = simulated(n_frames=3000, path={"kind": "pan", "length_px": 1e-6, "centre": (90.3, 70.6)}, flux=0.5)
    truth = source.truth()
    height, width = truth["frame_shape"]
    y, x = np.mgrid[:height, :width]
    points = np.stack([x, y, np.ones_like(x)], axis=-1) @ truth["homographies"][0].T
    px, py = points[..., 0] / points[..., 2], points[..., 1] / points[..., 2]
    flux = cv2.remap(truth["scene"], px.astype(np.float32), py.astype(np.float32), cv2.INTER_LINEAR)
    z = z_scores(source.counts(source.info.span), 3000, flux)
    assert abs(z.mean()) < 5 / np.sqrt(z.size)
    assert abs(z.var() - 1) < 5 * np.sqrt(2 / z.size)


def test_hot_pixels_do_not_change_the_others(simulated: Simulated) -> None:
    clean = simulated(flux=0.2)
    hot = simulated(flux=0.2, sensor={"hot_fraction": 0.1, "mask_hot_pixels": True})
    assert clean.valid.all()
    assert 0.07 < 1 - hot.valid.mean() < 0.13
    span = clean.info.span
    np.testing.assert_array_equal(clean.frames(span)[:, hot.valid], hot.frames(span)[:, hot.valid])
    assert hot.counts(span)[~hot.valid].mean() > 1.5 * clean.counts(span)[~hot.valid].mean()


def test_hot_pixels_are_valid_unless_they_are_masked(simulated: Simulated) -> None:
    assert simulated(sensor={"hot_fraction": 0.1}).valid.all()


def test_written_capture_has_the_same_frames(simulated: Simulated, tmp_path: Path) -> None:
    source = simulated(**NOISY, frame_shape=(40, 51))
    path, truth_path = write_packed(source, tmp_path / "cube.npy")
    packed = np.load(path, allow_pickle=False)
    assert packed.shape == (50, 40, 7)
    np.testing.assert_array_equal(np.unpackbits(packed, axis=-1, count=51), source.frames(source.info.span))
    with np.load(truth_path, allow_pickle=False) as truth:
        names = (
            "camera_matrix dark_rates frame_rate_hz frame_shape homographies hot_pixels rotations scene scene_projection seed"
        )
        assert sorted(truth) == names.split()
        assert (truth["homographies"].shape, truth["homographies"].dtype) == ((50, 3, 3), np.float64)
        assert (truth["scene"].shape, truth["scene"].dtype) == ((150, 200), np.float32)
        assert truth["frame_shape"].tolist() == [40, 51]
        homographies = truth["homographies"]

    replayed = simulated(sensor=NOISY["sensor"], frame_shape=(40, 51), path={"kind": "file", "file": truth_path})
    np.testing.assert_allclose(replayed.truth()["homographies"], homographies, rtol=0, atol=1e-12)


def test_span_beyond_the_end_is_refused(simulated: Simulated) -> None:
    with simulated() as source:
        for read in (source.counts, source.frames):
            with pytest.raises(InputError) as caught:
                read(FrameSpan(40, 51))
            assert str(caught.value) == "frames 40 to 50 were requested, but the capture has 50 frames (0 to 49)"


@pytest.mark.parametrize(("fill_factor", "side"), [(1.0, 4), (0.25, 2), (0.05, 1)])
def test_pixels_before_a_finer_scene_average_it_over_their_areas(simulated: Simulated, fill_factor: float, side: int) -> None:
    keys = {"scene_scale": 4, "fill_factor": fill_factor, "path": {"kind": "pan", "length_px": 1e-9}, "flux": 0.3}
    with simulated(n_frames=2000, frame_shape=(24, 32), **keys) as source:
        truth = source.truth()
        lit = source.counts(source.info.span) / 2000
    scene, to_scene = truth["scene"], truth["homographies"][0]
    assert to_scene[0, 0] == pytest.approx(4, rel=1e-3)
    expected = np.zeros(lit.shape)
    for row in range(lit.shape[0]):
        for column in range(lit.shape[1]):
            u, v, depth = to_scene @ (column, row, 1)
            x, y = np.floor(np.array([u, v]) / depth - (side - 1) / 2 + 1e-3).astype(int)
            expected[row, column] = scene[y : y + side, x : x + side].mean()
    assert np.corrcoef(lit.ravel(), -np.expm1(-expected).ravel())[0, 1] > 0.97


def test_path_of_a_finer_scene_is_in_pixels_of_a_frame(simulated: Simulated) -> None:
    keys = {"scene": {"kind": "street", "width": 600, "height": 400}, "path": {"kind": "pan", "length_px": 40}}
    with simulated(**keys) as coarse, simulated(scene_scale=2, **keys) as fine:
        middles = [
            np.array([h @ (25.5, 19.5, 1) / (h @ (25.5, 19.5, 1))[2] for h in source.truth()["homographies"]])
            for source in (coarse, fine)
        ]
    moved, moved_fine = (np.linalg.norm(each[-1] - each[0]) for each in middles)
    assert (moved, moved_fine) == (pytest.approx(40, rel=1e-3), pytest.approx(80, rel=1e-3))
    np.testing.assert_allclose(middles[0].mean(axis=0), middles[1].mean(axis=0), atol=0.1)
