"""The conventional camera."""

from __future__ import annotations

import numpy as np
import pytest

from photonpano import FrameSpan, SourceContext
from photonpano_simulator.config import CameraSimulatorConfig, IntensitySensor
from photonpano_simulator.sensor import Draw, IntensityCamera, generator
from photonpano_simulator.source import SimulatorSource

SHAPE = (200, 301)


def exposed(flux: float, **keys: float) -> tuple[IntensityCamera, np.ndarray]:
    camera = IntensityCamera(IntensitySensor(**keys), SHAPE)
    return camera, camera.expose(np.full(SHAPE, flux, np.float32), generator(0, Draw.PHOTONS))


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
