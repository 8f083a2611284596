"""Frames of a video, decoded as rarely as can be."""

from __future__ import annotations

from collections import OrderedDict
from itertools import chain
from threading import Lock
from typing import TYPE_CHECKING

import av
import numpy as np

from photonpano import InputError
from photonpano_sensors.intensity.video_index import open_video

if TYPE_CHECKING:
    from collections.abc import Iterator

    from av import VideoFrame

    from photonpano_sensors.intensity.summing import Levels
    from photonpano_sensors.intensity.video_index import VideoIndex

_SEEK = 4
"""To seek costs about as much as to decode so many frames."""


class Decoder:
    """Decodes a video from a key frame on: one thread at a time."""

    def __init__(self, index: VideoIndex, threads: int) -> None:
        """Open the video for itself.

        Raises:
            InputError: it is no longer there.
        """
        self._index = index
        self._container = open_video(index.path)
        self._stream = self._container.streams.video[0]
        self._stream.codec_context.thread_type = "AUTO"
        self._stream.codec_context.thread_count = threads
        self._frames: Iterator[VideoFrame] = self._container.decode(self._stream)
        self.next = 0

    def cost(self, frame: int) -> int:
        """Return how many frames have to be decoded to get at one; seeking costs something too."""
        key = self._index.key_before(frame)
        return frame - self.next if key <= self.next <= frame else frame - key + _SEEK

    def seek(self, frame: int) -> None:
        """Go to the key frame before a frame, unless decoding on comes to it as well."""
        key = self._index.key_before(frame)
        if key <= self.next <= frame:
            return
        # An index may be so coarse, or so wrong, that seeking leads past the key frame.
        for start in (key, 0):
            self._container.seek(int(self._index.times[start]), stream=self._stream)
            self._frames = self._container.decode(self._stream)
            first = next(self._frames, None)
            if first is not None and self._place(first) <= key:
                self._frames = chain([first], self._frames)
                break
        self.next = key

    def decode(self) -> tuple[int, Levels]:
        """Decode the next frame, and return its place and its levels.

        Raises:
            InputError: it is damaged or missing.
        """
        due = self.next
        try:
            frame = next((frame for frame in self._frames if self._place(frame) >= due), None)
        except av.FFmpegError:
            frame = None
        if frame is None or frame.is_corrupt or self._place(frame) > due:
            self.next = len(self._index.times)  # whoever comes next has to seek
            raise InputError(f"frame {due} of {self._index.path} is damaged or missing; export or copy it again")
        self.next = due + 1
        return due, _luma(frame, self._index)

    def close(self) -> None:
        """Let go of the file."""
        self._container.close()

    def _place(self, frame: VideoFrame) -> int:
        """Return which frame it is; -1 if it does not say, or is none of the index."""
        times = self._index.times
        place = len(times) if frame.pts is None else int(np.searchsorted(times, frame.pts))
        return place if place < len(times) and times[place] == frame.pts else -1


class DecodedFrames:
    """The frames of a video, those decoded last kept up to a number of bytes. May be used from several threads.

    Groups overlap, and the threads that merge them go along the video side by side: a decoder for each goes on where it is, and
    what one has decoded the others find here. A frame is decoded by the decoder that is nearest before it, even if that is
    at work for somebody else, who will soon be done.
    """

    def __init__(self, index: VideoIndex, threads: int, capacity_bytes: int) -> None:
        """Prepare to decode.

        Args:
            index: of the video.
            threads: how many ask for frames at once.
            capacity_bytes: how much is kept.
        """
        self._index = index
        self._threads = threads
        self._kept = max(1, capacity_bytes // (index.height * index.width * (1 if index.encoding.bits <= 8 else 2)))
        self._frames: OrderedDict[int, Levels] = OrderedDict()
        self._decoders: list[tuple[Decoder, Lock]] = []
        self._lock = Lock()
        self.n_decoded = 0

    def __getitem__(self, frame: int) -> Levels:
        """Return a frame, (H, W), which is not to be written to.

        Raises:
            InputError: it is damaged or missing.
        """
        with self._lock:
            if (known := self._known(frame)) is not None:
                return known
            decoder, turn = self._nearest(frame)
        with turn:
            with self._lock:
                # Whoever had the decoder before may have come by.
                if (known := self._known(frame)) is not None:
                    return known
            decoder.seek(frame)
            while True:
                place, levels = decoder.decode()
                with self._lock:
                    self.n_decoded += 1
                    self._keep(place, levels)
                if place == frame:
                    return levels

    def close(self) -> None:
        """Let go of the file."""
        for decoder, _ in self._decoders:
            decoder.close()

    def _known(self, frame: int) -> Levels | None:
        known = self._frames.get(frame)
        if known is not None:
            self._frames.move_to_end(frame)
        return known

    def _keep(self, frame: int, levels: Levels) -> None:
        self._frames[frame] = levels
        self._frames.move_to_end(frame)
        while len(self._frames) > self._kept:
            self._frames.popitem(last=False)

    def _nearest(self, frame: int) -> tuple[Decoder, Lock]:
        """Return the decoder that gets at a frame soonest; where all have to seek, the one that was longest without work."""
        best = min(self._decoders, key=lambda each: each[0].cost(frame), default=None)
        from_key = frame - self._index.key_before(frame) + _SEEK
        if (best is None or best[0].cost(frame) >= from_key) and len(self._decoders) < self._threads:
            best = Decoder(self._index, self._threads), Lock()
        assert best is not None
        self._decoders = [each for each in self._decoders if each is not best] + [best]
        return best


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
