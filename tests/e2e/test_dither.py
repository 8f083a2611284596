"""A dark scene before a camera whose motion returns, seen by a sensor with dead rows and a gap between two chips."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest

from photonpano import parse_spec, run
from photonpano.geometry import corners, inverse, transform_points, translation
from photonpano.testing.captures import detected, seen_along, textured
from photonpano.values import FloatArray

pytestmark = pytest.mark.usefixtures("without_report")

SHAPE, N_FRAMES, PERIODS, PX = (96, 128), 1200, (110.0, 80.0), 3.0
DEAD = np.zeros(SHAPE, np.bool_)
DEAD[5::20], DEAD[46:50], DEAD[:, 62:66] = True, True, True


def _to_scene(frame: float) -> FloatArray:
    x, y = (8 + PX * np.sin(2 * np.pi * frame / period) for period in PERIODS)
    return translation(float(x), float(y))


@pytest.fixture(scope="module")
def capture(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A frame holds 120 photons, and an exposure less than one in most pixels."""
    folder = tmp_path_factory.mktemp("dither")
    scene = cv2.GaussianBlur(textured((118, 150), 0.01, 1.5, 3), (0, 0), 1.5)
    seen = seen_along(scene, np.stack([_to_scene(frame) for frame in range(N_FRAMES)]), SHAPE)
    seen[:, DEAD] = 0
    np.save(folder / "capture.npy", np.packbits(detected(seen, 1), axis=-1))
    np.save(folder / "dead.npy", DEAD)
    return folder


def _error_px(folder: Path) -> float:
    """Return the mean error of the motion of a run."""
    with np.load(folder / "trajectory.npz") as found:
        homographies, reference = found["homographies"], int(found["reference"])
    truth = np.stack([_to_scene(frame) for frame in range(N_FRAMES)])
    expected = transform_points(inverse(truth[reference]) @ truth, corners(SHAPE))
    return float(np.linalg.norm(transform_points(homographies, corners(SHAPE)) - expected, axis=-1).mean())


@pytest.mark.parametrize("masked", [False, True])
def test_motion_that_returns_is_found_in_the_dark_with_and_without_a_mask(capture: Path, masked: bool, tmp_path: Path) -> None:
    """If no motion were found, the error would be 3.0 px."""
    spec: dict[str, Any] = {
        "version": 1,
        "source": {"use": "packed-npy", "with": {"path": str(capture / "capture.npy")}},
        "corrections": [{"mask": {"file": str(capture / "dead.npy")}}] if masked else [],
        "levels": 1,
        "refine": [],
    }
    record = run(parse_spec(spec, output=tmp_path / "run")).record
    (size,) = (each["value"] for each in record["decisions"] if each["what"] == "group_size")
    assert 16 <= size <= min(PERIODS) / 3
    assert _error_px(tmp_path / "run") < 0.8
