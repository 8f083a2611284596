"""Sources know their own captures, and leave those of others alone."""

from __future__ import annotations

import gzip
import json
import shutil
from collections.abc import Callable
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest
import tifffile
from scipy.io import savemat

from photonpano import FrameSpan, InputError, Recognised, Source, SourceContext, discover
from photonpano.photometry import BinaryResponse

NAMES = (
    "packed-npy npy zarr swissspad-half swissspad-full spad512 spad512-sparse mat-parts visionsim ubicept-h5 "
    "spike-dat video fastcam-mraw image-folder events"
)
CATALOG = discover()
SOURCES = {name: CATALOG.find("source", name).contribution for name in NAMES.split()}
PHOTRON = Path(__file__).parents[2] / "data" / "photron"
FRAMES = np.random.default_rng(0).integers(0, 2, (6, 10, 16), dtype=np.uint8)


def recognised(path: Path) -> dict[str, Recognised]:
    """Return who takes a path for its own."""
    answers = {name: source.recognise(path) for name, source in SOURCES.items()}
    return {name: answer for name, answer in answers.items() if answer is not None}


def reasons(path: Path) -> dict[str, str]:
    """Return who takes a path for its own, and why; and check that the keys are a config of theirs."""
    found = recognised(path)
    assert all(SOURCES[name].config.model_validate(answer.keys).path == path for name, answer in found.items())
    return {name: answer.because for name, answer in found.items()}


def opened(name: str, keys: Any) -> Source:
    source = SOURCES[name]
    return source.build(source.config.model_validate(dict(keys)), SourceContext())


def recorded(flux: np.ndarray, n_frames: int, seed: int = 0) -> np.ndarray:
    """Return frames of a camera that stands still, 4 % of whose pixels are hot."""
    rng = np.random.default_rng(seed)
    lit = np.where(rng.random(flux.shape) < 0.04, 1, BinaryResponse().mean_count(flux)).astype(np.float32)
    return np.stack([rng.random(flux.shape, np.float32) < lit for _ in range(n_frames)]).astype(np.uint8)


