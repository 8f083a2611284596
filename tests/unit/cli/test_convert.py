from __future__ import annotations

import shutil
import signal
import subprocess
import sys
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest


@pytest.fixture
def cube(folder: Path, finished: Path) -> Path:
    shutil.copy(finished / "cube.npy", folder / "cube.npy")
    return folder / "cube.npy"


@pytest.mark.parametrize("steps", [("out.npy",), ("out.zarr", "out.npy"), ("out.zarr --compress", "out.npy")], ids=" ".join)
def test_convert_copies_bits(cube: Path, invoke: Callable[..., Any], steps: tuple[str, ...]) -> None:
    if "--compress" in steps[0]:
        pytest.importorskip("numcodecs", reason="compression needs photonpano[zarr]")
    for source, words in zip(("cube.npy", "out.zarr"), steps, strict=False):
        assert invoke("convert", source, *words.split()).exit_code == 0
    assert (cube.parent / "out.npy").read_bytes() == cube.read_bytes()


def test_convert_applies_corrections_of_option(cube: Path, invoke: Callable[..., Any]) -> None:
    assert (
        invoke("convert", "cube.npy", "out.npy", "--correct", "{crop: {columns: [0, 43]}}", "--correct", "flip-lr").exit_code
        == 0
    )
    frames = np.unpackbits(np.load(cube), axis=-1)
    found = np.unpackbits(np.load(cube.parent / "out.npy"), axis=-1, count=43)
    np.testing.assert_array_equal(found, frames[:, :, 42::-1])


SLOWLY = """
import time
from photonpano.cli.app import main
from photonpano.captures import writing
writing._BLOCK_BYTES = 20 * 96 * 20
of = writing.PackedFrames.of
def slowly(self, span):
    time.sleep(0.05)
    return of(self, span)
writing.PackedFrames.of = slowly
main()
"""


def heed_interrupts() -> None:
    """Restore SIGINT, which shells disable in their background jobs."""
    signal.signal(signal.SIGINT, signal.SIG_DFL)


@pytest.mark.parametrize("sent", [signal.SIGINT, signal.SIGTERM])
def test_convert_continues_after_interrupt(cube: Path, invoke: Callable[..., Any], sent: signal.Signals) -> None:
    part, command = cube.parent / "out.npy.part", [sys.executable, "-c", SLOWLY, "convert", "cube.npy", "out.npy"]
    pipes = {"stdout": subprocess.PIPE, "stderr": subprocess.PIPE}
    with subprocess.Popen(command, cwd=cube.parent, text=True, preexec_fn=heed_interrupts, **pipes) as process:
        while not (part.exists() and part.stat().st_size > 128) and process.poll() is None:
            time.sleep(0.01)
        process.send_signal(sent)
        out, err = process.communicate(timeout=60)
    assert (process.returncode, out) == (128 + sent, "")
    assert err == (
        "the frames written so far are in out.npy.part; the same command continues from there\n"
        "\ninterrupted; no file is left half-written under its final name\n"
    )
    assert sorted(path.name for path in cube.parent.iterdir()) == ["capture.yaml", "cube.npy", "out.npy.part"]
    there = (part.stat().st_size - 128) // (96 * 20)
    result = invoke("convert", "cube.npy", "out.npy")
    assert result.stderr == f"out.npy.part holds {there} frames of this capture: continuing from there\n"
    assert (cube.parent / "out.npy").read_bytes() == cube.read_bytes()
    assert not part.exists()


def test_convert_onto_itself_keeps_capture(cube: Path, invoke: Callable[..., Any]) -> None:
    """The old file stays open until the new one replaces it."""
    before = cube.read_bytes()
    assert invoke("convert", "cube.npy", "cube.npy").exit_code == 0
    assert cube.read_bytes() == before
