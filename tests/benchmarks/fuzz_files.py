"""Small valid files of each kind that photonpano reads, and how it reads them; `fuzz.py` damages them."""

from __future__ import annotations

import gzip
import json
from functools import cache
from pathlib import Path

import av
import cv2
import h5py
import numpy as np
import tifffile
from harness import groups, packed, simulator
from scipy.io import savemat

from photonpano import FrameSpan, InputError, SourceContext, discover, evaluate, load_spec, run, simulate
from photonpano.pipeline.components import build_source, open_source
from photonpano.plugins.registry import Catalog
from photonpano.specs import parse_spec

MOST_READ = 2**26  # pixels of a damaged capture that are summed at most
FRAMES = np.random.default_rng(0).integers(0, 2, (64, 24, 32), dtype=np.uint8)
GREY = (np.random.default_rng(1).random((12, 48, 64)) * 255).astype(np.uint8)


def whole(name: str, folder: Path) -> Path:
    """Write a valid file or folder of a kind, and return what is read; all files in the folder may be damaged."""
    bits = np.packbits(FRAMES, axis=2)
    path = folder / "capture"
    match name:
        case "packed-npy":
            np.save(path := folder / "capture.npy", bits)
        case "npy":
            np.save(path := folder / "capture.npy", FRAMES)
        case "npy-gz":
            path = folder / "capture.npy.gz"
            with gzip.open(path, "wb") as archive:
                np.save(archive, bits)
        case "spad512-sparse":
            path = folder / "capture.bin"
            path.write_bytes(np.array([5, 17, 262144, 3, 9, 262144], "<u4").tobytes())
        case "mat5" | "mat5-compressed":
            content = {"TEXT": "text", "OUTPUT": np.moveaxis(FRAMES, 0, -1)}
            savemat(folder / "part_1.mat", content, do_compression=name != "mat5")
            path = folder
        case "mat73":
            with h5py.File(folder / "part_1.mat", "w") as file:
                file.create_dataset("OUTPUT", data=FRAMES.swapaxes(1, 2), chunks=(16, 32, 24), compression="gzip")
            path = folder
        case "ubicept":
            with h5py.File(path := folder / "capture.ubi.h5", "w") as file:
                for index, frame in enumerate(FRAMES[:12]):
                    file.create_dataset(f"raw/{index}", data=frame[..., None, None], chunks=(12, 32, 1, 1), compression="gzip")
                    file[f"raw/{index}"].attrs["metadata"] = '{"num_integrated_binary_frames": 3}'
        case "visionsim":
            np.save(folder / "frames.npy", bits)
            keys = {"h": 24, "w": 32, "c": 1, "fps": 9.5, "bitpack": True, "bitpack_dim": 2, "file_path": "frames.npy"}
            (folder / "transforms.json").write_text(json.dumps(keys | {"frames": [{}] * 64}))
            path = folder
        case "mraw-cih" | "mraw-cihx":
            data = Path(__file__).parents[1] / "data" / "photron"
            header = data / ("beam.cihx" if name == "mraw-cihx" else "sample_60k_16bit.cih")
            path = folder / f"a{header.suffix}"
            path.write_bytes(header.read_bytes())
            (folder / "a.mraw").write_bytes(bytes(7_913_472) if name == "mraw-cih" else (data / "beam.mraw").read_bytes())
        case "png":
            for index, frame in enumerate(GREY[:4]):
                cv2.imwrite(str(folder / f"{index}.png"), frame)
            path = folder
        case "tiff-folder":
            for index, frame in enumerate(GREY[:4]):
                tifffile.imwrite(folder / f"{index}.tif", frame, compression=None if index % 2 else "zlib")
            path = folder
        case "tiff" | "tiff-zlib":
            path = folder / "capture.tif"
            tifffile.imwrite(path, GREY, compression=None if name == "tiff" else "zlib", photometric="minisblack")
        case "avi" | "mkv" | "mp4":
            path = folder / f"capture.{name}"
            _film(path, {"avi": "mpeg4", "mkv": "ffv1", "mp4": "libx264"}[name])
        case "mask" | "mask-png" | "dark":
            np.save(folder / "capture.npy", bits)
            if name == "mask-png":
                cv2.imwrite(str(folder / "mask.png"), FRAMES[0] * 255)
            elif name == "mask":
                np.save(folder / "mask.npy", FRAMES[0].astype(bool))
            else:
                np.savez_compressed(folder / "dark.npz", rates=np.full((24, 32), 1e-3), n_frames=np.array(9))
        case "spec":
            np.save(folder / "capture.npy", bits)
            path = folder / "scan.yaml"
            path.write_text(SPEC)
        case "truth" | "run":
            _make_run(folder)
        case _:
            raise ValueError(name)
    return path


