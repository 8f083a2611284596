"""Corrected sources: one map, and corrections that move pixels."""

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


def bits(shape: tuple[int, int], n: int = 3) -> np.ndarray:
    return np.random.default_rng(0).integers(0, 2, (n, *shape), dtype=np.uint8)


def moved(frames: np.ndarray, corrections: Any) -> np.ndarray:
    with corrected_source(MemorySource(frames), corrections) as source:
        return source.frames(source.info.span)


def by_photoncube(frames: np.ndarray, folder: Path, transforms: tuple[str, ...] = (), **fixes: bool) -> np.ndarray:
    """Return packed frames as photoncube corrects them."""
    photoncube = pytest.importorskip("photoncube")
    np.save(folder / "cube.npy", np.packbits(frames, axis=-1))
    cube = photoncube.PhotonCube.open(str(folder / "cube.npy"))
    cube.set_transforms([getattr(photoncube.Transform, name) for name in transforms])
    cube.process_cube(str(folder / "corrected.npy"), **fixes)
    return np.load(folder / "corrected.npy")


@pytest.mark.parametrize(
    ("written", "transforms"),
    [
        (["rot90"], ("Rot90",)),
        (["rot180"], ("Rot180",)),
        (["rot270"], ("Rot270",)),
        (["flip-ud"], ("FlipUD",)),
        (["flip-lr"], ("FlipLR",)),
        (["rot90", "flip-ud"], ("Rot90", "FlipUD")),
    ],
)
def test_turns_equal_those_of_photoncube(written: list[str], transforms: Any, corrections: Callable, tmp_path: Path) -> None:
    frames = bits((16, 24))
    expected = by_photoncube(frames, tmp_path, transforms)
    np.testing.assert_array_equal(np.packbits(moved(frames, corrections(*written)), axis=-1), expected)


@pytest.mark.parametrize(
    ("preset", "shape", "fix", "result"),
    [
        ("colour-swissspad2", (256, 512), "colorspad_fix", (254, 496)),
        ("grey-swissspad2-half", (256, 512), "grayspad_fix", (254, 496)),
        ("grey-swissspad2-full", (512, 512), "grayspad_fix", (509, 496)),
    ],
)
def test_presets_equal_those_of_photoncube(
    preset: str, shape: Any, fix: str, result: Any, corrections: Callable, tmp_path: Path
) -> None:
    frames = bits(shape)
    expected = by_photoncube(frames, tmp_path, **{fix: True})
    corrected = moved(frames, corrections(preset))
    assert corrected.shape[1:] == result
    np.testing.assert_array_equal(np.packbits(corrected, axis=-1), expected)


@pytest.mark.parametrize(("settings", "row"), [({}, 3), ({"before": 1}, 1), ({"before": 6}, 6)])
def test_missing_row_is_dark_and_masked(settings: dict[str, int], row: int, corrections: Callable) -> None:
    frames = bits((6, 5))
    with corrected_source(MemorySource(frames), corrections({"missing-row": settings})) as source:
        np.testing.assert_array_equal(source.frames(source.info.span), np.insert(frames, row, 0, axis=1))
        np.testing.assert_array_equal(source.valid, np.arange(7)[:, None] != np.full((1, 5), row))
        assert not source.counts(FrameSpan(0, 3))[row].any()


@pytest.mark.parametrize(
    ("written", "message"),
    [
        (
            {"crop": {"rows": [2, 300]}},
            "there are no rows [2, 300]: frames have 6 rows at this place of the list",
        ),
        (
            {"crop": {"columns": [-12, None]}},
            "there are no columns [-12, null]: frames have 10 columns at this place of the list",
        ),
        (
            {"crop": {"rows": [4, 4]}},
            "there are no rows [4, 4]: frames have 6 rows at this place of the list",
        ),
        (
            {"swap-columns": {"first": [0, 2], "second": [9, 11]}},
            "there is no column 10: frames have 10 columns at this place of the list",
        ),
        ({"missing-row": {"before": 7}}, "there is no row 7: frames have 6 rows at this place of the list"),
        (
            "colour-swissspad2",
            "colour-swissspad2 is for frames of 256x512 px, and frames have 6x10 px at this place of the list",
        ),
    ],
)
def test_rearrangement_outside_the_frame_is_refused(written: Any, message: str, corrections: Callable) -> None:
    with pytest.raises(InputError) as caught:
        corrected_source(MemorySource(bits((6, 10))), corrections(written))
    assert str(caught.value) == message
