"""What `info`, `dark` and `preview` find and write; what they print is in the transcripts."""

from __future__ import annotations

import json
import shutil
from collections.abc import Callable
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest
from PIL import Image

from photonpano.specs import parse_spec

SPEC = "version: 1\nsource: {use: packed-npy, with: {path: covered.npy}}\n"


@pytest.fixture
def cube(folder: Path, finished: Path) -> Path:
    """A simulated capture in the current folder: 200 frames, a pan of 0.1 px a frame."""
    return Path(shutil.copy(finished / "cube.npy", folder / "cube.npy"))


def test_info_group_size_is_that_of_run(cube: Path, invoke: Callable[..., Any]) -> None:
    facts = json.loads(invoke("info", "cube.npy", "--json").stdout)
    (cube.parent / "scan.yaml").write_text("version: 1\nsource: {use: auto, with: {path: cube.npy}}\nlevels: 1\n")
    assert invoke("run", "scan.yaml").exit_code == 0
    decisions = json.loads((cube.parent / "runs" / "scan" / "run.json").read_text())["decisions"]
    assert {each["what"]: (each["value"], each["reason"]) for each in decisions} == {
        "source": ("packed-npy", facts["reason"]),
        "still_pixels": (0, facts["still_how"]),
        "standing_share": (
            facts["standing_share"],
            "share of the frame that stands still, of the parts that show motion or rest",
        ),
        "group_size": (facts["group_size"], facts["group_size_reason"]),
    }


def test_info_finds_hot_and_saturated_pixels(folder: Path, invoke: Callable[..., Any]) -> None:
    rng = np.random.default_rng(0)
    frames = rng.random((600, 64, 64)) < 0.1
    frames[:, rng.random((64, 64)) < 0.02] = True
    frames[:, :8] = True
    np.save(folder / "cube.npy", np.packbits(frames, axis=-1))
    facts = json.loads(invoke("info", "cube.npy", "--json").stdout)
    assert facts["hot_share"] == pytest.approx(0.02 * 7 / 8, abs=0.006)
    assert facts["saturated_share"] == pytest.approx(frames.all(axis=0).mean())


def test_dark_counts_and_masks_are_those_of_the_camera(folder: Path, invoke: Callable[..., Any]) -> None:
    rng = np.random.default_rng(0)
    hot = rng.random((24, 32)) < 0.03
    frames = rng.random((1000, 24, 32)) < -np.expm1(-np.where(hot, 0.5, 0.002))
    np.save("covered.npy", np.packbits(frames, axis=-1))
    Path("covered.yaml").write_text(SPEC)
    done = invoke("dark", "covered.yaml", "--output", "dark.npz"), invoke("dark", "covered.npy", "-o", "mask.npy")
    with np.load("dark.npz") as archive:
        assert sorted(archive.files) == ["n_frames", "rates"]
        assert archive["rates"][hot].mean() == pytest.approx(0.5, rel=0.1)
        assert archive["rates"][~hot].mean() == pytest.approx(0.002, rel=0.1)
    np.testing.assert_array_equal(np.load("mask.npy"), hot)
    corrections = [parse_spec(f"{SPEC}{each.stdout.splitlines()[-1]}\n", directory=folder).corrections for each in done]
    assert list(map(len, corrections)) == [2, 1]
    invoke("dark", "covered.yaml", "-o", "dark.npz", "--correct", "rot90", "--correct", "{crop: {rows: [0, 10]}}")
    with np.load("dark.npz") as archive:
        assert archive["rates"].shape == (10, 24)


@pytest.mark.usefixtures("cube")
def test_preview_writes_pictures_and_films(invoke: Callable[..., Any]) -> None:
    invoke("preview", "cube.npy", "-o", "look", "--group-size", "50", "--step", "75", "--white", "1.5")
    files = sorted(Path("look").iterdir())
    assert [file.name for file in files] == ["frame_000.png", "frame_075.png", "frame_150.png"]
    assert {cv2.imread(str(file), cv2.IMREAD_UNCHANGED).shape for file in files} == {(110, 160)}
    invoke("preview", "cube.npy", "-o", "look.webp", "--group-size", "20", "--fps", "10", "--no-label")
    with Image.open("look.webp") as film:
        assert (film.n_frames, film.size) == (10, (160, 96))