@pytest.mark.parametrize("brightness", [1.0, 0.05])
@pytest.mark.parametrize(("name", "rows"), [("swissspad-half", 256), ("swissspad-full", 512)])
def test_swissspad_arrays_are_distinguished_by_correlation(
    tmp_path: Path, bin_file: Callable, street: np.ndarray, name: str, rows: int, brightness: float
) -> None:
    frames = recorded(street[100 : 100 + rows, 300:812] * brightness, 512 * 256 // rows)
    for number in (2, 10):
        (tmp_path / f"filename{number}.bin").write_bytes(bin_file(name, frames))
    for path in (tmp_path, tmp_path / "filename2.bin"):
        found = recognised(path)
        assert set(found) == {name}
        with opened(name, found[name].keys) as source:
            np.testing.assert_array_equal(source.frames(FrameSpan(0, 3)), frames[:3])


def test_smooth_scenes_of_swissspad_are_told_by_the_borders_of_zones(tmp_path: Path, bin_file: Callable) -> None:
    rng = np.random.default_rng(3)
    scene = cv2.GaussianBlur(rng.standard_normal((512, 512)), (0, 0), 12)
    lit = (-np.expm1(-0.1 * np.exp(scene / scene.std() / 4))).astype(np.float32)
    for name, rows in (("swissspad-half", 256), ("swissspad-full", 512)):
        path = tmp_path / f"{name}.bin"
        frames = [rng.random((rows, 512), np.float32) < lit[:rows] for _ in range(512 * 256 // rows)]
        path.write_bytes(bin_file(name, np.array(frames, np.uint8)))
        assert set(recognised(path)) == {name}


@pytest.mark.parametrize("n_frames", [256, 1000])
def test_spad512_is_recognised_by_file_size(tmp_path: Path, n_frames: int) -> None:
    path = tmp_path / "frames.bin"
    path.write_bytes(bytes(n_frames * 32768 + 4 * (n_frames == 256)))
    assert set(recognised(path)) == {"spad512"}
    with opened("spad512", recognised(path)["spad512"].keys) as source:
        assert source.info.n_frames == n_frames


def test_spad512_sparse_is_recognised_by_last_word(tmp_path: Path, bin_file: Callable) -> None:
    frames = np.random.default_rng(0).random((4, 512, 512)) < 0.01
    (tmp_path / "sparse.bin").write_bytes(bin_file("spad512-sparse", frames))
    assert set(recognised(tmp_path)) == {"spad512-sparse"}


@pytest.mark.parametrize("shape", [(250, 400), (1000, 1000), (480, 640), (360, 640), (396, 640)])
def test_spike_dat_is_recognised_by_rows_and_frames_that_are_alike(
    tmp_path: Path, street: np.ndarray, shape: tuple[int, int]
) -> None:
    scene = cv2.resize(street[:400, :640], shape[::-1])
    frames = recorded(scene, 60)  # whole frames of 250x400 px in any shape
    (tmp_path / "capture.dat").write_bytes(np.packbits(frames.ravel(), bitorder="little").tobytes())
    keys = {"path": str(tmp_path / "capture.dat"), "frame_shape": list(shape)}
    assert recognised(tmp_path / "capture.dat")["spike-dat"].keys == keys
    (tmp_path / "noise.dat").write_bytes(np.random.default_rng(0).bytes(1_000_000))
    assert not recognised(tmp_path / "noise.dat")


def test_packed_npy_is_recognised_by_header(tmp_path: Path) -> None:
    np.save(tmp_path / "cube.npy", np.packbits(FRAMES, axis=-1))
    found = recognised(tmp_path / "cube.npy")
    assert set(found) == {"packed-npy"}
    assert found["packed-npy"].because == "uint8 of shape (6, 10, 2) in a .npy file"
    (tmp_path / "cube.npy.gz").write_bytes(gzip.compress((tmp_path / "cube.npy").read_bytes()))
    assert set(recognised(tmp_path / "cube.npy.gz")) == {"packed-npy"}
    np.save(tmp_path / "colour.npy", np.repeat(np.packbits(FRAMES, axis=-1)[..., None], 3, axis=-1))
    found = recognised(tmp_path / "colour.npy")
    assert found["packed-npy"].keys == {"path": str(tmp_path / "colour.npy")}
    assert found["packed-npy"].because == "uint8 of shape (6, 10, 2, 3) in a .npy file, in three channels"
    bits = np.repeat(np.tile(FRAMES, (2, 1, 1))[..., None], 3, axis=-1)
    np.save(tmp_path / "bits.npy", bits)
    assert recognised(tmp_path / "bits.npy")["npy"].keys == {"path": str(tmp_path / "bits.npy"), "holds": "bits"}


@pytest.mark.parametrize("dtype", [bool, np.uint8, np.int32])
def test_unpacked_bits_are_recognised_by_their_values(tmp_path: Path, dtype: Any) -> None:
    path = tmp_path / "cube.npy"
    np.save(path, FRAMES.astype(dtype))
    found = recognised(path)
    assert set(found) == {"npy"}
    assert found["npy"].keys == {"path": str(path), "holds": "bits"}
    name = np.dtype(dtype).name
    assert found["npy"].because == f"{name} of shape (6, 10, 16) in a .npy file, where all of 960 values sampled are 0 or 1"
    with opened("npy", found["npy"].keys) as source:
        np.testing.assert_array_equal(source.frames(source.info.span), FRAMES)
    (tmp_path / "cube.npy.gz").write_bytes(gzip.compress(path.read_bytes()))
    assert set(recognised(tmp_path / "cube.npy.gz")) == {"npy"}


def test_arrays_in_files_of_arrays_are_recognised_as_in_a_npy_file(tmp_path: Path, clouds: Callable[..., np.ndarray]) -> None:
    frames = clouds()
    savemat(tmp_path / "cube.mat", {"OUTPUT": np.moveaxis(frames, 0, -1).astype(float)})
    np.savez(tmp_path / "cube.npz", packed=np.packbits(frames, axis=-1, bitorder="little"), times=np.arange(len(frames)))
    np.savez(tmp_path / "motion.npz", homographies=np.random.default_rng(0).random((40, 3, 3)), located=np.ones(40, np.bool_))
    assert recognised(tmp_path / "cube.mat")["npy"].keys == {"path": str(tmp_path / "cube.mat"), "holds": "bits"}
    found = recognised(tmp_path / "cube.npz")
    assert found["packed-npy"].keys == {"path": str(tmp_path / "cube.npz"), "bit_order": "little"}
    assert recognised(tmp_path / "motion.npz") == {}
    for path, name in (("cube.mat", "npy"), ("cube.npz", "packed-npy")):
        with opened(name, recognised(tmp_path / path)[name].keys) as source:
            np.testing.assert_array_equal(source.frames(FrameSpan(3, 5)), frames[3:5])


@pytest.mark.parametrize(
    ("axis", "bit_order", "keys"),
    [
        (2, "little", {"bit_order": "little"}),
        (1, "big", {"packed_along": "height"}),
        (1, "little", {"packed_along": "height", "bit_order": "little"}),
    ],
)
def test_order_of_packed_pixels_is_recognised(
    tmp_path: Path, clouds: Callable[..., np.ndarray], axis: int, bit_order: Any, keys: dict[str, str]
) -> None:
    frames = clouds()
    np.save(tmp_path / "cube.npy", np.packbits(frames, axis=axis, bitorder=bit_order))
    found = recognised(tmp_path / "cube.npy")
    assert set(found) == {"packed-npy"}
    assert found["packed-npy"].keys == {"path": str(tmp_path / "cube.npy")} | keys
    assert ", where pixels correlate by " in found["packed-npy"].because
    with opened("packed-npy", found["packed-npy"].keys) as source:
        np.testing.assert_array_equal(source.frames(FrameSpan(0, 5)), frames[:5])


@pytest.mark.parametrize(
    "stored",
    [
        lambda frames: frames.reshape(12, 32, 64, 96).sum(axis=1).astype(np.uint8),
        lambda frames: frames.reshape(12, 32, 64, 96).sum(axis=1).astype(np.float32),
        lambda frames: np.ascontiguousarray(np.moveaxis(np.packbits(frames[:, :32, :48], axis=2), 0, -1)),
        lambda frames: np.ascontiguousarray(np.moveaxis(np.packbits(frames[:, :32, :48], axis=1), 0, -1)),
    ],
    ids=["sums", "floats", "packed, frames last", "packed along the height, frames last"],
)
def test_other_layouts_are_not_recognised(tmp_path: Path, clouds: Callable[..., np.ndarray], stored: Callable) -> None:
    np.save(tmp_path / "cube.npy", stored(clouds()))
    assert recognised(tmp_path / "cube.npy") == {}


def test_visionsim_is_recognised_by_transforms_json(tmp_path: Path) -> None:
    np.save(tmp_path / "frames.npy", np.packbits(FRAMES, axis=1))
    np.save(tmp_path / "other.npy", np.packbits(FRAMES, axis=1))
    transforms = {"h": 10, "w": 16, "bitpack_dim": 1, "file_path": "frames.npy", "frames": [{}] * 6}
    (tmp_path / "transforms.json").write_text(json.dumps(transforms))
    for path in (tmp_path, tmp_path / "transforms.json", tmp_path / "frames.npy"):
        found = recognised(path)
        assert set(found) == {"visionsim"}
        with opened("visionsim", found["visionsim"].keys) as source:
            np.testing.assert_array_equal(source.frames(source.info.span), FRAMES)
    assert recognised(tmp_path / "other.npy") == {}


def test_zarr_arrays_are_recognised_packed_or_not(tmp_path: Path, clouds: Callable[..., np.ndarray]) -> None:
    zarr = pytest.importorskip("zarr", reason="the arrays are written by zarr itself")
    frames = clouds()
    sums = frames.reshape(-1, 8, *frames.shape[1:]).sum(axis=1).astype(np.uint8)
    arrays = {"packed": np.packbits(frames, axis=-1), "bits": frames, "bool": frames.astype(bool), "sums": sums}
    for name, array in arrays.items():
        zarr.create_array(tmp_path / f"{name}.zarr", data=array)
    keys = {name: dict(found["zarr"].keys) for name in arrays if (found := recognised(tmp_path / f"{name}.zarr"))}
    paths = {name: {"path": str(tmp_path / f"{name}.zarr")} for name in arrays}
    holds = {"holds": "bits"}
    assert keys == {"packed": paths["packed"], "bits": paths["bits"] | holds, "bool": paths["bool"] | holds}
    for name in keys:
        with opened("zarr", keys[name]) as source:
            np.testing.assert_array_equal(source.frames(FrameSpan(3, 5)), frames[3:5])


def test_parts_of_matlab_with_frames_first_are_read_only_if_that_is_written(
    tmp_path: Path, clouds: Callable[..., np.ndarray]
) -> None:
    frames = clouds()
    for number, part in enumerate(np.array_split(frames, 3), start=1):
        savemat(tmp_path / f"part_{number}.mat", {"OUTPUT": part})
    with pytest.raises(
        InputError, match=r"part_1.mat has its frames along the first axis of \(128, 64, 96\), .* frame_axis: first"
    ):
        opened("mat-parts", {"path": tmp_path})
    with opened("mat-parts", {"path": tmp_path, "frame_axis": "first"}) as source:
        np.testing.assert_array_equal(source.frames(source.info.span), frames)


def test_mat_parts_and_ubicept_are_recognised_by_name(tmp_path: Path) -> None:
    (tmp_path / "part_1.mat").write_bytes(b"anything")
    assert set(recognised(tmp_path)) == {"mat-parts"}
    (tmp_path / "capture.ubi.h5").write_bytes(b"\x89HDF\r\n\x1a\n")
    assert set(recognised(tmp_path / "capture.ubi.h5")) == {"ubicept-h5"}


@pytest.mark.parametrize(
    ("name", "because"),
    [("beam.cihx", "beam.mraw beside it holds the frames"), ("beam.mraw", "beam.cihx beside it is its header")],
)
def test_fastcam_recordings_are_recognised(name: str, because: str) -> None:
    assert reasons(PHOTRON / name) == {"fastcam-mraw": because}


@pytest.mark.parametrize(
    ("name", "codec", "because"),
    [
        ("a.avi", "mjpeg", "by its first bytes it is an AVI file"),
        ("a.mp4", "mpeg4", "by its first bytes it is an MP4 or MOV file"),
        ("a.mkv", "mpeg4", "by its first bytes it is a Matroska or WebM file"),
    ],
)
def test_videos_are_recognised_by_their_first_bytes(
    moving: Callable, write_video: Callable, tmp_path: Path, name: str, codec: str, because: str
) -> None:
    path = write_video(moving(2), name, codec, "yuvj420p" if codec == "mjpeg" else "yuv420p")
    assert reasons(shutil.copy(path, tmp_path / "without-a-suffix")) == {"video": because}


def test_pictures_and_infinicam_files_are_recognised(tmp_path: Path) -> None:
    cv2.imwrite(str(tmp_path / "a.png"), np.zeros((4, 4), np.uint8))
    tifffile.imwrite(tmp_path / "b.tif", np.zeros((2, 4, 4), np.uint8))
    (tmp_path / "c.mdat").touch()
    (tmp_path / "c.cih").touch()
    assert reasons(tmp_path / "b.tif") == {"image-folder": "by its first bytes it is a TIFF file"}
    assert reasons(tmp_path / "c.mdat") == {"fastcam-mraw": "Photron's cameras write .mdat files"}
    assert reasons(tmp_path / "c.cih") == {"fastcam-mraw": "c.mdat beside it holds the frames"}
    (tmp_path / "b.tif").unlink()
    assert reasons(tmp_path) == {"image-folder": "it holds 1 .png file"}
