"""Captures that are damaged or something else: what each source says, and that it says it before a run."""

from __future__ import annotations

import json
import os
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from scipy.io import savemat

from photonpano import FrameSpan, InputError, Source, SourceContext, discover

CATALOG = discover()
HALF, FULL, DENSE, SPARSE = "swissspad-half", "swissspad-full", "spad512", "spad512-sparse"
FRAME_BYTES = {HALF: 16384, FULL: 32768, DENSE: 32768}


def _read(source: Source, span: FrameSpan) -> None:
    with source:
        source.counts(span)


def refusal(name: str, n_frames: int = 1, checked: bool = True, **keys: Any) -> str:
    """Return what a source says when it is opened, or reads its first frames; the check must say it too where it can."""
    contribution = CATALOG.find("source", name).contribution
    config = contribution.config.model_validate(keys)
    with pytest.raises(InputError) as caught:
        _read(contribution.build(config, SourceContext()), FrameSpan(0, n_frames))
    assert list(contribution.check(config)) == ([str(caught.value)] if checked else [])
    return str(caught.value)


def fill(folder: Path, sizes: Mapping[str, int]) -> None:
    for name, size in sizes.items():
        (folder / name).write_bytes(bytes(size))


@pytest.mark.parametrize("name", [HALF, FULL, DENSE])
def test_bin_files_with_a_partial_frame_are_refused(tmp_path: Path, name: str) -> None:
    frame = FRAME_BYTES[name]
    more = ", with or without 4 more" if name == DENSE else ""
    for size in (0, 3 * frame - 1, 3 * frame + 5):
        fill(tmp_path, {"f1.bin": 4 * frame, "f2.bin": size})
        assert refusal(name, path=tmp_path) == (
            f"{tmp_path / 'f2.bin'} has {size:,} bytes, which is not a whole number of frames of {frame:,} bytes{more}; it is "
            "cut short, or of another camera: copy it again, or choose another source"
        )
    assert sorted(path.name for path in tmp_path.iterdir()) == ["f1.bin", "f2.bin"]


@pytest.mark.parametrize("name", [HALF, FULL, DENSE])
def test_bin_files_of_different_length_are_refused(tmp_path: Path, name: str) -> None:
    frame = FRAME_BYTES[name]
    advice = "only the last file of a capture may hold fewer: copy it again, or take out the files of other captures"
    fill(tmp_path, {"f1.bin": 4 * frame, "f2.bin": 3 * frame, "f10.bin": 4 * frame})
    assert refusal(name, path=tmp_path) == f"{tmp_path / 'f2.bin'} holds 3 frames and f1.bin, the first, 4; {advice}"
    fill(tmp_path, {"f2.bin": 4 * frame, "f10.bin": 5 * frame})
    assert refusal(name, path=tmp_path) == f"{tmp_path / 'f10.bin'} holds 5 frames and f1.bin, the first, 4; {advice}"


@pytest.mark.parametrize("name", [HALF, FULL, DENSE, SPARSE])
def test_folders_without_frames_are_refused(tmp_path: Path, name: str) -> None:
    advice = f"there is no .bin file in the folder {tmp_path}; check the path"
    assert refusal(name, path=tmp_path) == advice
    fill(tmp_path, {"notes.txt": 10, "._filename0.bin": 10})
    assert refusal(name, path=tmp_path) == advice
    assert refusal(name, path=tmp_path / "x") == f"there is no file or folder {tmp_path / 'x'}; check the path"


def test_truncated_sparse_frames_are_refused(tmp_path: Path) -> None:
    path = tmp_path / "sparse.bin"
    for content in (b"", b"\0", np.array([5, 262144, 7], "<u4").tobytes(), np.array([262144], "<u4").tobytes() + b"\0"):
        path.write_bytes(content)
        assert refusal(SPARSE, path=path) == (
            f"{path} does not end with the end of a frame, the uint32 262144; it is cut short, or not sparse: copy it again, "
            "or choose another source"
        )


