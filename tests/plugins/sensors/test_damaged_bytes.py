"""Whatever bytes a file begins with, sources raise nothing but InputError, which names the file."""

from __future__ import annotations

import json
import os
import random
from collections.abc import Callable
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest
import tifffile
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st
from scipy.io import savemat

from photonpano import FrameSpan, InputError, SourceContext, discover
from photonpano_sensors.intensity.pictures import read_header

CATALOG = discover()
PHOTRON = Path(__file__).parents[2] / "data" / "photron"
BEAM, CIH = (PHOTRON / "beam.cihx").read_bytes(), (PHOTRON / "sample_60k_16bit.cih").read_bytes()
FRAMES = np.random.default_rng(0).integers(0, 2, (3, 10, 16), dtype=np.uint8)
GREY = (np.random.default_rng(1).random((6, 48, 64)) * 255).astype(np.uint8)
SAMPLE = 30  # damaged pictures and films of each kind; `tests/benchmarks/fuzz.py` reads thousands
TRANSFORMS = {"h": 10, "w": 16, "c": 1, "fps": 9.5, "bitpack": True, "bitpack_dim": 2, "file_path": "frames.npy"}
JSON = st.recursive(
    st.none()
    | st.booleans()
    | st.integers()
    | st.floats()
    | st.text(max_size=5)
    | st.sampled_from(["frames.npy", 1, 2, 10, 16]),
    lambda values: st.lists(values, max_size=3) | st.dictionaries(st.sampled_from([*TRANSFORMS, "frames", "offset"]), values),
    max_leaves=12,
)
few = settings(deadline=None, max_examples=40, suppress_health_check=[HealthCheck.function_scoped_fixture])


def read(name: str, path: Path) -> str:
    """Read some frames, and return the sentence that refuses the capture; empty if nothing is found to be wrong."""
    contribution = CATALOG.find("source", name).contribution
    config = contribution.config(path=path)
    contribution.recognise(path)
    problems = list(contribution.check(config))
    try:
        with contribution.build(config, SourceContext()) as source:
            assert not problems, problems
            assert min(source.info.frame_shape) > 0
            source.frames(FrameSpan(0, 1))
            source.counts(FrameSpan(0, min(source.info.n_frames, 12)))
    except InputError as error:
        return str(error)
    return ""


