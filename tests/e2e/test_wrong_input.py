"""Wrong input on the command line: the text of `test_wrong_input.txt`, the exit code, and no files left.

A block of that file is the name of a case, the exit code, and what is printed: DIR is the folder, and # any number. What each
source says of damaged captures stands in `tests/plugins/sensors`.
"""

from __future__ import annotations

import importlib.util
import re
from collections.abc import Callable
from pathlib import Path

import cv2
import numpy as np
import pytest
from typer.testing import CliRunner

from photonpano.api.cli.app import app

SPEC = """\
version: 1
source: {use: packed-npy, with: {path: cube.npy}}
resample: {with: {group_size: 10}}
"""
PACKED = np.packbits(np.random.default_rng(0).random((40, 32, 48)) < 0.4, axis=-1)
BLANK_WALL = np.packbits(np.random.default_rng(0).random((40, 128, 160)) < 0.4, axis=-1)
VIDEO, PICTURES = (("packed-npy, with: {path: cube.npy}", f"{use}, with: {{path: a}}") for use in ("video", "image-folder"))
SHORT = ("group_size: 10", "group_size: 1")


def saved(array: np.ndarray) -> Callable[[Path], None]:
    return lambda folder: np.save(folder / "cube.npy", array)


def nothing(folder: Path) -> None: ...


def truncated(folder: Path) -> None:
    saved(PACKED)(folder)
    (folder / "cube.npy").write_bytes((folder / "cube.npy").read_bytes()[:-100])


def with_a_file_in_the_way(folder: Path) -> None:
    saved(PACKED)(folder)
    (folder / "runs").write_text("not a folder")


def text(folder: Path) -> None:
    (folder / "a").write_bytes(b"not a video" * 100)


def pictures(level: int) -> Callable[[Path], None]:
    def write(folder: Path) -> None:
        (folder / "a").mkdir()
        for number in range(8):
            cv2.imwrite(str(folder / "a" / f"{number}.png"), np.full((4, 6), level, np.uint8))

    return write


# What writes the capture into a folder, and texts of the spec with their replacements.
CASES: dict[str, tuple[Callable[[Path], None], list[tuple[str, str]]]] = {
    "missing": (nothing, []),
    "truncated": (truncated, []),
    "fewer frames than a group": (saved(PACKED), [("group_size: 10", "group_size: 100")]),
    "a reference beyond the end": (saved(PACKED), [("10}}\n", "10}}\nrender: {reference: 40}\n")]),
    "all zero": (saved(0 * PACKED), []),
    "all one": (saved(0 * PACKED + 255), []),
    "a file in the way": (with_a_file_in_the_way, []),
    "no texture": (saved(BLANK_WALL), []),
    "a video that is missing": (nothing, [VIDEO]),
    "a video that is text": (text, [VIDEO]),
    "a video without its library": (text, [VIDEO]),
    "dark pictures": (pictures(0), [PICTURES, SHORT]),
    "saturated pictures": (pictures(255), [PICTURES, SHORT]),
}
BLOCKS = (block.split("\n", 2) for block in Path(__file__).with_suffix(".txt").read_text(encoding="utf-8").split("\n\n"))
GOLDEN = {name: (int(code), printed.rstrip("\n") + "\n") for name, code, printed in BLOCKS}


def pattern(golden: str, folder: Path) -> str:
    return re.escape(golden.replace("DIR", str(folder))).replace(r"\#", r"\d+(?:\.\d+)?").replace(r"\.\.\.", ".*")


@pytest.mark.parametrize("case", CASES)
def test_wrong_input_exits_with_message_and_leaves_nothing(tmp_path: Path, case: str, monkeypatch: pytest.MonkeyPatch) -> None:
    (arrange, changes), (code, golden), spec = CASES[case], GOLDEN[case], SPEC
    if case == "a video without its library":
        there = importlib.util.find_spec
        monkeypatch.setattr(importlib.util, "find_spec", lambda name, *more: None if name == "av" else there(name, *more))
    elif VIDEO in changes:
        pytest.importorskip("av")
    arrange(tmp_path)
    for change in changes:
        spec = spec.replace(*change)
    (tmp_path / "spec.yaml").write_text(spec)
    before = sorted(tmp_path.rglob("*"))
    result = CliRunner().invoke(app, ["run", str(tmp_path / "spec.yaml")])
    assert re.fullmatch(pattern(golden, tmp_path), result.stderr), result.stderr
    assert (result.exit_code, result.stdout) == (code, "")
    report = tmp_path / "runs" / "spec.failed.html"
    assert report.exists() == ("report    " in golden)
    assert {*tmp_path.rglob("*")} == {*before} | ({report, report.parent} if report.exists() else set())