SPEC = """\
version: 1
source: &source {use: packed-npy, with: {path: capture.npy, frame_rate_hz: 96800}}
corrections: [rot90, {crop: {rows: [2, null]}}, still-pixels]
resample: {use: midpoint, with: {group_size: 4}}
locate: {use: chain-of-backends, with: {backends: [direct, {use: opencv-sift, with: {min_inliers: 12}}]}}
levels:
  - {scale: 0.5}
  - {locate: {use: direct}}
render: {scale: 2.0, reference: middle}
output: {directory: runs/scan}
run: {seed: 0, threads: auto, memory: 2 GiB}
"""
FIXED = {"mask": ("capture.npy",), "mask-png": ("capture.npy",), "dark": ("capture.npy",), "spec": ("capture.npy",)}
"""Files that are not damaged, since another kind does."""
SOURCES = {
    **{"mat5": "mat-parts", "mat5-compressed": "mat-parts", "mat73": "mat-parts", "ubicept": "ubicept-h5"},
    **{"packed-npy": "packed-npy", "npy": "npy", "npy-gz": "packed-npy", "spad512-sparse": "spad512-sparse"},
    **{"visionsim": "visionsim", "mraw-cih": "fastcam-mraw", "mraw-cihx": "fastcam-mraw"},
    **{"png": "image-folder", "tiff-folder": "image-folder", "tiff": "image-folder", "tiff-zlib": "image-folder"},
    **{"avi": "video", "mkv": "video", "mp4": "video"},
}
KINDS = [*SOURCES, "mask", "mask-png", "dark", "spec", "truth", "run"]


def _film(path: Path, codec: str) -> None:
    with av.open(str(path), "w") as container:
        stream = container.add_stream(codec, rate=30)
        stream.height, stream.width, stream.pix_fmt = 48, 64, "gray" if codec == "ffv1" else "yuv420p"
        for frame in GREY:
            container.mux(stream.encode(av.VideoFrame.from_ndarray(frame, "gray").reformat(format=stream.pix_fmt)))
        container.mux(stream.encode())


def _make_run(folder: Path) -> None:
    scene, path = {"kind": "street", "width": 300, "height": 200}, {"kind": "pan", "length_px": 20}
    capture = simulator(scene=scene, path=path, flux=1, n_frames=120, frame_shape=[64, 96])
    simulate(parse_spec(capture), folder / "cube.npy")
    run(parse_spec(packed(folder / "cube.npy", levels=1, resample=groups(30)), output=folder / "run"))


def read(name: str, path: Path, folder: Path) -> None:
    """Read files of a kind as the program does.

    Raises:
        PhotonpanoError: they are refused.
    """
    if name in SOURCES:
        _read_source(SOURCES[name], path)
    elif name in ("mask", "mask-png", "dark"):
        file = {"mask": "mask.npy", "mask-png": "mask.png", "dark": "dark.npz"}[name]
        keys = {"dark-counts": {"dark": file}} if name == "dark" else {"mask": {"file": file}}
        source = {"use": "packed-npy", "with": {"path": "capture.npy"}}
        plan = parse_spec({"version": 1, "source": source, "corrections": [keys]}, directory=folder, catalog=_catalog())
        with build_source(plan):
            pass
    elif name == "spec":
        plan = load_spec(path, catalog=_catalog())
        with open_source(plan):
            pass
    else:
        evaluate(folder / "run", folder / "cube.truth.npz", oracle=False)
        from photonpano.record.run_json import read_record

        parse_spec(read_record(folder / "run")["spec"], catalog=_catalog())


@cache
def _catalog() -> Catalog:
    return discover()


def _read_source(use: str, path: Path) -> None:
    for entry in _catalog().rows:
        if entry.kind == "source":
            entry.contribution.recognise(path)
    contribution = _catalog().find("source", use).contribution
    config = contribution.config(path=path, **({"holds": "bits"} if use == "npy" else {}))
    if problems := list(contribution.check(config)):
        raise InputError(problems[0])
    with contribution.build(config, SourceContext()) as source:
        info = source.info
        assert min(info.n_frames, info.height, info.width) > 0
        most = max(1, MOST_READ // (info.height * info.width))
        source.frames(FrameSpan(0, 1))
        source.counts(FrameSpan(0, min(info.n_frames, most)))
