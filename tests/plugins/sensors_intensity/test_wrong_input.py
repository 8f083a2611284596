"""Captures of grey levels that cannot be used: the exact message of a run, and nothing left behind."""

from __future__ import annotations

import importlib.util
import re
import shutil
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path

import cv2
import numpy as np
import pytest
import tifffile
from typer.testing import CliRunner

from photonpano.cli.app import app

REAL = Path(__file__).parents[2] / "data" / "photron"
SPEC = "version: 1\nsource: {{use: {use}, with: {{path: {path}{more}}}}}\nresample: {{with: {{group_size: 1}}}}\nlevels: 1\n"
AT_CHECK = "DIR/spec.yaml:2:1: source: {}\nerror: the spec has 1 problem\n"
AT_OPENING = "error: {}\n"
MDAT = (
    "DIR/a.mdat is compressed by the camera, and only Photron's own library for Windows decodes it; "
    "export it as AVI or MP4 in the camera's viewer, and read that with the source video"
)


@dataclass(frozen=True)
class Case:
    """A capture that cannot be used.

    Attributes:
        use: the source.
        path: what the spec names, in a folder DIR.
        arrange: puts files into the folder.
        golden: what is printed.
        more: more keys.
    """

    use: str
    path: str
    arrange: Callable[[Path], object]
    golden: str
    more: str = ""


def beam(old: bytes = b"", new: bytes = b"") -> Callable[[Path], None]:
    """Copy a recording, with something in its header replaced."""

    def arrange(folder: Path) -> None:
        content = (REAL / "beam.cihx").read_bytes()
        assert old in content
        (folder / "a.cihx").write_bytes(content.replace(old, new))
        shutil.copy(REAL / "beam.mraw", folder / "a.mraw")

    return arrange


def cut_mraw(folder: Path) -> None:
    beam()(folder)
    (folder / "a.mraw").write_bytes((REAL / "beam.mraw").read_bytes()[:-100])


def pictures(*images: np.ndarray, suffix: str = "png") -> Callable[[Path], None]:
    def arrange(folder: Path) -> None:
        for number, image in enumerate(images):
            cv2.imwrite(str(folder / f"{number}.{suffix}"), image)

    return arrange


def files(**contents: bytes) -> Callable[[Path], None]:
    def arrange(folder: Path) -> None:
        for name, content in contents.items():
            (folder / name.replace("_", ".")).write_bytes(content)

    return arrange


def two_sizes_of_pages(folder: Path) -> None:
    with tifffile.TiffWriter(folder / "a.tif") as writer:
        writer.write(np.zeros((4, 6), np.uint8))
        writer.write(np.zeros((5, 6), np.uint8))


