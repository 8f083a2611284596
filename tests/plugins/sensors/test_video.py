from __future__ import annotations

import contextlib
import pathlib
from concurrent.futures import ThreadPoolExecutor
from fractions import Fraction
from typing import Any

import cv2
import numpy as np
import pytest

from photonpano import FrameSpan, InputError, SourceContext
from photonpano_sensors.intensity.contributions import ImageFolderConfig, ResponseConfig, VideoConfig

pytest.importorskip("av")

from collections.abc import Callable, Iterable
from pathlib import Path

from photonpano_sensors.intensity.pictures import ImageFolderSource
from photonpano_sensors.intensity.video import DecodedFrames, VideoSource, index_of


def opened(path: Path, threads: int = 1, **keys: Any) -> VideoSource:
    return VideoSource(VideoConfig(path=path, **keys), SourceContext(threads=threads))


FORMATS = {
    "H.264 with frames that need later ones": ("a.mp4", "libx264", "yuvj420p", {"g": 12, "bf": 3, "crf": 1}),
    "H.264 in two-frame groups": ("a.mp4", "libx264", "yuvj420p", {"g": 2, "bf": 1, "crf": 1}),
    "H.265 with open groups": (
        "a.mp4",
        "libx265",
        "yuvj420p",
        {"x265-params": "crf=1:keyint=10:open-gop=1:log-level=none"},
    ),
    "MPEG-4 in AVI": ("a.avi", "mpeg4", "yuv420p", {"g": 12, "qscale": 1}),
    "MJPEG in AVI": ("a.avi", "mjpeg", "yuvj420p", {"qmin": 1, "qmax": 1}),
    "H.264 in Matroska": ("a.mkv", "libx264", "yuvj420p", {"g": 12, "bf": 3, "crf": 1}),
}


@pytest.mark.parametrize(("name", "codec", "pixels", "options"), FORMATS.values(), ids=FORMATS)
def test_frames_are_decoded_in_any_order(
    moving: Callable, write_video: Callable, name: str, codec: str, pixels: str, options: dict[str, Any]
) -> None:
    """Each frame is nearer to the one that was written than its neighbours are."""
    written = moving()
    index = index_of(write_video(written, name, codec, pixels, **options))
    assert len(index.times) == len(written)
    decoded = DecodedFrames(index, threads=1, capacity_bytes=0)
    for frame in (39, 0, 17, 18, 5, 38, 23, 11, 12):
        differences = np.abs(written - decoded[frame].astype(int)).mean(axis=(1, 2))
        assert differences.argmin() == frame
        assert differences[frame] < 6
    decoded.close()


@pytest.mark.parametrize(
    ("name", "codec", "pixels", "black", "white"),
    [
        ("a.mkv", "ffv1", "gray", 0, 255),
        ("a.mkv", "ffv1", "yuv420p", 16, 235),
        ("a.mkv", "ffv1", "yuv420p10le", 64, 940),
        ("a.avi", "mjpeg", "yuvj420p", 0, 255),
        ("a.avi", "rawvideo", "yuyv422", 16, 235),
        ("a.avi", "rawvideo", "bgr24", 0, 255),
    ],
)
def test_encoding_has_range_and_bits_of_the_file(
    moving: Callable, write_video: Callable, name: str, codec: str, pixels: str, black: float, white: float
) -> None:
    bits = 10 if "10" in pixels else 8
    frames = moving(3).astype(np.uint16 if bits == 10 else np.uint8) * 2 ** (bits - 8)
    if pixels in ("yuyv422", "bgr24"):
        frames = np.stack([frames] * (2 if pixels == "yuyv422" else 3), axis=-1)
    path = write_video(frames, name, codec, pixels)
    with opened(path) as source:
        assert source.info.bit_depth == bits
        assert (source.response.black_level, source.response.saturation_level) == (black, white)
        if codec != "mjpeg":
            grey = frames[..., 0] if frames.ndim == 4 else frames
            np.testing.assert_array_equal(source.frames(source.info.span), grey)
    with opened(path, response=ResponseConfig(black_level=2, white_level=200)) as source:
        assert (source.response.black_level, source.response.saturation_level) == (2, 200)


@pytest.mark.parametrize("threads", [1, 2, 3])
def test_overlapping_groups_decode_each_frame_about_once(moving: Callable, write_video: Callable, threads: int) -> None:
    """Groups of 20 frames, each beginning at the middle of the one before, merged side by side."""
    path = write_video(moving(200), "a.mp4", "libx264", "yuvj420p", g=50)
    index = index_of(path)
    decoded = DecodedFrames(index, threads, 60 * index.height * index.width)

    def merge(start: int) -> None:
        for frame in range(start, start + 20):
            decoded[frame]

    with ThreadPoolExecutor(threads) as pool:
        list(pool.map(merge, range(0, 190, 10)))
    decoded.close()
    # A thread that falls behind finds what it needs forgotten; each of two groups decoded by itself would be 380 and more.
    assert 200 <= decoded.n_decoded <= (200 if threads == 1 else 360)


