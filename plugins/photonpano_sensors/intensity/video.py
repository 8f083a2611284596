"""Source `video`: grey frames of a video file, each decoded as rarely as possible.

An index of the frames is made from the packets of the video, without decoding them.
"""

from __future__ import annotations

import logging
import re
from collections import OrderedDict
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from itertools import chain
from pathlib import Path
from threading import Lock

import av
import numpy as np
from av import VideoFrame
from av.container import InputContainer
from av.video.format import VideoFormat
from numpy.typing import NDArray

from photonpano import FrameSpan, InputError, SourceContext
from photonpano.reading import missing_file, reading
from photonpano_sensors.intensity.contributions import VideoConfig, refuse_mdat
from photonpano_sensors.intensity.source import Encoding, IntensitySource, Levels

logger = logging.getLogger("photonpano.video")
_KEPT_BYTES = 256 * 1024**2  # size of the cache of decoded frames


class VideoSource(IntensitySource):
    """Frames of a video in the order in which they are shown; of colours, the luma."""

    def __init__(self, config: VideoConfig, context: SourceContext) -> None:
        index = index_of(config.path)
        super().__init__(config, (len(index.times), index.height, index.width), index.frame_rate_hz, index.encoding)
        self.decoded = DecodedFrames(index, context.threads, _KEPT_BYTES)
        self.refuse_binary(
            config.path, f'[each.to_ndarray(format="gray") for each in av.open("{config.path}").decode(video=0)]'
        )

    def close(self) -> None:
        """Close the file."""
        self.decoded.close()

    def _read(self, span: FrameSpan, levels: Levels) -> None:
        for target, frame in zip(levels, range(span.start, span.stop), strict=True):
            target[...] = self.decoded[frame]


class _Decoder:
    """Decodes a video from a key frame on: the frame `next`, in the thread that has the lock `turn`; `users` want it."""

    def __init__(self, index: VideoIndex, threads: int) -> None:
        self._index = index
        self._container = open_video(index.path)
        self._stream = self._container.streams.video[0]
        self._stream.codec_context.thread_type = "AUTO"
        self._stream.codec_context.thread_count = threads
        self._frames: Iterator[VideoFrame] = self._container.decode(self._stream)
        self._seeks = False
        self.next = 0
        self.turn = Lock()
        self.users = 0

    def begin_before(self, frame: int) -> None:
        """Make the key frame before a frame the next one; the next call of `decode` seeks to it."""
        self.next, self._seeks = self._index.key_before(frame), True

    def decode(self) -> tuple[int, Levels]:
        """Decode the next frame: its index and its levels; raises an `InputError` if it is damaged or missing."""
        due = self.next
        try:
            if self._seeks:
                self._seek(due)
            frame = next((frame for frame in self._frames if self._place(frame) >= due), None)
        except (av.FFmpegError, ValueError, TypeError, AttributeError):  # PyAV does not expect all that a file can hold
            frame = None
        if frame is None or frame.is_corrupt or self._place(frame) > due:
            self.next = len(self._index.times)  # the next call has to seek
            raise InputError(f"frame {due} of {self._index.path} is damaged or missing; export or copy it again")
        self.next = due + 1
        return due, _luma(frame, self._index)

    def close(self) -> None:
        self._container.close()

    def _seek(self, key: int) -> None:
        self._seeks = False
        # If the index of the file is coarse or wrong, seeking may end behind the key frame.
        for start in (key, 0):
            self._container.seek(int(self._index.times[start]), stream=self._stream)
            self._frames = self._container.decode(self._stream)
            first = next(self._frames, None)
            if first is not None and self._place(first) <= key:
                self._frames = chain([first], self._frames)
                return

    def _place(self, frame: VideoFrame) -> int:
        """Return the index of a frame; -1 if its time is missing or not in the index."""
        times = self._index.times
        place = len(times) if frame.pts is None else int(np.searchsorted(times, frame.pts))
        return place if place < len(times) and times[place] == frame.pts else -1


