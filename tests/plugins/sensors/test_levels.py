from __future__ import annotations

from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import tifffile
from pydantic import ValidationError

from photonpano import FrameSpan, InputError
from photonpano.photometry import srgb_to_linear
from photonpano_sensors.intensity.contributions import FastcamMrawConfig, ImageFolderConfig, ResponseConfig
from photonpano_sensors.intensity.pictures import FastcamMrawSource, ImageFolderSource
from photonpano_sensors.intensity.source import Encoding, LinearLevels, linear_levels

LIMITED = Encoding(8, 16.0, 235.0)


def levels(encoding: Encoding = LIMITED, **keys: Any) -> LinearLevels:
    return linear_levels(ResponseConfig(**keys), encoding)


def flux_of_levels(linear: LinearLevels) -> np.ndarray:
    """Return the flux of each level of the file."""
    table = np.arange(256) if linear.table is None else linear.table
    return linear.response.flux(table.astype(np.float32), 1)


@pytest.mark.parametrize(
    ("curve", "light"), [("srgb", srgb_to_linear), (2.2, lambda encoded: encoded**2.2), (1.0, lambda encoded: encoded)]
)
def test_encoding_curves_are_inverted(curve: Any, light: Any) -> None:
    linear = levels(curve=curve, saturation_photons=1000.0)
    flux = flux_of_levels(linear)
    encoded = (np.arange(16, 236) - 16) / 219
    assert linear.bits == 16
    np.testing.assert_allclose(flux[16:236], 1000 * light(encoded), atol=0.02)
    np.testing.assert_allclose(flux[:16], -flux[32:16:-1], atol=0.02)
    assert (np.diff(flux) >= 0).all()


def test_noise_around_black_averages_to_zero_flux() -> None:
    """It would not if what lies below black were cut off."""
    linear = levels(curve="srgb")
    dark = np.clip(np.rint(16 + np.random.default_rng(0).normal(0, 4, 100_000)), 0, 255).astype(np.uint8)
    assert linear.table is not None
    mean = linear.table[dark].mean(dtype=np.float64)
    assert abs(linear.response.flux(np.float32([mean]), 1)[0]) < 5 * 10_000 * (4 / 219 / 12.92) / np.sqrt(100_000)


def test_measured_curve_is_scaled_to_black_and_white(tmp_path: Path) -> None:
    file = tmp_path / "curve.txt"
    np.savetxt(file, 7 + 3 * np.arange(256.0) ** 2)
    flux = flux_of_levels(levels(Encoding.full(8), curve_file=file, saturation_photons=255.0**2, black_level=10))
    np.testing.assert_allclose(flux[[10, 255]], [0, 255**2])
    np.testing.assert_allclose(np.diff(flux), (2 * np.arange(255) + 1) * 255**2 / (255**2 - 100), atol=2.1)


WRONG_CURVES = {
    "abc": "FILE is not a text file of numbers, one for each level",
    "1 2 3": "FILE holds 3 numbers; the levels of the capture are 256",
    " ".join(["1"] * 255 + ["0"]): "FILE: the numbers must be finite, and none smaller than the one before",
    " ".join(["nan"] * 256): "FILE: the numbers must be finite, and none smaller than the one before",
    " ".join(["1"] * 256): "FILE: the curve does not rise from the black level to the white level",
}


@pytest.mark.parametrize(("content", "golden"), WRONG_CURVES.items(), ids=range(len(WRONG_CURVES)))
def test_invalid_curve_file_is_refused(tmp_path: Path, content: str, golden: str) -> None:
    file = tmp_path / "curve.txt"
    file.write_text(content)
    with pytest.raises(InputError) as raised:
        levels(curve_file=file)
    assert str(raised.value) == golden.replace("FILE", str(file))


