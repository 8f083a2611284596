from __future__ import annotations

import gzip
import os
from collections.abc import Callable
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from photonpano import FrameSpan, InputError, OutputError, SourceContext
from photonpano.reading import PackedFileSource
from photonpano_core.sources.npy import PACKED_NPY, PackedNpyConfig


def cube(n: int = 40, height: int = 6, width: int = 24, seed: int = 0) -> np.ndarray:
    return np.random.default_rng(seed).integers(0, 2, (n, height, width), dtype=np.uint8)


def saved(path: Path, array: np.ndarray, **options: Any) -> Path:
    np.save(path, array, **options)
    return path


def opened(path: Path, **config: Any) -> PackedFileSource:
    source = PACKED_NPY.build(PackedNpyConfig(path=path, **config), SourceContext())
    assert isinstance(source, PackedFileSource)
    return source


ALONG = {"packed_along": "height"}
LITTLE = {"bit_order": "little"}
# Frames, how they are stored, and the keys that read them.
LAYOUTS: dict[str, tuple[np.ndarray, Callable[[np.ndarray], np.ndarray], dict[str, Any]]] = {
    "whole bytes": (cube(), lambda frames: np.packbits(frames, axis=2), {}),
    "a width of 19": (cube(width=19), lambda frames: np.packbits(frames, axis=2), {"width": 19}),
    "lowest bit first": (cube(width=19), lambda frames: np.packbits(frames, axis=2, bitorder="little"), LITTLE | {"width": 19}),
    "along the height": (cube(height=16, width=21), lambda frames: np.packbits(frames, axis=1), ALONG),
    "along a height of 13": (
        cube(height=13, width=21),
        lambda frames: np.packbits(frames, axis=1, bitorder="little"),
        ALONG | LITTLE | {"height": 13},
    ),
    **{
        f"channel {channel}": (
            cube(width=19),
            lambda frames, channel=channel: np.packbits(np.roll(in_colour(frames), channel, axis=-1), axis=2),
            {"width": 19, "channel": channel},
        )
        for channel in range(3)
    },
    "a channel along the height": (
        cube(height=16),
        lambda frames: np.packbits(np.roll(in_colour(frames), 2, axis=-1), axis=1, bitorder="little"),
        ALONG | LITTLE | {"channel": 2},
    ),
}


def in_colour(frames: np.ndarray) -> np.ndarray:
    """Return frames with two other channels after them: (n, H, W, 3)."""
    return np.stack([frames, *(cube(*frames.shape, seed=seed) for seed in (1, 2))], axis=-1)


@pytest.mark.parametrize("layout", LAYOUTS)
def test_frames_are_read_in_any_layout(tmp_path: Path, layout: str) -> None:
    frames, store, keys = LAYOUTS[layout]
    with opened(saved(tmp_path / "cube.npy", store(frames)), frame_rate_hz=96800, **keys) as source:
        assert str(source.info) == f"40 binary frames of {frames.shape[1]}x{frames.shape[2]} at 96,800 Hz"
        assert source.valid.all()
        assert source.valid.shape == frames.shape[1:]
        for span in (FrameSpan(0, 40), FrameSpan(7, 8), FrameSpan(13, 40)):
            part = frames[span.start : span.stop]
            np.testing.assert_array_equal(source.frames(span), part)
            np.testing.assert_array_equal(source.counts(span), part.sum(axis=0))
            np.testing.assert_array_equal(source.packed(span), np.packbits(part, axis=-1))


def test_width_defaults_to_whole_bytes(tmp_path: Path) -> None:
    path = saved(tmp_path / "cube.npy", np.packbits(cube(width=19), axis=-1))
    with opened(path) as source:
        assert source.info.frame_shape == (6, 24)


def test_lit_padding_bits_are_ignored(tmp_path: Path) -> None:
    with opened(saved(tmp_path / "cube.npy", np.full((3, 2, 2), 255, np.uint8)), width=11) as source:
        np.testing.assert_array_equal(source.counts(FrameSpan(0, 3)), np.full((2, 11), 3))
        assert source.frames(FrameSpan(0, 3)).shape == (3, 2, 11)


@pytest.fixture
def gzipped(tmp_path: Path) -> Path:
    path = tmp_path / "cube.npy.gz"
    path.write_bytes(gzip.compress(saved(tmp_path / "cube.npy", PACKED).read_bytes()))
    (tmp_path / "cube.npy").unlink()
    return path


