"""A capture in three channels, with red, green and blue at every pixel: read, corrected, and made into a panorama in colour."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest
import tifffile

from photonpano import FrameSpan, InputError, PackedSource, SourceContext, discover, evaluate, parse_spec, run
from photonpano.capture import Capture, capture_of
from photonpano.capture.writing import write_packed
from photonpano.corrections import DarkCounts, corrected_source
from photonpano.execution.context import Context
from photonpano.geometry import Canvas
from photonpano.merging.canvas_noise import CanvasNoise
from photonpano.merging.panorama import render
from photonpano.testing.captures import KnownMotion, detected, seen_along, textured

FLUX, FRAMES, SHAPE = (0.6, 0.3, 0.12), 300, (64, 92)
PACK: dict[str, Callable[[np.ndarray], np.ndarray]] = {
    "packed-npy": lambda cube: np.packbits(cube, axis=2),
    "npy": lambda cube: cube,
}
KEYS: dict[str, dict[str, Any]] = {"packed-npy": {"width": SHAPE[1]}, "npy": {"holds": "bits"}}


@pytest.fixture(scope="module")
def scene() -> np.ndarray:
    """Return a smooth scene: pixels may average over it."""
    colours = [cv2.GaussianBlur(textured((108, 192), flux, 1.2, seed), (0, 0), 3) for seed, flux in enumerate(FLUX)]
    return np.stack(colours, axis=-1)


@pytest.fixture(scope="module")
def homographies() -> np.ndarray:
    maps = np.tile(np.eye(3), (FRAMES, 1, 1))
    maps[:, 0, 2] = np.linspace(10, 80, FRAMES)
    maps[:, 1, 2] = 20 + 8 * np.sin(np.linspace(0, 3, FRAMES))
    return maps


@pytest.fixture(scope="module")
def cube(scene: np.ndarray, homographies: np.ndarray) -> np.ndarray:
    return detected(np.stack([seen_along(each, homographies, SHAPE) for each in np.moveaxis(scene, -1, 0)], axis=-1), 5)


def opened(cube: np.ndarray, folder: Path, name: str = "packed-npy", **keys: Any) -> Capture:
    np.save(folder / "cube.npy", PACK[name](cube))
    contribution = discover().find("source", name).contribution
    config = contribution.config(path=folder / "cube.npy", **KEYS[name], **keys)
    return capture_of(contribution.build(config, SourceContext()))


@pytest.mark.parametrize("name", PACK)
def test_channels_are_colours_and_a_grey_pixel_is_lit_in_any(cube: np.ndarray, tmp_path: Path, name: str) -> None:
    span = FrameSpan(3, 40)
    with opened(cube, tmp_path, name) as capture:
        assert isinstance(capture, PackedSource)
        np.testing.assert_array_equal(capture.frames(span), cube[3:40].any(axis=-1))
        assert list(capture.colours()) == ["red", "green", "blue"]
        for channel, each in enumerate(capture.colours().values()):
            np.testing.assert_array_equal(each.counts(span), cube[3:40, ..., channel].sum(axis=0))
    if name == "packed-npy":
        with opened(cube, tmp_path, channel=2) as blue:
            assert not blue.colours()
            np.testing.assert_array_equal(blue.frames(span), cube[3:40, ..., 2])


def test_what_is_for_one_channel_is_refused(cube: np.ndarray, tmp_path: Path) -> None:
    with opened(cube, tmp_path) as capture:
        with pytest.raises(InputError, match=r"^dark-counts is for one channel, and this capture has three; leave it out$"):
            corrected_source(capture, [DarkCounts(dark=tmp_path / "dark.npz")])
        with pytest.raises(InputError, match=r"holds one channel, and this capture has three; write channel: 0, 1 or 2$"):
            write_packed(capture, tmp_path / "grey.npy")


def test_noise_of_each_colour_is_what_its_error_bars_say(
    cube: np.ndarray, scene: np.ndarray, homographies: np.ndarray, tmp_path: Path
) -> None:
    canvas, motion = Canvas(*scene.shape[:2], np.eye(3)), KnownMotion(lambda frame: homographies[round(frame)])
    with opened(cube, tmp_path) as capture:
        span = capture.info.span
        panorama = render(capture, motion, span, canvas, 0.25, Context())
        std = CanvasNoise.of(capture, motion, span, canvas).std(panorama.flux, panorama.weight)
    inside = cv2.erode((panorama.weight.min(axis=-1) > 20).astype(np.uint8), np.ones((5, 5))) > 0
    z = ((panorama.flux - scene) / std)[inside]
    np.testing.assert_allclose(z.std(axis=0), 1, atol=0.06)
    np.testing.assert_allclose(z.mean(axis=0), 0, atol=0.12)


@pytest.mark.usefixtures("without_report")
def test_run_is_trusted_in_colour_and_follows_the_truth(
    cube: np.ndarray, scene: np.ndarray, homographies: np.ndarray, tmp_path: Path
) -> None:
    np.save(tmp_path / "cube.npy", PACK["packed-npy"](cube))
    truth = {"homographies": homographies, "scene": scene.astype(np.float32), "frame_shape": np.array(SHAPE)}
    np.savez(tmp_path / "cube.truth.npz", **truth)
    source = {"use": "packed-npy", "with": {"path": str(tmp_path / "cube.npy"), "width": SHAPE[1]}}
    spec = {"version": 1, "source": source, "resample": {"with": {"group_size": 25}}, "levels": 2}
    result = run(parse_spec(spec, output=tmp_path / "run"))
    assert result.verdict.status == "trusted", result.verdict.reasons
    assert result.record["verdict"]["reduced_chi2"] == pytest.approx(1, abs=0.1)
    flux = tifffile.imread(tmp_path / "run" / "panorama.tiff")
    assert flux.shape == (*flux.shape[:2], 3)
    np.testing.assert_allclose(np.nanmean(flux, axis=(0, 1)), scene[20:90, 10:170].mean(axis=(0, 1)), rtol=0.1)
    scores = evaluate(tmp_path / "run", tmp_path / "cube.truth.npz", oracle=True)
    assert scores.trajectory.errors_px.mean() < 0.15
    assert scores.below_oracle_db is not None
    assert scores.below_oracle_db < 0.3


@pytest.mark.usefixtures("without_report")
def test_red_lamp_that_goes_down_leaves_the_colours_alike_all_over_the_panorama(
    scene: np.ndarray, homographies: np.ndarray, tmp_path: Path
) -> None:
    """With one gain for all colours, red over green would fall to 0.4 along the way."""
    seen = np.stack([seen_along(each, homographies, SHAPE) for each in np.moveaxis(scene, -1, 0)], axis=-1)
    seen[FRAMES // 2 :, ..., 0] *= 0.4
    np.save(tmp_path / "cube.npy", PACK["packed-npy"](detected(seen, 6)))
    source = {"use": "packed-npy", "with": {"path": str(tmp_path / "cube.npy"), "width": SHAPE[1]}}
    spec = {"version": 1, "source": source, "resample": {"with": {"group_size": 25}}, "levels": 1}
    run(parse_spec(spec, output=tmp_path / "run"))
    with np.load(tmp_path / "run" / "light.npz") as light:
        assert light["tints"].shape == (3, FRAMES)
    flux = tifffile.imread(tmp_path / "run" / "panorama.tiff")
    thirds = [np.array_split(image[..., :2], 3, axis=1) for image in (flux, scene[20:92, 10:172])]
    found, true = ([np.nansum(part[..., 0]) / np.nansum(part[..., 1]) for part in parts] for parts in thirds)
    ratios = np.array(found) / true
    np.testing.assert_allclose(ratios / ratios.mean(), 1, atol=0.05)
