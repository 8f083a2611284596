from __future__ import annotations

import shutil
from collections.abc import Callable
from pathlib import Path
from typing import Any

import cv2
import pytest
from PIL import Image


@pytest.fixture
def cube(folder: Path, finished: Path) -> Path:
    shutil.copy(finished / "cube.npy", folder / "cube.npy")
    return folder / "cube.npy"


def test_preview_writes_folder_of_pictures(cube: Path, invoke: Callable[..., Any]) -> None:
    result = invoke("preview", "cube.npy", "-o", "look", "--group-size", "50", "--step", "75", "--white", "1.5")
    assert (result.exit_code, result.stderr) == (0, "")
    assert result.stdout == (
        "look: 3 pictures of 200 binary frames of 96x160, 50 frames each\nwhite is 1.5 photons per pixel per frame\n"
    )
    files = sorted((cube.parent / "look").iterdir())
    assert [file.name for file in files] == ["frame_000.png", "frame_075.png", "frame_150.png"]
    assert {cv2.imread(str(file), cv2.IMREAD_UNCHANGED).shape for file in files} == {(110, 160)}


def test_preview_writes_film(cube: Path, invoke: Callable[..., Any]) -> None:
    result = invoke("preview", "cube.npy", "-o", "look.webp", "--group-size", "20", "--fps", "10", "--no-label")
    assert result.stdout.startswith("look.webp: 10 pictures of ")
    with Image.open(cube.parent / "look.webp") as film:
        assert (film.n_frames, film.size) == (10, (160, 96))
