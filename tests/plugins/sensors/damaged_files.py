"""Captures that are damaged, or something else than their spec says, by the names of the cases."""

from __future__ import annotations

import gzip
import json
import struct
import zlib
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Any, TypeAlias

import cv2
import numpy as np
import pytest
import tifffile
from scipy.io import savemat

from photonpano import StreamInfo, discover

CATALOG = discover()
PHOTRON = Path(__file__).parents[2] / "data" / "photron"
RNG = np.random.default_rng(0)
BITS = RNG.integers(0, 2, (40, 6, 24), dtype=np.uint8)
PACKED = np.packbits(BITS, axis=-1)
FRAMES = RNG.integers(0, 2, (6, 10, 16), dtype=np.uint8)
SMALL, LARGE = np.zeros((4, 6), np.uint8), np.zeros((5, 6), np.uint8)
FRAME_BYTES = {"swissspad-half": 16384, "swissspad-full": 32768, "spad512": 32768}

# Puts a capture into a folder, and returns the keys of its source; the path is the folder by default.
Arrange: TypeAlias = Callable[[Path], dict[str, Any] | None]


def npy(array: np.ndarray, edit: Callable[[bytes], bytes] = bytes, name: str = "cube.npy", **keys: Any) -> Arrange:
    def arrange(folder: Path) -> dict[str, Any]:
        path = folder / name
        with path.open("wb") as file:
            np.save(file, array, allow_pickle=True)
        path.write_bytes(edit(path.read_bytes()))
        return {"path": path} | keys

    return arrange


def last(frames: np.ndarray) -> np.ndarray:
    return np.ascontiguousarray(np.moveaxis(frames, 0, -1))


def changed(array: np.ndarray, value: int, dtype: Any) -> np.ndarray:
    array = array.astype(dtype)
    array[21, 4, 17] = value
    return array


def files(contents: Mapping[str, bytes], path: str = ".", **keys: Any) -> Arrange:
    def arrange(folder: Path) -> dict[str, Any]:
        for name, content in contents.items():
            (folder / name).write_bytes(content)
        return {"path": folder / path} | keys

    return arrange


def zeros(**sizes: int) -> Arrange:
    return files({f"{name}.bin": bytes(size) for name, size in sizes.items()})


def words(*numbers: int, more: bytes = b"") -> Arrange:
    return files({"sparse.bin": np.array(numbers, "<u4").tobytes() + more}, "sparse.bin")


def mat(part: Mapping[str, Any] | None = None, *, cut: int | None = None, **info: int) -> Arrange:
    """Write three parts, with something else in the second, and with an info.json."""

    def arrange(folder: Path) -> None:
        for number in (1, 2, 3):
            savemat(folder / f"part_{number}.mat", {"OUTPUT": last(FRAMES)}, do_compression=cut == -20)
        second = folder / "part_2.mat"
        if part is not None:
            savemat(second, dict(part))
        second.write_bytes(second.read_bytes()[:cut])
        if info:
            (folder / "info.json").write_text(json.dumps(info))

    return arrange


def mat_without_second(folder: Path) -> None:
    mat()(folder)
    (folder / "part_2.mat").unlink()


TRANSFORMS = {"h": 10, "w": 16, "bitpack": True, "bitpack_dim": 2, "file_path": "frames.npy", "frames": [{}] * 6}


def visionsim(stored: np.ndarray | None = None, **changes: Any) -> Arrange:
    def arrange(folder: Path) -> None:
        np.save(folder / "frames.npy", np.packbits(FRAMES, axis=2) if stored is None else stored)
        (folder / "transforms.json").write_text(json.dumps(TRANSFORMS | changes))

    return arrange


def ubicept(
    frame: np.ndarray = FRAMES[0], metadata: str = '{"num_integrated_binary_frames": 3}', cut: int | None = None
) -> Arrange:
    """Write a capture of two frames, with something else about the second."""

    def arrange(folder: Path) -> dict[str, Any]:
        h5py, path = pytest.importorskip("h5py"), folder / "capture.ubi.h5"
        with h5py.File(path, "w") as file:
            for name, each in (("0", FRAMES[0]), ("1", frame)):
                file[f"raw/{name}"] = each
                file[f"raw/{name}"].attrs["metadata"] = metadata
        path.write_bytes(path.read_bytes()[:cut])
        return {"path": path}

    return arrange


