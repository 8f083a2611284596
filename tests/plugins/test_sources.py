"""Every source that comes with photonpano keeps what sources promise."""

from __future__ import annotations

import json
from collections.abc import Callable
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest
import tifffile

from photonpano import StreamInfo, discover
from photonpano.testing import SourceConformance

CATALOG = discover()
NO_FILE = {"path": "there-is-no-such-file"}
SMALL = {"scene": {"kind": "street", "width": 160, "height": 107}, "n_frames": 30, "frame_shape": [32, 40]}
PAN = {"kind": "pan", "length_px": 40}
CIH = """#Camera Information Header
Record Rate(fps) : 500
Total Frame : {0}
Image Width : {2}
Image Height : {1}
Color Type : Mono
Color Bit : {3}
File Format : MRaw
EffectiveBit Depth : {3}
EffectiveBit Side : Lower
"""


def of(kit: type[SourceConformance], name: str, **attributes: Any) -> type[SourceConformance]:
    """Return the tests of a source; keys, frames and wrong keys are attributes of its kit."""
    return type(name, (kit,), {"contribution": CATALOG.find("source", name).contribution, **attributes})


def frames_last(frames: np.ndarray) -> np.ndarray:
    return np.ascontiguousarray(np.moveaxis(frames, 0, -1))


TestSimulator = of(
    SourceConformance,
    "simulator",
    config={
        **SMALL,
        "path": PAN | {"shake": {"rms_px": 1}},
        "sensor": {"hot_fraction": 0.01, "mask_hot_pixels": True},
    },
    wrong=(
        {"scene": {"kind": "photo", "file": "there-is-no-such-file.png"}},
        {"path": {"kind": "file", "file": "there-is-no-such-file.npz"}},
        {"sensor": {"hot_pixels": "there-is-no-such-file.npy"}},
        {"path": {"kind": "pan", "length_px": 4000}},
    ),
)
TestDisturbedSimulator = of(
    SourceConformance,
    "simulator",
    config={
        **SMALL,
        "path": PAN,
        "lens": {"k1": -0.05, "vignette": 0.5},
        "objects": [{"size": [0.3, 0.5], "moves_px": [0.5, 0]}],
        "drops": [{"at": 10, "frames": 5}],
        "repeats": [{"at": 20, "frames": 3}],
        "sensor": {"gain_std": 0.05, "dirt": {}},
        "drift": 0.5,
    },
    wrong=({"drops": [{"at": 25, "frames": 20}]},),
)
CAMERA = {**SMALL, "path": {"kind": "pan", "length_px": 60}, "sensor": {"exposure": 0.5}}
TestConventionalCamera = of(
    SourceConformance, "camera-simulator", config=CAMERA, wrong=({"path": {"kind": "pan", "length_px": 4000}},)
)
TestConventionalCameraOf12Bits = of(SourceConformance, "camera-simulator", config=CAMERA | {"sensor": {"bits": 12}})
TestTravelSimulator = of(
    SourceConformance,
    "travel-simulator",
    config={
        "scene": {"kind": "planes"},
        "path": {"kind": "travel", "length_m": 0.3, "tremor": {"rms_px": 1}},
        "objects": [{"shape": "disc", "moves_px": [0.2, 0]}],
        "n_frames": 30,
        "frame_shape": [32, 40],
        "focal_px": 32,
        "drops": [{"at": 10, "frames": 5}],
        "sensor": {"hot_fraction": 0.01, "mask_hot_pixels": True},
    },
    wrong=(
        {"scene": {"kind": "room", "photo": "there-is-no-such-file.png"}},
        {"path": {"kind": "travel", "length_m": 40}},
        {"path": {"kind": "turn-only", "degrees": 200}},
        {"drops": [{"at": 25, "frames": 20}]},
        {"sensor": {"hot_pixels": "there-is-no-such-file.npy"}},
    ),
)


class InOneFile(SourceConformance):
    """A .npy file of what `stored` makes of frames."""

    wrong = (NO_FILE,)

    def stored(self, frames: np.ndarray) -> np.ndarray:
        return frames

    def write(self, frames: np.ndarray, folder: Path) -> dict[str, Any]:
        np.save(folder / "capture.npy", self.stored(frames))
        return {"path": folder / "capture.npy"}


TestPackedNpy = of(
    InOneFile,
    "packed-npy",
    config={"width": 27},
    wrong=(NO_FILE, {"width": 33}),
    stored=lambda _, frames: np.packbits(frames, axis=-1),
)
TestPackedNpyInColour = of(
    InOneFile,
    "packed-npy",
    config={"width": 27},
    wrong=(NO_FILE, {"width": 33}),
    stored=lambda _, frames: np.repeat(np.packbits(frames, axis=-1)[..., None], 3, axis=-1),
)
BITS, SUMS = {"holds": "bits"}, {"holds": "sums", "frames_per_sum": 1023}
LAST = {"frame_axis": "last"}
TestNpyBits = of(InOneFile, "npy", config=BITS, stored=lambda _, frames: frames.astype(bool))
TestNpyBitsInColour = of(InOneFile, "npy", config=BITS, stored=lambda _, frames: np.repeat(frames[..., None], 3, axis=-1))
TestNpyBitsFramesLast = of(
    InOneFile, "npy", config=BITS | LAST, grows=False, stored=lambda _, frames: frames_last(frames * np.uint8(255))
)


