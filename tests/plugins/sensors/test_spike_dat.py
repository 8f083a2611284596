"""Spikes of pixels that gather light until a threshold: flux is proportional to them, and its error bars are not too small."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from photonpano import SourceContext
from photonpano.photometry import flux_std
from photonpano_sensors.bin_files import SPIKE_DAT, SpikeDatConfig

SHAPE, N_FRAMES, PHOTONS = (40, 50), 300, 20


def spikes(flux: float, seed: int = 0) -> np.ndarray:
    """Simulate frames of pixels that fire after 20 photons, and keep what is left: (300, 40, 50)."""
    rng, frames = np.random.default_rng(seed), np.empty((N_FRAMES, *SHAPE), np.uint8)
    gathered = rng.random(SHAPE)
    for frame in frames:
        gathered += rng.poisson(flux * PHOTONS, SHAPE) / PHOTONS
        frame[:] = gathered >= 1
        gathered -= frame
    return frames


@pytest.mark.parametrize("flux", [0.01, 0.1, 0.5])
def test_flux_is_spikes_per_frame_within_its_error_bars(tmp_path: Path, flux: float) -> None:
    (tmp_path / "capture.dat").write_bytes(np.packbits(spikes(flux).ravel(), bitorder="little").tobytes())
    config = SpikeDatConfig(path=tmp_path / "capture.dat", frame_shape=SHAPE)
    with SPIKE_DAT.build(config, SourceContext()) as source:
        mean = source.counts(source.info.span) / np.float32(N_FRAMES)
        found = source.response.flux(mean, N_FRAMES)
        std = flux_std(found, np.full(SHAPE, N_FRAMES, np.float32), source.response)
    assert found.mean() == pytest.approx(flux, rel=0.01)
    assert (std > 0).all()
    z = (found - flux) / std
    assert z.std() < 0.6
    assert (abs(z) < 2).mean() > 0.95
