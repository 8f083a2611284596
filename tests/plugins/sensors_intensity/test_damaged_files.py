"""Damaged pictures and films: one sentence each, whatever their libraries make of them."""

from __future__ import annotations

import random
from collections.abc import Callable
from pathlib import Path

import cv2
import numpy as np
import pytest
import tifffile

from photonpano import FrameSpan, InputError, SourceContext, discover

CATALOG = discover()
FRAMES = (np.random.default_rng(1).random((6, 48, 64)) * 255).astype(np.uint8)
SAMPLE = 30  # damaged files of each kind; `tests/benchmarks/fuzz.py` reads thousands


def read(name: str, path: Path) -> str:
    """Read some frames, and return the sentence that refuses the capture; empty if nothing is found to be wrong."""
    contribution = CATALOG.find("source", name).contribution
    try:
        with contribution.build(contribution.config(path=path), SourceContext()) as source:
            assert min(source.info.frame_shape) > 0
            source.frames(FrameSpan(0, 1))
            source.counts(FrameSpan(0, min(source.info.n_frames, 12)))
    except InputError as error:
        return str(error)
    return ""


def damaged(content: bytes, rng: random.Random) -> bytes:
    data = bytearray(content)
    for _ in range(rng.choice((1, 2, 8))):
        at = rng.randrange(min(len(data), rng.choice((64, 512, 4096, len(data)))))
        data[at] = rng.choice((0, 255, rng.randrange(256)))
    return bytes(data[: rng.randrange(len(data)) if rng.random() < 0.2 else None])


@pytest.fixture
def no_look(monkeypatch: pytest.MonkeyPatch) -> None:
    """Read files without a first look, which takes longer than all else here."""
    for module in ("pictures", "video_index"):
        monkeypatch.setattr(f"photonpano_sensors.intensity.{module}.look_first", lambda *_: None)


@pytest.mark.usefixtures("no_look")
@pytest.mark.parametrize("kind", ["png", "tif", "pages", "avi", "mkv", "mp4"])
def test_damaged_file_raises_input_error_only(tmp_path: Path, write_video: Callable[..., Path], kind: str) -> None:
    path = tmp_path / "capture" / f"film.{kind}"
    path.parent.mkdir()
    if kind == "png":
        cv2.imwrite(str(path), FRAMES[0])
    elif kind in ("tif", "pages"):
        frames = FRAMES[0] if kind == "tif" else FRAMES
        tifffile.imwrite(path, frames, photometric="minisblack", compression="zlib")
    else:
        film = write_video(FRAMES, path.name, {"avi": "mpeg4", "mkv": "ffv1", "mp4": "mpeg4"}[kind], "yuv420p")
        path.write_bytes(film.read_bytes())
    source = "video" if kind in ("avi", "mkv", "mp4") else "image-folder"
    content, capture = path.read_bytes(), path.parent if kind in ("png", "tif") else path
    assert read(source, capture) == ""
    for number in range(SAMPLE):
        path.write_bytes(damaged(content, random.Random(f"{kind} {number}")))
        sentence = read(source, capture)
        assert not sentence or str(tmp_path) in sentence