@pytest.mark.parametrize("byteorder", ["<", ">"])
def test_stack_of_imagej_has_all_its_frames(tmp_path: Path, byteorder: Any) -> None:
    frames = np.random.default_rng(0).integers(0, 4000, (7, 24, 40)).astype(np.uint16)
    path = tmp_path / "a.tif"
    tifffile.imwrite(path, frames, byteorder=byteorder, imagej=True, truncate=True)
    with ImageFolderSource(ImageFolderConfig(path=path)) as source:
        np.testing.assert_array_equal(source.frames(source.info.span), frames)


def test_curve_and_curve_file_together_are_refused() -> None:
    with pytest.raises(ValidationError, match="curve_file takes the place of the curve srgb; leave out one of them"):
        ResponseConfig(curve="srgb", curve_file="curve.txt")


@pytest.mark.parametrize("curve", ["linear", "srgb"])
def test_flux_of_saturated_pixels_is_a_lower_bound(tmp_path: Path, curve: Any) -> None:
    (tmp_path / "a.cih").write_text(
        "File Format : MRaw\nTotal Frame : 2\nImage Width : 2\nImage Height : 2\nColor Bit : 8\n"
        "EffectiveBit Depth : 8\nEffectiveBit Side : Lower\n"
    )
    np.array([[[255, 0], [250, 240]], [[255, 0], [240, 240]]], np.uint8).tofile(tmp_path / "a.mraw")
    response = ResponseConfig(white_level=240, saturation_photons=500, curve=curve)
    with FastcamMrawSource(FastcamMrawConfig(path=tmp_path / "a.cih", response=response)) as source:
        flux = source.response.flux((source.counts(FrameSpan(0, 2)) / 2).astype(np.float32), 2)
    np.testing.assert_allclose(flux, [[500, 0], [500, 500]], rtol=1e-5)


@pytest.fixture
def recorded(tmp_path: Path) -> Callable[..., Path]:
    def recorded(levels: np.ndarray, rate: str = "1000", side: str = "Lower") -> Path:
        """Write a recording of two frames of 2x2 px of 16 bits, of which 12 are effective, and return its header."""
        (tmp_path / "a.cih").write_text(
            "File Format : MRaw\nTotal Frame : 2\nImage Width : 2\nImage Height : 2\nColor Bit : 16\n"
            f"Record Rate(fps) : {rate}\nEffectiveBit Depth : 12\nEffectiveBit Side : {side}\n"
        )
        levels.astype("<u2").tofile(tmp_path / "a.mraw")
        return tmp_path / "a.cih"

    return recorded


@pytest.mark.parametrize(("rate", "expected_hz"), [("60,000", 60_000), ("1.0e5", 100_000), ("2.5E+3", 2500), ("fast", None)])
def test_frame_rate_of_a_header_is_read_as_people_write_it(
    recorded: Callable[..., Path], rate: str, expected_hz: float | None
) -> None:
    with FastcamMrawSource(FastcamMrawConfig(path=recorded(np.zeros((2, 2, 2)), rate))) as source:
        assert source.info.frame_rate_hz == expected_hz


def test_more_frames_than_the_header_promises_are_a_warning(
    recorded: Callable[..., Path], caplog: pytest.LogCaptureFixture
) -> None:
    with FastcamMrawSource(FastcamMrawConfig(path=recorded(np.zeros((4, 2, 2))))) as source:
        assert source.info.n_frames == 2
    assert "a.mraw holds 4 frames, and a.cih promises 2, which are read" in caplog.text


def test_levels_that_contradict_the_effective_bits_are_refused(recorded: Callable[..., Path]) -> None:
    wrong = "levels up to 65520, and its header says that the lower 12 bits are used; correct"
    source = FastcamMrawSource(FastcamMrawConfig(path=recorded(np.full((2, 2, 2), 4095 << 4))))
    with source, pytest.raises(InputError, match=wrong):
        source.counts(FrameSpan(0, 2))
    with FastcamMrawSource(FastcamMrawConfig(path=recorded(np.full((2, 2, 2), 4095 << 4), side="Higher"))) as source:
        assert source.counts(FrameSpan(0, 2)).max() == 2 * 65520