SMALL, LARGE = np.zeros((4, 6), np.uint8), np.zeros((5, 6), np.uint8)
CASES = {
    "bits a pixel that Photron does not write": Case(
        "fastcam-mraw",
        "a.cihx",
        beam(b"<bit>16</bit>", b"<bit>10</bit>"),
        AT_CHECK.format("DIR/a.cihx: pixels of 10 bits cannot be read, only of 8, 12 or 16"),
    ),
    "colour": Case(
        "fastcam-mraw",
        "a.cihx",
        beam(b"<bit>16</bit>", b"<bit>48</bit>"),
        AT_CHECK.format(
            "DIR/a.cihx: pixels of 48 bits cannot be read, only of 8, 12 or 16; "
            "colour is not supported: save the recording as raw or monochrome"
        ),
    ),
    "more effective bits than bits": Case(
        "fastcam-mraw",
        "a.cihx",
        beam(b"<bit>16</bit>", b"<bit>8</bit>"),
        AT_CHECK.format("DIR/a.cihx: pixels of 8 bits cannot hold 12 effective ones"),
    ),
    "no width": Case(
        "fastcam-mraw",
        "a.cihx",
        beam(b"imageDataInfo", b"imageDataInf"),
        AT_CHECK.format(
            "DIR/a.cihx lacks 'imageDataInfo/colorInfo/bit'; check that it is the header of a recording, and complete"
        ),
    ),
    "a width that is none": Case(
        "fastcam-mraw",
        "a.mraw",
        beam(b"<width>1024</width>", b"<width>-4</width>"),
        AT_CHECK.format("DIR/a.cihx: 'imageDataInfo/resolution/width' must be a whole number above 0, got -4"),
    ),
    "pictures instead of raw frames": Case(
        "fastcam-mraw",
        "a.cihx",
        beam(b"<fileFormat>Mraw<", b"<fileFormat>Tiff<"),
        AT_CHECK.format(
            "DIR/a.cihx belongs to a recording of the format Tiff, not MRaw; "
            "read .avi files with the source video, .tif and .png files with image-folder"
        ),
    ),
    "a header that is cut off": Case(
        "fastcam-mraw",
        "a.cihx",
        beam(b"</cih>", b""),
        AT_CHECK.format("DIR/a.cihx is no header of a Photron camera: it has no part between <cih> and </cih>"),
    ),
    "frames cut short": Case(
        "fastcam-mraw",
        "a.cihx",
        cut_mraw,
        AT_CHECK.format(
            "DIR/a.mraw is cut short: 4 frames of 80x1024 pixels of 16 bits, as a.cihx promises, are 655360 bytes, "
            "the file has 655260; copy or record it again"
        ),
    ),
    "no header": Case(
        "fastcam-mraw",
        "a.mraw",
        files(a_mraw=b"1234"),
        AT_CHECK.format(
            "DIR/a.mraw has no .cihx or .cih file beside it, with the size and the bits of its frames; copy it too"
        ),
    ),
    "no frames": Case(
        "fastcam-mraw",
        "a.cih",
        files(a_cih=b"1234"),
        AT_CHECK.format("DIR/a.cih has no .mraw file beside it, which holds the frames; copy it from the camera too"),
    ),
    "no recording": Case("fastcam-mraw", "a.cih", files(), AT_CHECK.format("there is no file DIR/a.cih; check the path")),
    "an Infinicam file as a recording": Case("fastcam-mraw", "a.mdat", files(a_mdat=b"1234"), AT_CHECK.format(MDAT)),
    "an Infinicam file as a video": Case("video", "a.mdat", files(a_mdat=b"1234"), AT_CHECK.format(MDAT)),
    "the header of an Infinicam file": Case("fastcam-mraw", "a.cih", files(a_mdat=b"1234", a_cih=b""), AT_CHECK.format(MDAT)),
    "black above white": Case(
        "fastcam-mraw",
        "a.cihx",
        beam(),
        AT_OPENING.format(
            "black_level 5000 and white_level 4095 do not suit levels of 12 bits: "
            "black must be below white, and white at most 4095"
        ),
        ", response: {black_level: 5000}",
    ),
    "no video": Case("video", "a.mp4", files(), AT_CHECK.format("there is no file DIR/a.mp4; check the path")),
    "something else than a video": Case(
        "video",
        "a.mp4",
        files(a_mp4=b"not a video" * 100),
        AT_OPENING.format(
            "DIR/a.mp4 is not a video that FFmpeg reads, or its end is missing (Invalid data found when processing input); "
            "export or copy it again"
        ),
    ),
    "no folder": Case("image-folder", "there", files(), AT_CHECK.format("there is no file DIR/there; check the path")),
    "an empty folder": Case(
        "image-folder",
        "there",
        lambda folder: (folder / "there").mkdir(),
        AT_CHECK.format("DIR/there holds no .png or .tif files; name the folder that the frames are in"),
    ),
    "pictures of two sizes": Case(
        "image-folder",
        ".",
        pictures(SMALL, SMALL, LARGE),
        AT_CHECK.format(
            "DIR/2.png has 5x6 pixels of 8 bits, and DIR/0.png has 4x6 pixels of 8 bits; "
            "all frames must have one size: remove other pictures"
        ),
    ),
    "pictures of two depths": Case(
        "image-folder",
        ".",
        pictures(SMALL, SMALL.astype(np.uint16), suffix="tif"),
        AT_CHECK.format(
            "DIR/1.tif has 4x6 pixels of 16 bits, and DIR/0.tif has 4x6 pixels of 8 bits; "
            "all frames must have one size: remove other pictures"
        ),
    ),
    "pages of two sizes": Case(
        "image-folder",
        "a.tif",
        two_sizes_of_pages,
        AT_CHECK.format(
            "page 1 of DIR/a.tif has 5x6 pixels of 8 bits, and page 0 of DIR/a.tif has 4x6 pixels of 8 bits; "
            "all frames must have one size: remove other pictures"
        ),
    ),
    "pictures in colour": Case(
        "image-folder",
        ".",
        pictures(np.zeros((4, 6, 3), np.uint8)),
        AT_CHECK.format("DIR/0.png has colours; convert the frames to grey"),
    ),
    "pictures in colour as TIFF": Case(
        "image-folder",
        ".",
        pictures(np.zeros((4, 6, 3), np.uint8), suffix="tif"),
        AT_CHECK.format("DIR/0.tif has colours, or white as 0; convert the frames to grey"),
    ),
    "a file that is no picture": Case(
        "image-folder",
        ".",
        files(a_png=b"1234"),
        AT_CHECK.format("DIR/a.png is not a PNG file, by its first bytes; remove it, or save it again"),
    ),
    "a dark capture": Case(
        "image-folder",
        ".",
        pictures(*[SMALL] * 8),
        "error: DIR/spec.yaml:2:1: source: no pixel is brighter than black in any of 8 frames sampled all over the capture; "
        "check that the file is the right one, and that the lens was open\n",
    ),
    "a saturated capture": Case(
        "image-folder",
        ".",
        pictures(*[SMALL + 255] * 8),
        "error: DIR/spec.yaml:2:1: source: every pixel is saturated in all of 8 frames sampled all over the capture, "
        "so the flux cannot be estimated; check the layout of the file, or expose less\n",
    ),
}


