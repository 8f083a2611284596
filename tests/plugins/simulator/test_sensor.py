"""Sensors: pixels that detect a photon or none, and those of a conventional camera."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from photonpano import FrameSpan, InputError, SourceContext
from photonpano.testing.scenes import z_scores
from photonpano_simulator.config import CameraSimulatorConfig, IntensitySensor, Sensor
from photonpano_simulator.sensor import Draw, IntensityCamera, SpadSensor, generator
from photonpano_simulator.source import SimulatorSource

SHAPE = (60, 81)
CAMERA_SHAPE = (200, 301)


def counts(sensor: SpadSensor, flux: float, n_frames: int) -> np.ndarray:
    total = np.zeros(SHAPE)
    for index in range(n_frames):
        total += sensor.expose(np.full(SHAPE, flux, np.float32), generator(0, Draw.PHOTONS, index))
    return total


@pytest.mark.parametrize(("flux", "dark"), [(0.5, 0.0), (0.02, 0.0), (0.1, 0.05), (3.0, 0.0), (0.0, 0.01)])
def test_pixel_is_lit_with_probability_of_equation_2(flux: float, dark: float) -> None:
    n = 400
    chance = 1 - np.exp(-(flux + dark))
    z = z_scores(counts(SpadSensor(Sensor(dark_rate=dark), SHAPE, 0), flux, n), n, flux + dark)
    assert abs(z.mean()) < 5 / np.sqrt(z.size)
    # The variance of a binomial count's square deviation is 2 + (1 - 6 p (1 - p)) / (n p (1 - p)).
    kurtosis = 2 + (1 - 6 * chance * (1 - chance)) / (n * chance * (1 - chance))
    assert abs(z.var() - 1) < 5 * np.sqrt(kurtosis / z.size)


def test_zero_flux_lights_no_pixel_and_high_flux_all() -> None:
    sensor = SpadSensor(Sensor(), SHAPE, 0)
    assert counts(sensor, 0.0, 200).max() == 0
    assert counts(sensor, 1e6, 200).min() == 200


def test_small_probabilities_are_not_rounded() -> None:
    """At 8 bits a chance of 1 / 1000 would be 0 or 1 / 256."""
    n = 1000
    lit = counts(SpadSensor(Sensor(), SHAPE, 0), 1e-3, n).sum()
    expected = n * SHAPE[0] * SHAPE[1] * -np.expm1(-1e-3)
    assert abs(lit - expected) < 5 * np.sqrt(expected)


def test_hot_pixels_have_fraction_and_rates_of_the_config() -> None:
    sensor = SpadSensor(Sensor(hot_fraction=0.3, hot_rate=(0.01, 1.0), dark_rate=0.5), (200, 200), seed=3)
    share = sensor.hot.mean()
    assert abs(share - 0.3) < 5 * np.sqrt(0.3 * 0.7 / 40_000)
    np.testing.assert_array_equal(sensor.dark_rates[~sensor.hot], np.float32(0.5))
    logarithms = np.log10(sensor.dark_rates[sensor.hot] - 0.5)
    assert -2.001 < logarithms.min() < -1.95
    assert -0.05 < logarithms.max() < 0.001
    assert abs(logarithms.mean() + 1) < 5 * 2 / np.sqrt(12 * logarithms.size)
    assert (SpadSensor(Sensor(hot_fraction=0.3), (200, 200), seed=4).hot != sensor.hot).any()


def test_files_of_rates_and_hot_pixels_are_added(tmp_path: Path) -> None:
    rates, hot = np.zeros(SHAPE), np.zeros(SHAPE, bool)
    rates[3, 4], hot[5, 6] = 0.25, True
    np.save(tmp_path / "rates.npy", rates)
    np.save(tmp_path / "hot.npy", hot)
    config = Sensor(dark_rate=0.01, dark_rates=tmp_path / "rates.npy", hot_pixels=tmp_path / "hot.npy", hot_rate=(0.5, 0.5))
    sensor = SpadSensor(config, SHAPE, 0)
    expected = np.full(SHAPE, 0.01)
    expected[3, 4] += 0.25
    expected[5, 6] += 0.5
    np.testing.assert_allclose(sensor.dark_rates, expected, rtol=1e-6)
    np.testing.assert_array_equal(sensor.hot, hot)


@pytest.mark.parametrize(
    ("field", "array", "message"),
    [
        (
            "dark_rates",
            np.zeros((2, 3)),
            "{path} holds float64 of shape (2, 3); rates are numbers of the frame's shape (60, 81)",
        ),
        ("dark_rates", np.full(SHAPE, -1.0), "{path} holds rates that are negative or not finite"),
        ("dark_rates", np.full(SHAPE, np.nan), "{path} holds rates that are negative or not finite"),
        ("hot_pixels", np.zeros(SHAPE), "{path} holds float64 of shape (60, 81); a mask is bool of the frame's shape (60, 81)"),
        ("hot_pixels", np.array([{}]), "{path} is not a mask: it is no .npy or .npz file of plain numbers"),
        ("hot_pixels", None, "there is no file {path}; check the path"),
    ],
)
def test_wrong_rate_and_mask_files_are_refused(tmp_path: Path, field: str, array: np.ndarray | None, message: str) -> None:
    path = tmp_path / "file.npy"
    if array is not None:
        np.save(path, array)
    with pytest.raises(InputError) as caught:
        SpadSensor(Sensor.model_validate({field: path}), SHAPE, 0)
    assert str(caught.value) == message.format(path=path)


def test_archive_is_refused_as_a_mask(tmp_path: Path) -> None:
    path = tmp_path / "truth.npz"
    np.savez(path, hot=np.zeros(SHAPE, bool))
    with pytest.raises(InputError) as caught:
        SpadSensor(Sensor(hot_pixels=path), SHAPE, 0)
    assert str(caught.value) == f"{path} is an archive; name a .npy file"


def exposed(flux: float, **keys: float) -> tuple[IntensityCamera, np.ndarray]:
    camera = IntensityCamera(IntensitySensor(**keys), CAMERA_SHAPE)
    return camera, camera.expose(np.full(CAMERA_SHAPE, flux, np.float32), generator(0, Draw.PHOTONS))


@pytest.mark.parametrize(("bits", "read_noise"), [(8, 20.0), (8, 0.0), (12, 20.0), (16, 5.0)])
def test_levels_have_mean_and_noise_of_the_response(bits: int, read_noise: float) -> None:
    flux = 1000.0
    camera, levels = exposed(flux, bits=bits, read_noise=read_noise, black_level=10)
    estimate = camera.response.flux(levels.astype(np.float32), 1)
    variance = flux + camera.response.read_noise**2
    assert estimate.mean(dtype=np.float64) == pytest.approx(flux, abs=5 * np.sqrt(variance / levels.size))
    assert estimate.var(dtype=np.float64) == pytest.approx(variance, rel=0.05)


def test_pixel_saturates_at_full_well() -> None:
    _, levels = exposed(20_000, bits=12)
    assert (levels == 4095).all()


def test_open_shutter_blurs_along_the_motion_and_keeps_the_flux() -> None:
    def frame(exposure: float) -> np.ndarray:
        config = CameraSimulatorConfig.model_validate(
            {
                "scene": {"kind": "street", "width": 512, "height": 341},
                "path": {"kind": "pan", "length_px": 200},
                "n_frames": 11,
                "frame_shape": (80, 100),
                "sensor": {"full_well": 1e7, "bits": 16, "read_noise": 0, "exposure": exposure},
                "flux": 1e6,
            }
        )
        with SimulatorSource(config, SourceContext()) as source:
            return source.counts(FrameSpan(5, 6)).astype(float)

    sharp, blurred = frame(0.0), frame(0.8)
    assert blurred[:, 20:-20].mean() == pytest.approx(sharp[:, 20:-20].mean(), rel=0.05)
    # 16 px along x, as an average of the sharp one over as many says.
    averaged = np.mean([np.roll(sharp, shift, axis=1) for shift in range(-8, 9)], axis=0)
    inside = np.s_[:, 12:-12]
    assert np.corrcoef(blurred[inside].ravel(), averaged[inside].ravel())[0, 1] > 0.99
    assert np.corrcoef(blurred[inside].ravel(), sharp[inside].ravel())[0, 1] < 0.95
