"""What a run prints of captures of grey levels that cannot be used, and that it leaves nothing behind.

What each source says of damaged captures stands in `tests/plugins/captures`.
"""

from __future__ import annotations

import importlib.util
from pathlib import Path

import cv2
import numpy as np
import pytest
from typer.testing import CliRunner

from photonpano.cli.app import app

SPEC = "version: 1\nsource: {{use: {use}, with: {{path: {path}}}}}\nresample: {{with: {{group_size: 1}}}}\nlevels: 1\n"
ONE_PROBLEM = "\nerror: the spec has 1 problem\n"
SAMPLED = "frames sampled all over the capture"
CASES = {
    "missing": ("video", "a.mp4", "DIR/spec.yaml:2:1: source: there is no file DIR/a.mp4; check the path" + ONE_PROBLEM),
    "damaged": (
        "video",
        "text.mp4",
        "error: DIR/text.mp4 is not a video that FFmpeg reads, or its end is missing (Invalid data found when processing "
        "input); export or copy it again\n",
    ),
    "dark": (
        "image-folder",
        "dark",
        f"error: DIR/spec.yaml:2:1: source: no pixel is brighter than black in any of 8 {SAMPLED}; check that the file is the "
        "right one, and that the lens was open\n",
    ),
    "saturated": (
        "image-folder",
        "saturated",
        f"error: DIR/spec.yaml:2:1: source: every pixel is saturated in all of 8 {SAMPLED}, so the flux cannot be estimated; "
        "check the layout of the file, or expose less\n",
    ),
}


@pytest.fixture
def folder(tmp_path: Path) -> Path:
    (tmp_path / "text.mp4").write_bytes(b"not a video" * 100)
    for name, level in (("dark", 0), ("saturated", 255)):
        (tmp_path / name).mkdir()
        for number in range(8):
            cv2.imwrite(str(tmp_path / name / f"{number}.png"), np.full((4, 6), level, np.uint8))
    return tmp_path


@pytest.mark.parametrize("case", CASES)
def test_run_refuses_wrong_capture_and_leaves_no_files(folder: Path, case: str) -> None:
    use, path, golden = CASES[case]
    if use == "video":
        pytest.importorskip("av")
    run(folder, use, path, golden)


def test_missing_library_is_named_with_its_extra(folder: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    there = importlib.util.find_spec
    monkeypatch.setattr(importlib.util, "find_spec", lambda name, *more: None if name == "av" else there(name, *more))
    missing = (
        "the source 'video' needs av, which is not installed: "
        'pip install "photonpano[video]" (in a checkout: pip install ".[video]")'
    )
    run(folder, "video", "text.mp4", f"DIR/spec.yaml:2:15: source.use: {missing}{ONE_PROBLEM}")


def run(folder: Path, use: str, path: str, golden: str) -> None:
    (folder / "spec.yaml").write_text(SPEC.format(use=use, path=path))
    before = sorted(folder.rglob("*"))
    result = CliRunner().invoke(app, ["run", str(folder / "spec.yaml")])
    assert result.stderr == golden.replace("DIR", str(folder))
    assert (result.exit_code, result.stdout) == (1 if golden.startswith("error: ") else 2, "")
    assert sorted(folder.rglob("*")) == before
