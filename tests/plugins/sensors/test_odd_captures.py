"""Captures of cameras that are odd and not wrong, or still being written; those that are wrong stand in `damaged.txt`."""

from __future__ import annotations

import json
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from scipy.io import savemat

from photonpano import Arrived, InputError, PackedSource, Source, SourceContext, Url, discover
from photonpano_sensors.intensity.pictures import read_header
from photonpano_sensors.intensity.source import Encoding

CATALOG = discover()
PHOTRON = Path(__file__).parents[2] / "data" / "photron"


def opened(name: str, path: Path) -> Source:
    contribution = CATALOG.find("source", name).contribution
    return contribution.build(contribution.config(path=path), SourceContext())


@pytest.mark.parametrize("n_frames", [18, 6])
def test_info_json_counts_frames_of_the_capture_or_of_a_part(tmp_path: Path, n_frames: int) -> None:
    for number in (1, 2, 3):
        savemat(tmp_path / f"part_{number}.mat", {"OUTPUT": np.zeros((10, 16, 6), np.uint8)})
    (tmp_path / "info.json").write_text(json.dumps({"no_parts": 3, "no_frames": n_frames}))
    with opened("mat-parts", tmp_path) as source:
        assert source.info.n_frames == 18


@pytest.mark.parametrize(("name", "shape"), [("swissspad-half", (256, 512)), ("swissspad-full", (512, 512))])
def test_frames_equal_those_of_photoncube(tmp_path: Path, bin_file: Callable, name: str, shape: tuple[int, int]) -> None:
    """The program reads the same bits out of the same files."""
    photoncube = pytest.importorskip("photoncube")
    folder, converted = tmp_path / "bins", tmp_path / "cube.npy"
    folder.mkdir()
    n_frames = 512 * 256 // shape[0]  # of a file: it takes no others
    for number in (2, 10):
        rows = np.random.default_rng(number).integers(0, 2, (n_frames, 1, shape[1]), dtype=np.uint8)
        frames = np.repeat(rows, shape[0], axis=1) ^ (np.arange(shape[0]) % 7 == 0).astype(np.uint8)[:, None]
        (folder / f"filename{number}.bin").write_bytes(bin_file(name, frames))
    photoncube.PhotonCube.convert_to_npy(str(folder), str(converted), is_full_array=name.endswith("full"))
    with opened(name, folder) as source:
        assert isinstance(source, PackedSource)
        assert np.array_equal(source.packed(source.info.span), np.load(converted))


@pytest.mark.parametrize("name", ["beam", "ball_12bit"])
@pytest.mark.filterwarnings("ignore::UserWarning")  # pyMRAW warns of recordings that it was not made for
def test_frames_equal_those_of_pymraw(name: str) -> None:
    reader = pytest.importorskip("pyMRAW")
    known, _ = reader.load_video(str(PHOTRON / f"{name}.cihx"))
    with opened("fastcam-mraw", PHOTRON / f"{name}.mraw") as source:
        np.testing.assert_array_equal(source.frames(source.info.span), known)
        np.testing.assert_array_equal(source.counts(source.info.span), known.sum(axis=0, dtype=np.uint32))


def test_header_of_fastcam_gives_size_bits_and_rate(tmp_path: Path) -> None:
    header = read_header(PHOTRON / "ball_12bit.cihx")
    assert (header.n_frames, header.height, header.width, header.bits) == (3, 384, 384, 12)
    assert (header.encoding, header.frame_rate_hz) == (Encoding.full(12), 30_000)
    header = read_header(PHOTRON / "sample_60k_16bit.cih")
    assert (header.n_frames, header.height, header.width, header.bits) == (12, 368, 896, 16)
    assert header.encoding == Encoding.full(12)
    assert header.frame_rate_hz == 60_000 / 36  # one frame in 36 was saved
    lower = (PHOTRON / "sample_60k_16bit.cih").read_bytes()
    (tmp_path / "a.cih").write_bytes(lower.replace(b"EffectiveBit Side : Lower", b"EffectiveBit Side : Higher"))
    assert read_header(tmp_path / "a.cih").encoding == Encoding(16, 0, 0xFFF0)


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


@pytest.mark.parametrize(
    ("name", "path", "keys", "message"),
    [
        ("packed-npy", Url("https://example.org/a"), {}, "is a URL, which cannot be followed"),
        ("swissspad-half", Url("https://example.org/a"), {}, "is a URL, which cannot be followed"),
        ("packed-npy", "a.npy.gz", {}, r"a\.npy\.gz is unpacked, so that no frame can be read before all are there"),
        (
            "npy",
            "last.npy",
            {"holds": "bits", "frame_axis": "last"},
            "frames along the last axis, so that none is whole before all are written",
        ),
    ],
)
def test_capture_that_cannot_be_followed_is_refused(
    tmp_path: Path, name: str, path: str | Url, keys: dict[str, Any], message: str
) -> None:
    (tmp_path / "a.npy.gz").write_bytes(b"\x1f\x8b")
    np.save(tmp_path / "last.npy", np.zeros((18, 27, 7), np.uint8))
    with pytest.raises(InputError, match=message):
        arrived(name, path=path if isinstance(path, Url) else tmp_path / path, **keys)