class InNpz(InOneFile):
    """An array in an .npz file, which is unpacked to a .npy file."""

    def write(self, frames: np.ndarray, folder: Path) -> dict[str, Any]:
        np.savez_compressed(folder / "capture.npz", frames=self.stored(frames), times=np.arange(3))
        return {"path": folder / "capture.npz"}


TestNpyBitsInNpz = of(InNpz, "npy", config=BITS, grows=False, stored=lambda _, frames: frames.astype(bool))
TestPackedInNpz = of(
    InNpz, "packed-npy", config={"width": 27}, grows=False, stored=lambda _, frames: np.packbits(frames, axis=-1)
)
TestNpySums = of(InOneFile, "npy", config=SUMS, bit_depth=10, stored=lambda _, frames: frames.astype(">i8"))
TestNpySumsFramesLast = of(
    InOneFile, "npy", config=SUMS | LAST, bit_depth=10, grows=False, stored=lambda _, frames: frames_last(frames)
)


class TestPackedRaw(SourceConformance):
    contribution = CATALOG.find("source", "packed-raw").contribution
    config = {"height": 18, "width": 27, "bit_order": "little", "header_bytes": 5}
    wrong = (NO_FILE, {"height": 1000}, {"header_bytes": 4})

    def write(self, frames: np.ndarray, folder: Path) -> dict[str, Any]:
        packed = np.packbits(frames, axis=-1, bitorder="little")
        (folder / "capture.raw").write_bytes(b"12345" + packed.tobytes())
        return {"path": folder / "capture.raw"}


class SpikeDat(SourceConformance):
    contribution = CATALOG.find("source", "spike-dat").contribution
    frame_shape = (18, 28)
    config = {"frame_shape": [18, 28]}
    wrong = (NO_FILE, {"frame_shape": [1000, 1000]})

    def write(self, frames: np.ndarray, folder: Path) -> dict[str, Any]:
        (folder / "capture.dat").write_bytes(np.packbits(frames.ravel(), bitorder="little").tobytes())
        return {"path": folder / "capture.dat"}


class TestSpikeDat(SpikeDat):
    pass


class TestSpikeDatInWholeBytes(SpikeDat):
    frame_shape = (18, 32)
    config = {"frame_shape": [18, 32]}


class ZarrConformance(SourceConformance):
    wrong = (NO_FILE, {"width": 80})
    compressed = False

    def write(self, frames: np.ndarray, folder: Path) -> dict[str, Any]:
        if self.compressed:
            pytest.importorskip("numcodecs", reason="compression needs photonpano[zarr]")
        array = folder / "cube.zarr"
        array.mkdir()
        info = StreamInfo(len(frames), *frames.shape[1:], 96800)
        packed = np.packbits(frames, axis=-1)
        self.contribution.write(array, info, iter(packed[:, None]), compressed=self.compressed)
        return {"path": array}


TestZarr = of(ZarrConformance, "zarr")
TestCompressedZarr = of(ZarrConformance, "zarr", compressed=True)