def test_sparse_addresses_outside_the_frame_are_refused(tmp_path: Path) -> None:
    path = tmp_path / "sparse.bin"
    path.write_bytes(np.array([5, 262144, 262145, 262144], "<u4").tobytes())
    assert refusal(SPARSE, checked=False, path=path) == (
        f"{path} names the pixel 262145 at byte 8, and the last of a frame is 262143; it is damaged, or not sparse: copy it "
        "again, or choose another source"
    )


def test_sparse_addresses_may_be_unordered_and_repeated(tmp_path: Path) -> None:
    path = tmp_path / "sparse.bin"
    path.write_bytes(np.array([700, 5, 700, 262144, 262144, 5, 262144], "<u4").tobytes())
    contribution = CATALOG.find("source", SPARSE).contribution
    with contribution.build(contribution.config(path=path), SourceContext()) as source:
        counts = source.counts(FrameSpan(0, 3))
        assert (counts[0, 5], counts[1, 700 - 512], counts.sum()) == (2, 1, 3)
        np.testing.assert_array_equal(source.frames(FrameSpan(0, 3)).sum(axis=0), counts)


def test_file_that_shrinks_while_read_is_refused(tmp_path: Path) -> None:
    path = tmp_path / "frames.bin"
    fill(tmp_path, {"frames.bin": 10 * 16384})
    contribution = CATALOG.find("source", HALF).contribution
    with contribution.build(contribution.config(path=path), SourceContext()) as source:
        os.truncate(path, 5 * 16384)
        assert not source.counts(FrameSpan(0, 5)).any()
        with pytest.raises(InputError) as caught:
            source.counts(FrameSpan(0, 6))
    assert str(caught.value) == f"{path} has become shorter while it was read; copy or record it again"


FRAMES = np.random.default_rng(0).integers(0, 2, (6, 10, 16), dtype=np.uint8)


@pytest.fixture
def mat_folder(tmp_path: Path) -> Path:
    for number in (1, 2, 3):
        savemat(tmp_path / f"part_{number}.mat", {"OUTPUT": np.moveaxis(FRAMES, 0, -1)})
    return tmp_path


def test_missing_mat_parts_are_refused(mat_folder: Path) -> None:
    (mat_folder / "part_2.mat").unlink()
    message = f"there is no part_2.mat in the folder {mat_folder}, which has 3 parts; copy it again"
    assert refusal("mat-parts", path=mat_folder) == message
    for path in mat_folder.iterdir():
        path.unlink()
    assert refusal("mat-parts", path=mat_folder) == f"there is no part_1.mat in the folder {mat_folder}; check the path"
    path = mat_folder / "x"
    assert refusal("mat-parts", path=path) == f"there is no folder {path}; name the folder of part_1.mat and so on"


def test_contradicting_info_json_is_refused(mat_folder: Path) -> None:
    info = mat_folder / "info.json"

    def said(**content: Any) -> str:
        info.write_text(json.dumps(content))
        return refusal("mat-parts", checked="no_frames" not in content or content["no_parts"] != 3, path=mat_folder)

    assert said(no_parts=4, no_frames=18) == (
        f"there is no part_4.mat in the folder {mat_folder}, which has 4 parts; copy it again"
    )
    assert said(no_parts=2, no_frames=18) == f"{info} speaks of 2 parts, and there is a part_3.mat; correct it"
    assert said(no_parts=3, no_frames=20) == (
        f"{info} speaks of 20 frames, and the parts hold 18; correct it, or copy the parts again"
    )
    assert said(no_parts=3) == f"{info} is wrong at no_frames: Field required; write it again"
    for agreed in (18, 6):
        info.write_text(json.dumps({"no_parts": 3, "no_frames": agreed}))
        contribution = CATALOG.find("source", "mat-parts").contribution
        with contribution.build(contribution.config(path=mat_folder), SourceContext()) as source:
            assert source.info.n_frames == 18


