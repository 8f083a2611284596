"""Source `video`: grey frames of a video file, each decoded as rarely as possible."""

from __future__ import annotations

from collections import OrderedDict
from collections.abc import Iterator
from itertools import chain
from threading import Lock

import av
import numpy as np
from av import VideoFrame

from photonpano import FrameSpan, InputError, SourceContext
from photonpano_sensors.intensity.contributions import VideoConfig
from photonpano_sensors.intensity.source import IntensitySource, Levels
from photonpano_sensors.intensity.video_index import VideoIndex, index_of, open_video

_KEPT_BYTES = 256 * 1024**2  # size of the cache of decoded frames


class VideoSource(IntensitySource):
    """Frames of a video in the order in which they are shown; of colours, the luma."""

    def __init__(self, config: VideoConfig, context: SourceContext) -> None:
        index = index_of(config.path)
        super().__init__(config, (len(index.times), index.height, index.width), index.frame_rate_hz, index.encoding)
        self.decoded = DecodedFrames(index, context.threads, _KEPT_BYTES)

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
