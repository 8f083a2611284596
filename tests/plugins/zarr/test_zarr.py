from __future__ import annotations

from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest

from photonpano import FrameSpan, InputError, SourceContext, StreamInfo, Url, discover
from photonpano_zarr import source as zarr_source
from photonpano_zarr.configs import ZarrConfig

ZARR = discover().find("source", "zarr").contribution
FRAMES = np.random.default_rng(0).integers(0, 2, (53, 6, 19), dtype=np.uint8)
PACKED = np.packbits(FRAMES, axis=-1)


def opened(path: Path, **keys: Any) -> Any:
    return ZARR.build(ZarrConfig(path=path, **keys), SourceContext())


@pytest.fixture
def written(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Any:
    """Write an array in chunks of ten frames."""
    monkeypatch.setattr(zarr_source, "_CHUNK_BYTES", 10 * 6 * 3)

    def written(compressed: bool = False, blocks: tuple[int, ...] = (7, 30)) -> Path:
        if compressed:
            pytest.importorskip("numcodecs", reason="compression needs photonpano[zarr]")
        path = tmp_path / ("compressed.zarr" if compressed else "cube.zarr")
        path.mkdir()
        ZARR.write(path, StreamInfo(53, 6, 19, 96800), np.split(PACKED, blocks), compressed=compressed)
        return path

    return written


@pytest.mark.parametrize("compressed", [False, True])
@pytest.mark.parametrize("blocks", [(), (10, 20), (1, 2, 3, 52), (7, 30)])
def test_frames_are_those_that_were_written(written: Any, compressed: bool, blocks: tuple[int, ...]) -> None:
    with opened(written(compressed, blocks)) as source:
        assert source.info == StreamInfo(53, 6, 19, 96800)
        for span in (FrameSpan(0, 53), FrameSpan(9, 11), FrameSpan(50, 53)):
            np.testing.assert_array_equal(source.frames(span), FRAMES[span.start : span.stop])
            np.testing.assert_array_equal(source.packed(span), PACKED[span.start : span.stop])
            np.testing.assert_array_equal(source.counts(span), FRAMES[span.start : span.stop].sum(axis=0))


@pytest.mark.parametrize("compressed", [False, True])
def test_zarr_python_reads_what_is_written(written: Any, compressed: bool) -> None:
    zarr = pytest.importorskip("zarr", reason="the other reader is not installed")
    array = zarr.open_array(written(compressed), mode="r")
    np.testing.assert_array_equal(array[:], PACKED)
    assert array.chunks == (10, 6, 3)
    assert array.attrs["photonpano"] == {
        "version": 1,
        "kind": "binary",
        "width": 19,
        "bit_order": "big",
        "frame_rate_hz": 96800,
    }


@pytest.mark.parametrize("chunks", [(10, 6, 3), (10, 4, 2), (60, 6, 3), (1, 1, 1)])
@pytest.mark.parametrize("codec", ["none", "zstd", "gzip", "blosc"])
def test_arrays_of_zarr_python_are_read(tmp_path: Path, chunks: tuple[int, ...], codec: str) -> None:
    zarr = pytest.importorskip("zarr", reason="the other writer is not installed")
    codecs = {"none": None, "zstd": zarr.codecs.ZstdCodec(), "gzip": zarr.codecs.GzipCodec(), "blosc": zarr.codecs.BloscCodec()}
    array = zarr.create_array(
        tmp_path / "cube.zarr",
        shape=PACKED.shape,
        chunks=chunks,
        dtype="uint8",
        compressors=codecs[codec],
        config={"write_empty_chunks": True},
    )
    array[:] = PACKED
    with opened(tmp_path / "cube.zarr", width=19, frame_rate_hz=1000) as source:
        assert source.info == StreamInfo(53, 6, 19, 1000)
        np.testing.assert_array_equal(source.frames(FrameSpan(5, 53)), FRAMES[5:])


def test_damaged_chunk_is_named_when_it_is_read(written: Any) -> None:
    path = written(compressed=True)
    chunk = path / "c.3.0.0"
    data = bytearray(chunk.read_bytes())
    data[len(data) // 2] ^= 0x10
    chunk.write_bytes(data)
    with opened(path) as source:
        source.counts(FrameSpan(0, 30))
        with pytest.raises(
            InputError, match=r"c\.3\.0\.0 is damaged: it cannot be decompressed to a chunk of \(10, 6, 3\); copy it again"
        ):
            source.counts(FrameSpan(29, 31))


@pytest.fixture
def foreign(tmp_path: Path) -> Any:
    """Write an array as other programs do, without our attributes."""
    zarr = pytest.importorskip("zarr", reason="the other writer is not installed")

    def foreign(values: np.ndarray) -> Path:
        path = tmp_path / "foreign.zarr"
        array = zarr.create_array(path, shape=values.shape, chunks=(100, *values.shape[1:]), dtype=values.dtype, overwrite=True)
        array[:] = values
        return path

    return foreign


def test_arrays_of_others_are_looked_at(foreign: Any) -> None:
    rng = np.random.default_rng(0)
    clouds = np.exp(cv2.GaussianBlur(rng.standard_normal((64, 96)), (0, 0), 2.5) * 6)
    frames = (rng.random((400, 64, 96)) < 1 - np.exp(-0.3 * clouds)).astype(np.uint8)
    (bits,) = ZARR.check(ZarrConfig(path=foreign(frames)))
    assert bits.endswith("is not packed: its values are 0 and 1; write holds: bits")
    assert ZARR.check(ZarrConfig(path=foreign(np.packbits(frames, axis=-1)))) == ()
    path = foreign(np.packbits(frames, axis=-1, bitorder="little"))
    (little,) = ZARR.check(ZarrConfig(path=path))
    assert "is packed in another order: pixels correlate by" in little
    assert little.endswith("; write bit_order: little, or write bit_order: big if it is right")
    assert ZARR.check(ZarrConfig(path=path, bit_order="little")) == ()


def test_recognises_arrays_and_nothing_else(written: Any, tmp_path: Path) -> None:
    path = written()
    found = ZARR.recognise(path)
    assert found is not None
    assert found.keys == {"path": str(path)}
    for other in (tmp_path, path / "zarr.json", tmp_path / "none.zarr", Url("http://127.0.0.1:1/cube.npy")):
        assert ZARR.recognise(other) is None


@pytest.mark.parametrize("compressed", [False, True])
def test_arrays_are_read_over_http(written: Any, compressed: bool, file_server: Any) -> None:
    path = written(compressed)
    with file_server(path.parent) as server, opened(Url(f"{server.address}/{path.name}")) as source:
        np.testing.assert_array_equal(source.frames(FrameSpan(7, 53)), FRAMES[7:])
    (path / "c.0.0.0").unlink()
    with file_server(path.parent) as server, opened(Url(f"{server.address}/{path.name}")) as source:
        source.counts(FrameSpan(10, 53))
        with pytest.raises(InputError, match=rf"there is no {server.address}/{path.name}/c.0.0.0; check the server"):
            source.counts(FrameSpan(0, 5))


def test_wrong_urls_are_refused(written: Any, file_server: Any) -> None:
    path = written()
    with file_server(path.parent) as server:
        (missing,) = ZARR.check(ZarrConfig(path=Url(f"{server.address}/none.zarr")))
        assert missing == f"there is no {server.address}/none.zarr/zarr.json; check the server or bucket, and the path"
        (path / "zarr.json").rename(path / ".zarray")
        (old,) = ZARR.check(ZarrConfig(path=Url(f"{server.address}/cube.zarr")))
        assert "is zarr version 2" in old
