"""List the frames of a video from its packets, without decoding them."""

from __future__ import annotations

import re
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path

import av
import numpy as np
from av.container import InputContainer
from av.video.format import VideoFormat
from numpy.typing import NDArray

from photonpano import InputError
from photonpano.reading import missing_file, reading
from photonpano_sensors.intensity.contributions import refuse_mdat
from photonpano_sensors.intensity.source import Encoding

_LUMA_FIRST = re.compile(r"(gray|yuvj?a?4\d\dp|nv\d\d)(\d+le)?")  # pixel formats whose first plane is the luma
_FULL_RANGE = re.compile(r"yuvj|gray")
_DAMAGED = "is damaged: FFmpeg finds contradictions in it; export or copy it again"
# FFmpeg's colour range in which all levels are used
_JPEG_RANGE = 2


@dataclass(frozen=True, slots=True, eq=False)
class VideoIndex:
    """The frames of a video, from its packets."""

    path: Path
    times: NDArray[np.int64]  # (n,) time of each frame, in units of the stream, increasing
    keys: NDArray[np.int64]  # (k,) frames at which decoding can start; the first is 0
    height: int
    width: int
    pixel_format: str  # format that frames are converted to; its first plane is the luma
    encoding: Encoding  # encoding of the luma
    frame_rate_hz: float | None  # frame rate at which the video is played

    def key_before(self, frame: int) -> int:
        """Return the key frame at which decoding has to start for a frame."""
        return int(self.keys[np.searchsorted(self.keys, frame, side="right") - 1])


def index_of(path: Path) -> VideoIndex:
    """Read the packets of the first video stream of a file; raises an `InputError` if it is no video, or ends early."""
    refuse_mdat(path)
    with reading(path, _DAMAGED), opened(path) as container:
        stream = container.streams.video[0]
        context = stream.codec_context
        try:
            # An empty packet ends the stream; discarded ones are of frames that were cut. None is kept: they hold the film.
            found = [
                (packet.dts if packet.pts is None else packet.pts, packet.is_keyframe)
                for packet in container.demux(stream)
                if packet.size and not packet.is_discard
            ]
        except av.FFmpegError as error:
            raise InputError(f"{path} is damaged: {error.strerror}; export or copy it again") from error
        times = np.array([time for time, _ in found], dtype=np.float64)
        if not len(times):
            raise InputError(f"{path} has no frames; export or copy it again")
        if np.isnan(times).any() or len(np.unique(times)) < len(times):
            raise InputError(f"{path} lacks the times of its frames; export it again, as MP4 or AVI")
        if len(times) < stream.frames:
            raise InputError(
                f"{path} is cut short: it promises {stream.frames} frames and holds {len(times)}; export or copy it again"
            )
        order = np.argsort(times)
        keys = np.flatnonzero(np.array([key for _, key in found])[order])
        if not len(keys) or keys[0]:
            raise InputError(f"{path} does not begin with a frame that stands alone; export it again")
        if context.format is None or not context.width * context.height:
            raise InputError(f"{path}: the size of its frames is missing; export it again")
        pixel_format = _pixel_format(context.format)
        depth = re.search(r"(?:p|gray)(\d+)le", pixel_format)
        bits = int(depth[1]) if depth else 8
        encoding = Encoding(bits, 16.0 * 2 ** (bits - 8), 235.0 * 2 ** (bits - 8))
        if context.color_range == _JPEG_RANGE or _FULL_RANGE.match(pixel_format):
            encoding = Encoding.full(bits)
        rate = stream.average_rate
        return VideoIndex(
            path,
            times[order].astype(np.int64),
            keys,
            context.height,
            context.width,
            pixel_format,
            encoding,
            float(rate) if rate else None,
        )


@contextmanager
def opened(path: Path) -> Iterator[InputContainer]:
    """Open a video within a block: see `open_video`."""
    container = open_video(path)
    try:
        yield container
    finally:
        container.close()


def open_video(path: Path) -> InputContainer:
    """Open a file; raises an `InputError` if it is missing, or has no video stream."""
    try:
        container = av.open(str(path), metadata_errors="replace")
    except FileNotFoundError as error:
        raise InputError(missing_file(path)) from error
    except IsADirectoryError as error:
        raise InputError(f"{path} is a folder; name the video in it, or read pictures with the source image-folder") from error
    except (av.FFmpegError, OSError) as error:
        raise InputError(
            f"{path} is not a video that FFmpeg reads, or its end is missing ({error.strerror}); export or copy it again"
        ) from error
    if not container.streams.video:
        container.close()
        raise InputError(f"{path} holds no pictures; name a video")
    return container


def _pixel_format(stored: VideoFormat) -> str:
    """Return the format that frames are converted to: their own if its first plane is the luma."""
    if _LUMA_FIRST.fullmatch(stored.name):
        return stored.name
    if "yuv" in stored.name or "yvu" in stored.name or "uyv" in stored.name:
        # Luma and colours alternate: converted to planes, the levels stay as they are.
        return "yuv422p"
    return "gray16le" if stored.components[0].bits > 8 else "gray"