class ZarrOfBitsConformance(SourceConformance):
    wrong = (NO_FILE,)

    def write(self, frames: np.ndarray, folder: Path) -> dict[str, Any]:
        zarr = pytest.importorskip("zarr", reason="the array is written by zarr itself")
        chunks = -(-len(frames) // 3), 7, 11
        array = zarr.create_array(
            folder / "bits.zarr", shape=frames.shape, chunks=chunks, dtype=bool, config={"write_empty_chunks": True}
        )
        array[:] = frames.astype(bool)
        return {"path": folder / "bits.zarr", "holds": "bits"}


TestZarrOfBits = of(ZarrOfBitsConformance, "zarr")


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


TestSwissSpadHalf = of(BinConformance, "swissspad-half", frame_shape=(256, 512))
TestSwissSpadFull = of(BinConformance, "swissspad-full")
TestSpad512 = of(BinConformance, "spad512")
TestSpad512Sparse = of(BinConformance, "spad512-sparse")


class EventsConformance(SourceConformance):
    """A list of the photons of all frames."""

    contribution = CATALOG.find("source", "events").contribution
    wrong = (NO_FILE, {"columns": {"when": "frame", "x": "x", "y": "z"}}, {"frame_shape": [9, 27]})
    grows = False
    columns: tuple[str, ...] = ("frame", "x", "y")

    def write(self, frames: np.ndarray, folder: Path) -> dict[str, Any]:
        frame, y, x = np.nonzero(frames)
        path = self.save(folder / "events", dict(zip(self.columns, (frame, x, y), strict=True)))
        return {"path": path, "start": 0, "n_frames": len(frames), "frame_shape": list(self.frame_shape)}

    def save(self, stem: Path, columns: dict[str, np.ndarray]) -> Path:
        np.savez(stem.with_suffix(".npz"), **columns)
        return stem.with_suffix(".npz")


class TestEvents(EventsConformance):
    pass


class TestEventsInFits(EventsConformance):
    columns = "EXPNO", "CHIPX", "CHIPY"
    wrong = (NO_FILE,)

    def save(self, stem: Path, columns: dict[str, np.ndarray]) -> Path:
        fits = pytest.importorskip("astropy.io.fits", reason="FITS needs photonpano[fits]")
        table = [fits.Column(name=name, format="J", array=column) for name, column in columns.items()]
        fits.BinTableHDU.from_columns(table, name="EVENTS").writeto(stem.with_suffix(".fits"))
        return stem.with_suffix(".fits")


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


class VisionsimConformance(SourceConformance):
    wrong = (NO_FILE, {"channel": 0})
    packed_along: int | None = None

    def write(self, frames: np.ndarray, folder: Path) -> dict[str, Any]:
        packing: dict[str, Any] = {"bitpack": False}
        stored = frames * np.uint8(255)
        if self.packed_along is not None:
            packing = {"bitpack": True, "bitpack_dim": self.packed_along}
            stored = np.packbits(frames, axis=self.packed_along)
        np.save(folder / "frames.npy", stored[..., None])
        n_frames, height, width = frames.shape
        camera = {"fl_x": 10, "fl_y": 10, "cx": 5, "cy": 5, "h": height, "w": width, "c": 1, "fps": 1000}
        poses = [{"transform_matrix": np.eye(4).tolist()}] * n_frames
        transforms = camera | {"frames": poses, "file_path": "frames.npy"} | packing
        (folder / "transforms.json").write_text(json.dumps(transforms))
        return {"path": folder / "transforms.json"}


TestVisionsim = of(VisionsimConformance, "visionsim", packed_along=2)
TestVisionsimPackedAlongHeight = of(VisionsimConformance, "visionsim", packed_along=1)
TestVisionsimNotPacked = of(VisionsimConformance, "visionsim")


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


class VideoConformance(SourceConformance):
    """FFV1 loses nothing; a key frame every 12 frames, so that decoding has to begin before what is asked for."""

    wrong = ({"path": "there-is-no-such-file.mp4"}, {"path": "capture.mdat"})

    def write(self, frames: np.ndarray, folder: Path) -> dict[str, Any]:
        import av

        pixels = "gray" if self.bit_depth == 8 else "gray16le"
        with av.open(str(folder / "capture.mkv"), "w") as container:
            stream = container.add_stream("ffv1", rate=30, options={"g": "12"})
            stream.height, stream.width, stream.pix_fmt = *frames.shape[1:], pixels
            for frame in frames:
                container.mux(stream.encode(av.VideoFrame.from_ndarray(frame, format=pixels)))
            container.mux(stream.encode())
        return {"path": folder / "capture.mkv"}


TestVideo = of(VideoConformance, "video", bit_depth=8)
TestVideoOf16Bits = of(VideoConformance, "video", bit_depth=16)


class FastcamConformance(SourceConformance):
    wrong = ({"path": "there-is-no-such-file.cih"},)

    def write(self, frames: np.ndarray, folder: Path) -> dict[str, Any]:
        (folder / "capture.cih").write_text(CIH.format(*frames.shape, self.bit_depth))
        if self.bit_depth == 12:
            first, second = frames.reshape(-1, 2).T
            frames = np.stack([first >> 4, (first & 15) << 4 | second >> 8, second & 255], axis=-1).astype(np.uint8)
        frames.tofile(folder / "capture.mraw")
        return {"path": folder / "capture.cih"}


TestFastcamMraw = of(FastcamConformance, "fastcam-mraw", bit_depth=8)
TestFastcamMrawOf12Bits = of(FastcamConformance, "fastcam-mraw", bit_depth=12)
TestFastcamMrawOf16Bits = of(FastcamConformance, "fastcam-mraw", bit_depth=16)


class PicturesConformance(SourceConformance):
    """Without leading zeros, so that the order of letters is a wrong one; "pages" is one file."""

    bit_depth = 8
    suffix = "png"
    wrong = (NO_FILE,)

    def write(self, frames: np.ndarray, folder: Path) -> dict[str, Any]:
        if self.suffix == "pages":
            tifffile.imwrite(folder / "capture.tif", frames)
            return {"path": folder / "capture.tif"}
        for index, frame in enumerate(frames):
            cv2.imwrite(str(folder / f"frame{index}.{self.suffix}"), frame)
        return {"path": folder}


TestImageFolder = of(PicturesConformance, "image-folder")
TestImageFolderOf16Bits = of(PicturesConformance, "image-folder", bit_depth=16)
TestImageFolderOfTiff = of(PicturesConformance, "image-folder", bit_depth=16, suffix="tif")
TestPagesOfTiff = of(PicturesConformance, "image-folder", suffix="pages")
