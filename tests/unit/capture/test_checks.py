"""What is found before a run: the pixel order, repeats, obstacles, parts of a capture, its fingerprint and checks."""

import os
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from photonpano import (
    FrameSpan,
    InputError,
    SpecError,
    StreamInfo,
    open_source,
    parse_spec,
    simulate,
)
from photonpano.capture import capture_of
from photonpano.capture.writing import truth_path
from photonpano.errors import LocationError
from photonpano.execution.context import Context
from photonpano.photometry import IntensityResponse
from photonpano.pipeline.components import build_source
from photonpano.pipeline.obstacles import naming_obstacles, order_warning, timeline_of
from photonpano.pipeline.summary import require_photons
from photonpano.reading import FrameFile, FrameLayout, PackedFileSource
from photonpano.record.contents import changes, fingerprint
from photonpano.record.schema import CaptureRecord
from photonpano.testing import MemorySource
from photonpano.values import Still

DARK = (
    "no pixel is lit in any of {} frames sampled all over the capture; "
    "check that the file is the right one, and that the lens was open"
)
LIT = (
    "every pixel is lit in all of {} frames sampled all over the capture, so the flux cannot be estimated; "
    "check the layout of the file, or expose less"
)


@pytest.mark.parametrize(("n_frames", "looked_at"), [(1, 1), (40, 40), (256, 256), (257, 256), (1000, 256)])
@pytest.mark.parametrize(("value", "text"), [(0, DARK), (1, LIT)])
def test_require_photons_refuses_all_dark_and_all_lit(
    memory_source: type, n_frames: int, looked_at: int, value: int, text: str
) -> None:
    with pytest.raises(InputError) as caught:
        require_photons(memory_source(np.full((n_frames, 4, 8), value)))
    assert str(caught.value) == text.format(looked_at)


@pytest.mark.parametrize(("level", "text"), [(16, "no pixel is brighter than black"), (235, "every pixel is saturated")])
def test_require_photons_compares_grey_levels_with_black_and_white(memory_source: type, level: int, text: str) -> None:
    with pytest.raises(InputError, match=f"^{text} in"):
        require_photons(grey(memory_source, level))
    require_photons(grey(memory_source, 100))


def grey(memory_source: type, level: int) -> Any:
    """Return a capture of one level, whose black is 16 and whose white is 235."""
    source = memory_source(np.full((40, 4, 8), level))
    source.info, source.response = StreamInfo(40, 4, 8, None, "intensity", 8), IntensityResponse(40.0, 16.0, 235.0, 20.0)
    return source


@pytest.mark.parametrize("read", ["big", "little"])
@pytest.mark.parametrize("stored", ["big", "little"])
def test_packed_source_that_is_read_in_another_order_is_warned_of(
    tmp_path: Path, clouds: Callable[..., np.ndarray], stored: str, read: str
) -> None:
    np.packbits(clouds(), axis=2, bitorder=stored).tofile(tmp_path / "cube.bin")
    with PackedFileSource([FrameFile(tmp_path / "cube.bin", 384)], FrameLayout((64, 96), (64, 12), read)) as source:
        warning = order_warning(source)
    if stored == read:
        assert warning is None
    else:
        assert warning is not None
        assert warning.startswith(
            "the pixels of the frames seem to be in another order than they are read in: pixels correlate"
        )
        assert warning.endswith(" if the first pixel is the lowest bit; check the source and its keys")


RNG = np.random.default_rng(8)


def repeated(folder: Path, frames: np.ndarray) -> list[int]:
    """Return the numbers of the repeated frames."""
    np.packbits(frames, axis=2).tofile(folder / "cube.bin")
    file, layout = FrameFile(folder / "cube.bin", len(frames)), FrameLayout((40, 64), (40, 8), "big")
    with PackedFileSource([file], layout) as source:
        return (np.flatnonzero(np.diff(timeline_of(source, Context(threads=2)).taken) == 0) + 1).tolist()


def taken(n_frames: int, share: float = 0.2) -> np.ndarray:
    return RNG.random((n_frames, 40, 64)) < share


def test_copies_of_the_frame_before_are_found_across_blocks(tmp_path: Path) -> None:
    order = np.sort(np.concatenate([np.arange(520), [3, 100, 100, 255, 256]]))
    assert repeated(tmp_path, taken(520)[order]) == [4, 102, 103, 259, 261]


def test_independent_and_dark_and_saturated_frames_are_no_copies(tmp_path: Path) -> None:
    frames = taken(60)
    frames[20:30] = False
    frames[40:50] = True
    frames[:, 5, 5] = True
    assert repeated(tmp_path, frames) == []


SHAPE = 96, 128


def test_error_says_that_a_mask_leaves_few_pixels() -> None:
    masked = np.random.default_rng(0).random(SHAPE) < 0.98
    capture = replace(capture_of(MemorySource(np.zeros((64, *SHAPE), bool))), valid=~masked)
    with pytest.raises(LocationError) as raised, naming_obstacles(capture):
        raise LocationError("none of the pairs could be located")
    said = "98% of the pixels are masked: if the mask marks the pixels that count, invert it."
    assert str(raised.value).splitlines()[1:] == [said]


def test_error_names_what_stands_still() -> None:
    frames = np.random.default_rng(0).random((64, *SHAPE)) < 0.4
    capture = replace(capture_of(MemorySource(frames)), still=Still(0.38))
    with pytest.raises(LocationError) as raised, naming_obstacles(capture):
        raise LocationError("none of the pairs could be located")
    assert str(raised.value).splitlines() == [
        "none of the pairs could be located",
        "38% of the frame stands still while the rest moves, as a window or dirt in front of the sensor does.",
    ]


