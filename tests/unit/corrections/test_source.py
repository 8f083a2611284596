"""A corrected source is a source: whole numbers, one map, and what belongs to sums where there is something to take out."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from photonpano import Config, FrameSpan, InputError, PackedSource, SourceContribution
from photonpano.corrections import CORRECTIONS, corrected_source
from photonpano.corrections.geometry import Crop, MissingRow
from photonpano.testing import MemorySource, SourceConformance

N, SHAPE = 40, (12, 16)
SPAN = FrameSpan(0, N)


@pytest.fixture
def frames() -> np.ndarray:
    return np.random.default_rng(1).integers(0, 2, (N, *SHAPE), dtype=np.uint8)


class MovedConfig(Config):
    """Nothing to choose."""


class TestCorrectedSource(SourceConformance):
    """Turned, cropped and with a row that is missing: what the kit asks of any source."""

    def opened(self) -> Any:
        return corrected_source(MemorySource(self.known_frames()), (CORRECTIONS["rot90"](), Crop(rows=(1, -2)), MissingRow()))

    contribution = SourceContribution(name="moved", summary="Toy", config=MovedConfig, build=lambda *_: None)


@pytest.mark.parametrize(
    "written",
    [[], [{"crop": {"rows": [2, None], "columns": [0, 8]}}], ["rot90", "flip-ud"], ["missing-row"], ["rot90", "rot270"]],
    ids=str,
)
def test_packed_equals_packed_frames(
    written: list[Any], frames: np.ndarray, packed_source: type, corrections: Callable
) -> None:
    source = corrected_source(packed_source(frames), corrections(*written))
    assert isinstance(source, PackedSource)
    np.testing.assert_array_equal(source.packed(FrameSpan(3, 9)), np.packbits(source.frames(FrameSpan(3, 9)), axis=-1))
    np.testing.assert_array_equal(source.counts(SPAN), source.frames(SPAN).sum(axis=0))


def test_masks_of_source_and_corrections_are_combined_and_moved(
    frames: np.ndarray, corrections: Callable, tmp_path: Path
) -> None:
    valid, bad = np.ones(SHAPE, bool), np.zeros(SHAPE, bool)
    valid[2, 3], bad[5, 7] = False, True
    np.save(tmp_path / "bad.npy", bad)
    source = corrected_source(MemorySource(frames, valid), corrections({"mask": {"file": "bad.npy"}}, "rot90"))
    np.testing.assert_array_equal(source.valid, np.rot90(valid & ~bad, -1))
    with pytest.raises(ValueError, match="read-only"):
        source.valid[0, 0] = False


def test_corrections_that_mask_all_pixels_are_refused(frames: np.ndarray, corrections: Callable, tmp_path: Path) -> None:
    half = np.zeros(SHAPE, bool)
    half[:6] = True
    np.save(tmp_path / "upper.npy", half)
    np.save(tmp_path / "lower.npy", ~half)
    written = [{"mask": {"file": "upper.npy"}}, {"mask": {"file": "lower.npy"}}]
    with pytest.raises(InputError) as caught:
        corrected_source(MemorySource(frames), corrections(*written))
    assert str(caught.value) == "mask leaves no pixel that may be used"


def test_linearly_corrected_source_is_refused(frames: np.ndarray, corrections: Callable, tmp_path: Path) -> None:
    """What it takes out would be lost, as it is of the size of its own frames."""
    np.save(tmp_path / "dark.npy", np.zeros(SHAPE))
    once = corrected_source(MemorySource(frames), corrections({"dark-counts": {"dark": "dark.npy"}}))
    with pytest.raises(InputError, match="corrects its sums itself, and cannot be corrected further"):
        corrected_source(once, corrections("rot90"))


def test_corrected_source_closes_the_source(frames: np.ndarray, monkeypatch: pytest.MonkeyPatch) -> None:
    closed = []
    monkeypatch.setattr(MemorySource, "close", lambda self: closed.append(self))
    with corrected_source(MemorySource(frames), ()):
        pass
    assert len(closed) == 1