def test_other_files_as_mat_parts_are_refused(mat_folder: Path) -> None:
    path = mat_folder / "part_2.mat"

    def said() -> str:
        return refusal("mat-parts", 18, checked=False, path=mat_folder)

    path.write_bytes(path.read_bytes()[:100])
    damaged = f"{path} cannot be read as a MATLAB file: it is damaged or something else; copy it again"
    assert said() == damaged
    savemat(path, {"OTHER": 1})
    assert said() == f"{path} has no variable OUTPUT; its frames must be (height, width, frames) of that name"
    savemat(path, {"OUTPUT": np.zeros((2, 2, 2, 2))})
    assert said() == f"{path} has OUTPUT of shape (2, 2, 2, 2); frames are (height, width, frames)"
    savemat(path, {"OUTPUT": np.zeros((4, 5, 6))})
    assert said() == f"{path} holds frames of 4x5 px, and part_1.mat of 10x16; parts of one capture have the same size"
    savemat(path, {"OUTPUT": np.full((10, 16, 6), 2)})
    assert said() == f"{path} holds values other than 0 and 1: its frames are not binary"
    savemat(path, {"OUTPUT": np.moveaxis(FRAMES, 0, -1)}, do_compression=True)
    path.write_bytes(path.read_bytes()[:-20])
    assert said() == damaged


TRANSFORMS = {"h": 10, "w": 16, "bitpack": True, "bitpack_dim": 2, "file_path": "frames.npy", "frames": [{}] * 6}
PROMISE = "holds frames of shape (10, 2), and the transforms.json beside it promises"
WRONG_TRANSFORMS: dict[str, tuple[dict[str, Any], str]] = {
    "height": ({"h": 0}, "{json} is wrong at h: Input should be greater than or equal to 1; write it again"),
    "dimension": ({"bitpack_dim": 3}, "{json} is wrong at bitpack_dim: Input should be 1 or 2; write it again"),
    "no dimension": (
        {"bitpack_dim": None},
        "{json} says that frames are packed, but not along which dimension; add bitpack_dim: 1 or 2",
    ),
    "two dimensions": (
        {"frames": [{"bitpack_dim": 1}] + [{}] * 5},
        "{json} describes frames that are packed along different dimensions, which this source cannot read",
    ),
    "other dimension": (
        {"bitpack_dim": 1},
        "{npy} " + PROMISE + " (2, 16, 1); correct its h, w, c, bitpack or bitpack_dim",
    ),
    "width": ({"w": 17}, "{npy} " + PROMISE + " (10, 3, 1); correct its h, w, c, bitpack or bitpack_dim"),
    "colour": ({"c": 3}, "{json} says that frames have c: 3; choose a channel: 0, 1 or 2"),
    "no frames": (
        {"frames": []},
        "{json} is wrong at frames: Tuple should have at least 1 item after validation, not 0; write it again",
    ),
    "more frames": (
        {"frames": [{}] * 7},
        "{json} lists frame 6 of frames.npy, which has 6; write it again",
    ),
    "no file": ({"file_path": None}, "{json} names no file_path; add that of the .npy file"),
    "another file": ({"file_path": "other.npy"}, "there is no file {folder}/other.npy; check the path"),
    "images": ({"file_path": "frames.png"}, "{json} names frames.png, not a .npy file; convert the images with visionsim"),
}


@pytest.fixture
def visionsim_folder(tmp_path: Path) -> Path:
    np.save(tmp_path / "frames.npy", np.packbits(FRAMES, axis=2))
    (tmp_path / "transforms.json").write_text(json.dumps(TRANSFORMS))
    return tmp_path


@pytest.mark.parametrize("case", WRONG_TRANSFORMS)
def test_contradicting_transforms_json_is_refused(visionsim_folder: Path, case: str) -> None:
    changes, message = WRONG_TRANSFORMS[case]
    path = visionsim_folder / "transforms.json"
    path.write_text(json.dumps(TRANSFORMS | changes))
    expected = message.format(json=path, npy=visionsim_folder / "frames.npy", folder=visionsim_folder)
    assert refusal("visionsim", path=visionsim_folder) == expected


