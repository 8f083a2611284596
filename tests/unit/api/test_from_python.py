"""Panoramas of frames in memory, and runs of specs that no file holds."""

from __future__ import annotations

import gc
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from photonpano import InputError, SpecError, panorama, run
from photonpano.geometry import translation
from photonpano.testing.captures import detected, seen_along, textured

pytestmark = pytest.mark.usefixtures("without_report")
KEYS: dict[str, Any] = {"levels": 1, "refine": [], "motion": {"model": "translation"}}


@pytest.fixture(scope="module")
def capture(simulated: Callable[..., Path]) -> Path:
    return simulated(path={"kind": "pan", "length_px": 40})


def test_panorama_of_frames_is_that_of_their_capture(capture: Path, tmp_path: Path) -> None:
    frames = np.unpackbits(np.load(capture), axis=2)
    made = panorama(frames, 96_800, **KEYS)
    spec = {"version": 1, "source": {"use": "packed-npy", "with": {"path": str(capture)}}, **KEYS}
    from_spec = run(spec | {"output": {"directory": str(tmp_path / "spec")}})
    from_path = panorama(capture, output=tmp_path / "path", **KEYS)
    assert made.verdict == from_spec.verdict == from_path.verdict
    assert made.record["source"]["frame_rate_hz"] == 96_800
    for other in (from_spec, from_path):
        np.testing.assert_array_equal(made.panorama.flux, other.panorama.flux)
        np.testing.assert_array_equal(made.trajectory.homographies, other.trajectory.homographies)
    directory = made.directory
    assert directory.is_dir()
    del made
    gc.collect()
    assert not directory.parent.exists()


def test_frames_are_kept_beside_a_run_folder(capture: Path, tmp_path: Path) -> None:
    frames = np.unpackbits(np.load(capture), axis=2)[:, :, :157]  # no whole bytes
    made = panorama(frames.astype(bool), output=tmp_path / "run", **KEYS)
    assert made.trajectory.frame_shape == frames.shape[1:]
    np.testing.assert_array_equal(np.unpackbits(np.load(tmp_path / "run.npy"), axis=2)[:, :, :157], frames)


@pytest.mark.parametrize(
    ("frames", "says"),
    [
        (np.zeros((30, 40)), "frames: expected an array of shape (frames, height, width), got (30, 40)"),
        (np.zeros((0, 30, 40)), "frames: expected an array of shape (frames, height, width), got (0, 30, 40)"),
        (
            np.zeros((30, 40, 500)),
            "frames: expected an array of shape (frames, height, width), and (30, 40, 500) seems to have the frames last; "
            "pass np.moveaxis(frames, -1, 0)",
        ),
        (
            np.arange(2 * 3 * 4).reshape(2, 3, 4) / 2,
            "frames: expected 0 and 1, got 0.5 in frame 0 at row 0, column 1; sums of frames and grey levels are read from "
            "files, by the sources npy and image-folder",
        ),
    ],
)
def test_array_without_binary_frames_is_refused(frames: np.ndarray, says: str, tmp_path: Path) -> None:
    with pytest.raises(InputError) as error:
        panorama(frames, output=tmp_path / "run")
    assert str(error.value) == says
    assert not list(tmp_path.iterdir())


def test_wrong_key_is_named(tmp_path: Path) -> None:
    with pytest.raises(SpecError, match="motoin: unknown key; did you mean 'motion'"):
        panorama(np.ones((4, 20, 24), bool), output=tmp_path / "run", motoin={})
    assert not list(tmp_path.iterdir())


def test_frames_along_the_last_axis_are_named_also_where_they_are_few(tmp_path: Path) -> None:
    """An array of 300 frames of 96x128 px has the shape of 96 frames of 128x300 px."""
    path = np.array([translation(5 + 0.2 * frame, 10) for frame in range(300)])
    frames = detected(seen_along(textured((120, 200), 0.4).astype(np.float32), path, (96, 128)))
    with pytest.raises(InputError, match=r"and \(96, 128, 300\) seems to have the frames last"):
        panorama(np.moveaxis(frames, 0, -1), output=tmp_path / "run")