def changed(content: bytes, changes: dict[int, int]) -> bytes:
    damaged = bytearray(content)
    for place, value in changes.items():
        damaged[place % len(content)] = value
    return bytes(damaged)


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Hold a capture of each kind that has a header."""
    folder = tmp_path_factory.mktemp("fuzz")
    np.save(folder / "frames.npy", np.packbits(FRAMES, axis=2))
    for name, compressed in (("whole.mat", False), ("compressed.mat", True)):
        savemat(folder / name, {"TEXT": "text", "OUTPUT": np.moveaxis(FRAMES, 0, -1)}, do_compression=compressed)
    return folder


@few
@given(content=st.binary(max_size=64) | st.lists(st.integers(0, 262145)).map(lambda words: np.array(words, "<u4").tobytes()))
@pytest.mark.parametrize("name", ["swissspad-half", "swissspad-full", "spad512", "spad512-sparse"])
def test_bin_source_raises_input_error_on_random_bytes(folder: Path, name: str, content: bytes) -> None:
    path = folder / "frames.bin"
    path.write_bytes(content)
    read(name, path)


@few
@given(kept=st.integers(0, 20_000), info=st.none() | JSON, compressed=st.booleans())
def test_mat_parts_raises_input_error_on_truncated_file(folder: Path, kept: int, info: Any, compressed: bool) -> None:
    """Other bytes are not changed: scipy may end the process for some of these."""
    parts = folder / "parts"
    parts.mkdir(exist_ok=True)
    content = (folder / ("compressed.mat" if compressed else "whole.mat")).read_bytes()
    (parts / "part_1.mat").write_bytes(content[: kept % len(content)])
    (parts / "info.json").unlink(missing_ok=True)
    if info is not None:
        (parts / "info.json").write_text(json.dumps(info))
    read("mat-parts", parts)


def write_hdf5(path: Path, metadata: Any, frames: np.ndarray = FRAMES) -> Path:
    with pytest.importorskip("h5py").File(path, "w") as file:
        for index, frame in enumerate(frames):
            file[f"raw/{index}"] = frame
            file[f"raw/{index}"].attrs["metadata"] = json.dumps(metadata)
    return path


@pytest.fixture(scope="module")
def hdf5(folder: Path) -> bytes:
    return write_hdf5(folder / "capture.ubi.h5", {"num_integrated_binary_frames": 3}).read_bytes()


@few
@given(kept=st.integers(0, 20_000), start=st.binary(max_size=12))
def test_ubicept_raises_input_error_on_truncated_file(folder: Path, hdf5: bytes, kept: int, start: bytes) -> None:
    """Or begin with something else. Other bytes are not changed: the HDF5 library ends the process for some of these."""
    path = folder / "capture.ubi.h5"
    path.write_bytes((start + hdf5[len(start) :])[: kept % len(hdf5)])
    read("ubicept-h5", path)


def damaged(content: bytes, rng: random.Random) -> bytes:
    data = bytearray(content)
    for _ in range(rng.choice((1, 2, 8))):
        at = rng.randrange(min(len(data), rng.choice((64, 512, 4096, len(data)))))
        data[at] = rng.choice((0, 255, rng.randrange(256)))
    return bytes(data[: rng.randrange(len(data)) if rng.random() < 0.2 else None])


@pytest.mark.parametrize("kind", ["png", "tif", "pages", "avi", "mkv", "mp4"])
def test_damaged_file_raises_input_error_only(tmp_path: Path, write_video: Callable[..., Path], kind: str) -> None:
    path = tmp_path / "capture" / f"film.{kind}"
    path.parent.mkdir()
    if kind == "png":
        cv2.imwrite(str(path), GREY[0])
    elif kind in ("tif", "pages"):
        frames = GREY[0] if kind == "tif" else GREY
        tifffile.imwrite(path, frames, photometric="minisblack", compression="zlib")
    else:
        film = write_video(GREY, path.name, {"avi": "mpeg4", "mkv": "ffv1", "mp4": "mpeg4"}[kind], "yuv420p")
        path.write_bytes(film.read_bytes())
    source = "video" if kind in ("avi", "mkv", "mp4") else "image-folder"
    content, capture = path.read_bytes(), path.parent if kind in ("png", "tif") else path
    assert read(source, capture) == ""
    for number in range(SAMPLE):
        path.write_bytes(damaged(content, random.Random(f"{number} {kind}")))
        sentence = read(source, capture)
        assert not sentence or str(tmp_path) in sentence


PIECES = [b"-1", b"1e999", b"\xb2", b"<cih>", b"&x;", b" : "]  # beside bytes by chance


@st.composite
def headers(draw: st.DrawFn, whole: bytes) -> bytes:
    """Draw a header of which parts were overwritten, cut out or repeated."""
    content = bytearray(whole)
    for _ in range(draw(st.integers(1, 4))):
        start = draw(st.integers(0, len(content)))
        stop = min(len(content), start + draw(st.integers(0, 40)))
        content[start:stop] = draw(st.binary(max_size=20) | st.sampled_from(PIECES))
    return bytes(content)


@pytest.mark.parametrize(("suffix", "whole"), [(".cihx", BEAM), (".cih", CIH)])
@settings(
    max_examples=int(os.environ.get("FUZZ_EXAMPLES", "150")),
    deadline=None,
    derandomize="FUZZ_EXAMPLES" not in os.environ,
    suppress_health_check=[HealthCheck.too_slow, HealthCheck.data_too_large, HealthCheck.function_scoped_fixture],
)
@given(data=st.data())
def test_damaged_header_raises_input_error_only(folder: Path, suffix: str, whole: bytes, data: st.DataObject) -> None:
    texts = st.text(max_size=300).map(lambda text: f"<cih>{text}</cih>".encode())
    path = folder / f"a{suffix}"
    path.write_bytes(data.draw(headers(whole) | st.binary(max_size=300) | texts))
    try:
        header = read_header(path)
    except InputError:
        return
    assert header.n_frames > 0
    assert header.frame_bytes > 0
    assert header.encoding.black < header.encoding.white < 2**header.encoding.bits
    assert header.frame_rate_hz is None or header.frame_rate_hz > 0


def test_xml_entities_are_not_expanded(tmp_path: Path) -> None:
    """A document type is cut off, or makes the header a damaged one."""
    entities = b'<!DOCTYPE a [<!ENTITY a "999"><!ENTITY b "&a;&a;"><!ENTITY c "&b;&b;">]>'
    bomb = BEAM.replace(b"<cih>", entities + b"<cih>", 1).replace(b"<width>1024</width>", b"<width>&c;</width>")
    (tmp_path / "a.cihx").write_bytes(bomb)
    with pytest.raises(InputError, match="undefined entity"):
        read_header(tmp_path / "a.cihx")