def hdf5(name: str, values: np.ndarray) -> Arrange:
    def arrange(folder: Path) -> dict[str, Any]:
        with pytest.importorskip("h5py").File(folder / "capture.ubi.h5", "w") as file:
            file[name] = values
        return {"path": folder / "capture.ubi.h5"}

    return arrange


def zarr(remove: str = "", content: bytes | None = None, width: int | None = None, **changes: Any) -> Arrange:
    """Write an array, with other metadata, and with another content of one of its files."""

    def arrange(folder: Path) -> dict[str, Any]:
        path = folder / "cube.zarr"
        path.mkdir()
        CATALOG.find("source", "zarr").contribution.write(path, StreamInfo(40, 6, 19, 96800), [PACKED], compressed=False)
        metadata = path / "zarr.json"
        metadata.write_text(json.dumps(json.loads(metadata.read_text()) | changes))
        if content is not None:
            (path / remove).write_bytes(content)
        elif remove:
            (path / remove).unlink()
        return {"path": path, "width": width}

    return arrange


def old_zarr(folder: Path) -> dict[str, Any]:
    return zarr("zarr.json")(folder) | files({"cube.zarr/.zarray": b"{}"}, "cube.zarr")(folder)


def zarr_group(folder: Path) -> None:
    zarr()(folder)
    (folder / "zarr.json").write_text(json.dumps({"zarr_format": 3, "node_type": "group"}))


def beam(old: bytes = b"", new: bytes = b"", path: str = "a.cihx", cut: int | None = None, **keys: Any) -> Arrange:
    """Copy a recording, with something in its header replaced."""

    def arrange(folder: Path) -> dict[str, Any]:
        content = (PHOTRON / "beam.cihx").read_bytes()
        assert old in content
        (folder / "a.cihx").write_bytes(content.replace(old, new))
        (folder / "a.mraw").write_bytes((PHOTRON / "beam.mraw").read_bytes()[:cut])
        return {"path": folder / path} | keys

    return arrange


def pictures(*images: np.ndarray, suffix: str = "png") -> Arrange:
    def arrange(folder: Path) -> None:
        for number, image in enumerate(images):
            cv2.imwrite(str(folder / f"{number}.{suffix}"), image)

    return arrange


def png_of(height: int, width: int) -> bytes:
    chunk = b"IHDR" + struct.pack(">IIBBBBB", width, height, 8, 0, 0, 0, 0)
    return b"\x89PNG\r\n\x1a\n" + struct.pack(">I", 13) + chunk + struct.pack(">I", zlib.crc32(chunk)) + b"IDAT"


def pages(*images: np.ndarray, **tags: int) -> Arrange:
    def arrange(folder: Path) -> dict[str, Any]:
        path = folder / "a.tif"
        with tifffile.TiffWriter(path) as writer:
            for image in images:
                writer.write(image, photometric="minisblack", compression="zlib")
        with tifffile.TiffFile(path, mode="r+b") as file:
            for name, value in tags.items():
                file.pages[0].tags[name].overwrite(value)
        return {"path": path}

    return arrange


def stack(image: np.ndarray, cut: int = 0, **options: Any) -> Arrange:
    """Write a TIFF file as ImageJ does: one page, and all frames behind it."""

    def arrange(folder: Path) -> dict[str, Any]:
        path = folder / "a.tif"
        tifffile.imwrite(path, image, **options)
        path.write_bytes(path.read_bytes()[: path.stat().st_size - cut])
        return {"path": path}

    return arrange


