"""Output and errors of `photonpano dark`."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from photonpano.specs import parse_spec

SHAPE = (24, 32)
SPEC = "version: 1\nsource: {use: packed-npy, with: {path: covered.npy}}\n"


@pytest.fixture
def hot(folder: Path) -> np.ndarray:
    """Write frames of a covered camera into the folder, and return the mask of its hot pixels."""
    rng = np.random.default_rng(0)
    hot = rng.random(SHAPE) < 0.03
    rates = np.where(hot, 0.5, 0.002)
    np.save(folder / "covered.npy", np.packbits(rng.random((1000, *SHAPE)) < -np.expm1(-rates), axis=-1))
    (folder / "covered.yaml").write_text(SPEC)
    return hot


def test_dark_writes_counts_and_prints_corrections(hot: np.ndarray, folder: Path, invoke: Callable[..., Any]) -> None:
    done = invoke("dark", "covered.yaml", "--output", "dark.npz")
    assert (done.exit_code, done.stderr) == (0, "")
    with np.load(folder / "dark.npz") as archive:
        assert sorted(archive.files) == ["n_frames", "rates"]
        assert archive["rates"][hot].mean() == pytest.approx(0.5, rel=0.1)
        assert archive["rates"][~hot].mean() == pytest.approx(0.002, rel=0.1)
    lines = done.stdout.splitlines()
    assert lines[0] == "dark.npz               from 1,000 binary frames of 24x32"
    assert lines[1].startswith("dark counts per frame  median 0.002, 90 % 0.0")
    assert lines[2].startswith(f"hot pixels             {hot.sum()} of 768 ({100 * hot.mean():.2f} %), above 0.0")
    line = "corrections: [{hot-pixels: {dark: dark.npz}}, {dark-counts: {dark: dark.npz}}]"
    assert lines[3:] == ["", "In a spec in this folder:", "", line]
    assert len(parse_spec(f"{SPEC}{line}\n", directory=folder).corrections) == 2


def test_dark_writes_mask_to_npy_file(hot: np.ndarray, folder: Path, invoke: Callable[..., Any]) -> None:
    done = invoke("dark", "covered.npy", "-o", "mask.npy", "--threshold", "20")
    np.testing.assert_array_equal(np.load(folder / "mask.npy"), hot)
    line = done.stdout.splitlines()[-1]
    assert line == "corrections: [{mask: {file: mask.npy}}]"
    assert len(parse_spec(f"{SPEC}{line}\n", directory=folder).corrections) == 1


@pytest.mark.usefixtures("hot")
def test_dark_applies_corrections_that_move_pixels(folder: Path, invoke: Callable[..., Any]) -> None:
    invoke("dark", "covered.yaml", "-o", "dark.npz", "--correct", "rot90", "--correct", "{crop: {rows: [0, 10]}}")
    with np.load(folder / "dark.npz") as archive:
        assert archive["rates"].shape == (10, 24)
