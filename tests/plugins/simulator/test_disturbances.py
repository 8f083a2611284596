"""Lens, dirt, objects, missing frames and light of a simulated capture."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

import cv2
import numpy as np
import pytest

from photonpano import FrameSpan
from photonpano.geometry import corners, transform_points
from photonpano_simulator.camera import DrawnObject, SpadSensor, undistorted
from photonpano_simulator.config import FrameObject, Lens, Sensor, SimulatorConfig

if TYPE_CHECKING:
    from collections.abc import Callable

    from photonpano_simulator.source import SimulatorSource

    Simulated = Callable[..., SimulatorSource]

STILL: dict[str, Any] = {"path": {"kind": "pan", "length_px": 1e-6}, "n_frames": 2000}
SHAPE, WIDE = (40, 52), (40, 60)


def z_scores(counts: np.ndarray, n_frames: int, flux: Any) -> np.ndarray:
    """Return the deviations of counts of a binary camera from a flux, in standard deviations of photon noise."""
    chance = -np.expm1(-np.asarray(flux, np.float64))
    return (counts - n_frames * chance) / np.sqrt(n_frames * chance * (1 - chance))


def deviations(source: SimulatorSource, flux: np.ndarray) -> np.ndarray:
    """Return the deviations of the counts of a capture from a constant flux, in standard deviations."""
    return z_scores(source.counts(source.info.span), source.info.n_frames, flux)


def radii(points: np.ndarray) -> np.ndarray:
    """Return the distances of (N, 2) points from the middle of the frame, in half-diagonals."""
    middle = (np.array(SHAPE[::-1]) - 1) / 2
    return np.linalg.norm(points - middle, axis=-1) / np.linalg.norm(middle)


def lensed(k1: float, k2: float = 0) -> SimulatorConfig:
    return SimulatorConfig(lens=Lens(k1=k1, k2=k2), frame_shape=SHAPE)


def test_distortion_follows_the_division_model() -> None:
    lens = lensed(-0.03, 0.01)
    points = np.array([[0.0, 0.0], [51.0, 39.0], [10.0, 33.0], [40.0, 20.0]])
    r = radii(points)
    np.testing.assert_allclose(radii(undistorted(lens, points)), r / (1 - 0.03 * r**2 + 0.01 * r**4), rtol=1e-12)
    np.testing.assert_array_equal(undistorted(lens, [25.5, 19.5]), [25.5, 19.5])
    # The corner is imaged 3 % nearer to the middle than without distortion.
    np.testing.assert_allclose(radii(undistorted(lensed(-0.03), corners(SHAPE))) * 0.97, 1, rtol=1e-12)


def test_distorted_frames_agree_with_the_truth(simulated: Simulated) -> None:
    source = simulated(**STILL, lens={"k1": -0.2, "k2": 0.05})
    truth = source.truth()
    assert truth["distortion"].tolist() == [-0.2, 0.05]
    y, x = np.mgrid[: SHAPE[0], : SHAPE[1]]
    pixels = np.stack([x, y], axis=-1).reshape(-1, 2).astype(float)
    seen = transform_points(truth["homographies"][0], undistorted(lensed(-0.2, 0.05), pixels)).astype(np.float32)
    flux = cv2.remap(truth["scene"], seen[:, :1], seen[:, 1:], cv2.INTER_LINEAR).reshape(SHAPE)
    z = deviations(source, flux)
    assert abs(z.mean()) < 5 / np.sqrt(z.size)
    assert abs(z.var() - 1) < 5 * np.sqrt(2 / z.size)
    np.testing.assert_allclose(truth["undistorted_corners"], undistorted(lensed(-0.2, 0.05), corners(SHAPE)))
    # A lens without distortion images something else there.
    assert deviations(simulated(**STILL), flux).var() > 2


def test_vignette_takes_its_fraction_of_the_light_at_the_corner(simulated: Simulated) -> None:
    clear, dark = simulated(**STILL, flux=0.1), simulated(**STILL, flux=0.1, lens={"vignette": 0.6})
    lit = [-np.log1p(-(source.counts(source.info.span) / 2000)) for source in (clear, dark)]
    gains = dark.truth()["gains"]
    assert gains[0, 0] == gains[-1, -1] == pytest.approx(0.4)
    assert gains[19:21, 25:27].min() > 0.999
    r = radii(np.stack(np.meshgrid(np.arange(52), np.arange(40)), axis=-1))
    np.testing.assert_allclose(gains, 1 - 0.6 * r**2, rtol=1e-5)
    for ring in (r < 0.3, (r > 0.4) & (r < 0.6), r > 0.8):
        expected = (gains * lit[0])[ring].sum()
        assert lit[1][ring].sum() == pytest.approx(expected, abs=5 * np.sqrt(2 * expected / 2000))


def test_gains_and_dirt_are_sensitivities_of_the_pixels() -> None:
    shape = (200, 300)
    gains = SpadSensor(Sensor(gain_std=0.1), shape, seed=1).gains
    assert gains.mean() == pytest.approx(1, abs=5 * 0.1 / np.sqrt(gains.size))
    assert gains.std() == pytest.approx(0.1, rel=5 / np.sqrt(2 * gains.size))
    assert (SpadSensor(Sensor(gain_std=0.1), shape, seed=2).gains != gains).any()
    dirty = SpadSensor(Sensor(dirt={"specks": 1, "radius_px": 4, "loss": 0.7}), shape, seed=1).gains
    # The light that a Gaussian speck takes is its loss times 2 pi radius^2.
    assert dirty.min() == pytest.approx(0.3, abs=0.01)
    assert (1 - dirty).sum() == pytest.approx(0.7 * 2 * np.pi * 4**2, rel=0.01)


def test_gains_scale_the_flux_of_the_frames(simulated: Simulated) -> None:
    source = simulated(**STILL, flux=0.3, sensor={"gain_std": 0.2, "dirt": {"specks": 3}}, lens={"vignette": 0.3})
    clean = simulated(**STILL, flux=0.3)
    truth = source.truth()
    x, y = transform_points(
        truth["homographies"][0], np.stack(np.meshgrid(np.arange(52), np.arange(40)), axis=-1).reshape(-1, 2)
    ).T
    scene = cv2.remap(truth["scene"], x.astype(np.float32), y.astype(np.float32), cv2.INTER_LINEAR).reshape(SHAPE)
    assert abs(deviations(source, scene * truth["gains"]).var() - 1) < 5 * np.sqrt(2 / scene.size)
    assert "gains" not in clean.truth()


@pytest.mark.parametrize(("size", "share"), [((0.5, 0.6), 0.3), ((0.95, 0.9474), 0.9), ((1.0, 1.0), 1.0), ((4.0, 0.25), 0.25)])
def test_object_covers_its_share_of_the_frame(size: tuple[float, float], share: float) -> None:
    view = np.ones(SHAPE, np.float32)
    DrawnObject(FrameObject(size=size, flux=0), SHAPE, 0.5, np.zeros((3, 2))).draw(view, 1)
    assert 1 - view.mean() == pytest.approx(share, rel=1e-3)
    lit = np.zeros(SHAPE, np.float32)
    DrawnObject(FrameObject(size=(1, 1), flux=2), SHAPE, 0.5, np.zeros((3, 2))).draw(lit, 1)
    assert lit.mean() == pytest.approx(2 * 0.5, rel=1e-3)


@pytest.mark.parametrize(
    ("settings", "moved"),
    [({"moves_px": (0.01, -0.005)}, (20, -10)), ({"follows": 1.0}, (-40, 0)), ({"follows": 0.5}, (-20, 0))],
)
def test_object_moves_through_the_frame(simulated: Simulated, settings: dict[str, Any], moved: tuple[float, float]) -> None:
    dark = {"size": (0.2, 0.2), "at": (0.5, 0.6), "flux": 0}
    source = simulated(n_frames=2001, path={"kind": "pan", "length_px": 40}, flux=1000, objects=[dark | settings])
    middles = []
    for frame in (0, 2000):
        rows, columns = np.nonzero(source.counts(FrameSpan(frame, frame + 1)) == 0)
        middles.append((columns.mean(), rows.mean()) if len(rows) else (np.nan, np.nan))
    expected = np.array([0.5 * 52 - 0.5 + moved[0], 0.6 * 40 - 0.5 + moved[1]])
    np.testing.assert_allclose(middles[0], (25.5, 23.5), atol=0.5)
    if 5 < expected[0] < 47:
        np.testing.assert_allclose(middles[1], expected, atol=0.5)
    else:
        assert np.isnan(middles[1]).all()


def test_dropped_and_repeated_frames_have_the_truth_of_the_frames_that_are_there(simulated: Simulated) -> None:
    whole = simulated()
    source = simulated(drops=[{"at": 10, "frames": 5}], repeats=[{"at": 20, "frames": 3}, {"at": 49}])
    taken = [*range(10), *range(15, 23), 20, 21, 22, *range(23, 50), 49]
    assert source.info.n_frames == len(taken) == 49
    np.testing.assert_array_equal(source.frames(source.info.span), whole.frames(whole.info.span)[taken])
    np.testing.assert_array_equal(source.truth()["homographies"], whole.truth()["homographies"][taken])
    np.testing.assert_array_equal(source.truth()["taken"], taken)


def test_light_drifts_exponentially(simulated: Simulated) -> None:
    source = simulated(**STILL | {"n_frames": 2001}, flux=0.2, drift=0.125)
    np.testing.assert_allclose(source.truth()["light"][[0, 1000, 2000]], [1, 8**-0.5, 0.125])
    mean = float(np.mean(source.truth()["scene"]))
    steady = simulated(**STILL | {"n_frames": 2001}, flux=0.2)
    first, last = (source.counts(FrameSpan(start, start + 200)).sum() for start in (0, 1801))
    expected = steady.counts(FrameSpan(0, 200)).sum()
    assert first / expected == pytest.approx(8**-0.05, rel=0.05)
    assert last / expected == pytest.approx(8**-0.95, rel=0.15)
    assert mean == pytest.approx(0.2, rel=0.01)


def test_lamp_flickers_by_its_depth_at_its_phase(simulated: Simulated) -> None:
    lamp = {"frequency_hz": 100.0, "depth": 0.8, "phase_deg": 90.0}
    source = simulated(**STILL, flux=0.3, frame_rate_hz=2000.0, lamps=[lamp])
    light = source.truth()["lamp_light"][0]
    np.testing.assert_allclose(light, 1 + 0.8 * np.cos(2 * np.pi * np.arange(2000) / 20 + np.pi / 2))
    lit = source.frames(FrameSpan(0, 2000)).mean(axis=(1, 2)).reshape(100, 20).mean(axis=0)
    steady = simulated(**STILL, flux=0.3).frames(FrameSpan(0, 2000)).mean()
    np.testing.assert_allclose(-np.log1p(-lit), -np.log1p(-steady) * light[:20], atol=0.02)