@pytest.mark.parametrize("case", CASES.values(), ids=CASES)
def test_run_refuses_wrong_capture_and_leaves_no_files(tmp_path: Path, case: Case) -> None:
    if case.use == "video":
        pytest.importorskip("av")
    case.arrange(tmp_path)
    run(tmp_path, case.use, case.path, case.golden, case.more)


def test_truncated_video_is_refused(moving: Callable, write_video: Callable, tmp_path: Path) -> None:
    """An AVI file promises its frames at its beginning; the end of an MP4 file is its index."""
    video = write_video(moving(), "a.avi", "mjpeg", "yuvj420p")
    content = video.read_bytes()
    video.write_bytes(content[: len(content) // 2])
    golden = "DIR/a.avi is cut short: it promises 40 frames and holds #; export or copy it again"
    run(tmp_path, "video", "a.avi", AT_OPENING.format(golden))


def test_missing_library_is_named_with_its_extra(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    there = importlib.util.find_spec
    monkeypatch.setattr(importlib.util, "find_spec", lambda name, *more: None if name == "av" else there(name, *more))
    (tmp_path / "a.mp4").write_bytes(b"1234")
    missing = (
        "the source 'video' needs av, which is not installed: "
        'pip install "photonpano[video]" (in a checkout: pip install ".[video]")'
    )
    golden = f"DIR/spec.yaml:2:15: source.use: {missing}\nerror: the spec has 1 problem\n"
    run(tmp_path, "video", "a.mp4", golden)


def run(folder: Path, use: str, path: str, golden: str, more: str = "") -> None:
    (folder / "spec.yaml").write_text(SPEC.format(use=use, path=path, more=more))
    before = sorted(folder.rglob("*"))
    result = CliRunner().invoke(app, ["run", str(folder / "spec.yaml")])
    expected = re.escape(golden.replace("DIR/.", f"{folder}").replace("DIR", str(folder))).replace(r"\#", r"\d+")
    assert re.fullmatch(expected, result.stderr), result.stderr
    assert (result.exit_code, result.stdout) == (1 if golden.startswith("error: ") else 2, "")
    assert sorted(folder.rglob("*")) == before
