"""Pixels that somebody knows to be bad, and pixels behind a colour filter."""

from collections.abc import Callable
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest

from photonpano import FrameSpan, InputError
from photonpano.capture import part_of
from photonpano.corrections import corrected_source
from photonpano.merging import Chunk, accumulate, binned_mean
from photonpano.testing import MemorySource

SHAPE = (6, 10)
SPAN = FrameSpan(0, 50)
RED, WHITE = (255, 0, 0), (255, 255, 255)


@pytest.fixture
def source() -> MemorySource:
    return MemorySource(np.random.default_rng(0).integers(0, 2, (50, *SHAPE), dtype=np.uint8))


@pytest.fixture
def refused(source: MemorySource, corrections: Callable) -> Callable[..., str]:
    def refused(*written: Any) -> str:
        with pytest.raises(InputError) as caught:
            corrected_source(source, corrections(*written))
        return str(caught.value)

    return refused


def test_mask_from_a_picture_equals_mask_from_an_array(source: MemorySource, corrections: Callable, tmp_path: Path) -> None:
    bad = np.random.default_rng(3).random(SHAPE) < 0.2
    np.save(tmp_path / "bad.npy", bad)
    cv2.imwrite(str(tmp_path / "bad.png"), bad * np.uint8(255))
    cv2.imwrite(str(tmp_path / "faint.png"), bad * np.uint16(1))
    for name in ("bad.npy", "bad.png", "faint.png"):
        np.testing.assert_array_equal(corrected_source(source, corrections({"mask": {"file": name}})).valid, ~bad)


def test_wrong_mask_files_are_refused(refused: Callable, tmp_path: Path) -> None:
    np.save(tmp_path / "rates.npy", np.zeros(SHAPE))
    np.savez(tmp_path / "dark.npz", rates=np.zeros(SHAPE))
    for name in ("text.npy", "text.png"):
        (tmp_path / name).write_text("no array")
    (tmp_path / "empty.png").touch()
    np.save(tmp_path / "objects.npy", np.array([{}], dtype=object), allow_pickle=True)
    kind = "a mask is a .npy file of bool, true for pixels that must not be used"
    array = "is not a mask of bad pixels: it is no .npy or .npz file of plain numbers"
    picture = "is not a mask of bad pixels: it is no picture that can be read"
    expected = {
        "rates.npy": f"holds float64 values; {kind}",
        "dark.npz": "is an archive; name a .npy file",
        "text.npy": array,
        "objects.npy": array,
        "text.png": picture,
        "empty.png": picture,
    }
    for name, message in expected.items():
        assert refused({"mask": {"file": name}}) == f"{tmp_path / name} {message}"


def test_mask_of_some_frames_follows_rearrangements_and_counts_frames_of_the_recording(
    source: MemorySource, corrections: Callable, tmp_path: Path
) -> None:
    bad = np.zeros(SHAPE, bool)
    bad[:, :4] = True
    np.save(tmp_path / "bad.npy", bad)
    mask = {"mask": {"file": "bad.npy", "frames": [20, 30]}}
    capture = part_of(
        corrected_source(part_of(source, FrameSpan(10, 50)), corrections(mask, "rot90", "missing-row")), FrameSpan(5, 40)
    )
    with_gap = np.insert(np.rot90(~bad, -1), 5, False, axis=0)
    assert capture.valid[[4, 6]].all()
    assert capture.pieces(FrameSpan(0, 35)) == [FrameSpan(0, 5), FrameSpan(5, 15), FrameSpan(15, 35)]
    for span, shown in [((0, 5), True), ((4, 6), with_gap), ((14, 15), with_gap), ((15, 35), True)]:
        np.testing.assert_array_equal(capture.masked_in(FrameSpan(*span)).valid, capture.valid & shown)


