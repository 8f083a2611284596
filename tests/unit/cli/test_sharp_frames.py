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


def test_corrections_that_move_no_pixels_keep_sharp_frames(here: Path, invoke: Callable[..., Any]) -> None:
    for number, (correction, code) in enumerate((("{mask: {file: mask.npy}}", 0), ("rot90", 1))):
        np.save("mask.npy", np.zeros((24, 32), bool))
        Path("more.yaml").write_text(f"{SPEC}corrections: [{correction}]\n")
        done = invoke("simulate", "more.yaml", "-o", f"more{number}.npy", "--sharp-every", "20")
        assert done.exit_code == code, done.output
        assert Path(f"more{number}.sharp").is_dir() == (code == 0)


def test_sharp_frames_of_a_planar_scene(here: Path, invoke: Callable[..., Any]) -> None:
    keys = (
        "{n_frames: 4, frame_shape: [16, 24], scene: {kind: street, width: 256, height: 171}, path: {kind: pan, length_px: 2}}"
    )
    Path("pan.yaml").write_text(f"version: 1\nsource: {{use: simulator, with: {keys}}}\n")
    assert invoke("simulate", "pan.yaml", "-o", "pan.npy", "--sharp-every", "3").exit_code == 0
    assert len(list(Path("pan.sharp").iterdir())) == 2


def test_sharp_frames_are_refused_before_anything_is_written(here: Path, invoke: Callable[..., Any]) -> None:
    np.save("recorded.npy", np.zeros((4, 8, 2), np.uint8))
    Path("recorded.yaml").write_text("version: 1\nsource: {use: packed-npy, with: {path: recorded.npy}}\n")
    done = invoke("simulate", "recorded.yaml", "-o", "a.npy", "--sharp-every", "3")
    assert done.exit_code == 1
    assert "only simulated captures have sharp frames" in done.stderr
    Path("b.sharp").mkdir()
    Path("b.sharp/mine.txt").write_text("kept")
    done = invoke("simulate", "depth.yaml", "-o", "b.npy", "--sharp-every", "3")
    assert done.exit_code == 1
    assert "cannot write b.sharp: it is there already; choose another folder, or remove it" in done.stderr
    assert not {file.name for file in here.iterdir()} & {"a.npy", "a.sharp", "b.npy", "b.truth.npz"}