def test_truncated_frame_is_refused_when_read(moving: Callable, write_video: Callable) -> None:
    """A file whose packets are all there, and damaged."""
    path = write_video(moving(), "a.mp4", "libx264", "yuvj420p", g=12)
    content = bytearray(path.read_bytes())
    index = index_of(path)
    data = content.find(b"mdat") + 4
    length = int.from_bytes(content[data - 8 : data - 4], "big")
    content[data + length // 2 : data + length - 8] = bytes(length - 8 - length // 2)
    path.write_bytes(content)
    with opened(path) as source:
        assert source.info.n_frames == len(index.times)
        with pytest.raises(InputError, match=rf"^frame \d+ of {path} is damaged or missing; export or copy it again$"):
            source.counts(source.info.span)
        assert source.counts(FrameSpan(0, 1)).any()


@pytest.fixture
def film(tmp_path: Path) -> Callable[..., Path]:
    def film(name: str, frames: Iterable[int] = range(40), levels: int = 200) -> Path:
        """Write an MKV of random levels whose times are those of some frames at 30 Hz."""
        import av

        rng = np.random.default_rng(0)
        with av.open(str(tmp_path / name), "w") as container:
            stream = container.add_stream("ffv1", rate=30)
            stream.width, stream.height, stream.pix_fmt = 64, 48, "gray"
            stream.codec_context.time_base = Fraction(1, 1000)
            for number in frames:
                frame = av.VideoFrame.from_ndarray(rng.integers(0, levels, (48, 64)).astype(np.uint8), format="gray")
                frame.pts, frame.time_base = round(number * 1000 / 30), Fraction(1, 1000)
                container.mux(stream.encode(frame))
            container.mux(stream.encode())
        return tmp_path / name

    return film


def test_matroska_that_is_cut_short_is_refused(film: Callable[..., Path]) -> None:
    whole = film("film.mkv").read_bytes()
    cut = film("cut.mkv")
    cut.write_bytes(whole[: int(0.6 * len(whole))])
    with pytest.raises(InputError, match=r"cut.mkv is cut short: it promises 1.33 s, and its frames end after 0.\d+ s; export"):
        index_of(cut)


def test_gaps_between_frames_are_a_warning(film: Callable[..., Path], caplog: pytest.LogCaptureFixture) -> None:
    gap = film("gap.mkv", [*range(20), *range(25, 40)])
    assert index_of(gap).frame_rate_hz == pytest.approx(30, rel=0.01)
    assert "times of frames have gaps, 1 in all: 200 ms after frame 19, and 33.3 ms elsewhere" in caplog.text
    caplog.clear()
    index_of(film("even.mkv"))
    assert not caplog.text


@pytest.mark.parametrize("codec", ["mpeg4", "mjpeg"])
def test_binary_frames_are_no_grey_levels_after_a_codec_with_loss_either(
    codec: str, write_video: Callable[..., Path], moving: Callable[..., np.ndarray]
) -> None:
    pixels = "yuvj420p" if codec == "mjpeg" else "yuv420p"
    bits = (np.random.default_rng(0).random((12, 48, 64)) < 0.4).astype(np.uint8) * 255
    with pytest.raises(InputError, match="seems to hold binary frames that a codec changed"):
        VideoSource(VideoConfig(path=write_video(bits, "bits.avi", codec, pixels)), SourceContext())
    noisy = moving(12) // 2 + np.random.default_rng(0).integers(0, 128, moving(12).shape, np.uint8)
    VideoSource(VideoConfig(path=write_video(noisy, "grey.avi", codec, pixels)), SourceContext()).close()


def test_binary_frames_are_no_grey_levels(tmp_path: Path) -> None:
    """The line of the message saves them."""
    frames = np.random.default_rng(0).random((12, 16, 24)) < 0.5
    folder = tmp_path / "frames"
    folder.mkdir()
    for number, frame in enumerate(frames):
        cv2.imwrite(str(folder / f"{number}.png"), frame.astype(np.uint8) * 255)
    with pytest.raises(InputError, match="holds binary frames, of 0 and 255 only") as caught:
        ImageFolderSource(ImageFolderConfig(path=folder))
    line = str(caught.value).partition("packed-npy: ")[2]
    with contextlib.chdir(tmp_path):
        exec(line, {"numpy": np, "cv2": cv2, "pathlib": pathlib})
    np.testing.assert_array_equal(np.unpackbits(np.load(tmp_path / "cube.npy"), axis=-1), frames)