def part(path: Path, start: int, stop: int) -> dict[str, Any]:
    return {"use": "packed-npy", "with": {"path": str(path), "frames": [start, stop]}}


def test_part_holds_the_frames_of_its_span(small_capture: Path) -> None:
    source = {"use": "packed-npy", "with": {"path": str(small_capture)}}
    whole = build_source(parse_spec({"version": 1, "source": source}))
    some = build_source(parse_spec({"version": 1, "source": part(small_capture, 40, 100)}))
    with whole, some:
        assert (some.info.n_frames, some.info.frame_shape) == (60, whole.info.frame_shape)
        inner, outer = FrameSpan(5, 20), FrameSpan(45, 60)
        for method in ("counts", "frames", "packed"):
            np.testing.assert_array_equal(getattr(some, method)(inner), getattr(whole, method)(outer))


def test_truth_of_a_part_is_that_of_its_frames(tmp_path: Path) -> None:
    keys = {"n_frames": 60, "frame_shape": [24, 32], "path": {"kind": "pan", "length_px": 20}}
    truths = []
    for name, more in (("whole", {}), ("part", {"frames": [10, 40]})):
        spec = parse_spec({"version": 1, "source": {"use": "simulator", "with": keys | more}})
        with np.load(truth_path(simulate(spec, tmp_path / f"{name}.npy").path)) as truth:
            truths.append(dict(truth))
    whole, some = truths
    np.testing.assert_array_equal(some["homographies"], whole["homographies"][10:40])
    np.testing.assert_array_equal(some["scene"], whole["scene"])


@pytest.mark.parametrize(
    ("frames", "message"),
    [
        ([0, 301], "the capture has 300 frames: expected [start, stop] with stop up to 300, got [0, 301]"),
        ([9, 9], "expected [start, stop] with start < stop, got [9, 9]"),
        ([-1, 9], "expected an integer of at least 0, got -1"),
        (9, "expected a list of 2 items or null, got 9"),
    ],
)
def test_frames_that_are_no_part_of_the_capture_are_named(small_capture: Path, frames: Any, message: str) -> None:
    source = {"use": "packed-npy", "with": {"path": str(small_capture), "frames": frames}}
    with pytest.raises(SpecError) as caught, open_source(parse_spec({"version": 1, "source": source})):
        pass
    assert str(caught.value).endswith(message)


FRAMES = np.random.default_rng(0).integers(0, 256, (200, 16, 3), np.uint8)


@pytest.fixture
def cube(tmp_path: Path) -> Path:
    np.save(tmp_path / "cube.npy", FRAMES)
    return tmp_path / "cube.npy"


def fingerprint_of(cube: Path, **changed: Any) -> CaptureRecord:
    source = {"use": "packed-npy", "with": {"path": str(cube), "frame_rate_hz": 1000}}
    plan = parse_spec({"version": 1, "source": source, "corrections": [], **changed})
    with open_source(plan) as opened:
        return fingerprint(plan, opened)


def test_changes_name_a_touched_file_and_other_frames_of_the_same_size_and_time(cube: Path) -> None:
    before, stat = fingerprint_of(cube), cube.stat()
    os.utime(cube, ns=(0, 5))
    (change,) = changes(before, fingerprint_of(cube))
    assert change == f"{cube} was written at 1970-01-01T00:00:00.000000005Z, not {before['files'][0]['modified']}"
    np.save(cube, FRAMES[::-1])
    os.utime(cube, ns=(stat.st_atime_ns, stat.st_mtime_ns))
    assert changes(before, fingerprint_of(cube)) == ["the frames are others"]


def test_changes_name_another_mask(cube: Path, tmp_path: Path) -> None:
    mask = tmp_path / "mask.npy"
    np.save(mask, np.zeros((16, 24), bool))
    corrections = [{"mask": {"file": str(mask)}}]
    before, stat = fingerprint_of(cube, corrections=corrections), mask.stat()
    np.save(mask, np.eye(16, 24) == 1)
    os.utime(mask, ns=(stat.st_atime_ns, stat.st_mtime_ns))
    after = fingerprint_of(cube, corrections=corrections)
    assert changes(before, after) == ["the mask or another correction gives other pixels"]
    assert changes(fingerprint_of(cube), before) == [f"{mask} is read as well"]


def test_fingerprint_of_a_folder_leaves_out_runs_in_it(tmp_path: Path) -> None:
    for index in range(2):
        (tmp_path / f"RAW{index:05}.bin").write_bytes(bytes(512 * 512 // 8 * 64))
    plan_of = {"version": 1, "source": {"use": "spad512", "with": {"path": str(tmp_path)}}, "corrections": []}
    plan = parse_spec(plan_of)
    with open_source(plan) as source:
        before = fingerprint(plan, source)
        (tmp_path / "runs" / "scan").mkdir(parents=True)
        for name in ("run.json", "big.bin"):
            (tmp_path / "runs" / "scan" / name).write_bytes(b"content")
        (tmp_path / "notes.txt").write_text("a note")
        assert changes(before, fingerprint(plan, source)) == []
        (tmp_path / "more.bin").write_bytes(b"content")
        assert changes(before, fingerprint(plan, source)) == [f"{tmp_path} has another size"]
