"""Captures that are damaged, or something else than their spec says: one sentence each, compared with `damaged.txt`.

A block of that file is the name of a case, and what is said: by the check before a run, by opening the capture and reading its
frames, or by both. DIR is the folder of the capture, and R a correlation.
"""

from __future__ import annotations

import re
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from photonpano import InputError, SourceContext

from .damaged_files import CASES, CATALOG, RNG, last, npy

GOLDEN = dict(block.split("\n", 1) for block in Path(__file__).with_name("damaged.txt").read_text().rstrip("\n").split("\n\n"))


def said_by(contribution: Any, config: Any) -> str:
    """Open a capture and read it; return the sentence that refuses it, or an empty one."""
    try:
        with contribution.build(config, SourceContext()) as source:
            source.frames(source.info.span)
            source.counts(source.info.span)
    except InputError as error:
        return str(error)
    return ""


def refusal(name: str, keys: dict[str, Any], folder: Path) -> str:
    """Return what the check of a source says, and what opening and reading says, as `damaged.txt` has it."""
    contribution = CATALOG.find("source", name).contribution
    config = contribution.config.model_validate({"path": folder} | keys)
    checked, opened = list(contribution.check(config)), said_by(contribution, config)
    lines = [f"check: {each}" for each in checked] + [f"open: {opened}"] * bool(opened)
    text = f"check and open: {opened}" if checked == [opened] else "\n".join(lines)
    return re.sub(r"\b0\.\d\d\b", "R", text.replace(str(folder), "DIR"))


@pytest.mark.parametrize("case", CASES)
def test_damaged_capture_is_refused_in_a_sentence_and_left_as_it_is(tmp_path: Path, case: str) -> None:
    name = case.partition(" ")[0].rstrip(",")
    keys = CASES[case](tmp_path) or {}
    before = sorted(tmp_path.rglob("*"))
    assert refusal(name, keys, tmp_path) == GOLDEN[case]
    assert sorted(tmp_path.rglob("*")) == before


LAYOUTS: dict[str, Callable[[np.ndarray], np.ndarray]] = {
    "packed-npy with zeros and ones": lambda frames: frames,
    "packed-npy with zeros and 255": lambda frames: frames * np.uint8(255),
    "packed-npy with sums of four": lambda frames: frames.reshape(96, 4, *frames.shape[1:]).sum(axis=1, dtype=np.uint8),
    "packed-npy with the lowest bit first": lambda frames: np.packbits(frames, axis=2, bitorder="little"),
    "packed-npy packed along the height": lambda frames: np.packbits(frames, axis=1),
    "packed-npy along the height, lowest bit first": lambda frames: np.packbits(frames, axis=1, bitorder="little"),
    "packed-npy with frames last": lambda frames: last(np.packbits(frames[:, :32, :48], axis=2)),
    "packed-npy with frames last, packed along the height": lambda frames: last(np.packbits(frames[:, :32, :48], axis=1)),
    "packed-npy with frames last in bytes": lambda frames: np.packbits(np.moveaxis(frames, 0, -1), axis=-1),
    "npy with frames last": last,
}


@pytest.mark.parametrize("case", LAYOUTS)
def test_check_says_what_to_write_for_another_layout(tmp_path: Path, clouds: Callable[..., np.ndarray], case: str) -> None:
    name = case.partition(" ")[0]
    frames = clouds()
    keys = {"holds": "bits"} if name == "npy" else {}
    right = frames if name == "npy" else np.packbits(frames, axis=2)
    assert refusal(name, npy(right)(tmp_path) | keys, tmp_path) == ""
    assert refusal(name, npy(LAYOUTS[case](frames))(tmp_path) | keys, tmp_path) == GOLDEN[case]


def test_truncated_video_is_refused(tmp_path: Path, write_video: Callable[..., Path]) -> None:
    """An AVI file promises its frames at its beginning; the end of an MP4 file is its index."""
    video = write_video(RNG.integers(0, 255, (40, 48, 66), dtype=np.uint8), "a.avi", "mjpeg", "yuvj420p")
    video.write_bytes(video.read_bytes()[: video.stat().st_size // 2])
    found = re.sub(r"holds \d+", "holds N", refusal("video", {"path": video}, tmp_path))
    assert found == "open: DIR/a.avi is cut short: it promises 40 frames and holds N; export or copy it again"