def test_compressed_captures_are_unpacked_once(gzipped: Path, caplog: pytest.LogCaptureFixture) -> None:
    beside = gzipped.with_name("cube.npy.gz.unpacked.npy")
    message = f"{gzipped} is unpacked to {beside.name}, once"

    def read() -> list[str]:
        caplog.clear()
        with opened(gzipped) as source:
            np.testing.assert_array_equal(source.frames(source.info.span), cube())
        return caplog.messages

    assert list(PACKED_NPY.check(PackedNpyConfig(path=gzipped))) == []
    assert not beside.exists()
    assert read() == [message]
    assert read() == []
    assert sorted(gzipped.parent.iterdir()) == [gzipped, beside]
    os.utime(gzipped, (beside.stat().st_mtime + 10,) * 2)
    assert read() == []
    os.truncate(beside, 100)
    assert read() == [message]


def test_full_disk_is_reported_before_unpacking(gzipped: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("shutil.disk_usage", lambda _: SimpleNamespace(free=847))
    with pytest.raises(OutputError) as caught:
        opened(gzipped)
    beside = gzipped.with_name("cube.npy.gz.unpacked.npy")
    assert str(caught.value) == (
        f"cannot write {beside}: it takes 848 B, and its disk has 847 B free; free some space or choose another folder"
    )
    assert list(gzipped.parent.iterdir()) == [gzipped]


PACKED = np.packbits(cube(), axis=-1)


def test_file_that_shrinks_while_read_is_refused(tmp_path: Path) -> None:
    path = tmp_path / "cube.npy"
    np.save(path, np.zeros((100, 16, 2), np.uint8))
    with opened(path) as source:
        os.truncate(path, 1000)
        assert not source.counts(FrameSpan(0, 10)).any()
        with pytest.raises(InputError) as caught:
            source.counts(FrameSpan(10, 100))
    assert str(caught.value) == f"{path} has become shorter while it was read; copy or record it again"


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return tmp_path_factory.mktemp("fuzz")


@settings(deadline=None, max_examples=100)
@given(changes=st.dictionaries(st.integers(0, 127), st.integers(0, 255), min_size=1, max_size=4))
def test_damaged_headers_raise_input_error_only(folder: Path, changes: dict[int, int]) -> None:
    path = saved(folder / "cube.npy", PACKED)
    content = bytearray(path.read_bytes())
    for place, value in changes.items():
        content[place] = value
    path.write_bytes(content)
    try:
        with opened(path) as source:
            source.counts(FrameSpan(0, 1))
    except InputError:
        pass


def problem_of(path: Path, array: np.ndarray, **config: Any) -> str | None:
    """Return what the check says of an array."""
    problems = PACKED_NPY.check(PackedNpyConfig(path=saved(path, array), **config))
    assert len(problems) <= 1
    return problems[0] if problems else None


def test_path_in_the_line_to_write_is_quoted_where_yaml_needs_it(tmp_path: Path, clouds: Callable) -> None:
    message = problem_of(tmp_path / "scan: 2, {a}.npy", clouds(n_frames=16))
    assert str(message).endswith(f'write source: {{use: npy, with: {{path: "{tmp_path}/scan: 2, {{a}}.npy", holds: bits}}}}')


@pytest.mark.parametrize("keys", [{"bit_order": "big"}, {"bit_order": "little"}, {"packed_along": "width"}])
def test_layout_that_the_spec_states_is_believed(tmp_path: Path, clouds: Callable, keys: dict[str, Any]) -> None:
    for packed in (np.packbits(clouds(), axis=2, bitorder="little"), clouds()):
        assert problem_of(tmp_path / "cube.npy", packed, **keys) is None


def test_layout_of_each_channel_is_checked(tmp_path: Path, clouds: Callable) -> None:
    stored = np.packbits(np.repeat(clouds(n_frames=128)[..., None], 3, axis=-1), axis=2, bitorder="little")
    assert "write bit_order: little" in str(problem_of(tmp_path / "cube.npy", stored, channel=2))


def test_layout_of_a_compressed_capture_is_checked(tmp_path: Path, clouds: Callable) -> None:
    path = tmp_path / "cube.npy.gz"
    with gzip.open(path, "wb") as file:
        np.save(file, np.packbits(clouds(), axis=2, bitorder="little"))
    (problem,) = PACKED_NPY.check(PackedNpyConfig(path=path))
    assert problem.endswith("write bit_order: little, or bit_order: big if it is right")
