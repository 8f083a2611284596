"""Captures that are still being written: the whole frames that are there are read, and no others."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from photonpano import Arrived, InputError, Url, discover

CATALOG = discover()


def arrived(name: str, **keys: Any) -> Arrived:
    contribution = CATALOG.find("source", name).contribution
    found = contribution.arrived(contribution.config(**keys))
    assert isinstance(found, Arrived)
    return found


def frames_of(found: Arrived) -> np.ndarray:
    assert found.source is not None
    with found.source as source:
        return source.frames(source.info.span)


@pytest.mark.parametrize(
    ("name", "shape"), [("swissspad-half", (256, 512)), ("swissspad-full", (512, 512)), ("spad512", (512, 512))]
)
def test_files_appear_and_the_last_one_grows(
    tmp_path: Path, bin_file: Callable[[str, np.ndarray], bytes], name: str, shape: tuple[int, int]
) -> None:
    frames = np.random.default_rng(0).integers(0, 2, (7, *shape), dtype=np.uint8)
    assert arrived(name, path=tmp_path / "scan").source is None
    (tmp_path / "scan").mkdir()
    assert arrived(name, path=tmp_path / "scan").source is None
    first, second = (bin_file(name, part) for part in (frames[:4], frames[4:]))
    frame_bytes = shape[0] * shape[1] // 8
    for end, n_frames in ((frame_bytes - 1, 0), (2 * frame_bytes + 5, 2), (len(first), 4)):
        (tmp_path / "scan" / "a9.bin").write_bytes(first[:end])
        found = arrived(name, path=tmp_path / "scan")
        assert (0 if found.source is None else len(frames_of(found))) == n_frames
    for end, n_frames in ((0, 4), (2 * frame_bytes + 5, 6)):
        (tmp_path / "scan" / "a10.bin").write_bytes(second[:end])
        np.testing.assert_array_equal(frames_of(arrived(name, path=tmp_path / "scan")), frames[:n_frames])


@pytest.mark.parametrize(("name", "keys"), [("packed-npy", {"width": 27}), ("npy", {"holds": "bits"})])
def test_npy_file_grows_to_what_it_promises(tmp_path: Path, name: str, keys: dict[str, Any]) -> None:
    frames = np.random.default_rng(0).integers(0, 2, (7, 18, 27), dtype=np.uint8)
    np.save(tmp_path / "whole.npy", np.packbits(frames, axis=-1) if name == "packed-npy" else frames)
    data, growing = (tmp_path / "whole.npy").read_bytes(), tmp_path / "growing.npy"
    frame_bytes = (len(data) - 128) // 7
    assert arrived(name, path=growing, **keys).source is None
    growing.write_bytes(data[:60])
    assert arrived(name, path=growing, **keys).source is None
    for n_frames in (0, 3, 7):
        growing.write_bytes(data[: 128 + n_frames * frame_bytes + min(4, 7 - n_frames)])
        found = arrived(name, path=growing, **keys)
        assert found.promised == 7
        if n_frames:
            np.testing.assert_array_equal(frames_of(found), frames[:n_frames])
        else:
            assert found.source is None


@pytest.mark.parametrize("name", ["packed-npy", "swissspad-half"])
def test_url_cannot_be_followed(name: str) -> None:
    with pytest.raises(InputError, match="is a URL, which cannot be followed"):
        arrived(name, path=Url("https://example.org/a"))


def test_compressed_file_cannot_be_followed(tmp_path: Path) -> None:
    (tmp_path / "a.npy.gz").write_bytes(b"\x1f\x8b")
    with pytest.raises(InputError, match=r"a\.npy\.gz is compressed, so that no frame can be read before all are there"):
        arrived("packed-npy", path=tmp_path / "a.npy.gz")


def test_frames_along_the_last_axis_cannot_be_followed(tmp_path: Path) -> None:
    np.save(tmp_path / "a.npy", np.zeros((18, 27, 7), np.uint8))
    with pytest.raises(InputError, match="frames along the last axis, so that none is whole before all are written"):
        arrived("npy", path=tmp_path / "a.npy", holds="bits", frame_axis="last")