class DecodedFrames:
    """The frames of a video, of which the last decoded ones are cached. Safe from several threads.

    Groups overlap, and the threads that merge them move along the video together, so they share a cache. A thread that needs a
    further frame takes the decoder that reaches it next, and waits if another thread uses it. If no decoder reaches the frame,
    an idle one seeks to a key frame.
    """

    def __init__(self, index: VideoIndex, threads: int, capacity_bytes: int) -> None:
        """Take the number of threads that read frames at once, and the size of the cache."""
        self._index = index
        self._threads = threads
        self._kept = max(1, capacity_bytes // (index.height * index.width * (1 if index.encoding.bits <= 8 else 2)))
        self._frames: OrderedDict[int, Levels] = OrderedDict()
        self._decoders: list[_Decoder] = []
        self._lock = Lock()
        self.n_decoded = 0

    def __getitem__(self, frame: int) -> Levels:
        """Return a frame, (H, W), read-only; raises an `InputError` if it is damaged or missing."""
        while True:
            with self._lock:
                if (known := self._known(frame)) is not None:
                    return known
                decoder = self._decoder_for(frame)
                decoder.users += 1
            try:
                with decoder.turn:
                    levels = self._decoded(decoder, frame)
            finally:
                with self._lock:
                    decoder.users -= 1
            if levels is not None:
                return levels

    def close(self) -> None:
        """Close the file."""
        for decoder in self._decoders:
            decoder.close()

    def _decoded(self, decoder: _Decoder, frame: int) -> Levels | None:
        """Decode up to a frame; None if another thread has decoded it with this decoder, and it has left the cache."""
        while decoder.next <= frame:
            place, levels = decoder.decode()
            with self._lock:
                self.n_decoded += 1
                self._frames[place] = levels
                self._frames.move_to_end(place)
                while len(self._frames) > self._kept:
                    self._frames.popitem(last=False)
            if place == frame:
                return levels
        with self._lock:
            return self._known(frame)

    def _decoder_for(self, frame: int) -> _Decoder:
        """Return the decoder that reaches a frame next, or one that seeks to the key frame before it."""
        key = self._index.key_before(frame)
        coming = [decoder for decoder in self._decoders if key <= decoder.next <= frame]
        idle = [decoder for decoder in self._decoders if not decoder.users]
        if coming:
            chosen = max(coming, key=lambda decoder: decoder.next)
        elif idle and len(self._decoders) >= self._threads:
            chosen = idle[0]
            chosen.begin_before(frame)
        else:
            chosen = _Decoder(self._index, self._threads)
            chosen.begin_before(frame)
        # The least recently used decoder comes first.
        self._decoders = [decoder for decoder in self._decoders if decoder is not chosen] + [chosen]
        return chosen

    def _known(self, frame: int) -> Levels | None:
        known = self._frames.get(frame)
        if known is not None:
            self._frames.move_to_end(frame)
        return known


def _luma(frame: VideoFrame, index: VideoIndex) -> Levels:
    """Return the levels of a frame: (H, W), a copy."""
    if (frame.height, frame.width) != (index.height, index.width):
        raise InputError(
            f"{index.path} changes from {index.height}x{index.width} to {frame.height}x{frame.width} pixels; "
            "export it with frames of one size"
        )
    if frame.format.name != index.pixel_format:
        frame = frame.reformat(format=index.pixel_format)
    plane = frame.planes[0]
    dtype = np.dtype("u1" if index.encoding.bits <= 8 else "<u2")
    rows = np.frombuffer(memoryview(plane), dtype).reshape(-1, plane.line_size // dtype.itemsize)
    levels: Levels = rows[: index.height, : index.width].copy()
    levels.flags.writeable = False
    return levels


_LUMA_FIRST = re.compile(r"(gray|yuvj?a?4\d\dp|nv\d\d)(\d+le)?")  # pixel formats whose first plane is the luma
_FULL_RANGE = re.compile(r"yuvj|gray")
_DAMAGED = "is damaged: FFmpeg finds contradictions in it; export or copy it again"
# FFmpeg's colour range in which all levels are used
_JPEG_RANGE = 2


@dataclass(frozen=True, slots=True, eq=False, kw_only=True)
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
        tick_s = float(stream.time_base or 0)
        step_s = _step_s(path, times[order] * tick_s, tick_s)
        lasts_s = (container.duration or 0) / av.time_base if "matroska" in container.format.name else 0.0
        if len(container.streams) == 1 and times.max() * tick_s + 2 * step_s < lasts_s:  # sound may be longer than pictures
            ends = f"its frames end after {times.max() * tick_s:.3g} s"
            raise InputError(f"{path} is cut short: it promises {lasts_s:.3g} s, and {ends}; export or copy it again")
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
        rate = float(stream.average_rate or 0)
        # Where the header does not say the rate, FFmpeg takes the clock of the file for it.
        if rate and step_s and not 0.5 < rate * step_s < 2:
            rate = 1 / step_s
        return VideoIndex(
            path=path,
            times=times[order].astype(np.int64),
            keys=keys,
            height=context.height,
            width=context.width,
            pixel_format=pixel_format,
            encoding=encoding,
            frame_rate_hz=rate or None,
        )


def _step_s(path: Path, times_s: NDArray[np.float64], tick_s: float) -> float:
    """Return the time from frame to frame, 0 if it is not known; gaps are a warning."""
    steps = np.diff(times_s)
    if not len(steps):
        return 0.0
    gaps = steps > 1.5 * np.median(steps) + tick_s
    step_s = float(steps[~gaps].mean())
    if gaps.any():
        first = int(np.argmax(gaps))
        logger.warning(
            f"{path}: times of frames have gaps, {gaps.sum()} in all: {1000 * steps[first]:.3g} ms after frame {first}, and "
            f"{1000 * step_s:.3g} ms elsewhere; frames may be missing there"
        )
    return step_s


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