BITS_KEYS: dict[str, Any] = {"holds": "bits", "frame_axis": "first"}
SUMS_KEYS: dict[str, Any] = {"holds": "sums", "frames_per_sum": 300, "frame_axis": "first"}
LAST: dict[str, Any] = {"frame_axis": "last"}
ATTRIBUTES: dict[str, Any] = {"version": 1, "width": 30}
CASES: dict[str, Arrange] = {
    "packed-npy of floats": npy(BITS.astype(np.float32)),
    "packed-npy of bool": npy(BITS.astype(bool)),
    "packed-npy of sums": npy(3 * BITS.astype(np.int64)),
    "packed-npy with channels first": npy(np.zeros((3, 4, 6, 2), np.uint8)),
    "packed-npy of two channels": npy(np.zeros((4, 6, 2, 2), np.uint8)),
    "packed-npy without frames": npy(PACKED[:0]),
    "packed-npy in Fortran order": npy(np.asfortranarray(PACKED)),
    "packed-npy cut short": npy(PACKED, lambda data: data[:-100]),
    "packed-npy that is empty": npy(PACKED, lambda _: b""),
    "packed-npy with a damaged header": npy(PACKED, lambda _: b"\x93NUMPY\x01\x00\x10\x00{'descr': broken"),
    "packed-npy without a file": files({}, "cube.npy"),
    "packed-npy of a larger width": npy(PACKED, width=25),
    "packed-npy of unpacked frames": npy(BITS, width=24),
    "packed-npy of another height": npy(PACKED, height=48),
    "packed-npy with a channel": npy(PACKED, channel=2),
    "packed-npy compressed and cut short": npy(PACKED, lambda data: gzip.compress(data)[:-12], "cube.npy.gz"),
    "packed-npy compressed and damaged": npy(PACKED, lambda data: gzip.compress(data)[:-6] + b"wrong!", "cube.npy.gz"),
    "packed-npy compressed, a byte less": npy(PACKED, lambda data: gzip.compress(data[:-1]), "cube.npy.gz"),
    "npy of floats": npy(BITS.astype(np.float32), **BITS_KEYS),
    "npy of floats as sums": npy(BITS.astype(">f8"), **SUMS_KEYS),
    "npy that is flat": npy(BITS[0], **BITS_KEYS),
    "npy in three channels, frames last": npy(np.zeros((6, 8, 4, 3), np.uint8), holds="bits", frame_axis="last"),
    "npy cut short": npy(BITS, lambda data: data[:-100], **BITS_KEYS),
    "npy with a 2 among bits": npy(changed(BITS, 2, np.uint8), **BITS_KEYS),
    "npy with 301 as a sum of 300": npy(changed(BITS, 301, np.uint16), **SUMS_KEYS),
    "npy of sums as bits": npy(BITS + 3, **BITS_KEYS),
    **{
        f"{name} {what}": zeros(f1=4 * size, **{each: frames * size + more for each, (frames, more) in rest.items()})
        for name, size in FRAME_BYTES.items()
        for what, rest in {
            "with an empty file": {"f2": (0, 0)},
            "with a frame cut short": {"f2": (3, -1)},
            "with bytes after a frame": {"f2": (3, 5)},
            "with a short file between": {"f2": (3, 0), "f10": (4, 0)},
            "with a longer file": {"f2": (4, 0), "f10": (5, 0)},
        }.items()
    },
    **{
        f"{name} {what}": arrange
        for name in (*FRAME_BYTES, "spad512-sparse")
        for what, arrange in {
            "in an empty folder": files({}),
            "in a folder of other files": files({"notes.txt": b"0", "._filename0.bin": b"0"}),
            "in no folder": files({}, "x"),
        }.items()
    },
    "spike-dat that fits another shape": files({"cube.dat": bytes(3 * 480 * 640 // 8)}, "cube.dat", frame_shape=[250, 400]),
    "spike-dat that fits no shape": files({"cube.dat": bytes(12_501)}, "cube.dat", frame_shape=[250, 400]),
    "spike-dat without a file": files({}, "cube.dat", frame_shape=[250, 400]),
    "spad512-sparse that is empty": words(),
    "spad512-sparse within a frame": words(5, 262144, 7),
    "spad512-sparse with an address outside": words(5, 262144, 262145, 262144),
    "mat-parts without the second": mat_without_second,
    "mat-parts without the first": files({}),
    "mat-parts, fewer than promised": mat(no_parts=4, no_frames=18),
    "mat-parts with other frames than promised": mat(no_parts=3, no_frames=20),
    "mat-parts with half an info.json": mat(no_parts=3),
    "mat-parts cut short": mat(cut=100),
    "mat-parts without the variable": mat({"OTHER": 1}),
    "mat-parts of two sizes": mat({"OUTPUT": np.zeros((4, 5, 6))}),
    "mat-parts that are not binary": mat({"OUTPUT": np.full((10, 16, 6), 2)}),
    "visionsim without a height": visionsim(h=0),
    "visionsim of two dimensions": visionsim(frames=[{"bitpack_dim": 1}] + [{}] * 5),
    "visionsim of another width": visionsim(w=17),
    "visionsim that is not in colour": visionsim(c=3),
    "visionsim without frames": visionsim(frames=[]),
    "visionsim with too many frames": visionsim(frames=[{}] * 7),
    "visionsim without a name": visionsim(file_path=None),
    "visionsim that is not binary": visionsim(FRAMES * 7, bitpack=False),
    "visionsim that is no JSON": files({"transforms.json": b"{"}, "transforms.json"),
    "visionsim without a file": files({}, "transforms.json"),
    "ubicept-h5 with a large value": ubicept(FRAMES[0] + 3),
    "ubicept-h5 with damaged metadata": ubicept(metadata="{"),
    "ubicept-h5 with a small frame": ubicept(FRAMES[0, :5]),
    "ubicept-h5 cut short": ubicept(cut=-100),
    "ubicept-h5 without frames": hdf5("raw/first", FRAMES),
    "ubicept-h5 that is no HDF5": files({"capture.ubi.h5": b"no HDF5"}, "capture.ubi.h5"),
    "zarr with a short chunk": zarr("c.0.0.0", b"short"),
    "zarr of floats": zarr(data_type="float32"),
    "zarr that is flat": zarr(shape=[40, 18]),
    "zarr of another width in its attributes": zarr(attributes={"photonpano": ATTRIBUTES}),
    "zarr of a newer photonpano": zarr(attributes={"photonpano": ATTRIBUTES | {"version": 2}}),
    "zarr in shards": zarr(codecs=[{"name": "sharding_indexed", "configuration": {}}]),
    "zarr that is no JSON": zarr("zarr.json", b"{"),
    "zarr of version 2": old_zarr,
    "zarr that is a group": zarr_group,
    "fastcam-mraw of 10 bits": beam(b"<bit>16</bit>", b"<bit>10</bit>"),
    "fastcam-mraw in colour": beam(b"<bit>16</bit>", b"<bit>48</bit>"),
    "fastcam-mraw without bits": beam(b"imageDataInfo", b"imageDataInf"),
    "fastcam-mraw of a negative width": beam(b"<width>1024</width>", b"<width>-4</width>", "a.mraw"),
    "fastcam-mraw with half a header": beam(b"</cih>"),
    "fastcam-mraw cut short": beam(cut=-100),
    "fastcam-mraw without a header": files({"a.mraw": b"1234"}, "a.mraw"),
    "fastcam-mraw without a file": files({}, "a.cih"),
    "fastcam-mraw of an Infinicam": files({"a.mdat": b"1234"}, "a.mdat"),
    "fastcam-mraw with black above white": beam(response={"black_level": 5000}),
    "video of an Infinicam": files({"a.mdat": b"1234"}, "a.mdat"),
    "video without a file": files({}, "a.mp4"),
    "video of text": files({"a.mp4": b"not a video" * 100}, "a.mp4"),
    "image-folder without a folder": files({}, "there"),
    "image-folder that is empty": files({}),
    "image-folder of two sizes": pictures(SMALL, SMALL, LARGE),
    "image-folder of two depths": pictures(SMALL, SMALL.astype(np.uint16), suffix="tif"),
    "image-folder in colour": pictures(np.zeros((4, 6, 3), np.uint8)),
    "image-folder of text": files({"a.png": b"1234"}),
    "image-folder of 48 GiB": files({"1.png": png_of(200_000, 250_000)}),
    "image-folder with pages of two sizes": pages(SMALL, LARGE),
    "image-folder with half a stack of ImageJ": stack(np.stack([SMALL] * 9), 100, imagej=True, truncate=True),
    "image-folder with channels": stack(np.stack([[SMALL] * 2] * 9), imagej=True, truncate=True, metadata={"axes": "TCYX"}),
    "image-folder below zero": stack(np.full((9, 4, 6), -7, np.int16)),
    "image-folder of floats": stack(np.zeros((9, 4, 6), np.float16)),
    "image-folder that is to be turned": stack(np.stack([SMALL] * 9), extratags=[("Orientation", "H", 1, 6, True)]),
}