def test_masked_frames_count_in_no_sum(source: MemorySource, corrections: Callable, tmp_path: Path) -> None:
    bad = np.zeros(SHAPE, bool)
    bad[2:4] = True
    np.save(tmp_path / "bad.npy", bad)
    capture = corrected_source(source, corrections({"mask": {"file": "bad.npy", "frames": [20, 30]}}))
    summed = accumulate(capture, [Chunk(each, np.eye(3)) for each in capture.pieces(SPAN)], np.eye(3), SHAPE)
    others = source.counts(FrameSpan(0, 20)) + source.counts(FrameSpan(30, 50))
    expected = np.where(bad, others, source.counts(SPAN))
    np.testing.assert_array_equal(summed.weight, np.where(bad, 40, 50))
    np.testing.assert_array_equal(summed.counts, expected)
    np.testing.assert_allclose(binned_mean(capture, SPAN), expected / np.where(bad, 40, 50), rtol=1e-6)
    assert np.isnan(binned_mean(capture, FrameSpan(20, 30))[bad]).all()


def test_masks_that_leave_no_pixel_in_some_frames_are_refused(refused: Callable, tmp_path: Path) -> None:
    half = np.arange(10) < 5
    for name, bad in (("left", half), ("right", ~half), ("all", half | True)):
        np.save(tmp_path / f"{name}.npy", np.broadcast_to(bad, SHAPE))
    masks = [{"mask": {"file": f"{name}.npy", "frames": span}} for name, span in (("left", [10, 30]), ("right", [20, 40]))]
    left_over = "mask leaves no pixel that may be used in frames 20 to 29; mask less of them, or read other frames"
    assert refused(*masks) == refused(*masks[::-1]) == left_over
    assert refused(masks[0], {"mask": {"file": "right.npy"}}) == left_over.replace("20", "10")
    assert refused({"mask": {"file": "all.npy"}}) == "mask leaves no pixel that may be used"


def pattern_of(red: np.ndarray) -> np.ndarray:
    return np.where(red[..., None], np.uint8(RED), np.uint8(WHITE))


def test_interpolated_pixels_are_the_mean_of_clear_neighbours(
    source: MemorySource, corrections: Callable, tmp_path: Path
) -> None:
    red = np.zeros(SHAPE, bool)
    red[2, 3:5] = True
    bad = np.zeros(SHAPE, bool)
    bad[1, 3] = True
    np.save(tmp_path / "pattern.npy", pattern_of(red))
    np.save(tmp_path / "bad.npy", bad)
    keys = {"pattern": "pattern.npy", "others": "interpolate"}
    corrected = corrected_source(source, corrections({"colour-filter": keys}, {"mask": {"file": "bad.npy"}}))
    np.testing.assert_array_equal(corrected.valid, ~bad)
    counts = corrected.counts(SPAN)
    np.testing.assert_array_equal(counts, source.counts(SPAN))
    summed = corrected.corrected(counts, len(SPAN))
    assert summed.dtype == np.float32
    np.testing.assert_array_equal(summed[~red], counts[~red])
    k = counts.astype(float)
    beside, corners = k[3, 3] + k[2, 2], k[1, 2] + k[1, 4] + k[3, 2] + k[3, 4]
    assert summed[2, 3] == pytest.approx((beside + corners / 2) / 4)


def test_wrong_patterns_are_refused(refused: Callable, tmp_path: Path) -> None:
    pattern = pattern_of(np.zeros(SHAPE, bool))
    pattern[4, 5] = (255, 255, 0)
    np.save(tmp_path / "pattern.npy", pattern)
    np.save(tmp_path / "grey.npy", pattern[..., 0])
    assert refused({"colour-filter": {"pattern": "pattern.npy"}}) == (
        f"{tmp_path / 'pattern.npy'} has the colour (255, 255, 0) at row 4, column 5; a pattern has white for clear pixels, "
        "and pure red, green and blue"
    )
    assert refused({"colour-filter": {"pattern": "grey.npy"}}) == (
        f"{tmp_path / 'grey.npy'} holds uint8 values of shape (6, 10); a pattern is a .npy file of uint8 (height, width, 3)"
    )
