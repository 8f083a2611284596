"""The components of this plugin keep what every component of their kinds promises."""

from __future__ import annotations

import json
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from photonpano import discover
from photonpano.testing import SourceConformance

CATALOG = discover()
NO_FILE = {"path": "there-is-no-such-file"}


class BinConformance(SourceConformance):
    """Two files of which the second is shorter."""

    n_frames = 13
    frame_shape = (512, 512)
    wrong = (NO_FILE,)

    @pytest.fixture(autouse=True)
    def _capture(self, tmp_path: Path, bin_file: Callable[[str, np.ndarray], bytes]) -> None:
        self.bin_file = bin_file
        self.prepare(tmp_path)

    def write(self, frames: np.ndarray, folder: Path) -> dict[str, Any]:
        for number, part in ((2, frames[:8]), (10, frames[8:])):
            (folder / f"filename{number}.bin").write_bytes(self.bin_file(self.contribution.name, part))
        return {"path": folder, "frame_rate_hz": 96800}


class TestSwissSpadHalf(BinConformance):
    contribution = CATALOG.find("source", "swissspad-half").contribution
    frame_shape = (256, 512)


class TestSwissSpadFull(BinConformance):
    contribution = CATALOG.find("source", "swissspad-full").contribution


class TestSpad512(BinConformance):
    contribution = CATALOG.find("source", "spad512").contribution


class TestSpad512Sparse(BinConformance):
    contribution = CATALOG.find("source", "spad512-sparse").contribution


class TestMatParts(SourceConformance):
    contribution = CATALOG.find("source", "mat-parts").contribution
    wrong = (NO_FILE,)

    def write(self, frames: np.ndarray, folder: Path) -> dict[str, Any]:
        parts = np.array_split(frames, 3)
        for number, part in enumerate(parts, start=1):
            self.save(folder / f"part_{number}.mat", part)
        (folder / "info.json").write_text(json.dumps({"no_parts": len(parts), "no_frames": len(frames)}))
        return {"path": folder, "frame_rate_hz": 96800}

    def save(self, path: Path, frames: np.ndarray) -> None:
        from scipy.io import savemat

        savemat(path, {"OUTPUT": np.moveaxis(frames, 0, -1)}, do_compression=True)


class TestMatPartsOfMatlab73(TestMatParts):
    def save(self, path: Path, frames: np.ndarray) -> None:
        h5py = pytest.importorskip("h5py")
        with h5py.File(path, "w", userblock_size=512) as file:
            file["OUTPUT"] = frames.swapaxes(1, 2)
        with path.open("r+b") as file:
            file.write(b"MATLAB 7.3 MAT-file")


class TestVisionsim(SourceConformance):
    contribution = CATALOG.find("source", "visionsim").contribution
    wrong = (NO_FILE, {"channel": 0})

    def write(self, frames: np.ndarray, folder: Path) -> dict[str, Any]:
        stored, packing = self.stored(frames)
        np.save(folder / "frames.npy", stored[..., None])
        n_frames, height, width = frames.shape
        camera = {"fl_x": 10, "fl_y": 10, "cx": 5, "cy": 5, "h": height, "w": width, "c": 1, "fps": 1000}
        poses = [{"transform_matrix": np.eye(4).tolist()}] * n_frames
        transforms = camera | {"frames": poses, "file_path": "frames.npy"} | packing
        (folder / "transforms.json").write_text(json.dumps(transforms))
        return {"path": folder / "transforms.json"}

    def stored(self, frames: np.ndarray) -> tuple[np.ndarray, dict[str, Any]]:
        return np.packbits(frames, axis=2), {"bitpack": True, "bitpack_dim": 2}


class TestVisionsimPackedAlongHeight(TestVisionsim):
    def stored(self, frames: np.ndarray) -> tuple[np.ndarray, dict[str, Any]]:
        return np.packbits(frames, axis=1), {"bitpack": True, "bitpack_dim": 1}


class TestVisionsimNotPacked(TestVisionsim):
    def stored(self, frames: np.ndarray) -> tuple[np.ndarray, dict[str, Any]]:
        return frames * np.uint8(255), {"bitpack": False}


class TestUbiceptH5(SourceConformance):
    contribution = CATALOG.find("source", "ubicept-h5").contribution
    bit_depth = 4
    wrong = (NO_FILE,)

    def write(self, frames: np.ndarray, folder: Path) -> dict[str, Any]:
        h5py = pytest.importorskip("h5py")
        with h5py.File(folder / "capture.ubi.h5", "w") as file:
            group = file.create_group("capture_integrated/raw_hdf5")
            for index, frame in enumerate(frames):
                group[f"{7 + index}"] = frame[..., None, None]
                group[f"{7 + index}"].attrs["metadata"] = json.dumps({"num_integrated_binary_frames": 15})
        return {"path": folder / "capture.ubi.h5"}