def test_invalid_transforms_json_is_refused(visionsim_folder: Path) -> None:
    path = visionsim_folder / "transforms.json"
    path.write_text("{")
    assert refusal("visionsim", path=path) == (
        f"{path} is wrong: Invalid JSON: EOF while parsing an object at line 1 column 1; write it again"
    )
    path.unlink()
    assert refusal("visionsim", path=path) == f"there is no file {path}; check the path"


def test_visionsim_frames_that_are_not_binary_are_refused(visionsim_folder: Path) -> None:
    np.save(visionsim_folder / "frames.npy", FRAMES * 7)
    path = visionsim_folder / "transforms.json"
    path.write_text(json.dumps(TRANSFORMS | {"bitpack": False}))
    assert refusal("visionsim", 6, checked=False, path=path) == (
        f"{path} describes frames with values other than 0, 1 and 255: they are not binary"
    )
    np.save(visionsim_folder / "frames.npy", FRAMES.astype(float))
    npy = visionsim_folder / "frames.npy"
    assert refusal("visionsim", path=path) == f"{npy} holds float64 values; binary frames are uint8 or bool in C order"


@pytest.fixture
def ubicept_file(tmp_path: Path) -> Callable[..., Path]:
    """Write a capture of two frames, with one thing about it that is different."""
    h5py = pytest.importorskip("h5py")

    def write(frame: np.ndarray = FRAMES[0], metadata: str = '{"num_integrated_binary_frames": 3}', name: str = "1") -> Path:
        path = tmp_path / "capture.ubi.h5"
        with h5py.File(path, "w") as file:
            for each in ("0", name):
                file[f"raw/{each}"] = frame if each == "1" else FRAMES[0]
                file[f"raw/{each}"].attrs["metadata"] = metadata
        return path

    return write


def test_wrong_ubicept_files_are_refused(tmp_path: Path, ubicept_file: Callable[..., Path]) -> None:
    h5py = pytest.importorskip("h5py")

    def said(path: Path) -> str:
        return refusal("ubicept-h5", 2, checked=False, path=path).removeprefix(str(path))

    assert said(ubicept_file(metadata="{}")) == (" does not contain the number of binary frames of each sum; set binary_frames")
    assert said(ubicept_file(FRAMES[0] + 3)) == (
        " holds uint8 values up to 4 in frame 1, which cannot be the sum of 3 binary frames, as uint8; correct binary_frames, "
        "or copy the file again"
    )
    damaged = " cannot be read as a .ubi.h5 file: it is damaged or something else; copy it again"
    assert said(ubicept_file(metadata="{")) == damaged
    assert said(ubicept_file(FRAMES[0, :5])) == damaged
    path = ubicept_file()
    path.write_bytes(path.read_bytes()[:-100])
    assert said(path) == damaged
    with h5py.File(path, "w") as file:
        file["raw/first"] = FRAMES
    assert said(path) == " has no group of frames, that is, datasets with numbers as names; choose another source"
    with h5py.File(path, "w") as file:
        file["raw/0"] = FRAMES
    assert said(path) == " holds frames of shape (6, 10, 16); they are (height, width) or (height, width, 1, 1)"
    with h5py.File(path, "w") as file:
        file["raw/0"] = FRAMES[0].astype(float)
    assert said(path) == " holds float64 values; sums of binary frames are uint8 or uint16"
    path.write_bytes(b"no HDF5")
    assert list(CATALOG.find("source", "ubicept-h5").contribution.check(_config(path))) == [
        f"{path} is not an HDF5 file, by its first bytes; copy it again, or choose another source"
    ]


def _config(path: Path) -> Any:
    return CATALOG.find("source", "ubicept-h5").contribution.config(path=path)
