"""Source `video`: grey frames of a video file."""

from __future__ import annotations

from photonpano import FrameSpan, SourceContext
from photonpano_sensors.intensity.configs import VideoConfig
from photonpano_sensors.intensity.decoding import DecodedFrames
from photonpano_sensors.intensity.source import IntensitySource
from photonpano_sensors.intensity.summing import Levels
from photonpano_sensors.intensity.video_index import index_of

_KEPT_BYTES = 256 * 1024**2
"""Size of the cache of decoded frames."""


class VideoSource(IntensitySource):
    """Frames of a video in the order in which they are shown; of colours, the luma.

    Raises:
        InputError: the file is missing, is not a video, or ends early.
    """

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
