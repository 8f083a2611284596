from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import cv2
import numpy as np
import pytest

from photonpano.testing.images import PANORAMA_SHAPE, panorama
from photonpano_core.configs import ExrConfig
from photonpano_core.exporters import RadianceExporter


@pytest.mark.parametrize("in_colour", [False, True])
def test_hdr_holds_flux_to_one_part_in_250(tmp_path: Path, in_colour: bool) -> None:
    """Read with OpenCV; the error is relative to the brightest colour of a pixel."""
    stored = panorama(in_colour)
    RadianceExporter().export(stored, tmp_path / "a.hdr")
    found = cv2.imread(str(tmp_path / "a.hdr"), cv2.IMREAD_UNCHANGED)[..., ::-1]
    expected = np.nan_to_num(stored.flux)
    expected = expected if in_colour else np.repeat(expected[..., None], 3, axis=-1)
    assert found.shape == (*PANORAMA_SHAPE, 3)
    error = np.abs(found - expected) / np.maximum(expected.max(axis=-1, keepdims=True), 1e-9)
    assert error.max() < 1 / 250


@pytest.mark.parametrize("level", [0.0, -1.0, np.nan, 1e-38, 1e-30, 255.9 / 256, 1.0, 1e38])
def test_hdr_holds_any_flux(level: float, tmp_path: Path) -> None:
    stored = replace(panorama(False), flux=np.full(PANORAMA_SHAPE, level, np.float32))
    RadianceExporter().export(stored, tmp_path / "a.hdr")
    found = cv2.imread(str(tmp_path / "a.hdr"), cv2.IMREAD_UNCHANGED)
    np.testing.assert_allclose(found, level if level > 1e-37 else 0, rtol=0.004)


@pytest.mark.parametrize("compression", ["zip", "zips", "none"])
@pytest.mark.parametrize("in_colour", [False, True])
def test_exr_holds_flux_weight_std_and_saturated_pixels(tmp_path: Path, in_colour: bool, compression: str) -> None:
    openexr = pytest.importorskip("OpenEXR")
    from photonpano_core.exporters import ExrExporter

    stored = panorama(in_colour)
    ExrExporter(ExrConfig(compression=compression)).export(stored, tmp_path / "a.exr")
    rows = stored.rows(0, PANORAMA_SHAPE[0])
    with openexr.File(str(tmp_path / "a.exr"), separate_channels=True) as file:
        channels = {name: channel.pixels for name, channel in file.channels().items()}
    colours = dict(zip("RGB", range(3), strict=True)) if in_colour else {"Y": None}
    for name, index in colours.items():
        part = ... if index is None else (..., index)
        end = "" if index is None else f".{name}"
        for channel, image in ((name, rows.flux), (f"weight{end}", rows.weight), (f"std{end}", rows.std)):
            np.testing.assert_array_equal(channels.pop(channel), np.nan_to_num(image[part]))
        np.testing.assert_array_equal(channels.pop(f"saturated{end}"), rows.saturated[part])
    np.testing.assert_array_equal(channels.pop("A"), np.isfinite(rows.flux).reshape(*PANORAMA_SHAPE, -1).all(axis=-1))
    assert not channels
    assert rows.saturated[-1].all()
    assert np.isfinite(rows.std[6:]).all()
