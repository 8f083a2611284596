"""`photonpano simulate --sharp-every`."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest

from photonpano.photometry import srgb_to_linear
from photonpano_simulator.travel.truth import read_truth, sharp_view

SPEC = """
version: 1
source:
  use: travel-simulator
  with: {scene: {kind: planes}, n_frames: 25, frame_shape: [24, 32], focal_px: 25, sensor: {dark_rate: 0.3}}
"""


@pytest.fixture
def here(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    monkeypatch.chdir(tmp_path)
    Path("depth.yaml").write_text(SPEC)
    return tmp_path


def test_sharp_frames_are_views_without_noise(here: Path, invoke: Callable[..., Any]) -> None:
    done = invoke("simulate", "depth.yaml", "-o", "cube.npy", "--sharp-every", "10")
    assert done.exit_code == 0, done.output
    assert [file.name for file in sorted(Path("cube.sharp").iterdir())] == [f"frame_0000{n}.png" for n in ("00", "10", "20")]
    lines = done.stdout.splitlines()
    assert lines[2].startswith("cube.sharp ")
    assert lines[2].endswith("3 frames without noise")
    assert lines[-1] == "To score a run with `pose` of it: photonpano evaluate RUN --truth cube.truth.npz"
    truth = read_truth("cube.truth.npz")
    levels = np.stack([cv2.imread(f"cube.sharp/frame_0000{n}.png", cv2.IMREAD_UNCHANGED) for n in (10, 20)])
    flux = np.stack([sharp_view(truth, n) for n in (10, 20)])
    assert levels.dtype == np.uint8
    unsaturated = levels < 255
    shown = srgb_to_linear((levels[unsaturated] / 255).astype(np.float32))
    white = np.median(flux[unsaturated] / shown)
    np.testing.assert_allclose(shown * white, flux[unsaturated], atol=0.012 * white)
